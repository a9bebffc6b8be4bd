"""Recorded trajectories: made by simulation, kept on disk, handed on in other formats."""
