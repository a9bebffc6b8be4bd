"""A physical layer says what a slot of the band carries, how surely and how fast."""
