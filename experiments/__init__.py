"""Measurements of the code itself, which are not in the wheel: run them from the root of the repository."""
