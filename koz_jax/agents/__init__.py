"""Trained agents: loading, asking, saving; the shipped ones."""
