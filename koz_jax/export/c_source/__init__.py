"""What becomes of a controller, and of its shield, as C99 source: the text that fills the templates."""
