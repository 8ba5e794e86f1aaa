"""Safety filters of others, as alternatives to the shield, and the one place that makes any of them from settings."""
