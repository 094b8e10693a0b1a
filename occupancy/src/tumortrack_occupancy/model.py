"""A `quick` or `paper` model."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from safetensors.torch import load, save

from tumortrack.core.config import from_builtins
from tumortrack.core.errors import InputError
from tumortrack.io.model_folder import read_tensors
from tumortrack.registration.base_model import Model
from tumortrack_occupancy.config import TrainConfig
from tumortrack_occupancy.hardware import choose_device
from tumortrack_occupancy.network import OccupancyNetwork

WEIGHTS = "weights.safetensors"
_OPSET = 18  # of ONNX files
_LARGEST_BOX_MM = 1000.0


@dataclass(frozen=True, eq=False, kw_only=True)
class OccupancyModel(Model):
    """A trained network, in evaluation mode. ``query_box_mm``: where the organ can lie (lower and
    upper corner), relative to the median of the observed points, camera frame."""

    config: TrainConfig
    network: OccupancyNetwork
    query_box_mm: Float64[np.ndarray, "2 3"]

    def files(self) -> dict[str, bytes]:
        weights = self.network.state_dict().items()
        return {WEIGHTS: save({k: v.detach().cpu().contiguous() for k, v in weights})}

    def entries(self) -> dict[str, Any]:
        return {"query_box_mm": self.query_box_mm.tolist()}

    def synchronise(self) -> None:
        device = next(self.network.parameters()).device
        if device.type == "cuda":  # kernels run asynchronously
            torch.cuda.synchronize(device)

    @classmethod
    def from_folder(
        cls, folder: Path, manifest: dict[str, Any], *, device: str = "auto", **known: Any
    ) -> OccupancyModel:
        config = from_builtins(manifest["config"], TrainConfig, f"{folder}: config")
        network = OccupancyNetwork(config.network)
        network.load_state_dict(read_tensors(folder / WEIGHTS, load))
        box_mm = np.array(manifest["query_box_mm"], float).reshape(2, 3)
        if not ((box_mm[0] < box_mm[1]).all() and (np.abs(box_mm) < _LARGEST_BOX_MM).all()):
            raise InputError(f"query_box_mm {box_mm.tolist()} is not a box about an organ.")
        network = network.eval().requires_grad_(False).to(choose_device(device))
        return cls(config=config, network=network, query_box_mm=box_mm, **known)


def onnx_bytes(model: OccupancyModel) -> bytes:
    """A model's network as an ONNX file, in single precision, for other programs. Sampling and
    ball queries are plain operators. Any number of queries is allowed; the number of points is
    that of the training scenes (repeat the points of a smaller cloud). ``cloud_mm`` (1, N, 3) and
    ``queries_mm`` (1, Q, 3) -> ``logits`` (1, Q, classes); camera frame, mm, float32."""
    n_points, generator = model.config.scene.cloud.n_points, torch.Generator().manual_seed(0)
    cloud = torch.randn(1, n_points, 3, generator=generator) * 20 + torch.tensor([0.0, 0.0, 130.0])
    content: Any = io.BytesIO()  # the annotation lacks files, which work as well
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # shapes are constants here, on purpose
        torch.onnx.export(
            model.network.folded().cpu(),
            (cloud, cloud[:, :7]),
            content,
            dynamo=False,
            opset_version=_OPSET,
            input_names=["cloud_mm", "queries_mm"],
            output_names=["logits"],
            dynamic_axes={"queries_mm": {1: "queries"}, "logits": {1: "queries"}},
        )
    return content.getvalue()
