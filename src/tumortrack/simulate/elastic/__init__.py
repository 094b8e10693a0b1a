"""Elastic deformations of one organ: finite elements once, a small reduced model for every scene.

``body.build_body`` makes a ``Body``: displacement modes of the organ and a library of states that
it took under random loads. See docs/method.md, section "Elastic deformations".
"""
