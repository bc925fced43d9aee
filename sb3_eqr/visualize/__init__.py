"""Seeing what an agent has learned: diagnostics, pictures, animations. Needs ``pip install sb3-eqr[visualize]``."""
