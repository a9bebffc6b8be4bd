"""Settings are declared here, read from where they come from, and checked."""
