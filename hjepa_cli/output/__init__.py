"""People see the screen, tables, figures and films."""
