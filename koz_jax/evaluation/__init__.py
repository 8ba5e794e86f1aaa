"""Flying cases and judging them."""
