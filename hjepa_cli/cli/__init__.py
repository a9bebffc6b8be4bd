"""The command line has flags and help, and surrounds every command."""
