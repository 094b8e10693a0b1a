"""The study behind docs/results.md: what is measured, kept, tabulated and drawn."""
