"""Deformations: one file per model.

A model's configuration samples parameters from what the camera sees (``sample``); the sampled
deformation is a value that maps any point of the CT frame to its new place (``apply``) and can be
recorded (``record``). To add one here: write its file, add its configuration to the union in
``installed``. Other packages add theirs with an entry point, see there.
"""

from typing import TYPE_CHECKING, Any

from tumortrack.simulate.deform import installed
from tumortrack.simulate.deform.chain import ChainConfig, RestConfig
from tumortrack.simulate.deform.drag import DragConfig
from tumortrack.simulate.deform.elastic import ElasticConfig
from tumortrack.simulate.deform.stretch import StretchConfig

__all__ = ["ChainConfig", "DragConfig", "ElasticConfig", "RestConfig", "StretchConfig"]

if TYPE_CHECKING:
    DeformConfig = installed.LinkConfig | ChainConfig | RestConfig
else:

    def __getattr__(name: str) -> Any:
        """``DeformConfig``, which includes the models of other packages, on first use."""
        if name != "DeformConfig":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = union = installed.LinkConfig | ChainConfig | RestConfig
        return union
