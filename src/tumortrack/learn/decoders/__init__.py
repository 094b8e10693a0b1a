"""Decoders: what a latent says. One file per kind, one name here.

``mlp`` labels normalised queries; ``warp`` gives pose and state of the pre-operative organ.
"""

from tumortrack.learn.decoders.mlp import MlpDecoderConfig
from tumortrack.learn.decoders.warp import WarpDecoderConfig

DecoderConfig = MlpDecoderConfig | WarpDecoderConfig

__all__ = ["DecoderConfig"]
