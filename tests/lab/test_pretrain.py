"""Random kidneys, the frame they share, pretraining on them, and what a patient takes over."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import manifold3d
import msgspec
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from elastic_objects import SMALL, UP, organ
from stories import refusal, tumortrack, write_phantom_case
from tumortrack.cli.training import Train
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.types import Mesh
from tumortrack.registration.canonical_frame import (
    FIELDS,
    UPRIGHT_MM,
    carry_over,
    generic_fields,
    generic_points,
    upright_of,
)
from tumortrack.registration.network import RegistrationNetwork, facing_rotation
from tumortrack.registration.rest_shape import long_axis_of
from tumortrack.simulate.deform import ElasticConfig
from tumortrack.simulate.occupancy import OccupancyConfig
from tumortrack.training.model import SHIPPED, PretrainedWeights, load_start, start_of
from tumortrack.training.presets import clinic, quick
from tumortrack.training.state import (
    TrainingProgress,
    TrainingRun,
    TrainingState,
    provenance,
)
from tumortrack.training.task import TrainingTask, task_of
from tumortrack.training.train import train
from tumortrack_lab.pretraining.kidneys import random_anatomy
from tumortrack_lab.pretraining.pretrain import (
    KidneyStream,
    Pretraining,
    organ_of,
    pretrain,
    pretraining,
)

CPU = torch.device("cpu")
TINY_BODY = msgspec.structs.replace(SMALL, modes=12, responses=24, patches=80, states=8)


def tiny(config):
    """The same configuration with a body, batches and validation of seconds."""
    return msgspec.structs.replace(
        config,
        scene=msgspec.structs.replace(
            config.scene,
            deform=(ElasticConfig(body=TINY_BODY),),
            occupancy=OccupancyConfig(pool=3000, per_side=16),
        ),
        batch_size=4,
        validation_pairs=4,
        validation_points=256,
    )


def a_pretraining() -> Pretraining:
    return Pretraining(tiny(pretraining()), anatomies=2, steps=4, workers=0, device="cpu")


def silent(_: object) -> None:
    pass


@pytest.fixture(scope="module")
def pretrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pretrain") / "start"
    pretrain(a_pretraining(), folder, silent)
    return folder


@pytest.fixture(scope="module")
def start(pretrained: Path) -> PretrainedWeights:
    return load_start(pretrained)


@pytest.fixture(scope="module")
def stream() -> KidneyStream:
    return KidneyStream(a_pretraining())


@pytest.fixture(scope="module")
def task(patient: TrainingRun) -> TrainingTask:
    return task_of(patient, CPU)


@pytest.fixture(scope="module")
def patient(start: PretrainedWeights) -> TrainingRun:
    config = clinic(organ())
    network = msgspec.structs.replace(
        config.network, decoder=msgspec.structs.replace(config.network.decoder, modes=12)
    )
    config = msgspec.structs.replace(tiny(config), network=network)
    return TrainingRun(
        organ(), UP, "no digest", config, steps=2, workers=0, device="cpu", start=start
    )


@pytest.mark.parametrize("seed", range(6))
def test_a_random_kidney_is_closed_and_holds_its_tumors(seed):
    anatomy, up = random_anatomy(seed)
    again, _ = random_anatomy(seed)
    assert np.array_equal(anatomy.organ.vertices_mm, again.organ.vertices_mm)
    assert np.linalg.norm(up) == pytest.approx(1)
    solids = [solid(part) for part in anatomy.parts]
    assert 1 <= len(anatomy.tumors) <= 3
    spread = anatomy.organ.vertices_mm @ long_axis_of(anatomy.organ)
    assert 80 < np.ptp(spread) < 165  # 90 to 130 mm, and bulging tumors
    for part, tumor in zip(anatomy.tumors, solids[1:], strict=True):
        assert 0.4 < part.volume_mm3 / 1000 < 55  # balls of 10 to 45 mm, in ml
        outside = (tumor - solids[0]).volume()
        assert outside < 0.01 * tumor.volume()


def solid(mesh: Mesh) -> manifold3d.Manifold:
    made = manifold3d.Manifold(
        manifold3d.Mesh(mesh.vertices_mm.astype(np.float32), mesh.faces.astype(np.uint32))
    )
    assert made.status() == manifold3d.Error.NoError
    assert made.volume() == pytest.approx(mesh.volume_mm3, rel=1e-3)
    assert made.volume() > 0
    return made


def test_kidneys_differ():
    volumes = {round(random_anatomy(seed)[0].organ.volume_mm3) for seed in range(4)}
    assert len(volumes) == 4


@pytest.mark.parametrize("seed", range(3))
def test_the_upright_frame_does_not_depend_on_the_axes_of_the_ct(seed):
    anatomy, up = random_anatomy(seed)
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    turned = anatomy.organ.moved(anatomy.organ.vertices_mm @ turn.T + [5, 6, 7])
    x, y, z = turn @ up
    here = facing_rotation(up, long_axis_of(anatomy.organ))
    there = facing_rotation((float(x), float(y), float(z)), long_axis_of(turned))
    np.testing.assert_allclose(there @ turn, here, atol=1e-9)
    np.testing.assert_allclose(here @ long_axis_of(anatomy.organ), [1, 0, 0], atol=1e-9)
    _, across, towards = here @ up
    assert across == pytest.approx(0, abs=1e-9)
    assert towards < -0.9


def test_an_organ_seen_along_its_axis_still_has_an_upright_frame():
    frame = facing_rotation((0.0, 0.0, 1.0), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(frame @ [0, 0, 1], [1, 0, 0], atol=1e-12)


def test_the_fields_stretch_and_bend_but_do_not_move_or_turn():
    points = generic_points(2000)
    fields = generic_fields(points).reshape(-1, FIELDS)
    shift = np.tile([1.0, 0, 0], len(points))
    turn = np.cross([0, 1.0, 0], points).ravel()
    np.testing.assert_allclose(fields.T @ np.stack([shift, turn], 1), 0, atol=1e-6)
    stretch = (points * [1.0, 0, 0]).ravel()
    stretch = stretch - shift * points[:, 0].mean()
    found, *_ = np.linalg.lstsq(fields, stretch, rcond=None)
    left = np.linalg.norm(fields @ found - stretch) / np.linalg.norm(stretch)
    assert left < 0.05  # the dense points' own asymmetry
    assert np.sqrt((fields**2).sum(0) / len(points)) == pytest.approx(0.6)


def test_a_stream_shows_every_kidney_in_the_same_frame_and_size(stream):
    points = generic_points(a_pretraining().config.network.decoder.points)
    for number in range(2):
        batch = stream.batch(number)
        rotation, place = batch.camera_from_ct[:, :3, :3], batch.camera_from_ct[:, :3, 3]
        rest = points @ rotation.transpose(0, 2, 1) + place[:, None]
        assert np.linalg.norm(rest - batch.points_mm, axis=-1).mean() < 6  # deformation alone
        assert np.ptp(rest[..., 2], axis=1).max() < 2.2 * UPRIGHT_MM
        scenes, upright = organ_of(a_pretraining(), number)
        upper = rotation @ upright.facing @ scenes.up_lps  # towards the camera, within the tilts
        assert (upper[:, 2] < -0.7).all()


def test_a_patient_is_placed_as_the_pretrained_network_places_any_organ(patient, task, start):
    """Before its own training: the same rotation and place, turned and scaled into its CT."""
    own = RegistrationNetwork(patient.config.network).eval()
    task.initialize(own)
    general = RegistrationNetwork(start.config).eval()
    general.load_state_dict(start.weights)
    body = task.body
    upright = upright_of(organ().organ, UP, body.center_ct, long_axis_of(organ().organ))
    cloud = 20 * torch.randn(3, 300, 3, generator=torch.Generator().manual_seed(0))
    cloud = cloud * torch.tensor([2.0, 1.0, 0.3]) + torch.tensor([0, 0, 130.0])
    with torch.no_grad():
        mine = own.flip_hypotheses(cloud)
        theirs = general.flip_hypotheses(cloud * upright.scale)
    facing = torch.as_tensor(upright.facing, dtype=torch.float32)
    torch.testing.assert_close(mine.rotation, theirs.rotation @ facing, atol=1e-4, rtol=0)
    centre = theirs.centre_mm / upright.scale
    torch.testing.assert_close(mine.centre_mm, centre, atol=1e-2, rtol=0)
    torch.testing.assert_close(mine.right_way, theirs.right_way, atol=1e-3, rtol=0)


def test_fields_that_are_a_patients_modes_are_taken_over_as_they_are(patient, task, start):
    own = RegistrationNetwork(
        msgspec.structs.replace(
            start.config,
            normalisation=patient.config.network.normalisation,
        )
    )
    upright = upright_of(organ().organ, UP, task.body.center_ct, long_axis_of(organ().organ))
    points = generic_points(len(own.points))
    fields = generic_fields(points)
    turned = np.einsum("pdf,dc->pcf", fields, upright.facing) / upright.scale
    own.points.copy_(torch.as_tensor(upright.in_ct(points) - upright.center_ct))
    own.modes.copy_(torch.as_tensor(100 * turned))  # so that the ridge weighs nothing
    carry_over(own, start.weights, upright)
    torch.testing.assert_close(
        100 * own.output.weight[10:], start.weights["output.weight"][10:], atol=1e-3, rtol=1e-3
    )


def test_a_crashed_pretraining_ends_with_the_weights_of_one_that_was_not(
    pretrained, stream, tmp_path, monkeypatch
):
    def crash(status: object) -> None:
        raise RuntimeError("power cut")

    run = replace(a_pretraining(), checkpoint_every_s=0.0)
    broken = tmp_path / "broken"
    monkeypatch.setattr("tumortrack_lab.pretraining.pretrain.KidneyStream", lambda _: stream)
    with monkeypatch.context() as patch:
        patch.setattr("tumortrack.training.train.REPORT_EVERY_S", 0.0)  # after the first step
        with pytest.raises(RuntimeError, match="power cut"):
            pretrain(run, broken, crash)
    assert (broken / "training" / "checkpoint.safetensors").is_file()
    with pytest.raises(ArtifactError, match=r"in --seed \(0 there, 1 here\)\. Give"):
        pretrain(replace(run, seed=1), broken, silent)
    pretrain(run, broken, silent)
    name = "weights.safetensors"
    assert (broken / name).read_bytes() == (pretrained / name).read_bytes()


def test_a_model_says_what_it_started_from(patient, start, tmp_path):
    model = train(patient, tmp_path / "with", silent)
    assert model.provenance["start_sha256"] == start.sha256
    plain = replace(patient, start=None)
    assert plain.differences(patient.decided_by) == "--start"
    assert "start_sha256" not in provenance(plain, TrainingProgress(step=1), CPU)


def test_without_a_step_a_model_is_its_start(patient, task, start, tmp_path):
    run, expected = replace(patient, steps=0), RegistrationNetwork(patient.config.network)
    made = train(run, tmp_path / "model", silent)
    task.initialize(expected)
    for name, value in expected.state_dict().items():
        assert torch.equal(made.network.state_dict()[name], value), name
    assert made.provenance["steps"] == 0
    assert made.provenance["start_sha256"] == start.sha256
    assert made.calibration.std_scale > 0.1
    assert sorted(p.suffix for p in (tmp_path / "model").iterdir()) == [
        *(".json", ".safetensors", ".safetensors")
    ]
    for minutes, end in ((0.0, 0), (1.0, None)):  # none: settled on the way
        timed = replace(patient, steps=None, minutes=minutes)
        assert TrainingState(timed, CPU).progress.end == end
    with pytest.raises(InputError, match="starts from nothing"):
        replace(run, start=None)


def test_the_package_has_a_start_for_every_patient():
    network = clinic(organ()).network
    shipped = start_of(network, None)
    shipped.check(network)
    assert max(float(v.std()) for k, v in shipped.weights.items() if "output" in k) > 0.01
    assert start_of(network, Path("none")) is None
    assert start_of(quick(organ()).network, None) is None
    about = store.read_manifest(SHIPPED, "pretrained")["provenance"]
    assert about["command"].startswith("tumortrack pretrain OUT --anatomies ")
    assert about["steps"] > 0


def test_what_does_not_fit_is_refused(patient, start):
    with pytest.raises(InputError, match="--start is for the preset clinic"):
        TrainingRun(organ(), UP, "no digest", quick(organ()), start=start)
    network = patient.config.network
    wider = msgspec.structs.replace(
        network, decoder=msgspec.structs.replace(network.decoder, width=64)
    )
    other = msgspec.structs.replace(patient.config, network=wider)
    with pytest.raises(InputError, match="another network"):
        replace(patient, config=other)
    with pytest.raises(InputError, match="anatomies is 0"):
        replace(a_pretraining(), anatomies=0)


def test_the_commands_refuse_what_is_no_start_for_them(pretrained, tmp_path):
    case, model = tmp_path / "case", tmp_path / "model"
    write_phantom_case(case)
    with pytest.raises(InputError, match="for the preset clinic"):
        Train(case=case, model=model, preset="quick", start=pretrained).run()
    with pytest.raises(ArtifactError, match="a 'pretrained' is needed"):
        Train(case=case, model=model, start=case).run()
    damaged = tmp_path / "damaged"
    shutil.copytree(pretrained, damaged)
    with (damaged / "weights.safetensors").open("ab") as file:
        file.write(b"x")
    with pytest.raises(ArtifactError, match="changed after it was written"):
        Train(case=case, model=model, start=damaged).run()
    assert not model.exists()


def test_the_command_line_keeps_finished_weights(pretrained):
    message = refusal(tumortrack("pretrain", pretrained, "--steps", 5))
    assert "in --steps (4 there, 5 here), and in --anatomies (2 there, 400 here)." in message


def test_a_head_start_shortens_what_nobody_has_limited(patient):
    config = msgspec.structs.replace(patient.config, steps=60, steps_from_start=7)
    run = replace(patient, config=config, steps=None)
    assert run.end == TrainingState(run, CPU).progress.end == 7
    assert replace(run, start=None).end == 60
    assert replace(run, config=msgspec.structs.replace(config, steps_from_start=None)).end == 60
    assert replace(run, minutes=1.0).end is None
    assert replace(run, minutes=0.0).end == 0
