"""Encoders: normalised points (B, N, 3) -> latent (B, L). One file per kind, one name here."""

from tumortrack.models.encoders.heightmap import HeightMapConfig
from tumortrack.models.encoders.pointnet2 import PointNet2Config

EncoderConfig = PointNet2Config | HeightMapConfig
