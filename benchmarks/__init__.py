"""What is measured about the code itself, outside the wheel: run from the root of the repository."""
