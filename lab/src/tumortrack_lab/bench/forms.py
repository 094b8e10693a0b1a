"""Trained models with a cloud: what we do, what the naive form does, and what it has to cost.

Arithmetic is counted by torch for modules, by formulas elsewhere. A multiplication and an addition
are 2. Comparisons, square roots and exponentials are 1 each: formulas are meant to be right within
some tens of per cent.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.imaging.raster import label_grid
from tumortrack.models.hardware import has_fast_bfloat16
from tumortrack.models.report import grid_over
from tumortrack.occupancy.inference import Inference
from tumortrack.occupancy.locator import steps_over
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.sparse import organ_lattice, sparse_logits, sparse_margins
from tumortrack.registration.model import RegistrationModel
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.bench.naive import Encoded, NaiveOccupancy, NaiveRegistration
from tumortrack_lab.bench.rows import Call, InterleavedTiming, Precision, Uncounted, Work

QUERIES = 40_000  # of a frame
IN_ONE_PIECE = 40_000  # queries of the naive form: of more the latent's copies fill the memory
_PRECISIONS: dict[str, Precision] = {"float32": "fp32", "bfloat16": "bf16", "int8": "int8"}
_BYTES: dict[Precision, int] = {"fp32": 4, "bf16": 2, "int8": 1}
_NO_VOLUME = 8  # voxels along the longest side: whoever asks for a frame wants no volume
_FLOW_STEPS = 6
_SAMPLE = 60  # trilinear value of three components: 8 weights, 24 products, the place
_SQUARE = 8  # a squared distance in space
Grid = tuple[np.ndarray, tuple[int, int, int]]  # camera_from_index, shape


def module_flops(call: Callable[[], object]) -> float:
    """Of the matrix products and convolutions in a call, by ``torch.utils.flop_counter``."""
    with FlopCounterMode(display=False) as counter:
        call()
    return float(counter.get_total_flops())


def weight_bytes(module: torch.nn.Module, bytes_each: int) -> float:
    """Of all weights, moved once."""
    return float(bytes_each * sum(weight.numel() for weight in module.parameters()))


def flow_flops(points: int) -> float:
    """Points that follow a velocity field on a lattice: one sample a step and one to begin."""
    return float(points * (_FLOW_STEPS + 1) * (_SAMPLE + 12))


class CountedQueries:
    """Logits at places (n, 3), mm; ``places``: how many were asked for."""

    def __init__(self, inference: Inference, points_mm: np.ndarray) -> None:
        self._inference, self._latent, self.places = inference, inference.encode(points_mm), 0

    def __call__(self, points_mm: np.ndarray) -> torch.Tensor:
        self.places += len(points_mm)
        return self._inference.logits(self._latent, points_mm)


class OccupancyForms:
    """An occupancy network with a cloud. ``naive_frame_s``: of the naive form's frame, once that
    was measured."""

    naive_is = "single precision, latent beside every query, Python loops, one piece"
    naive_frame_s: InterleavedTiming | None = None

    def __init__(self, model: OccupancyModel, points_mm: np.ndarray, device: str = "cpu") -> None:
        self.points_mm, self.device, self._classes = points_mm, device, len(model.parts) + 1
        self._network = model.network.to(device)
        self.inference = Inference(self._network, model.arithmetic)
        self.encode = self.inference.encode
        self._plain = NaiveOccupancy(self._network)
        self._cloud = torch.tensor(points_mm)[None].to(device)
        self._labelled: dict[int, np.ndarray] = {}  # by the naive form, of so many queries
        fast = has_fast_bfloat16(torch.device(device))
        self._precision: Precision = "bf16" if fast else "fp32"

    def queries(self, count: int) -> np.ndarray:
        """Evenly in the box about the cloud where the organ can be."""
        lower, upper = self.points_mm.min(0), self.points_mm.max(0)
        upper[2] += upper[2] - lower[2]  # its hidden half
        rng = np.random.default_rng(0)
        return rng.uniform(lower, upper, (count, 3)).astype(np.float32)

    def counted(self) -> CountedQueries:
        return CountedQueries(self.inference, self.points_mm)

    def labelling(self, count: int) -> Call:
        """Labels of queries, the cloud being encoded."""
        logits, queries = self.counted(), self.queries(count)
        return lambda: logits(queries).argmax(-1)

    def every_query(self, queries: np.ndarray) -> np.ndarray:
        """Labels by asking at every place."""
        labels: np.ndarray = self.counted()(queries).argmax(-1).cpu().numpy()
        return labels

    def our_frame(self, queries: np.ndarray) -> tuple[np.ndarray, int]:
        """Labels as `locate` finds them, and how many places were asked for: logits on a lattice
        over the queries' box, linear between its points where that is plain, else asked."""
        logits = self.counted()
        box = np.stack([queries.min(0), queries.max(0)]).astype(float)
        lattice = organ_lattice(logits, box, steps_over(box))
        return sparse_logits(logits, lattice, queries).argmax(-1), logits.places

    def grid(self, size: int) -> Grid:
        """Voxels over the organ, as `locate` lays them: about the points that are inside."""
        queries = self.queries(QUERIES)
        return grid_over(queries[self.every_query(queries) > 0], size)

    def filling(self, size: int) -> Call:
        """A label in every voxel."""
        return partial(sparse_margins, self.counted(), *self.grid(size))

    @torch.inference_mode()
    def naive_labels(self, queries: np.ndarray) -> np.ndarray:
        """In single precision, piece by piece."""
        encoded = self._plain.encode(self._cloud)
        pieces = self._on_device(queries).split(IN_ONE_PIECE, dim=1)
        labels = [self._plain.logits(encoded, piece)[0].argmax(-1) for piece in pieces]
        return torch.cat(labels).cpu().numpy()

    def agreement(self, labels: np.ndarray) -> float:
        """Share of the labels of so many ``queries`` that are the naive form's."""
        count = len(labels)
        if count not in self._labelled:
            self._labelled[count] = self.naive_labels(self.queries(count))
        return float((labels == self._labelled[count]).mean())

    @torch.inference_mode()
    def naive_encoding(self) -> Encoded:
        return self._plain.encode(self._cloud)

    def naive_decoding(self, queries: np.ndarray) -> Call:
        """The cloud being encoded."""
        tensor, encoded = self._on_device(queries), self.naive_encoding()
        return torch.inference_mode()(lambda: self._plain.logits(encoded, tensor).argmax(-1))

    def naive_frame(self, queries: np.ndarray) -> Call:
        tensor, plain = self._on_device(queries), self._plain
        return torch.inference_mode()(
            lambda: plain.logits(plain.encode(self._cloud), tensor).argmax(-1).cpu()
        )

    def encoder_work(self) -> Work:
        folded = self._network.folded()
        flops = module_flops(lambda: folded.encode(self._cloud))
        n = len(self.points_mm)
        for level in folded.config.encoder.levels:  # type: ignore[union-attr]
            centres = round(level.ratio * n)
            # Each choice of the farthest compares all points with the newest; then the neighbours
            # of the centres, every point tried.
            flops += n * centres * ((_SQUARE + 2) + (_SQUARE + 1))
            n = centres
        moved = weight_bytes(folded.encoder, _BYTES[self._precision])
        return Work(flops=flops, bytes=moved + self.points_mm.nbytes, precision=self._precision)

    def decoder_work(self, queries: int, voxels: int = 0) -> Work:
        """The latent's share once a frame; queries in, logits out; a label to every voxel."""
        precision = _PRECISIONS.get(self.inference.arithmetic.numbers, self._precision)
        folded = self._network.folded()
        latent, some = folded.encode(self._cloud), self._on_device(self.queries(100))
        flops = module_flops(lambda: folded.query(latent, some)) * queries / 100
        moved = weight_bytes(folded.decoder, _BYTES[precision]) + voxels
        return Work(
            flops=flops, bytes=moved + queries * (12 + 4 * self._classes), precision=precision
        )

    def frame_work(self, queries: int) -> Work:
        one, two = self.encoder_work(), self.decoder_work(queries)
        flops, moved = one.flops + two.flops, one.bytes + two.bytes
        return Work(flops=flops, bytes=moved, precision=two.precision)

    def _on_device(self, queries: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(queries)[None].to(self.device)


class RegistrationForms:
    """A registration model with a cloud."""

    naive_is = "nearest vertices by a tree, SciPy, every start to its end, inside tests"

    def __init__(self, model: RegistrationModel, cloud: SensorCloud) -> None:
        self.cloud, self.network, self._shape = cloud, model.network, model.shape
        self.encode = model.registration().propose
        self.tracker, self.plain = Tracker(model), NaiveRegistration(model)
        self.estimate = self.tracker.locate(cloud, _NO_VOLUME, 0)
        self.anatomy = Anatomy(tuple(self.estimate.meshes.values()))  # where it was found
        self._queries = self._places(QUERIES)

    def labelling(self, count: int) -> Call:
        """Labels of places in the camera frame, at our motion."""
        places = self._places(count)
        return lambda: self._shape.labels_at(self._back(places).astype(np.float32))[0]

    def grid(self, size: int) -> Grid:
        return grid_over(self.anatomy.organ.vertices_mm, size)

    def filling(self, size: int) -> Call:
        """A label in every voxel."""
        return partial(label_grid, self.anatomy, *self.grid(size))

    def ours(self) -> Uncounted:
        estimate = self.tracker.locate(self.cloud, _NO_VOLUME, 0)
        return Uncounted(estimate.report["timings"]["volume"])

    def naive(self) -> None:
        self.plain.labels(self.cloud.points_mm, self._queries)

    def agreement(self) -> float:
        """Share of the points inside, at our motion, where inside tests say the same."""
        cloud = self.estimate.cloud
        found = self.plain.labels_where(self._back(cloud.points_mm.astype(float)))
        return float((found == cloud.labels).mean())

    def work(self, report: dict, queries: int) -> Work:
        """Refinement of one start, field and flow of the queries, the surfaces moved. ``report``:
        of the estimate whose steps are counted."""
        motion, points = report["motion"], len(self.cloud.points_mm)
        vertices = sum(len(part.vertices_mm) for part in self._shape.anatomy_ct.parts)
        unknown = 6 + len(motion["coefficients"])
        # A Gauss-Newton step carries the points back, looks distance and slope up, carries them
        # half the way, projects the modes there, and sums the curvature (symmetric: half of it).
        a_point = 2 * flow_flops(1) + _SAMPLE + 8 * 2 * 3 * unknown + unknown**2
        flops = float(motion["steps"] * (points * a_point + unknown**3 / 3))
        flops += flow_flops(queries + vertices)
        moved = self._shape.body.modes.nbytes + 16 * queries + 24 * vertices
        return Work(flops=flops, bytes=float(moved))

    def _places(self, count: int) -> np.ndarray:
        """Evenly in the organ's box, camera frame."""
        lower, upper = self.anatomy.organ.box_mm
        return np.random.default_rng(0).uniform(lower, upper, (count, 3))

    def _back(self, places_mm: np.ndarray) -> np.ndarray:
        """Camera frame -> CT, by our motion."""
        motion = self.estimate.motion
        back = None if motion is None else motion.back(places_mm)
        assert back is not None
        return back
