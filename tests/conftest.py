"""What tests of several packages have of the slim model: its tracker, and scenes for it."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def tracker(slim_model):
    from tumortrack.tracking.model_files import load_model
    from tumortrack.tracking.tracker import Tracker

    return Tracker(load_model(slim_model, "cpu"))


@pytest.fixture(scope="session")
def stages():
    """Scenes that no model was calibrated on, of a body with other states."""
    from elastic_objects import UP
    from tumortrack.simulation.scene import SceneRecipe, Simulator, body_for
    from warp_objects import ANATOMY, slim_elastic

    config = slim_elastic().scene
    simulator = Simulator(ANATOMY, UP, config, body_for(ANATOMY, UP, config, 77))
    return [simulator.render(SceneRecipe(5, "test", index)) for index in range(8)]
