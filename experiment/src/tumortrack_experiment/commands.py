"""The experiment's commands: `tumortrack` finds them by its entry points' names."""
