"""
Networks: ``layers`` has what PyTorch does not have, ``encoders`` turn observations into group elements, ``q_networks`` these
into values of actions.
"""
