"""Speed on this machine: every part beside the naive form of it, in turns, in one run."""
