"""What lies on disk: datasets, checkpoints, run directories, the model zoo."""
