"""Settings shared by all tests: the same examples on every machine."""

import signal

from hypothesis import settings

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
