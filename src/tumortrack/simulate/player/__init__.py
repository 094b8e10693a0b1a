"""An operating room in motion: an organ that breathes and is pushed on its table, before a camera.

``stage.Theatre`` is a function of time: the same seed and time give the same state, depth image
and true surfaces.
"""
