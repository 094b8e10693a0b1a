"""A soak test: an hour of tracking with injected faults, and the judge of its estimates."""
