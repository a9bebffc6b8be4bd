"""Each subcommand has a module, which reads top-down as the story of its stage."""
