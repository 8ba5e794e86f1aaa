"""The interactive 3-D page of maneuvers; opens offline."""
