"""The studies behind docs/results.md and others: measurements, tables, pictures."""
