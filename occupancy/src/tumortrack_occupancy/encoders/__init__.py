"""Encoders: normalised points (B, N, 3) -> latent (B, L). One file and one name here per kind."""

from tumortrack_occupancy.encoders.pointnet2 import PointNet2Config

EncoderConfig = PointNet2Config
