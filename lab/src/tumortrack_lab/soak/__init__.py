"""Tracking for an hour while everything round it goes wrong: faults, and who judges the answers."""
