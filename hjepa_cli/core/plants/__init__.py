"""Plants are what is controlled; each has a teacher and a camera."""
