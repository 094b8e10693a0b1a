"""A head start for every patient: one network taught on random kidneys."""
