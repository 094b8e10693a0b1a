"""The smallest nnU-Net model: two stages of 1 x 1 x 1 convolutions that learn HU windows."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import torch

_RESAMPLE = {"order": 1, "order_z": 0, "force_separate_z": None}


def _plans() -> dict:
    resampling = {}
    for what, is_seg in (("data", False), ("seg", True), ("probabilities", False)):
        resampling[f"resampling_fn_{what}"] = "resample_data_or_seg_to_shape"
        resampling[f"resampling_fn_{what}_kwargs"] = {"is_seg": is_seg, **_RESAMPLE}
    kwargs = {
        "n_stages": 2, "features_per_stage": [8, 8], "conv_op": "torch.nn.modules.conv.Conv3d",
        "kernel_sizes": [[1, 1, 1]] * 2, "strides": [[1, 1, 1], [2, 2, 2]],
        "n_conv_per_stage": [2, 1], "n_conv_per_stage_decoder": [1], "conv_bias": True,
        "norm_op": None, "norm_op_kwargs": {}, "dropout_op": None, "dropout_op_kwargs": None,
        "nonlin": "torch.nn.LeakyReLU", "nonlin_kwargs": {"inplace": True},
    }  # fmt: skip
    architecture = {
        "network_class_name": "dynamic_network_architectures.architectures.unet.PlainConvUNet",
        "arch_kwargs": kwargs,
        "_kw_requires_import": ["conv_op", "norm_op", "dropout_op", "nonlin"],
    }
    configuration = {
        "data_identifier": "nnUNetPlans_3d_fullres", "preprocessor_name": "DefaultPreprocessor",
        "batch_size": 2, "patch_size": [32, 32, 32], "median_image_size_in_voxels": [48, 48, 48],
        "spacing": [2.0, 2.0, 2.0], "normalization_schemes": ["CTNormalization"],
        "use_mask_for_norm": [False], "architecture": architecture, "batch_dice": False,
    }  # fmt: skip
    window = {"mean": 100.0, "std": 150.0, "percentile_00_5": -200.0, "percentile_99_5": 500.0}
    return {
        "dataset_name": "Dataset900_Beans", "plans_name": "nnUNetPlans",
        "original_median_spacing_after_transp": [2.0, 2.0, 2.0],
        "original_median_shape_after_transp": [48, 48, 48],
        "image_reader_writer": "SimpleITKIO",
        "transpose_forward": [0, 1, 2], "transpose_backward": [0, 1, 2],
        "configurations": {"3d_fullres": configuration | resampling},
        "experiment_planner_used": "ExperimentPlanner", "label_manager": "LabelManager",
        "foreground_intensity_properties_per_channel": {"0": window},
    }  # fmt: skip


def tiny_model(folder: Path, labels: dict) -> Path:
    """A model folder that labels 100 HU as 1 and 400 HU as 2, learnt within seconds."""
    for name in ("raw", "preprocessed", "results"):
        (folder / name).mkdir()
        os.environ[f"nnUNet_{name}"] = str(folder / name)  # read when nnunetv2 is imported
    data = folder / "preprocessed" / "Dataset900_Beans" / "nnUNetPlans_3d_fullres"
    data.mkdir(parents=True)
    (data / "case.npz").touch()  # the trainer looks what kind of files there are
    from nnunetv2.training.nnUNetTrainer.nnUNetTrainer import nnUNetTrainer

    dataset = {
        "channel_names": {"0": "CT"}, "labels": labels, "numTraining": 1, "file_ending": ".nii.gz",
        "regions_class_order": [1, 2],
    }  # fmt: skip
    plans = _plans()
    torch.manual_seed(0)
    given = {**plans, "continue_training": False}  # as its command does
    trainer = nnUNetTrainer(given, "3d_fullres", 0, dataset, torch.device("cpu"))
    trainer.initialize()
    kinds = torch.from_numpy(np.random.default_rng(0).integers(0, 3, (2, 1, 16, 16, 16)))
    image = (torch.tensor([-100.0, 100.0, 400.0])[kinds] - 100) / 150
    wanted = torch.cat([kinds >= 1, kinds == 2], 1).float()  # regions: kidney, tumor
    network, optimizer = trainer.network, torch.optim.Adam(trainer.network.parameters(), 0.02)
    for _ in range(150):
        logits = network(image)
        logits = logits[0] if isinstance(logits, (list, tuple)) else logits
        loss = torch.nn.functional.binary_cross_entropy_with_logits(logits, wanted)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    model = Path(trainer.output_folder).parent
    trainer.save_checkpoint(str(model / "fold_0" / "checkpoint_final.pth"))
    (model / "plans.json").write_text(json.dumps(plans))
    (model / "dataset.json").write_text(json.dumps(dataset))
    return model
