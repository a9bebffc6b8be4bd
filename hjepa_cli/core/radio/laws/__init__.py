"""Laws share one radio cell among devices: one file per law, each with one object."""
