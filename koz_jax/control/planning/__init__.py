"""Planners: search a way around the zones before the maneuver, time it, and track it."""
