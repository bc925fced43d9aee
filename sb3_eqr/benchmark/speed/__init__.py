"""
What everything costs, measured in turns within one process: ``python -m sb3_eqr.benchmark.speed`` (docs/results/speed.md).

``floor`` is what a step cannot do without, ``workload`` the agents and frames, ``clock`` takes turns and ``stopwatch`` times
methods from outside; ``steps``, ``play``, ``replay_sizes`` and ``model_sizes`` measure, ``tables`` and ``plot`` show.
"""
