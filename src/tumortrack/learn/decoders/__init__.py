"""Decoders: latent and normalised queries -> logits. One file per kind, one name here."""

from tumortrack.learn.decoders.mlp import MlpDecoderConfig

DecoderConfig = MlpDecoderConfig  # a second kind: ``MlpDecoderConfig | OtherConfig``

__all__ = ["DecoderConfig"]
