"""Encoders: normalised points (B, N, 3) -> latent (B, L). One file per kind, one name here."""

from tumortrack_occupancy.encoders.pointnet2 import PointNet2Config

EncoderConfig = PointNet2Config
