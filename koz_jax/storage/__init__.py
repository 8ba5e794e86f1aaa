"""Files, archives, locks and processes: the host's side of what lasts."""
