"""The networks that read frames, predict and act, and a model that holds them."""
