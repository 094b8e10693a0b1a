"""A source and a sink for tumortrack, as another package would bring them."""
