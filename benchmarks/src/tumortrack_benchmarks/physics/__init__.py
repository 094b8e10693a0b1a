"""Scenes of a wider world, to calibrate and test bounds on: other physics, noise and views than the
default method's own simulation, with which they share no code; and the digital twin.

``tets``, ``solid``, ``equilibrium``, ``forces``, ``organ``: finite elements. ``families``: eight
families of states, each one random draw of tissue, bed and load; ``twin``: the states of the
paper's bench, and `tumortrack twin`. ``segmentation``: how the true organ differs from the case;
``noise``: another stereo camera; ``views``: directions, hands, instruments, fat, and the organ as
tracking finds it; ``scenes``: all of it by number (`make stress`); ``evidence``: drawn from a
scene's truth. ``cut``: a plan cuts the true organ.

What is still missing: vessels, fat and neighbours as bodies of their own, blood and perfusion,
hands that touch the organ they hide (what deforms it is mostly not in the picture), motion within a
frame.
"""
