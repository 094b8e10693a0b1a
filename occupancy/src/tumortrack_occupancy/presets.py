"""The presets: the paper's network and training, and a slim one."""

from __future__ import annotations

import msgspec

from tumortrack.core.types import Anatomy
from tumortrack.registration.config import Rotations
from tumortrack.simulation.clutter import ClutterConfig
from tumortrack.simulation.deform import ChainConfig, DragConfig, StretchConfig
from tumortrack.simulation.deform.drag import CONFIGURATIONS
from tumortrack.simulation.noise import D405_NOISE
from tumortrack.simulation.scene import OccupancyConfig, PoseConfig, SceneConfig
from tumortrack_occupancy.config import MlpDecoderConfig, NetworkConfig, Schedule, TrainConfig
from tumortrack_occupancy.encoders.pointnet2 import PointNet2Config, SetAbstraction
from tumortrack_occupancy.normalisation import Aligned, CloudBox


def paper(anatomy: Anatomy, rotations: Rotations = "limited") -> TrainConfig:
    """The paper's network and rules: 31,000 clean scenes of deformation configuration 3, 200
    epochs; Adam 5e-4 x 0.99 per epoch, batch 40 and dropped points from the follow-up."""
    return TrainConfig(
        network=paper_network(len(anatomy.parts) + 1),
        scene=SceneConfig(pose=PoseConfig(rotations=rotations)).seen_whole(anatomy),
        schedule=Schedule(kind="exponential", learning_rate=5e-4),
        batch_size=40,
        steps=200 * 31_000 // 40,
        drop_points=0.7,
        ema=0.0,
        training_pairs=31_000,
        validation_pairs=1000,
        validate_every=31_000 // 40,
    )


def quick(anatomy: Anatomy, rotations: Rotations = "limited") -> TrainConfig:
    """A slim network that learns in minutes on two CPU cores, from endless noisy scenes: drags of
    the paper's configurations 3 and 6, half of them squeezed and bent as a whole."""
    local = tuple(DragConfig(steps=CONFIGURATIONS[n]) for n in (3, 6))
    squeezed = tuple(ChainConfig(links=(drag, StretchConfig())) for drag in local)
    return TrainConfig(
        network=quick_network(len(anatomy.parts) + 1, anatomy.organ.longest_mm / 2),
        scene=SceneConfig(
            pose=PoseConfig(rotations=rotations),
            deform=(*local, *squeezed),
            clutter=ClutterConfig(scenes=0.5, largest_share=0.08),
            noise=D405_NOISE,
            occupancy=OccupancyConfig(per_side=64),
            free_range=0.5,
        ).seen_whole(anatomy),
        schedule=Schedule(learning_rate=3e-3),
        batch_size=16,
        steps=12_000,
        drop_points=0.6,
    )


def quick_long(anatomy: Anatomy, rotations: Rotations = "limited") -> TrainConfig:
    """``quick`` for hours, to its plateau. Its scenes show a coarser surface: 0.1 mm off, below the
    noise, and a scene takes a third less time."""
    config = quick(anatomy, rotations)
    return msgspec.structs.replace(config, steps=120_000, validate_every=1000, cell_mm=2.5)


def paper_network(n_classes: int) -> NetworkConfig:
    """The paper's network.

    From the paper: PointNet++ to a 1024-d latent; 8 hidden layers x 512, ReLU, a skip into the
    fifth, batch norm on "the skip and the final layer": the fifth and the last hidden one. From
    the follow-up (LUDO, IEEE T-RO 2025): the levels' ratios, radii, neighbours and widths, and the
    cloud's bounding box as normalisation. From PointNet++: batch norm in the encoder. Ours: raw
    query coordinates (the follow-up adds octaves; the paper names none), He initialisation.
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
    octaves 0.55 against 0.39 for raw coordinates; with radii 0.4 and 0.9 0.62, with farthest
    points 0.63, with a skip 0.65; batch norm lost 0.03, and its running statistics make validation
    erratic in short runs. ``scale_mm``: about half the organ's longest side; with a reach of
    1.35 of it at most 0.6 % of the points of strongly deformed kidneys count as outliers.
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
