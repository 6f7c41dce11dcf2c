"""Line, plane and voxel grids against slow loops and functions that they represent exactly."""

from __future__ import annotations

import itertools

import pytest
import torch

from pipelines.nerf.errors import NerfError
from pipelines.nerf.networks.tensor_grids import CPEncoding, VMEncoding, VoxelGrid

KINDS = (CPEncoding, VMEncoding, VoxelGrid)
Encoding = CPEncoding | VMEncoding | VoxelGrid


def _points(num: int) -> torch.Tensor:
    """Points in and around the unit cube, its corners among them."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(num, 3, generator=generator, dtype=torch.float64) * 1.2 - 0.1
    points[:3] = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.5, 1.0, 0.0]])
    return points


def _inner_points(encoding: Encoding, num: int) -> torch.Tensor:
    """Points away from cell faces, where the derivative jumps."""
    generator = torch.Generator().manual_seed(1)
    cells = encoding.resolution - 1
    cell = torch.randint(cells, (num, 3), generator=generator)
    share = 0.1 + 0.8 * torch.rand(num, 3, generator=generator, dtype=torch.float64)
    return (cell + share) / cells


def _made(kind: type[Encoding], resolution: int = 5, features: int = 3) -> Encoding:
    torch.manual_seed(3)
    return kind(resolution, features).double()


def _hat(position: float, vertex: int) -> float:
    """The weight of a vertex: 1 on it, 0 at its neighbours, linear between."""
    return max(0.0, 1.0 - abs(position - vertex))


def _slow_line(line: torch.Tensor, u: float) -> torch.Tensor:
    size = len(line)
    position = min(max(u, 0.0), 1.0) * (size - 1)
    total = torch.zeros(line.shape[1], dtype=torch.float64)
    for i in range(size):
        total += _hat(position, i) * line[i]
    return total


def _slow_plane(plane: torch.Tensor, u: float, v: float) -> torch.Tensor:
    rows = torch.stack([_slow_line(plane[i], v) for i in range(len(plane))])
    return _slow_line(rows, u)


def _slow(encoding: Encoding, point: list[float]) -> torch.Tensor:
    x, y, z = point
    if isinstance(encoding, VoxelGrid):
        vertices = encoding.vertices.detach()
        planes = torch.stack([_slow_plane(vertices[i], y, z) for i in range(len(vertices))])
        return _slow_line(planes, x)
    a, b, c = (_slow_line(encoding.lines.detach()[k], point[k]) for k in range(3))
    if isinstance(encoding, CPEncoding):
        return a * b * c
    planes = encoding.planes.detach()
    by_mode = [
        a * _slow_plane(planes[0], y, z),
        b * _slow_plane(planes[1], x, z),
        c * _slow_plane(planes[2], x, y),
    ]
    return torch.cat(by_mode)


@pytest.mark.parametrize("kind", KINDS)
def test_features_equal_a_loop_over_all_vertices(kind: type[Encoding]) -> None:
    encoding, points = _made(kind), _points(25)
    expected = torch.stack([_slow(encoding, point) for point in points.tolist()])
    assert expected.shape[1] == encoding.num_outputs
    assert torch.allclose(encoding(points), expected, atol=1e-12)


@pytest.mark.parametrize(("kind", "outputs"), [(CPEncoding, 7), (VMEncoding, 21), (VoxelGrid, 7)])
def test_the_number_of_outputs_is_stated(kind: type[Encoding], outputs: int) -> None:
    encoding = kind(4, 7)
    assert encoding.resolution == 4
    assert encoding.num_outputs == outputs
    assert encoding(torch.rand(2, 5, 3)).shape == (2, 5, outputs)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_those_of_the_values_twice(kind: type[Encoding]) -> None:
    encoding = _made(kind, resolution=3, features=2)
    points = _inner_points(encoding, 3).requires_grad_()
    names = [name for name, _ in encoding.named_parameters()]

    def encode(points: torch.Tensor, *values: torch.Tensor) -> torch.Tensor:
        state = dict(zip(names, values, strict=True))
        return torch.func.functional_call(encoding, state, points)

    inputs = (points, *encoding.parameters())
    assert torch.autograd.gradcheck(encode, inputs, fast_mode=True)
    assert torch.autograd.gradgradcheck(encode, inputs, fast_mode=True)


def test_cp_represents_a_product_of_lines_exactly() -> None:
    # f(x, y, z) = (1 + 2 x)(3 - y)(0.5 + z): linear along each axis, so two vertices are enough.
    encoding = CPEncoding(2, 1).double()
    ends = torch.tensor([[1.0, 3.0], [3.0, 2.0], [0.5, 1.5]], dtype=torch.float64)
    encoding.lines.data.copy_(ends[..., None])
    points = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    x, y, z = points.unbind(-1)
    expected = (1.0 + 2.0 * x) * (3.0 - y) * (0.5 + z)
    assert torch.allclose(encoding(points)[:, 0], expected, rtol=1e-12)


def test_vm_represents_a_line_times_a_plane_exactly() -> None:
    # Mode 2: y alone times a bilinear function of (x, z); the axes of the plane must not be mixed.
    encoding = VMEncoding(2, 1).double()
    encoding.lines.data.zero_()
    encoding.planes.data.zero_()
    encoding.lines.data[1, :, 0] = torch.tensor([2.0, -1.0])
    for i, k in itertools.product((0, 1), repeat=2):
        encoding.planes.data[1, i, k, 0] = 1.0 + 5.0 * i - 2.0 * k + 4.0 * i * k
    points = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    x, y, z = points.unbind(-1)
    expected = (2.0 - 3.0 * y) * (1.0 + 5.0 * x - 2.0 * z + 4.0 * x * z)
    found = encoding(points)
    assert torch.allclose(found[:, 1], expected, atol=1e-12)
    assert not found[:, [0, 2]].any()


def test_voxels_represent_a_trilinear_function_exactly() -> None:
    grid = VoxelGrid(4, 1).double()
    for i, j, k in itertools.product(range(4), repeat=3):
        x, y, z = i / 3, j / 3, k / 3
        grid.vertices.data[i, j, k, 0] = 1.0 + 2.0 * x - 3.0 * y + z + 4.0 * x * y * z
    points = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    xs, ys, zs = points.unbind(-1)
    expected = 1.0 + 2.0 * xs - 3.0 * ys + zs + 4.0 * xs * ys * zs
    assert torch.allclose(grid(points)[:, 0], expected, rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_refining_to_a_nested_grid_changes_no_value(kind: type[Encoding]) -> None:
    encoding, points = _made(kind, resolution=4), _points(200)
    before = encoding(points)
    old = [value.detach().clone() for value in encoding.parameters()]
    encoding.upsample(10)  # three new cells in each old one
    assert encoding.resolution == 10
    assert torch.allclose(encoding(points), before, atol=1e-12)
    for kept, parameter in zip(old, encoding.parameters(), strict=True):
        value: torch.Tensor = parameter
        for axis in range(value.dim() - 1):
            if value.shape[axis] == 10:
                value = value.index_select(axis, torch.tensor([0, 3, 6, 9]))
        assert torch.equal(kept, value)


@pytest.mark.parametrize("kind", KINDS)
def test_refining_to_any_grid_puts_the_old_function_on_the_new_vertices(
    kind: type[Encoding],
) -> None:
    encoding = _made(kind, resolution=4)
    steps = torch.linspace(0.0, 1.0, 7, dtype=torch.float64)
    vertices = torch.cartesian_prod(steps, steps, steps)
    before = encoding(vertices)
    encoding.upsample(7)
    assert torch.allclose(encoding(vertices), before, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_refined_grids_learn_and_load(kind: type[Encoding]) -> None:
    encoding = _made(kind, resolution=3)
    encoding.upsample(6)
    points = _points(10)
    encoding(points).sum().backward()
    for value in encoding.parameters():
        assert value.grad is not None
        assert bool(value.grad.abs().sum() > 0)
    copy = kind(6, 3).double()
    copy.load_state_dict(encoding.state_dict())
    assert torch.equal(copy(points), encoding(points))


@pytest.mark.parametrize("kind", KINDS)
def test_grids_that_cannot_be_are_refused(kind: type[Encoding]) -> None:
    for resolution, features in ((1, 3), (4, 0)):
        with pytest.raises(NerfError) as caught:
            kind(resolution, features)
        assert caught.value.code == "bad_config"
    with pytest.raises(NerfError):
        kind(4, 3).upsample(1)
