"""Settings shared by all tests: the same examples on every machine."""

import os
import signal

from hypothesis import settings

# Where a process per core runs tests (make test), each computes in one thread, and so does what it
# starts: more threads than cores wait for each other.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"

# A shell's background jobs ignore Ctrl-C, those of nohup the end of the terminal, and so would
# every process that a test starts.
for number, handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

# Derandomised: a failure on one machine is a failure on all. No deadline: machines are shared.
settings.register_profile("hjepa", derandomize=True, deadline=None, max_examples=50, database=None)
settings.load_profile("hjepa")
