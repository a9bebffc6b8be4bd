"""``python -m hjepa_cli`` is the same program as ``hjepa``."""

from hjepa_cli.cli.app import main

if __name__ == "__main__":
    main()
