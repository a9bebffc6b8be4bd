"""``--dry-run``: what a command would read, do and write, and about how long it would take.

Sizes follow from the settings; times from rates measured on two cores (``benchmarks/``), so they
are right within a factor of two or three on other machines. Nothing is written here.
"""

import dataclasses
from pathlib import Path
from typing import Any

from hjepa_cli.screen import Screen
from hjepa_cli.settings import Settings

NOTHING = "nothing"
