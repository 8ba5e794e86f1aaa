"""What flies the spacecraft, besides trained agents."""
