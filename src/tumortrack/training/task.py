"""What a run teaches: which points it shows, how it judges, what it leaves. One class per kind."""

from __future__ import annotations

from functools import cached_property
from typing import Protocol

import torch

from tumortrack.occupancy.network import OccupancyNetwork
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import OccupancyPool, PointSource
from tumortrack.simulate.scene import Simulator, body_for
from tumortrack.training.model import Model
from tumortrack.training.networks import Network
from tumortrack.training.registration_task import RegistrationTask
from tumortrack.training.run import TrainingRun
from tumortrack.training.validate import ValidationScenes, ValidationSet, validation_scenes


class TrainingTask(Protocol):
    """What training asks of a kind of model."""

    @property
    def points(self) -> PointSource:
        """Those of the training scenes."""
        ...

    @property
    def body(self) -> ElasticBody | None:
        """The organ's, where scenes or model need it."""
        ...

    def teach(self, network: Network) -> None:
        """Tell a fresh network what does not have to be learnt."""
        ...

    def miou(self, network: Network) -> float:
        """On the validation scenes."""
        ...

    def model(self, network: Network, provenance: dict) -> Model:
        """The finished model of the network."""
        ...


def course_of(run: TrainingRun, device: torch.device) -> TrainingTask:
    """The course of a run's kind of network.

    Raises:
        InputError: a part too small to be learnt, deformations that do not fit the network.
    """
    return RegistrationTask(run, device) if run.config.network.warps else OccupancyTask(run, device)


class OccupancyTask:
    """Labels of points about surfaces, in the paper's way."""

    def __init__(self, run: TrainingRun, device: torch.device) -> None:
        self._run, self._device = run, device
        self.points = OccupancyPool(run.anatomy_ct, run.config.scene.occupancy, run.seed)
        self.body = body_for(run.anatomy_ct, run.up_lps, run.config.scene, run.seed)

    @cached_property
    def _scenes(self) -> ValidationScenes:
        run = self._run
        simulator = Simulator(run.anatomy_ct, run.up_lps, run.config.scene, self.body)
        return validation_scenes(simulator, self.points.parts[0], run.config, run.seed)

    @cached_property
    def _validation(self) -> ValidationSet:
        return ValidationSet(self._scenes, len(self._run.anatomy_ct.parts) + 1, self._device)

    def teach(self, network: Network) -> None:
        """An occupancy network starts with nothing."""

    def miou(self, network: Network) -> float:
        assert isinstance(network, OccupancyNetwork)
        return self._validation.miou(network)

    def model(self, network: Network, provenance: dict) -> Model:
        assert isinstance(network, OccupancyNetwork)
        return Model(
            network,
            self._run.config,
            self._run.anatomy_ct.names,
            self._scenes.query_box_mm,
            self._validation.familiar(network),
            provenance,
        )
