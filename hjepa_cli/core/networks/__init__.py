"""Networks read frames, predict and act; a model holds them."""
