"""Settings as command line flags, and those that commands share."""
