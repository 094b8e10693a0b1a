"""Sinks of live tracking, one file each; ``live.spec`` lists them."""
