"""The field's training kernels against the plain definitions, in values and in all gradients.

The plain twin runs in float64, so that what differs is the rounding of the float32 kernels: values
within 1e-5, gradients within 3e-5 of the largest entry of the same tensor. Seen were at most 3e-6
and 1e-5, no more than the plain definitions lose in float32; a wrong term costs 1e-2 and more.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from pipelines.nerf.along_ray.intervals import bin_midpoints, weights_from_density
from pipelines.nerf.along_ray.rendering import composite
from pipelines.nerf.engines.cpu.train.field import render_field, supports
from pipelines.nerf.engines.cpu.train.gradients import accumulate_in_place
from pipelines.nerf.networks.fields import MLP, NerfactoField
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.parts import HashGridConfig

VALUE_ERROR = 1e-5
GRADIENT_ERROR = 3e-5
GRID = HashGridConfig(num_levels=5, max_res=64, log2_table_size=10)


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def linear(mlp: MLP, index: int) -> nn.Linear:
    layer = mlp.layers[index]
    assert isinstance(layer, nn.Linear)
    return layer


def random_field(**changes: object) -> NerfactoField:
    """A small field whose densities reach from fog to walls."""
    torch.manual_seed(1)
    settings: dict[str, object] = {"grid": GRID, "appearance_dim": 6}
    field = NerfactoField(NerfactoConfig(**(settings | changes)), 4)  # type: ignore[arg-type]
    with torch.no_grad():
        field.grid.table.normal_()
        linear(field.density_mlp, -1).weight[0] *= 8.0
        linear(field.density_mlp, -1).bias[0] += 5.0
        linear(field.color_mlp, -1).weight.mul_(4.0)
    return field


class Batch:
    """Rays with their intervals and codes, and gradients to send back."""

    def __init__(self, num_rays: int, num_samples: int, num_codes: int) -> None:
        generator = torch.Generator().manual_seed(2)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator)

        self.origins = torch.rand(num_rays, 3, generator=generator) - 0.5
        self.directions = torch.nn.functional.normalize(normal(num_rays, 3), dim=-1)
        spread = torch.rand(num_rays, num_samples + 1, generator=generator)
        self.t_edges = 4.0 * spread.sort(dim=-1).values
        self.codes = normal(num_rays, num_codes) if num_codes else None
        self.noise = torch.rand(num_rays, 3, generator=generator)
        self.upstream = normal(num_rays, 3), normal(num_rays, num_samples)

    def inputs(self, dtype: torch.dtype = torch.float32) -> list[Tensor]:
        """Fresh leaves: origins, directions and, where there are some, codes."""
        given = [self.origins, self.directions, self.codes]
        return [x.detach().clone().to(dtype).requires_grad_() for x in given if x is not None]


def parameters(field: NerfactoField) -> list[Tensor]:
    return [p for name, p in field.named_parameters() if "appearance" not in name]


def plain_twin(
    field: NerfactoField, batch: Batch, background: str
) -> tuple[list[Tensor], list[Tensor]]:
    """Values and gradients (inputs, then parameters) by the definitions, in float64."""
    exact = copy.deepcopy(field).double()
    leaves = batch.inputs(torch.float64)
    origins, directions, *codes = leaves
    t_edges = batch.t_edges.double()
    points = origins[:, None] + directions[:, None] * bin_midpoints(t_edges)[..., None]
    density, geometry = exact.density(points)
    weights = weights_from_density(density, t_edges)
    colors = exact.color(directions, geometry, codes[0] if codes else None)
    if background == "random":
        rgb = composite(colors, weights, "black")
        rgb = rgb + (1.0 - weights.sum(-1, keepdim=True)) * batch.noise.double()
    else:
        rgb = composite(colors, weights, background)
    upstream = [gradient.double() for gradient in batch.upstream]
    gradients = torch.autograd.grad([rgb, weights], [*leaves, *parameters(exact)], upstream)
    return [rgb, weights], list(gradients)


def fast(field: NerfactoField, batch: Batch, background: str) -> tuple[list[Tensor], list[Tensor]]:
    leaves = batch.inputs()
    origins, directions, *codes = leaves
    noise = batch.noise if background == "random" else None
    values = render_field(
        origins,
        directions,
        batch.t_edges,
        codes[0] if codes else None,
        field,
        background,
        noise=noise,
    )
    gradients = torch.autograd.grad(values, [*leaves, *parameters(field)], batch.upstream)
    return list(values), list(gradients)


def assert_equal_to_rounding(
    found: tuple[list[Tensor], list[Tensor]], expected: tuple[list[Tensor], list[Tensor]]
) -> None:
    for value, twin in zip(found[0], expected[0], strict=True):
        assert value.dtype == torch.float32
        assert (value - twin).abs().max() < VALUE_ERROR
    for gradient, twin in zip(found[1], expected[1], strict=True):
        assert gradient.shape == twin.shape
        assert twin.abs().max() > 0.0
        assert (gradient - twin).abs().max() < GRADIENT_ERROR * twin.abs().max()


@pytest.mark.parametrize("contraction", ["linf", "l2", "none"])
@pytest.mark.parametrize("background", ["last_sample", "black", "white", "random"])
def test_equals_the_plain_definitions(contraction: str, background: str) -> None:
    field = random_field(contraction=contraction)
    batch = Batch(37, 13, 6)
    expected = plain_twin(field, batch, background)
    assert 0.2 < expected[0][1].sum(-1).mean() < 0.999  # rays end in the scene and behind it
    assert_equal_to_rounding(fast(field, batch, background), expected)


@pytest.mark.parametrize(
    ("num_rays", "num_samples", "num_codes", "changes"),
    [
        (1, 1, 0, {}),
        (16, 8, 0, {}),  # one block fills one tile
        (17, 48, 32, {"grid": HashGridConfig(num_levels=16, max_res=64, log2_table_size=12)}),
        (5, 300, 3, {}),  # a ray is longer than two tiles
        (33, 7, 5, {"hidden_dim": 20, "hidden_dim_color": 28, "geo_feature_dim": 6}),
        (9, 4, 1, {"hidden_dim": 9, "hidden_dim_color": 11, "geo_feature_dim": 1}),
    ],
)
def test_shapes_are_free(
    num_rays: int, num_samples: int, num_codes: int, changes: dict[str, object]
) -> None:
    field = random_field(**({"appearance_dim": num_codes} | changes))
    batch = Batch(num_rays, num_samples, num_codes)
    # With one sample its weight does not matter where the last sample is the background.
    assert_equal_to_rounding(fast(field, batch, "black"), plain_twin(field, batch, "black"))


def test_nothing_stands_outside_an_uncontracted_cube() -> None:
    field = random_field(contraction="none")
    batch = Batch(20, 6, 6)
    batch.origins += 10.0
    rgb, weights = render_field(
        batch.origins, batch.directions, batch.t_edges, batch.codes, field, "white"
    )
    assert torch.equal(weights, torch.zeros(20, 6))
    assert torch.equal(rgb, torch.ones(20, 3))


@pytest.mark.parametrize("kept", [0, 1])
def test_one_of_the_outputs_is_enough_for_a_gradient(kept: int) -> None:
    field, batch = random_field(), Batch(20, 6, 6)
    unused = batch.upstream[1 - kept].zero_()
    assert unused.abs().sum() == 0.0
    expected = plain_twin(field, batch, "last_sample")[1]
    leaves = batch.inputs()
    outputs = render_field(leaves[0], leaves[1], batch.t_edges, leaves[2], field, "last_sample")
    table, first = field.grid.table, linear(field.density_mlp, 0).weight
    found = torch.autograd.grad(
        outputs[kept],
        [leaves[0], table, first],
        batch.upstream[kept],
    )
    for gradient, twin in zip(found, (expected[0], expected[3], expected[4]), strict=True):
        assert (gradient - twin).abs().max() < GRADIENT_ERROR * twin.abs().max()


def test_rays_that_stay_put_get_no_gradient_and_change_no_other() -> None:
    field, batch = random_field(), Batch(20, 6, 6)
    expected = fast(field, batch, "black")
    rgb, weights = render_field(
        batch.origins, batch.directions, batch.t_edges, batch.codes, field, "black"
    )
    found = torch.autograd.grad([rgb, weights], parameters(field), batch.upstream)
    # Without slopes the features are summed in another order, hence not to the bit.
    for gradient, twin in zip(found, expected[1][3:], strict=True):
        assert (gradient - twin).abs().max() < GRADIENT_ERROR * twin.abs().max()


def test_results_repeat_to_the_bit_whatever_the_threads() -> None:
    field, batch = random_field(), Batch(300, 20, 6)
    first = fast(field, batch, "last_sample")
    again = fast(field, batch, "last_sample")
    torch.set_num_threads(1)
    alone = fast(field, batch, "last_sample")
    for kind in range(2):
        for a, b, c in zip(first[kind], again[kind], alone[kind], strict=True):
            assert torch.equal(a, b)
            assert torch.equal(a, c)


def test_memory_layout_of_inputs_does_not_matter() -> None:
    field, batch = random_field(), Batch(20, 6, 6)
    assert batch.codes is not None
    expected = fast(field, batch, "white")
    # Transposed twice, the same numbers lie apart in memory.
    batch.origins, batch.directions, batch.t_edges, batch.codes = (
        given.t().contiguous().t()
        for given in (batch.origins, batch.directions, batch.t_edges, batch.codes)
    )
    assert not batch.t_edges.is_contiguous()
    rgb, weights = batch.upstream
    batch.upstream = rgb[:1].expand(20, 3), weights.t().contiguous().t()
    leaves = batch.inputs()
    values = render_field(leaves[0], leaves[1], batch.t_edges, leaves[2], field, "white")
    assert torch.equal(values[0], expected[0][0])
    assert torch.equal(values[1], expected[0][1])
    found = torch.autograd.grad(values, [*leaves, *parameters(field)], batch.upstream)
    batch.upstream = rgb[:1].repeat(20, 1), weights
    for gradient, twin in zip(found, fast(field, batch, "white")[1], strict=True):
        assert torch.equal(gradient, twin)


def test_two_passes_before_one_backward_share_nothing() -> None:
    field = random_field()
    batches = Batch(20, 6, 6), Batch(20, 6, 6)
    batches[1].origins += 0.3
    expected = [fast(field, batch, "last_sample")[1][3] for batch in batches]
    values: list[Tensor] = []
    for batch in batches:
        origins, directions, codes = batch.inputs()
        values += render_field(origins, directions, batch.t_edges, codes, field, "last_sample")
    upstream = [*batches[0].upstream, *batches[1].upstream]
    (found,) = torch.autograd.grad(values, field.grid.table, upstream)
    assert (expected[0] - expected[1]).abs().max() > 0.1 * expected[0].abs().max()
    assert torch.equal(found, expected[0] + expected[1])


def test_backward_can_be_repeated() -> None:
    field, batch = random_field(), Batch(20, 6, 6)
    values = render_field(
        batch.origins, batch.directions, batch.t_edges, batch.codes, field, "black"
    )
    wanted = parameters(field)
    first = torch.autograd.grad(values, wanted, batch.upstream, retain_graph=True)
    second = torch.autograd.grad(values, wanted, batch.upstream)
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a, b)


def test_parameters_that_changed_before_backward_are_noticed() -> None:
    field, batch = random_field(), Batch(20, 6, 6)
    rgb, _ = render_field(
        batch.origins, batch.directions, batch.t_edges, batch.codes, field, "black"
    )
    with torch.no_grad():
        linear(field.color_mlp, 1).weight += 1.0
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        torch.autograd.backward(rgb.sum())


def test_no_rays_are_no_trouble() -> None:
    field, batch = random_field(), Batch(0, 6, 6)
    values, gradients = fast(field, batch, "last_sample")
    assert [tuple(value.shape) for value in values] == [(0, 3), (0, 6)]
    assert all(torch.equal(g, torch.zeros_like(g)) for g in gradients)


def test_table_gradient_is_added_in_place_where_that_is_agreed() -> None:
    field, batch = random_field(), Batch(20, 6, 6)
    expected = fast(field, batch, "black")[1][3]
    accumulate_in_place(field)
    buffer = field.grid.table.grad
    assert buffer is not None
    for _ in range(2):
        values = render_field(
            batch.origins, batch.directions, batch.t_edges, batch.codes, field, "black"
        )
        torch.autograd.backward(values, batch.upstream)
    assert field.grid.table.grad is buffer
    assert (buffer - 2.0 * expected).abs().max() < GRADIENT_ERROR * expected.abs().max()


def test_walls_of_infinite_density_leave_finite_gradients() -> None:
    field, batch = random_field(), Batch(40, 12, 6)
    with torch.no_grad():
        linear(field.density_mlp, -1).weight[0] *= 200.0
    points = batch.origins[:, None] + batch.directions[:, None] * 2.0
    assert torch.isinf(field.density(points)[0]).any()
    values, gradients = fast(field, batch, "last_sample")
    for tensor in [*values, *gradients]:
        assert torch.isfinite(tensor).all()
    assert values[1].sum(-1).max() < 1.0 + 1e-5


def test_a_parameter_that_is_not_a_number_shows() -> None:
    field, batch = random_field(), Batch(20, 6, 6)
    with torch.no_grad():
        linear(field.color_mlp, 1).weight[3, 3] = float("nan")
    values, gradients = fast(field, batch, "black")
    assert torch.isnan(values[0]).any()
    assert torch.isnan(gradients[3]).any()


def test_refuses_what_it_cannot_compute() -> None:
    batch = Batch(4, 3, 6)
    assert supports(random_field())
    others = [
        random_field().double(),
        random_field(
            grid=HashGridConfig(num_levels=5, max_res=64, log2_table_size=10, features_per_level=4)
        ),
    ]
    for field in others:
        assert not supports(field)
        with pytest.raises(ValueError, match="engine 'plain'"):
            render_field(
                batch.origins, batch.directions, batch.t_edges, batch.codes, field, "black"
            )


def test_refuses_inputs_that_do_not_fit() -> None:
    field, batch = random_field(), Batch(4, 3, 6)
    rays = (batch.origins, batch.directions)
    with pytest.raises(ValueError, match="codes has shape"):
        render_field(*rays, batch.t_edges, None, field, "black")
    with pytest.raises(ValueError, match="t_edges has shape"):
        render_field(*rays, batch.t_edges[:2], batch.codes, field, "black")
    with pytest.raises(ValueError, match="no background 'red'"):
        render_field(*rays, batch.t_edges, batch.codes, field, "red")


def test_levels_that_wait_count_nothing_and_are_left_alone() -> None:
    grid = replace(GRID, start_levels=2)
    field = random_field(grid=grid)
    first = int(field.grid.offsets[2])
    with torch.no_grad():
        field.grid.table[first:] = 0.0
    batch = Batch(37, 13, 6)
    everything = fast(field, batch, "last_sample")
    field.grid.active_levels = 2
    found = fast(field, batch, "last_sample")
    expected = plain_twin(field, batch, "last_sample")
    assert_equal_to_rounding(found, expected)
    for value, same in zip(found[0], everything[0], strict=True):
        assert torch.equal(value, same)
    table = len(batch.inputs())  # the first of the parameters
    assert found[1][table].shape == field.grid.table.shape
    assert float(found[1][table][first:].abs().sum()) == 0.0
    assert float(everything[1][table][first:].abs().sum()) > 0.0
