"""The core holds plants, networks, radio, control loop and metrics; one idea per file."""
