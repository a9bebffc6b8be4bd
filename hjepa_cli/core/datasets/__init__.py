"""Trajectories are simulated, kept on disk, and handed on in other formats."""
