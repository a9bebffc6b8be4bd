"""hjepa: semantic predictive control over wireless links with a hierarchical JEPA."""

__version__ = "0.1.0"
