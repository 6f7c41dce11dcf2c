"""Checks of the Triton hash grid against the plain definition; run by `test_kernels`.

They run on a GPU, or, with TRITON_INTERPRET=1 set before triton is imported, on the CPU.
"""

from __future__ import annotations

import os

import pytest
import torch
from torch import Tensor

from pipelines.nerf.engines.gpu.parts.hash_grid import POINTS_PER_PROGRAM, hash_encode_triton
from pipelines.nerf.errors import NerfError
from pipelines.nerf.networks.encodings import hash_encode
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.space.hash_levels import level_layout

DEVICE = torch.device("cpu" if os.environ.get("TRITON_INTERPRET") == "1" else "cuda")
Levels = tuple[Tensor, Tensor, Tensor]

MIXED = HashGridConfig(num_levels=3, min_res=4, max_res=40, log2_table_size=9)
ONLY_DENSE = HashGridConfig(num_levels=2, min_res=2, max_res=5, log2_table_size=8)
ONLY_HASHED = HashGridConfig(num_levels=1, min_res=2000, max_res=2000, log2_table_size=8)


def levels_of(config: HashGridConfig) -> Levels:
    """Resolutions, dense flags and offsets as tensors."""
    layout = level_layout(config)
    return (
        torch.tensor(layout.resolutions, device=DEVICE),
        torch.tensor(layout.dense, device=DEVICE),
        torch.tensor(layout.offsets, device=DEVICE),
    )


def drawn(
    config: HashGridConfig, num_points: int, num_features: int, dtype: torch.dtype
) -> tuple[Tensor, Tensor, Levels]:
    """Points in and around the unit cube, and a table."""
    levels = levels_of(config)
    random = torch.Generator().manual_seed(num_points)
    points = torch.rand(num_points, 3, generator=random, dtype=dtype) * 1.2 - 0.1
    table = torch.randn(int(levels[2][-1]), num_features, generator=random, dtype=dtype)
    return points.to(DEVICE), table.to(DEVICE), levels


@pytest.mark.parametrize(
    ("config", "num_features"),
    [(MIXED, 1), (MIXED, 2), (MIXED, 3), (MIXED, 8), (ONLY_DENSE, 2), (ONLY_HASHED, 2)],
)
def test_features_are_those_of_the_plain_definition(
    config: HashGridConfig, num_features: int
) -> None:
    points, table, levels = drawn(config, 37, num_features, torch.float32)
    # A position of 2000 cells keeps 13 of its 24 bits for the place inside a cell.
    found = hash_encode_triton(points, table, *levels)
    torch.testing.assert_close(found, hash_encode(points, table, *levels), rtol=1e-5, atol=2e-3)


@pytest.mark.parametrize(
    "num_points", [1, POINTS_PER_PROGRAM - 1, POINTS_PER_PROGRAM, POINTS_PER_PROGRAM + 1]
)
def test_every_point_of_a_block_is_encoded_and_none_behind_it(num_points: int) -> None:
    points, table, levels = drawn(MIXED, num_points, 2, torch.float32)
    found = hash_encode_triton(points, table, *levels)
    assert found.shape == (num_points, 6)
    torch.testing.assert_close(found, hash_encode(points, table, *levels), rtol=1e-5, atol=1e-5)


def test_vertices_and_faces_belong_to_the_cells_of_the_plain_definition() -> None:
    _, table, levels = drawn(MIXED, 1, 2, torch.float32)
    steps = torch.arange(0.0, 1.01, 0.125, device=DEVICE)
    points = torch.cartesian_prod(steps, steps[::4], steps[::8])
    found = hash_encode_triton(points, table, *levels)
    torch.testing.assert_close(found, hash_encode(points, table, *levels), rtol=1e-5, atol=1e-5)


def test_a_vertex_of_a_dense_level_shows_its_entry() -> None:
    _, table, levels = drawn(ONLY_DENSE, 1, 2, torch.float32)
    point = torch.tensor([[0.5, 1.0, 0.0]], device=DEVICE)  # 2 cells a side: vertex (1, 2, 0)
    found = hash_encode_triton(point, table, *levels)
    torch.testing.assert_close(found[0, :2], table[1 + 3 * 2])


def test_leading_dimensions_are_kept_and_no_points_give_no_features() -> None:
    points, table, levels = drawn(MIXED, 12, 2, torch.float32)
    found = hash_encode_triton(points.reshape(3, 4, 3), table, *levels)
    assert torch.equal(found.reshape(12, 6), hash_encode_triton(points, table, *levels))
    assert hash_encode_triton(points[:0], table, *levels).shape == (0, 6)


@pytest.mark.parametrize(("config", "num_features"), [(MIXED, 1), (MIXED, 4), (ONLY_DENSE, 2)])
def test_gradients_are_those_of_the_plain_definition(
    config: HashGridConfig, num_features: int
) -> None:
    points, table, levels = drawn(config, 70, num_features, torch.float32)
    points[0] = points[1]  # two points that add to the same entries
    incoming = torch.randn(70, len(levels[0]) * num_features, device=DEVICE)
    found = []
    for encode in (hash_encode_triton, hash_encode):
        place, entries = points.clone().requires_grad_(), table.clone().requires_grad_()
        found.append(
            torch.autograd.grad(encode(place, entries, *levels), (place, entries), incoming)
        )
    torch.testing.assert_close(found[0][0], found[1][0], rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(found[0][1], found[1][1], rtol=1e-5, atol=1e-5)


def test_point_gradients_are_the_slopes_of_the_features() -> None:
    points, table, levels = drawn(ONLY_DENSE, 2, 1, torch.float64)
    place = (0.3 + 0.5 * points).requires_grad_()
    assert torch.autograd.gradcheck(lambda where: hash_encode_triton(where, table, *levels), place)


def test_table_gradient_sums_to_the_incoming_gradient() -> None:
    points, table, levels = drawn(MIXED, 50, 2, torch.float32)
    entries = table.clone().requires_grad_()
    incoming = torch.randn(50, 6, device=DEVICE)
    (found,) = torch.autograd.grad(hash_encode_triton(points, entries, *levels), entries, incoming)
    torch.testing.assert_close(
        found.sum(0), incoming.reshape(50, 3, 2).sum((0, 1)), rtol=1e-4, atol=1e-4
    )


def test_points_beyond_a_face_do_not_move_along_its_axis() -> None:
    _, table, levels = drawn(MIXED, 1, 2, torch.float32)
    point = torch.tensor([[1.5, 0.3, -0.2]], device=DEVICE, requires_grad=True)
    (found,) = torch.autograd.grad(hash_encode_triton(point, table, *levels).sum(), point)
    assert found[0, 0] == 0.0
    assert found[0, 1] != 0.0
    assert found[0, 2] == 0.0


@pytest.mark.parametrize("num_features", [1, 2])
def test_a_half_precision_copy_is_read_and_the_master_learns(num_features: int) -> None:
    points, table, levels = drawn(MIXED, 40, num_features, torch.float32)
    half = table.half()
    incoming = torch.randn(40, 3 * num_features, device=DEVICE)
    place, entries = points.clone().requires_grad_(), table.clone().requires_grad_()
    found = hash_encode_triton(place, entries, *levels, lookup=half)
    plain_place, plain_entries = points.clone().requires_grad_(), half.float().requires_grad_()
    expected = hash_encode(plain_place, plain_entries, *levels)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    ours = torch.autograd.grad(found, (place, entries), incoming)
    theirs = torch.autograd.grad(expected, (plain_place, plain_entries), incoming)
    torch.testing.assert_close(ours[0], theirs[0], rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(ours[1], theirs[1], rtol=1e-5, atol=1e-5)


def test_a_point_that_is_not_a_number_gives_features_that_are_none() -> None:
    _, table, levels = drawn(MIXED, 1, 2, torch.float32)
    point = torch.tensor([[float("nan"), 0.5, 0.5], [0.1, 0.5, 0.5]], device=DEVICE)
    found = hash_encode_triton(point, table, *levels)
    assert found[0].isnan().all()
    assert found[1].isfinite().all()


@pytest.mark.parametrize("case", ["points", "features", "type", "lookup", "strides"])
def test_another_shape_or_type_is_refused_by_name(case: str) -> None:
    points, table, levels = drawn(MIXED, 2, 2, torch.float32)
    arguments = {
        "points": (points[:, :2], table, None),
        "features": (points, table.repeat(1, 5), None),
        "type": (points, table.half(), None),
        "lookup": (points, table, table.half()[1:]),
        "strides": (points, torch.stack([table, table], -1)[..., 0], None),
    }
    places, entries, lookup = arguments[case]
    with pytest.raises(NerfError, match="hash grid cannot be read") as raised:
        hash_encode_triton(places, entries, *levels, lookup=lookup)
    assert raised.value.code == "bad_config"


@pytest.mark.parametrize("num_features", [1, 2])
def test_within_an_autocast_features_and_their_gradients_are_rounded_once(
    num_features: int,
) -> None:
    points, table, levels = drawn(MIXED, 40, num_features, torch.float32)
    incoming = torch.randn(40, 3 * num_features, device=DEVICE).half()
    place, entries = points.clone().requires_grad_(), table.clone().requires_grad_()
    with torch.autocast(DEVICE.type, torch.float16):
        found = hash_encode_triton(place, entries, *levels)
    ours = torch.autograd.grad(found, (place, entries), incoming)
    whole = hash_encode_triton(place, entries, *levels)
    theirs = torch.autograd.grad(whole, (place, entries), incoming.float())
    assert torch.equal(found, whole.half())
    for half, full in zip(ours, theirs, strict=True):
        assert half.dtype == torch.float32
        torch.testing.assert_close(half, full, rtol=1e-5, atol=1e-5)


def test_a_gradient_that_begins_between_two_pairs_is_read_right() -> None:
    points, table, levels = drawn(ONLY_DENSE, 1, 2, torch.float32)
    entries = table.clone().requires_grad_()
    incoming = torch.randn(5, device=DEVICE)
    found = hash_encode_triton(points, entries, *levels)
    (shifted,) = torch.autograd.grad(found, entries, incoming[1:][None], retain_graph=True)
    (own,) = torch.autograd.grad(found, entries, incoming[1:].clone()[None])
    torch.testing.assert_close(shifted, own)
