"""Settings shared by all tests: the same examples on every machine, and no window system."""

import os

from hypothesis import settings

os.environ.setdefault("MPLBACKEND", "Agg")

# Derandomised: a failure on one machine is a failure on all. No deadline: machines are shared.
settings.register_profile("hjepa", derandomize=True, deadline=None, max_examples=50, database=None)
settings.load_profile("hjepa")
