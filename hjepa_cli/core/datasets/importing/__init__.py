"""Recordings of other programs become trajectories: a file per format, then what all share."""
