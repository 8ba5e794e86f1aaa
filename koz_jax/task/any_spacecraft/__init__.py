"""What it takes that one policy flies any spacecraft: units and axes of its own, and spacecraft drawn at random."""
