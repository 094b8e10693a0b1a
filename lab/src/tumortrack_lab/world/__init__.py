"""A wider world: scenes to calibrate and test bounds on, with other physics, other noise and other
views than the default method's own simulation, with which they share no code.

``families``: eight families of states (rest, plate, clamp, twist, pull, tether, roll, cut), each
state one random draw of tissue, bed and load; ``organ`` and ``forces``: the mechanics;
``segmentation``: how the true organ differs from the case; ``noise``: another stereo camera;
``views``: directions, hands, instruments, fat, and the organ as tracking finds it; ``scenes``: all
of it by number. A scene is one view of one state. ``lab/scripts/world.py`` (`make
world`) writes and measures them.

``paths``: moving organs; ``films``: depth images of them, and the truth; ``following``: how
followers do. ``lab/scripts/sequences.py`` (`make sequences`).

The solid and its solver are the twin's (``twin.solid``, ``twin.equilibrium``). What is still
missing: vessels, fat and neighbours as bodies of their own, blood and perfusion, hands that touch
the organ they hide (what deforms it is mostly not in the picture), motion within a frame.
"""
