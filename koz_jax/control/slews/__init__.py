"""Planning by a choice among a few slews."""
