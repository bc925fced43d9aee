"""Measuring EqR: ``python -m sb3_eqr.benchmark.speed`` prints what a step costs, ``reference`` holds published scores."""
