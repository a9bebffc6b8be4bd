"""One module per subcommand; each reads top-down as the story of its stage."""
