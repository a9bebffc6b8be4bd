"""Datasets, checkpoints, run directories and the model zoo lie on disk."""
