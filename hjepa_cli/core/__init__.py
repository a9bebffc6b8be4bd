"""The shared core: plant, camera, models, channel, control loop and metrics; one idea per file."""
