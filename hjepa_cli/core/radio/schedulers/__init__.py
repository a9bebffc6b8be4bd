"""Schedulers say who sends in a slot: one file for each."""
