"""A radio cell has links, codes, schedulers and laws of sharing."""
