"""What a run teaches: the points it shows, how it judges, what it leaves; a class per method."""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

import torch

from tumortrack.models.config import RegistrationHeadConfig
from tumortrack.models.model import Model, Network
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import PointSource
from tumortrack.training.occupancy_task import OccupancyTask
from tumortrack.training.registration_task import RegistrationTask
from tumortrack.training.run import TrainingRun

N = TypeVar("N", bound=Network, contravariant=True)


class TrainingTask(Protocol[N]):
    """What training asks of a method."""

    @property
    def points(self) -> PointSource:
        """Those of the training scenes."""
        ...

    @property
    def body(self) -> ElasticBody | None:
        """The organ's, where scenes or model need it."""
        ...

    def teach(self, network: N) -> None:
        """Tell a fresh network what does not have to be learnt."""
        ...

    def miou(self, network: N) -> float:
        """On the validation scenes."""
        ...

    def model(self, network: N, provenance: dict) -> Model:
        """The finished model of the network."""
        ...


def task_of(run: TrainingRun, device: torch.device) -> TrainingTask[Any]:
    """The task of a run's method.

    Raises:
        InputError: a part too small to be learnt, deformations that do not fit the network.
    """
    registers = isinstance(run.config.network.decoder, RegistrationHeadConfig)
    return RegistrationTask(run, device) if registers else OccupancyTask(run, device)
