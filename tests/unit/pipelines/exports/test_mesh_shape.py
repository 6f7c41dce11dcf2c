"""The mesh with the triangles asked for: what is told where that cannot be."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest

from pipelines.errors import ExportError
from pipelines.exports import mesh_shape
from pipelines.exports.mesh import empty_mesh, joined
from pipelines.exports.mesh_options import MeshOptions
from pipelines.exports.mesh_shape import Part, finished
from tests.unit.pipelines.exports.test_reduction import _FAR, ball


class _Context:
    """Of a stage's context what is needed here."""

    logger = logging.getLogger("finished")

    def told_part(self, *_: Any) -> Any:
        return lambda done: None


def done(part: Part, triangles: int) -> Part:
    context: Any = _Context()
    return finished(part, MeshOptions(triangles=triangles), context)


def test_more_triangles_than_were_asked_for_are_told(caplog: pytest.LogCaptureFixture) -> None:
    part = Part(joined([ball(_FAR + 3.0 * i, 1.0, 12) for i in range(30)]))
    assert len(done(part, 1500).mesh.faces) <= 1500
    assert not caplog.records
    made = done(part, 64)
    assert f"has {len(made.mesh.faces)} triangles, and not the 64" in caplog.text


@pytest.mark.parametrize(("method", "is_smoothed"), [("tsdf", True), ("poisson", False)])
def test_only_what_is_fused_in_voxels_loses_its_tremble(
    method: Any, is_smoothed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poisson's surface is smooth as it is."""
    trembling = ball(_FAR, 1.0, 24)
    rng = np.random.default_rng(4)
    trembling.vertices[:] += 0.01 * rng.standard_normal(trembling.vertices.shape)
    told: list[tuple[str, float]] = []

    class Context(_Context):
        def told_part(self, message: str, begin: float, end: float) -> Any:
            return lambda done: told.append((message, begin + (end - begin) * done))

    monkeypatch.setattr(mesh_shape, "_photos", lambda *_: [])  # nothing is there to refine by
    given: Any = method, None, [], MeshOptions(flatten=False), Context()
    moved = np.linalg.norm(
        mesh_shape._on_the_photos(trembling, *given).vertices - trembling.vertices, axis=1
    )
    assert (np.median(moved) > 0.003) == is_smoothed
    assert ("smoothing" in {message for message, _ in told}) == is_smoothed
    assert [share for _, share in told] == sorted(share for _, share in told)


def test_a_mesh_that_vanishes_is_an_error_that_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mesh_shape, "reduced", lambda *_: empty_mesh())
    with pytest.raises(ExportError, match="nothing is left in 64") as caught:
        done(Part(ball(_FAR, 1.0, 12)), 64)
    assert caught.value.code == "empty_mesh"
    assert "mesh.triangles" in caught.value.hint
