"""Methods drive devices; each family has a file, and the registry lists them."""
