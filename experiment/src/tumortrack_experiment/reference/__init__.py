"""A second CT of the phantom, of one deformed state, as the truth of its depth images."""
