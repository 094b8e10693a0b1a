"""How far off a camera's depths may be: by what is known of it, and by the size that they show.

All depths of a camera may err alike, by a constant and a share. No fit sees that but by the organ's
size: what is seen too near looks too small. Places are left as they were measured; their
uncertainty contains both.
"""

from __future__ import annotations

import numpy as np

from tumortrack.core.report import SizeFit
from tumortrack.core.types import DepthError

# Of a camera of which nothing is stated: mostly as its maker calibrates it (a D405's data sheets
# say 1.4 % and 2 %), else as the one D405 that others measured (-1.3 % and -5 mm). Shares assumed.
_UNSTATED = (0.8, DepthError(2.0, 0.01)), (0.2, DepthError(5.0, 0.02))


def depth_share(size: SizeFit, depth_mm: float, stated: DepthError | None) -> float:
    """Root mean square error of depths, as a share of them: the posterior's, by the apparent size,
    about the depths as measured. ``depth_mm``: of the organ."""
    known = _UNSTATED if stated is None else ((1.0, stated),)
    chances, off = np.array([chance for chance, _ in known]), size.times - 1
    prior = np.array([error.share(depth_mm) for _, error in known]) ** 2
    both = prior + size.std**2
    share = prior / both
    logs = np.log(chances / np.sqrt(both)) - off**2 / both / 2
    weights = np.exp(logs - logs.max())  # one of them is 1, however far off the size is
    return float(np.sqrt(np.average((share * off) ** 2 + share * size.std**2, weights=weights)))
