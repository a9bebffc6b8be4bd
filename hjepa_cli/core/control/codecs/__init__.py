"""Codecs turn an embedding into bits; each family has a file, and the registry lists them."""
