"""States have bounds in every loop, of plants, filters and oracles alike."""

STATE_LIMIT = 50.0  # states are clipped here instead of ending a run: a fallen pole keeps falling
