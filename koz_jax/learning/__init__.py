"""What learns: curriculum, training step, refinement."""
