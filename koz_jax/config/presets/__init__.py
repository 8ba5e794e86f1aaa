"""Named training configurations, and their sizes on a GPU."""
