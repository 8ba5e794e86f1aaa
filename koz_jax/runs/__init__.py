"""The host's side of a training run."""
