"""Workloads of a registration model with a cloud; counted as in ``occupancy``."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import torch

from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.imaging.raster import label_grid
from tumortrack.models.report import grid_over
from tumortrack.registration.model import RegistrationModel
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.bench import occupancy, rows
from tumortrack_lab.bench.naive import NaiveRegistration, flowed
from tumortrack_lab.bench.rows import Call, Uncounted, Work, Workload

_CARRIED = 20_000  # points that a live estimate of a warp holds
_NO_VOLUME = 8  # voxels along the longest side: whoever asks for a frame wants no volume
_FLOW_STEPS = 6
_SAMPLE = 60  # trilinear value of three components: 8 weights, 24 products, the place


def flow_flops(points: int) -> float:
    """Points that follow a velocity field on a lattice: one sample a step and one to begin."""
    return float(points * (_FLOW_STEPS + 1) * (_SAMPLE + 12))


class RegistrationForms:
    """Of preset ``clinic``; the workloads are those of ``OccupancyForms``."""

    naive_is = "nearest vertices by a tree, SciPy, every start to its end, inside tests"

    def __init__(self, model: RegistrationModel, cloud: SensorCloud) -> None:
        self._cloud, self._network, self._shape = cloud, model.network, model.shape
        self.encode = model.registration().propose
        self._tracker, self._plain = Tracker(model), NaiveRegistration(model)
        self._estimate = self._tracker.locate(cloud, _NO_VOLUME, 0)
        self._anatomy = Anatomy(tuple(self._estimate.meshes.values()))  # where it was found

    def labelling(self, count: int) -> Call:
        """Labels of places in the camera frame, at our motion."""
        places = self._places(count)
        return lambda: self._shape.labels_at(self._back(places).astype(np.float32))[0]

    def filling(self, size: int) -> Call:
        grid = grid_over(self._anatomy.organ.vertices_mm, size)
        return partial(label_grid, self._anatomy, *grid)

    def encoders(self) -> Iterator[Workload]:
        points = self._cloud.points_mm

        @torch.inference_mode()
        def facts() -> dict:
            flops = occupancy.module_flops(
                lambda: self._network.flip_hypotheses(torch.tensor(points)[None])
            )
            moved = occupancy.weight_bytes(self._network) + points.nbytes
            return {"work": Work(flops=flops, bytes=moved), "note": "both ways round"}

        ours = partial(self.encode, points)  # nobody writes it differently
        yield Workload(rows.ENCODER, "clinic", "cloud", ours, facts=facts)

    def frames(self) -> Iterator[Workload]:
        cloud = self._estimate.cloud

        def ours() -> Uncounted:
            estimate = self._tracker.locate(self._cloud, _NO_VOLUME, 0)
            return Uncounted(estimate.report["timings"]["volume"])

        def facts() -> dict:
            # Of the points inside, at our motion, where inside tests say the same.
            found = self._plain.labels_where(self._back(cloud.points_mm.astype(float)))
            return {
                "work": self._work(self._estimate.report, occupancy.QUERIES),
                "agreement": float((found == cloud.labels).mean()),
                "note": "`locate` without its volume: labels, probabilities, surfaces, report; "
                "agreement: points inside, at our motion, against inside tests",
            }

        yield Workload(
            rows.FRAME, "clinic", "frame", ours, self._naive_frame(), self.naive_is, facts=facts
        )

    def tracking(self) -> Iterator[Workload]:
        ours = occupancy.LiveFrames(self._tracker, self._cloud.points_mm)

        def facts() -> dict:
            steps = ours.last.report["motion"]["steps"]
            note = f"steady state: {steps} refinement steps, points carried, surfaces, report"
            return {"work": self._work(ours.last.report, _CARRIED), "note": note}

        naive_is = f"{self.naive_is}, every frame from the start"
        yield Workload(
            rows.TRACKING, "clinic", "frame", ours, self._naive_frame(), naive_is, facts=facts
        )

    def volumes(self) -> Iterator[Workload]:
        grid = grid_over(self._anatomy.organ.vertices_mm, occupancy.GRID)
        index, points = occupancy.slab(grid)
        voxels, faces = int(np.prod(grid[1])), sum(len(part.faces) for part in self._anatomy.parts)
        motion = self._estimate.report["motion"]
        camera_from_ct, state = (np.array(motion[k]) for k in ("camera_from_ct", "coefficients"))

        def naive() -> np.ndarray:
            rest = (points - camera_from_ct[:3, 3]) @ camera_from_ct[:3, :3]
            return self._plain.labels_where(flowed(self._plain.body, -state, rest))

        def facts() -> dict:
            # Each column of voxels is crossed by triangles, every voxel written once.
            flops = 60.0 * faces + 40.0 * grid[1][0] * grid[1][1]
            labels = label_grid(self._anatomy, *grid)[tuple(index.T)]
            return {
                "work": Work(flops=flops, bytes=float(voxels + 36 * faces)),
                "agreement": float((naive() == labels).mean()),
                "others": {"voxels": voxels},
                "note": "the moved surfaces filled",
            }

        yield Workload(
            rows.VOLUME, "clinic", "volume",
            ours=partial(label_grid, self._anatomy, *grid),
            naive=naive,
            naive_is=f"every voxel carried back, inside tests; {len(points):,} voxels, scaled",
            naive_share=voxels / len(points),
            facts=facts,
        )  # fmt: skip

    def _naive_frame(self) -> Call:
        return partial(self._plain.labels, self._cloud.points_mm, self._places(occupancy.QUERIES))

    def _work(self, report: dict, queries: int) -> Work:
        """Refinement of one start, field and flow of the queries, the surfaces moved. ``report``:
        of the estimate whose steps are counted."""
        motion, points = report["motion"], len(self._cloud.points_mm)
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
        lower, upper = self._anatomy.organ.box_mm
        return np.random.default_rng(0).uniform(lower, upper, (count, 3))

    def _back(self, places_mm: np.ndarray) -> np.ndarray:
        """Camera frame -> CT, by our motion."""
        assert self._estimate.motion is not None
        back = self._estimate.motion.back(places_mm)
        assert back is not None
        return back
