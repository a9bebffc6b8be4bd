"""The closed loop is what devices send and what a controller makes of it."""
