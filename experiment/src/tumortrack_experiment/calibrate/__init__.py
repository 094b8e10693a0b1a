"""Calibrations, each with the error that it leaves: of a camera, and of its place on a robot."""
