"""Error bounds: learned from random kidneys, and their factor on a user's scenes."""
