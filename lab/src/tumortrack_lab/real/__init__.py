"""Organs and deformations that nature made, from the user's own copies of public data."""
