"""Evaluation measures closed loops, and counts what follows for a cell."""
