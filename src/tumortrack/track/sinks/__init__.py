"""Sinks of the live loop: one file per kind.

A sink's configuration is what the command line writes as ``kind:target?key=value``; its ``open``
makes the sink (``track.live.Sink``). To add one: write its file, add its configuration to the
union.
"""
