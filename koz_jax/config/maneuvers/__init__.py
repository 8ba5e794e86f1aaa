"""Settings of one maneuver as a person writes it, and the files that hold them."""
