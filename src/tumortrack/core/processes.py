"""One program as several processes, as torchrun starts them."""

from __future__ import annotations

import os


def is_follower() -> bool:
    """Whether torchrun started this process as another than the first, which alone reports."""
    return "TORCHELASTIC_RUN_ID" in os.environ and os.environ.get("RANK", "0") != "0"
