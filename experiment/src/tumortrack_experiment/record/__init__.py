"""Recording an experiment, state by state, into one MCAP; and reading it again."""
