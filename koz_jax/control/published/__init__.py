"""Classical controllers as their papers have them, with the papers' gains."""
