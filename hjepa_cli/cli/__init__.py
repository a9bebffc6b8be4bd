"""The command line: flags, help and what surrounds every command."""
