"""What is measured of closed loops, and what follows for a cell."""
