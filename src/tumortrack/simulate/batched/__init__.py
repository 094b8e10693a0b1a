"""Scenes made many at once, as tensors on a device: the values of ``simulate.dataset``.

Chance stays on the host, scene by scene (``plan``), so that a recipe is the same scene however it
is made. What is done for every vertex, pixel and point runs batched (``motion``, ``raster``,
``sampling``). The compiled scenes of ``simulate.scene`` are the reference.
"""
