"""The network's algebra, invariances and determinism."""

import numpy as np
import pytest
import torch

from refused import refused
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import InputError
from tumortrack_occupancy import sampling
from tumortrack_occupancy.config import MlpDecoderConfig, NetworkConfig
from tumortrack_occupancy.encoders.pointnet2 import PointNet2Config, SetAbstraction
from tumortrack_occupancy.layers import max_over_neighbours
from tumortrack_occupancy.network import MlpDecoder, OccupancyNetwork, octave_features
from tumortrack_occupancy.normalisation import (
    Aligned,
    CloudBox,
    alignment,
    rotated,
    without_outliers,
)
from tumortrack_occupancy.presets import paper_network, quick_network
from tumortrack_occupancy.sampling import ball_query, farthest_points, strided_points, take


def slim_paper() -> NetworkConfig:
    """The paper's structure (farthest points, batch norm, skip) in small."""
    return NetworkConfig(
        encoder=PointNet2Config(
            levels=(
                SetAbstraction(ratio=0.5, radius=0.3, neighbours=8, widths=(8, 8, 16)),
                SetAbstraction(ratio=0.25, radius=0.5, neighbours=8, widths=(16, 16)),
            ),
            widths=(16, 32),
        ),
        decoder=MlpDecoderConfig(
            n_classes=4, width=16, hidden_layers=8, skip_layer=5, norm_layers=(5, 8)
        ),
        normalisation=CloudBox(),
    )


CONFIGS = {"slim paper": slim_paper(), "quick": quick_network(4, scale_mm=60.0)}


@pytest.fixture(params=CONFIGS)
def config(request) -> NetworkConfig:
    return CONFIGS[request.param]


def seeded(config: NetworkConfig, seed: int = 0) -> OccupancyNetwork:
    torch.manual_seed(seed)
    return OccupancyNetwork(config)


def scene(batch: int = 2, n: int = 300, q: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    """Upper halves of ellipsoids, and queries around them; camera frame, mm."""
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(batch, n, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    directions[..., 2] = -np.abs(directions[..., 2])
    middle = np.array([5.0, -8.0, 150.0])
    points = directions * [55, 30, 25] + middle
    queries = rng.uniform(-1, 1, (batch, q, 3)) * [70, 40, 35] + middle
    return torch.tensor(points, dtype=torch.float32), torch.tensor(queries, dtype=torch.float32)


# --- sampling, against slow references ---


def slow_farthest_points(points: np.ndarray, k: int) -> list[int]:
    def squared(to: np.ndarray) -> np.ndarray:
        d = points - to
        return d[:, 0] ** 2 + d[:, 1] ** 2 + d[:, 2] ** 2

    chosen = [int(squared(points.mean(axis=0)).argmax())]
    while len(chosen) < k:
        chosen.append(int(np.min([squared(points[i]) for i in chosen], axis=0).argmax()))
    return chosen


def slow_ball(points: np.ndarray, centre: np.ndarray, radius: float, k: int) -> list[int]:
    d = points - centre
    inside = np.flatnonzero(d[:, 0] ** 2 + d[:, 1] ** 2 + d[:, 2] ** 2 <= radius**2)[:k]
    return [*inside, *[inside[0]] * (k - len(inside))]


def test_farthest_points_agree_with_the_reference() -> None:
    points = torch.randn(3, 200, 3, generator=torch.Generator().manual_seed(1))
    expected = [slow_farthest_points(cloud.numpy(), 60) for cloud in points]
    assert farthest_points(points, 60).tolist() == expected


def test_compiled_sampling_chooses_as_the_plain_form(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    points = torch.randn(4, 500, 3, generator=torch.Generator().manual_seed(1))
    points[:, 100:150] = points[:, 50:51]  # equal points are a tie
    chosen = farthest_points(points, 470)
    found = ball_query(points, take(points, chosen), 0.6, 16)
    monkeypatch.setattr(sampling, "compiled", lambda _: False)
    assert torch.equal(farthest_points(points, 470), chosen)
    assert torch.equal(ball_query(points, take(points, chosen), 0.6, 16), found)
    assert (found[..., 1] != found[..., 0]).any()


@pytest.mark.parametrize("k", [1, 4, 64])
def test_ball_query_agrees_with_the_reference(k: int) -> None:
    points = torch.randn(2, 200, 3, generator=torch.Generator().manual_seed(1))
    centres = points[:, ::7]
    expected = [
        [slow_ball(cloud.numpy(), centre.numpy(), 0.7, k) for centre in row]
        for cloud, row in zip(points, centres, strict=True)
    ]
    assert ball_query(points, centres, 0.7, k).tolist() == expected


def test_an_empty_ball_gives_the_first_point() -> None:
    points = torch.ones(1, 5, 3)
    assert ball_query(points, points[:, :1] + 10, 1.0, 3).tolist() == [[[0, 0, 0]]]


def test_strided_points_spread_over_the_cloud() -> None:
    chosen = strided_points(torch.zeros(2, 10, 3), 4)
    assert chosen.tolist() == [[0, 2, 5, 7]] * 2


# --- exact algebra, against the naive form ---


@pytest.mark.parametrize(("octaves", "norms"), [((), (3, 5)), ((-1, 0, 2), ())])
def test_decoder_equals_the_plain_concatenation(
    octaves: tuple[int, ...], norms: tuple[int, ...]
) -> None:
    torch.manual_seed(0)
    config = MlpDecoderConfig(
        n_classes=4, width=24, hidden_layers=5, skip_layer=3, norm_layers=norms, octaves=octaves
    )
    decoder = MlpDecoder(config, latent_size=32).double()
    latent, queries = torch.randn(3, 32).double(), torch.randn(3, 40, 3).double()
    query = octave_features(queries, octaves)
    seen = torch.cat([query, latent[:, None].expand(-1, 40, -1)], dim=2)
    hidden = seen
    for number, layer in enumerate(decoder.layers, 1):
        hidden = layer(torch.cat([hidden, seen], dim=2) if number == 3 else hidden)
    torch.testing.assert_close(
        decoder(decoder.prepare(latent), queries), decoder.output(hidden), rtol=0, atol=1e-12
    )


def test_octaves_have_known_values() -> None:
    features = octave_features(torch.tensor([[0.5, 0.25, -1.0]]), (0, 1))
    angles = torch.pi * torch.tensor([0.5, 0.25, -1.0, 1.0, 0.5, -2.0])
    expected = torch.cat([torch.tensor([0.5, 0.25, -1.0]), angles.sin(), angles.cos()])
    torch.testing.assert_close(features[0], expected)


@pytest.mark.parametrize("norm", ["none", "batch"])
def test_set_abstraction_equals_the_plain_concatenation(norm: str) -> None:
    torch.manual_seed(0)
    level = SetAbstraction(ratio=0.25, radius=0.8, neighbours=6, widths=(8, 12))
    before = SetAbstraction(ratio=0.5, radius=0.8, neighbours=6, widths=(5,))
    module = PointNet2Config(levels=(before, level), widths=(4,), norm=norm).build().levels[1]
    module = module.double()
    points, features = torch.randn(2, 40, 3).double(), torch.randn(2, 40, 5).double()
    chosen = farthest_points(points, 10)
    plain = []
    for cloud in range(2):
        for i in chosen[cloud].tolist():
            ids = slow_ball(points[cloud].numpy(), points[cloud, i].numpy(), 0.8, 6)
            offsets = (points[cloud, ids] - points[cloud, i]) / 0.8
            plain.append(torch.cat([offsets, features[cloud, ids]], dim=1))
    expected = module.rest(module.first(torch.stack(plain))).amax(dim=1).view(2, 10, 12)
    centres, out = module(points, features)
    assert torch.equal(centres, take(points, chosen))
    torch.testing.assert_close(out, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", [torch.float32, torch.bfloat16])
def test_the_maximum_has_the_values_and_gradients_of_pooling_after_relu(kind: torch.dtype) -> None:
    torch.manual_seed(1)
    values = torch.randn(2, 5, 4, 33).to(kind)
    values[:, 0] = -values[:, 0].abs()  # none is above zero
    values[0, 1, 2] = values[0, 1, 0] = 2.0  # ties
    values[1, 2, 1], values[1, 2, 3, 5] = -0.0, torch.inf
    after, before = values.clone().requires_grad_(), values.clone().requires_grad_()
    out = torch.relu(max_over_neighbours(after))
    assert torch.equal(out, values.clamp_min(0).amax(2))
    weights = torch.randn_like(out)
    out.backward(weights)
    channels_first = torch.relu(before).permute(0, 3, 1, 2)
    torch.nn.functional.max_pool2d(channels_first, (1, 4)).backward(
        weights.transpose(1, 2)[..., None]
    )
    assert torch.equal(after.grad, before.grad)
    assert after.grad.count_nonzero() > 100
    assert not after.grad[0, 1, 2].any()  # of equal ones the first


@pytest.mark.parametrize("sign", [1, -1])
def test_the_maximum_keeps_nan(sign: int) -> None:
    values = torch.ones(1, 2, 3, 4)
    values[0, 1, 1, 2] = sign * torch.tensor(torch.nan)
    out = torch.relu(max_over_neighbours(values))
    assert out.isnan().nonzero().tolist() == [[0, 1, 2]]
    in_training = torch.relu(max_over_neighbours(values.requires_grad_()))
    assert in_training.isnan().nonzero().tolist() == [[0, 1, 2]]


def test_folded_batch_norms_change_nothing() -> None:
    network = seeded(slim_paper())
    points_mm, queries_mm = scene(batch=4)
    for _ in range(3):  # move the running statistics away from their start
        network(points_mm + torch.randn_like(points_mm), queries_mm)
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            torch.nn.init.normal_(module.weight)
            torch.nn.init.normal_(module.bias)
    network.eval()
    folded = network.folded()
    assert not any(isinstance(m, torch.nn.BatchNorm1d) for m in folded.modules())
    torch.testing.assert_close(
        folded(points_mm, queries_mm), network(points_mm, queries_mm), rtol=1e-4, atol=1e-4
    )


# --- invariances ---


def test_nothing_depends_on_the_camera_distance(config: NetworkConfig) -> None:
    network = seeded(config).eval()
    points_mm, queries_mm = scene()
    shift_mm = torch.tensor([0.0, 0.0, 100.0])
    torch.testing.assert_close(
        network(points_mm + shift_mm, queries_mm + shift_mm),
        network(points_mm, queries_mm),
        rtol=1e-3,
        atol=1e-3,
    )


@pytest.mark.parametrize("degrees", [10.0, 90.0, 200.0])
def test_quick_does_not_depend_on_turns_about_the_cameras_axis(degrees: float) -> None:
    network = seeded(quick_network(4, scale_mm=60.0)).eval()
    points_mm, queries_mm = scene()
    angle = torch.tensor(degrees).deg2rad()
    rows = [[angle.cos(), angle.sin(), 0.0], [-angle.sin(), angle.cos(), 0.0], [0.0, 0.0, 1.0]]
    turn = torch.tensor(rows)
    straight = network(points_mm, queries_mm)
    assert straight.abs().max() > 0.1
    torch.testing.assert_close(
        network(points_mm @ turn, queries_mm @ turn), straight, atol=1e-3, rtol=1e-3
    )
    tilt = torch.tensor([[1.0, 0.0, 0.0], *[[0.0, 0.8, 0.6], [0.0, -0.6, 0.8]]])
    assert (network(points_mm @ tilt, queries_mm @ tilt) - straight).abs().max() > 0.01


def test_alignment_finds_the_longest_direction_and_its_heavier_tail() -> None:
    x = torch.tensor([-1.0, -1.0, -1.0, 0.0, 3.0])
    along = torch.stack([0.6 * x, 0.8 * x, torch.zeros(5)], dim=-1)
    torch.testing.assert_close(alignment(along[None])[:, 0, 0], torch.tensor([0.6, 0.8]))
    torch.testing.assert_close(alignment(-along[None])[:, 0, 0], torch.tensor([-0.6, -0.8]))
    aligned = rotated(along[None], alignment(along[None]))
    torch.testing.assert_close(aligned[0, :, 0], x)


def test_outliers_are_replaced_by_points_within_reach_and_the_rest_keeps_its_order() -> None:
    points_mm, _ = scene(n=300)
    clean = without_outliers(points_mm, 80.0)
    assert torch.equal(clean, points_mm)
    spoiled = points_mm.clone()
    spoiled[0, 5::10] += torch.tensor([0.0, 200.0, 300.0])  # a tenth of one cloud
    out = without_outliers(spoiled, 80.0)
    assert torch.equal(out[1], points_mm[1])
    kept = torch.ones(300, dtype=torch.bool)
    kept[5::10] = False
    assert torch.equal(out[0, :270], points_mm[0, kept])
    assert torch.equal(out[0, 270:], points_mm[0, kept][:30])


def test_of_a_cloud_of_outliers_alone_the_first_remains() -> None:
    points_mm, _ = scene(n=301)
    assert torch.equal(without_outliers(points_mm, 1e-3), points_mm[:, :1].expand(-1, 301, -1))


def test_ten_per_cent_of_background_change_quick_by_little() -> None:
    network = seeded(quick_network(4, scale_mm=60.0)).eval()
    points_mm, _ = scene(n=512)
    before = network.encode(points_mm)
    far = torch.tensor([150.0, -100.0, 120.0])
    spoiled = torch.cat([points_mm[:, :460], points_mm[:, 460:] + far], dim=1)
    after = network.encode(spoiled)
    assert (after.centre_mm - before.centre_mm).norm(dim=2).max() < 1.0
    cosine = (before.rotation * after.rotation).sum(0).abs()  # an ellipsoid has no heavier tail
    assert cosine.min() > 0.999
    plain = spoiled.mean(dim=1, keepdim=True) - points_mm.mean(dim=1, keepdim=True)
    assert plain.norm(dim=2).min() > 10  # what the mean of all points would have done


def test_size_is_lost_by_the_box_and_kept_by_the_fixed_scale() -> None:
    points_mm, queries_mm = scene()
    for config, lost in ((slim_paper(), True), (quick_network(4, 60.0), False)):
        network = seeded(config).eval()
        same = torch.allclose(
            network(points_mm, queries_mm), network(1.5 * points_mm, 1.5 * queries_mm), atol=1e-3
        )
        assert same == lost


def test_every_query_is_answered_alone(config: NetworkConfig) -> None:
    network = seeded(config).eval()
    points_mm, queries_mm = scene()
    latent = network.encode(points_mm)
    whole = network.query(latent, queries_mm)
    parts = [network.query(latent, part) for part in queries_mm.split(17, dim=1)]
    torch.testing.assert_close(torch.cat(parts, dim=1), whole)
    torch.testing.assert_close(network(points_mm[1:], queries_mm[1:]), whole[1:])


def test_the_number_of_points_may_change(config: NetworkConfig) -> None:
    network = seeded(config).eval()
    for n in (200, 1000, 1733):
        points_mm, queries_mm = scene(n=n)
        logits = network(points_mm, queries_mm)
        assert logits.shape == (2, 50, 4)
        assert torch.isfinite(logits).all()


def test_the_cloud_matters(config: NetworkConfig) -> None:
    """A latent that ignored the cloud would pass every invariance."""
    network = seeded(config).eval()
    points_mm, queries_mm = scene()
    turned = points_mm[..., [1, 0, 2]] + torch.tensor([13.0, -13.0, 0.0])
    assert not torch.allclose(
        network(points_mm, queries_mm), network(turned, queries_mm), atol=1e-2
    )


# --- training ---


def gradients(config: NetworkConfig) -> list[torch.Tensor]:
    network = seeded(config)
    logits = network(*scene())
    labels = torch.arange(100) % 4
    torch.nn.functional.cross_entropy(logits.flatten(0, 1), labels).backward()
    return [p.grad for p in network.parameters()]


def test_gradients_repeat_bit_for_bit_and_reach_every_weight(config: NetworkConfig) -> None:
    first, second = gradients(config), gradients(config)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert sum(bool(g.any()) for g in first) >= 0.9 * len(first)


def test_quick_network_learns_which_side_a_point_lies() -> None:
    """Overfits two clouds in bf16: what the training loop does, in small."""
    network = seeded(quick_network(3, scale_mm=60.0))
    points_mm, queries_mm = scene(q=400)
    labels = (queries_mm[..., 2] > 150).long() + (queries_mm[..., 0] > 20).long()
    adam = torch.optim.Adam(network.parameters(), 2e-3)
    for _ in range(120):
        with torch.autocast("cpu", torch.bfloat16):
            logits = network(points_mm, queries_mm)
        loss = torch.nn.functional.cross_entropy(logits.float().flatten(0, 1), labels.flatten())
        adam.zero_grad()
        loss.backward()
        adam.step()
    right = (network.eval()(points_mm, queries_mm).argmax(-1) == labels).float().mean()
    assert right > 0.9


# --- configuration ---


def test_paper_network_has_the_papers_numbers() -> None:
    network = OccupancyNetwork(paper_network(4))
    widths = [layer.linear.out_features for layer in network.decoder.layers]
    normed = [n for n, layer in enumerate(network.decoder.layers, 1) if layer.norm is not None]
    assert widths == [512] * 8
    assert normed == [5, 8]
    assert network.decoder.layers[4].linear.in_features == 512 + 3 + 1024
    assert network.encode(torch.randn(2, 1000, 3)).vector.shape == (2, 1024)


def test_impossible_configurations_are_refused() -> None:
    with refused(InputError, "1..5"):
        MlpDecoderConfig(n_classes=4, width=8, hidden_layers=5, skip_layer=6)
    for wrong in ({"scale_mm": 0.0}, {"reach": -1.0}):
        with refused(InputError, *wrong):
            Aligned(**{"scale_mm": 50.0, "reach": 1.0} | wrong)
    data = to_builtins(quick_network(4, 60.0))
    data["decoder"]["dropout"] = 0.1
    with refused(InputError, "dropout"):
        from_builtins(data, NetworkConfig, "test")
