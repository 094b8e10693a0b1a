"""Tools whose tip touches, holds or sweeps the organ, and outlines that are drawn."""
