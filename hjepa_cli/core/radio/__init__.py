"""The radio cell: links, codes, schedulers and laws of sharing."""
