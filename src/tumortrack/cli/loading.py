"""PyTorch and its kin make objects by the hundred thousand that live to the end of the process."""

from __future__ import annotations

import gc
import os
import sys
from typing import NoReturn


def keep_loaded() -> None:
    """Called when all that a command needs is loaded: the garbage collector looks no more through
    what there is by now, neither while frames wait nor, for half a second, when all ends.

    Not after modules that nanobind made (manifold3d, ur_analytic_ik): these tell of leaks if they
    are not collected in the end.
    """
    gc.freeze()


def leave() -> NoReturn:
    """End the process at once, all being written: to take apart what was loaded, object by object,
    takes a fifth of a second. What is registered for the end of Python is not called."""
    if sys.stderr is not None:  # as after 2>&-
        sys.stderr.flush()
    os._exit(0)
