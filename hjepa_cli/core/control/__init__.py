"""The closed loop: what devices send, and what a controller makes of it."""
