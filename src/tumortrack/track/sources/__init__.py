"""Sources of the live loop: one file per kind.

A source's configuration is what the command line writes as ``kind:target?key=value``; its
``open`` makes the source (``track.live.Source``). To add one: write its file, add its
configuration to the union.
"""
