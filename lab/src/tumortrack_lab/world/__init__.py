"""A wider world: scenes to calibrate and test margins on, made by other physics, other noise and
other views than training's, with which they share no code.

``families``: eight families of states (rest, plate, clamp, twist, pull, tether, roll, cut), each
state one random draw of tissue, bed and load; ``organ`` and ``forces``: what they act on, and how;
``segmentation``: how the true organ differs from the case; ``noise``: another stereo camera;
``views``: directions, hands, instruments, fat, and the organ found as tracking finds it;
``scenes``: all of it by number. A scene is one state, seen once. ``lab/scripts/world.py`` (`make
world`) writes and measures them.

``paths``: organs on the move; ``films``: what cameras see of them, and the truth; ``following``:
how followers do. ``lab/scripts/sequences.py`` (`make sequences`).

The solid and its solver are the twin's (``twin.solid``, ``twin.equilibrium``). What is still
missing: vessels, fat and neighbours as bodies of their own, blood and perfusion, hands that touch
the organ they hide (what deforms it is mostly not in the picture), motion within a frame.
"""
