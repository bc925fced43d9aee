"""
Saving and resuming: ``files`` writes files that are complete or absent, ``plain_data`` turns Python values into JSON and back,
``models``, ``buffers``, ``env_state`` and ``checkpoints`` use both, ``transfer`` loads the representation of another agent.
"""
