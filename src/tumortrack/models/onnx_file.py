"""A model's network as an ONNX file, in single precision, for other programs.

Farthest points and balls are written out in plain operators; the number of queries is free, the
number of points is the one that the model was trained with (repeat the points of a smaller cloud).
"""

from __future__ import annotations

import io
import warnings
from typing import Any

import torch

from tumortrack.core.errors import InputError
from tumortrack.models.model import Model

_OPSET = 18


def onnx_bytes(model: Model) -> bytes:
    """The file's content.

    Occupancy networks: ``cloud_mm`` (1, N, 3) and ``queries_mm`` (1, Q, 3) -> ``logits``
    (1, Q, classes). Networks that place the organ: ``cloud_mm`` -> ``rotation`` (2, 3, 3),
    ``centre_mm`` (2, 3), ``coefficients`` (2, M), ``right_way`` (2,). Camera frame, mm, float32.

    Raises:
        InputError: the package onnx is not installed.
    """
    try:
        import onnx  # noqa: F401  PyTorch needs it, and says so in many words
    except ImportError as error:
        raise InputError(
            "writing ONNX needs the package onnx: pip install 'tumortrack[onnx]'."
        ) from error
    points, generator = model.config.scene.cloud.n_points, torch.Generator().manual_seed(0)
    cloud = torch.randn(1, points, 3, generator=generator) * 20 + torch.tensor([0.0, 0.0, 130.0])
    module, inputs, names = model.network.onnx_parts(cloud)
    content: Any = io.BytesIO()  # a file as good as a path, whatever the annotation says
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # shapes are constants here: on purpose
        torch.onnx.export(
            module,
            inputs,
            content,
            dynamo=False,
            opset_version=_OPSET,
            **names,
        )
    return content.getvalue()
