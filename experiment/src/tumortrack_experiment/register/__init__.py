"""One frame to another by the beads of a kit's base."""
