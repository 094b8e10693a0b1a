"""Decoders: what a latent says. One file per kind, one name here.

``mlp`` labels normalised queries; ``warp`` gives pose and state of the pre-operative organ.
"""

from tumortrack.occupancy.mlp_decoder import MlpDecoderConfig
from tumortrack.registration.config import RegistrationHeadConfig

DecoderConfig = MlpDecoderConfig | RegistrationHeadConfig

__all__ = ["DecoderConfig"]
