"""The temporal distortion: still at the start, still at t = 0, and what it computes."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from pipelines.nerf.errors import NerfError
from pipelines.nerf.networks.temporal import TemporalDistortion


def _points() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(4, 6, 3, generator=generator, dtype=torch.float64) * 2.0 - 1.0


def _moved(**options: Any) -> TemporalDistortion:
    """A distortion whose last layer is no longer zero."""
    torch.manual_seed(1)
    distortion = TemporalDistortion(hidden_dim=8, num_frequencies=2, **options).double()
    last = distortion.layers[-1]
    assert isinstance(last, torch.nn.Linear)
    torch.nn.init.normal_(last.weight)
    torch.nn.init.normal_(last.bias)
    return distortion


TIMES = torch.tensor([0.0, 0.25, 1e-6, 1.0], dtype=torch.float64)


def test_the_scene_starts_out_still_and_can_learn_to_move() -> None:
    torch.manual_seed(0)
    distortion = TemporalDistortion(hidden_dim=8).double()
    offsets = distortion(_points(), TIMES)
    assert torch.equal(offsets, torch.zeros(4, 6, 3, dtype=torch.float64))
    offsets.sum().backward()
    last = distortion.layers[-1]
    assert isinstance(last, torch.nn.Linear)
    assert last.weight.grad is not None
    assert bool(last.weight.grad.abs().sum() > 0.0)


def test_nothing_moves_at_time_zero_whatever_was_learned() -> None:
    offsets = _moved()(_points(), TIMES).detach()
    assert torch.equal(offsets[0], torch.zeros(6, 3, dtype=torch.float64))
    assert all(float(offsets[ray].abs().min()) > 0.0 for ray in (1, 2, 3))


def test_an_offset_equals_the_network_on_fourier_features_by_hand() -> None:
    distortion = _moved(num_layers=3)
    points = _points()
    found = distortion(points, TIMES)[1, 2]

    def features(values: list[float]) -> list[float]:
        angles = [2.0 * math.pi * 2.0**k * value for value in values for k in range(2)]
        return [math.sin(a) for a in angles] + [math.cos(a) for a in angles] + values

    unit = [0.5 * (value + 1.0) for value in points[1, 2].tolist()]
    hidden = torch.tensor(features(unit) + features([0.25]), dtype=torch.float64)
    linear = [layer for layer in distortion.layers if isinstance(layer, torch.nn.Linear)]
    assert len(linear) == 3
    for layer in linear[:-1]:
        hidden = (layer.weight @ hidden + layer.bias).clamp_min(0.0)
    assert torch.allclose(found, linear[-1].weight @ hidden + linear[-1].bias, atol=1e-12)


def test_gradients_are_those_of_the_values() -> None:
    distortion = _moved()
    points = _points()[:, :2].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: distortion(p, TIMES), (points,))


def test_a_scene_learns_a_known_motion() -> None:
    # Points that moved by (0.3 t, 0, -0.1 t): the offsets back to t = 0 are the negative of it.
    torch.manual_seed(0)
    distortion = TemporalDistortion(num_layers=2, hidden_dim=32, num_frequencies=2)
    optimizer = torch.optim.Adam(distortion.parameters(), lr=1e-2)
    speed = torch.tensor([0.3, 0.0, -0.1])
    generator = torch.Generator().manual_seed(0)
    for _ in range(200):
        points = torch.rand(64, 4, 3, generator=generator) * 2.0 - 1.0
        times = torch.rand(64, generator=generator)
        target = -times[:, None, None] * speed
        loss = (distortion(points, times) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    offset = distortion(torch.tensor([[[0.2, -0.4, 0.6]]]), torch.tensor([0.7])).detach()
    assert (offset[0, 0] + 0.7 * speed).abs().max() < 0.03


@pytest.mark.parametrize("options", [{"num_layers": 1}, {"hidden_dim": 0}])
def test_a_network_that_cannot_be_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(NerfError) as caught:
        TemporalDistortion(**options)
    assert caught.value.code == "bad_config"
