"""How fast the default method, the commands and the planner are on this machine."""
