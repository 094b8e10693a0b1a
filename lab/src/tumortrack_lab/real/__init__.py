"""Real organs and real deformations, from the user's own copies of public data."""
