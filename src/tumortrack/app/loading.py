"""PyTorch and its kin make objects by the hundred thousand that live to the end of the process."""

from __future__ import annotations

import gc


def keep_loaded() -> None:
    """Called when all that a command needs is loaded: the garbage collector looks no more through
    what there is by now, neither while frames wait nor, for half a second, when all ends.

    Not after modules that nanobind made (manifold3d, ur_analytic_ik): these tell of leaks if they
    are not collected in the end.
    """
    gc.freeze()
