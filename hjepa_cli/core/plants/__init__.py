"""What is controlled: plants, their teachers and cameras, and what they do over time."""
