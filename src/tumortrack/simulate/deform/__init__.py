"""Deformations: one file per model.

A model's configuration samples parameters from what the camera sees (``sample``); the sampled
deformation is a value that carries any point of the CT frame to its new place (``apply``) and
can be recorded (``record``). To add one: write its file, add its configuration to the union.
"""

from tumortrack.simulate.deform.chain import ChainConfig
from tumortrack.simulate.deform.drag import DragConfig
from tumortrack.simulate.deform.elastic import ElasticConfig
from tumortrack.simulate.deform.rest import RestConfig
from tumortrack.simulate.deform.stretch import StretchConfig

DeformConfig = DragConfig | StretchConfig | ElasticConfig | ChainConfig | RestConfig
