"""tumortrack: an organ and its tumors, located from one depth image of one side.

    import tumortrack as tt
    estimate = tt.locate("CASE", tt.read_cloud("cloud.ply"))

Millimetres everywhere; a transform is named ``b_from_a``. See docs/conventions.md. Each name is
loaded when it is first used: importing this package imports no heavy library.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tumortrack.api import *  # noqa: F403
    from tumortrack.assessment.advice import advise as advise
    from tumortrack.core import errors as errors
    from tumortrack.core.estimate import Estimate as Estimate
    from tumortrack.core.evidence import Cut as Cut
    from tumortrack.core.evidence import FreeSpace as FreeSpace
    from tumortrack.core.evidence import Grasp as Grasp
    from tumortrack.core.evidence import Landmark as Landmark
    from tumortrack.core.evidence import Outline as Outline
    from tumortrack.core.evidence import Touch as Touch
    from tumortrack.core.types import DepthFrame as DepthFrame
    from tumortrack.core.types import Intrinsics as Intrinsics
    from tumortrack.core.types import SensorCloud as SensorCloud
    from tumortrack.core.types import View as View
    from tumortrack.core.ultrasound import ProbeRecording as ProbeRecording
    from tumortrack.io.case import Case as Case
    from tumortrack.io.case import load_case as load_case
    from tumortrack.report.inspection import describe as describe
    from tumortrack.report.results import Evaluation as Evaluation
    from tumortrack.report.results import TrackSummary as TrackSummary
    from tumortrack.simulation import datasets as datasets
    from tumortrack.tracking import presets as presets
    from tumortrack.tracking.tracker import Tracker as Tracker

_NAMES = {  # by the module that has them
    "api": "estimate_from_surfaces evaluate export find_organ load_estimate load_model locate "
    "locate_files prepare read_cloud read_depth read_ultrasound scan_phantom simulate_scenes "
    "track train train_tissue_classifier write_scenes",
    "core": "errors",
    "core.estimate": "Estimate",
    "core.evidence": "Cut FreeSpace Grasp Landmark Outline Touch",
    "core.types": "DepthFrame Intrinsics View SensorCloud",
    "core.ultrasound": "ProbeRecording",
    "io.case": "Case load_case",
    "report.inspection": "describe",
    "report.results": "Evaluation TrackSummary",
    "assessment.advice": "advise",
    "tracking.tracker": "Tracker",
    "simulation": "datasets",
    "tracking": "presets",
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}

__version__ = "0.3.0"
__all__ = sorted(_HOMES)


class _Renamed:
    """The last finder of modules: what no other found may have had another place."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> None:
        if name.startswith(__name__):
            from tumortrack.core.renamed import refuse_module

            refuse_module(name)


sys.meta_path.append(_Renamed)


def _loaded(name: str) -> Any:
    if name not in _HOMES:
        from tumortrack.core.renamed import attributes_of

        return attributes_of(__name__)(name)
    home = f"{__name__}.{_HOMES[name]}"
    if name in ("datasets", "errors", "presets"):
        return import_module(f"{home}.{name}")
    return getattr(import_module(home), name)


if not TYPE_CHECKING:  # to a type checker what is not there stays so
    __getattr__ = _loaded


def __dir__() -> list[str]:
    return __all__
