"""What a research repository would have: the same answers, in the plain way."""
