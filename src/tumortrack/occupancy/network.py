"""The occupancy network: encode a cloud once, query many points.

Both in the camera frame and in mm; inside, everything is relative to a centre taken from the
cloud, so that nothing depends on where the camera is.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.models.encoders import EncoderConfig
from tumortrack.models.encoders.heightmap import HeightMapConfig
from tumortrack.models.encoders.pointnet2 import PointNet2Config, SetAbstraction
from tumortrack.models.layers import Layer
from tumortrack.models.sampling import compiled, take
from tumortrack.occupancy.decoders import DecoderConfig
from tumortrack.occupancy.mlp_decoder import MlpDecoderConfig
from tumortrack.registration.config import RegistrationHeadConfig


class CloudBox(Config, frozen=True, tag="cloud-box"):
    """Centre and half the longest side of the observed cloud's bounding box (the follow-up's)."""


class FixedScale(Config, frozen=True, tag="fixed"):
    """Scale: a constant, so that size is not lost. Centre: the mean of the points that lie
    within ``reach`` scales of it; the others are strays, and nothing sees them.

    The mean and not the box's centre: one stray point within reach moves it by 1 / N of its
    distance, the box by half.
    """

    scale_mm: float
    reach: float

    def __post_init__(self) -> None:
        for name in ("scale_mm", "reach"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(f"{name} must be positive, not {getattr(self, name)}.")


class Aligned(Config, frozen=True, tag="aligned"):
    """As ``FixedScale``, and turned about the camera's axis until the cloud's longest direction
    across it is x, its heavier tail at +x.

    Turning the organ or the camera about that axis then changes nothing, so that the network
    need not learn it: most of what varies between ``limited`` poses is gone.
    """

    scale_mm: float
    reach: float

    def __post_init__(self) -> None:
        FixedScale(scale_mm=self.scale_mm, reach=self.reach)


class NetworkConfig(Config, frozen=True):
    encoder: EncoderConfig
    decoder: DecoderConfig
    normalisation: CloudBox | FixedScale | Aligned

    @property
    def warps(self) -> bool:
        """Whether the network places the pre-operative organ, instead of labelling points."""
        return isinstance(self.decoder, RegistrationHeadConfig)

    def build(self) -> OccupancyNetwork:
        """The network, with weights from torch's global generator (``torch.manual_seed``).

        Raises:
            InputError: a warp decoder; ``registration.network`` has its network.
        """
        return OccupancyNetwork(self)


@dataclass(frozen=True, eq=False)
class Latent:
    """What is known of B clouds; valid only for the weights (and the mode) that made it."""

    vector: Tensor  # (B, L)
    centre_mm: Tensor  # (B, 1, 3), camera frame
    scale_mm: Tensor  # (B, 1, 1)
    turn: Tensor | None  # (2, B, 1): cosine and sine of the turn about z; None: no turn
    terms: tuple[Tensor, ...]  # the decoder's share, computed once per cloud


class OccupancyNetwork(nn.Module):
    """Labels of query points from one cloud (the paper, section "Localization")."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        if not isinstance(config.decoder, MlpDecoderConfig):
            raise InputError("an occupancy network needs a decoder of queries, such as `mlp`.")
        self.encoder = config.encoder.build()
        self.decoder = config.decoder.build(config.encoder.latent_size)

    def encode(self, points_mm: Tensor) -> Latent:
        """Clouds (B, N, 3), camera frame, mm, float32, points in random order -> Latent."""
        kind = self.config.normalisation
        if not isinstance(kind, CloudBox):
            points_mm = without_strays(points_mm, kind.reach * kind.scale_mm)
        centre_mm, scale_mm = normalisation(points_mm, kind)
        points = (points_mm - centre_mm) / scale_mm
        turn = None
        if isinstance(kind, Aligned):
            turn = alignment(points)
            points = turned(points, turn)
        vector = self.encoder(points)
        return Latent(vector, centre_mm, scale_mm, turn, self.decoder.prepare(vector))

    def query(self, latent: Latent, queries_mm: Tensor) -> Tensor:
        """Queries (B, Q, 3), camera frame, mm, float32 -> logits (B, Q, classes)."""
        logits: Tensor = self.decoder(latent.terms, normalised(latent, queries_mm))
        return logits

    def forward(self, points_mm: Tensor, queries_mm: Tensor) -> Tensor:
        """Both at once: (B, N, 3) and (B, Q, 3) -> logits (B, Q, classes)."""
        return self.query(self.encode(points_mm), queries_mm)

    def loss(
        self,
        clouds_mm: Tensor,
        points_mm: Tensor,
        labels: Tensor,
        camera_from_ct: Tensor,
        *,
        first: int = 0,
    ) -> Tensor:
        """Cross-entropy of the points' labels, all points equal (the paper). Neither the poses nor
        the first cloud's number in the batch are used."""
        logits = self.query(self.encode(clouds_mm), points_mm)
        flat = logits.float().flatten(0, 1)
        return nn.functional.cross_entropy(flat, labels.long().flatten())

    def folded(self) -> OccupancyNetwork:
        """A copy for inference: batch norms folded into their linear layers, no gradients."""
        out = copy.deepcopy(self).eval().requires_grad_(False)
        for module in out.modules():
            if isinstance(module, Layer):
                module.fold()
        return out


def normalised(latent: Latent, queries_mm: Tensor) -> Tensor:
    """Queries (B, Q, 3), camera frame, mm -> as the decoder is asked for them."""
    queries = (queries_mm - latent.centre_mm) / latent.scale_mm
    return queries if latent.turn is None else turned(queries, latent.turn)


def normalisation(
    points_mm: Tensor, kind: CloudBox | FixedScale | Aligned
) -> tuple[Tensor, Tensor]:
    """Centre (B, 1, 3) and scale (B, 1, 1), both mm, of clouds (B, N, 3)."""
    if not isinstance(kind, CloudBox):
        centre_mm = points_mm.mean(dim=1, keepdim=True)
        return centre_mm, points_mm.new_full((len(points_mm), 1, 1), kind.scale_mm)
    low = points_mm.amin(dim=1, keepdim=True)
    high = points_mm.amax(dim=1, keepdim=True)
    return (low + high) / 2, ((high - low) / 2).amax(dim=2, keepdim=True).clamp_min(1e-6)


def without_strays(points_mm: Tensor, reach_mm: float) -> Tensor:
    """Clouds (B, N, 3) with every point that is not within reach of the others' middle replaced
    by one that is: a repeated point changes no maximum, and is never a farthest one.

    The middle is the coordinates' median, then twice the mean of the points within reach, so
    that background moves it little (10 % of a plane behind a kidney: 0.5 mm, the mean of all by
    5 mm). The order of the points that stay is kept.
    """
    if compiled(points_mm) and not points_mm.requires_grad:
        from tumortrack.models.stray_kernels import near as gathered

        out = torch.empty_like(points_mm, memory_format=torch.contiguous_format)
        gathered(points_mm.contiguous().numpy(), np.float32(reach_mm), out.numpy())
        return out
    return _without_strays(points_mm, reach_mm)


def _without_strays(points_mm: Tensor, reach_mm: float) -> Tensor:
    """The reference, for every device."""
    n = points_mm.shape[1]
    if torch.jit.is_tracing():  # ONNX has no median
        middle = points_mm.sort(dim=1).values[:, (n - 1) // 2, None]
    else:
        middle = points_mm.median(dim=1, keepdim=True).values
    near = points_mm
    for _ in range(2):
        stray = (points_mm - middle).square().sum(dim=2) > reach_mm**2
        # No two keys are equal, so that any sorting keeps the order.
        row = torch.arange(n, device=points_mm.device)
        order = (stray * n + row).argsort(dim=1)
        count = (~stray).sum(dim=1, keepdim=True).clamp_min(1)
        near = take(points_mm, order.gather(1, row % count))
        middle = near.mean(dim=1, keepdim=True)
    return near


def alignment(points: Tensor) -> Tensor:
    """Cosine and sine (2, B, 1) of the angle about z of the principal direction of the centred
    points (B, N, 3) across z, pointing to their heavier tail."""
    x, y = points[..., 0], points[..., 1]
    angle = torch.atan2(2 * (x * y).mean(1), (x * x - y * y).mean(1)) / 2
    direction = torch.stack([torch.cos(angle), torch.sin(angle)])[..., None]
    along = x * direction[0] + y * direction[1]
    return direction * torch.where((along**3).mean(1) < 0, -1.0, 1.0)[:, None]


def turned(points: Tensor, turn: Tensor) -> Tensor:
    """Points (B, N, 3) turned by minus the angle. Not as a matrix product: that would be rounded
    to bf16, a tenth of a millimetre."""
    x, y, z = points.unbind(-1)
    cosine, sine = turn
    return torch.stack([x * cosine + y * sine, y * cosine - x * sine, z], dim=-1)


def paper_network(n_classes: int) -> NetworkConfig:
    """The paper's network.

    From the paper: PointNet++ to a 1024-d latent; 8 hidden layers x 512, ReLU, a skip into the
    fifth, batch norm on "the skip and the final layer": read as the fifth and the last hidden
    layer. From the follow-up (LUDO, IEEE T-RO 2025), where the paper is silent: the levels'
    ratios, radii, neighbours and widths, and the cloud's bounding box as normalisation. From
    PointNet++: batch norm in the encoder. Ours: raw query coordinates (the follow-up adds
    octaves; the paper names none) and He's start of the weights.
    """
    return NetworkConfig(
        encoder=PointNet2Config(
            levels=(
                SetAbstraction(ratio=0.5, radius=0.2, neighbours=64, widths=(64, 64, 128)),
                SetAbstraction(ratio=0.25, radius=0.4, neighbours=64, widths=(128, 128, 256)),
            ),
            widths=(256, 512, 1024),
        ),
        decoder=MlpDecoderConfig(
            n_classes=n_classes, width=512, hidden_layers=8, skip_layer=5, norm_layers=(5, 8)
        ),
        normalisation=CloudBox(),
    )


def quick_network(n_classes: int, scale_mm: float) -> NetworkConfig:
    """A slim network of the same family, for minutes of training on a CPU.

    All numbers are ours. Width: 256-d latent and 5 x 128 decoder as in our prototype. The rest
    by mIoU after 600 steps on a toy (dented ellipsoid, two spheres, bending, one seed each):
    octaves 0.55 against 0.39 for raw coordinates; radii 0.4 and 0.9 0.62, farthest points as
    well 0.63, a skip as well 0.65; batch norm lost 0.03, and its running statistics make short
    runs' validation erratic. ``scale_mm``: about half the organ's longest side; with a reach of
    1.35 of it at most 0.6 % of the points of strongly deformed kidneys are strays.
    """
    return NetworkConfig(
        encoder=PointNet2Config(
            levels=(
                SetAbstraction(ratio=0.25, radius=0.4, neighbours=16, widths=(32, 64)),
                SetAbstraction(ratio=0.25, radius=0.9, neighbours=16, widths=(64, 128)),
            ),
            widths=(128, 256),
            norm="none",
            n_points=512,
        ),
        decoder=MlpDecoderConfig(
            n_classes=n_classes, width=128, hidden_layers=5, skip_layer=3, octaves=(0, 1, 2)
        ),
        normalisation=Aligned(scale_mm=scale_mm, reach=1.35),
    )


def clinic_network(modes: int, scale_mm: float) -> NetworkConfig:
    """Height map to warp: learns in minutes, runs in milliseconds (docs/results.md has the
    comparison with the other encoders and decoders). ``modes``: of the organ's body."""
    return NetworkConfig(
        encoder=HeightMapConfig(),
        decoder=RegistrationHeadConfig(modes=modes),
        normalisation=Aligned(scale_mm=scale_mm, reach=1.35),
    )
