"""Peak memory and pauses of what a mesh is made by, at its largest.

    python -m tests.benchmarks.mesh_memory [--views 300] [--resolutions 256,2048]
        [--texture-px 8192] [--triangles 2000000] [--json out/mesh-memory.json]

Each row is a process of its own, with no model in it: analytic depth views of a ball fused at a
resolution by TSDF and by Poisson, bounds included, as `mesh` does it (cleaned and reduced to
200,000 triangles); the ball painted with 24 photos of 3000 px; a ball of many triangles reduced to
a tenth. `beyond` is what the peak is above the process before; children are told apart. The longest
pause is the longest time between two reports of progress that moved, within which nobody can cancel
either; `of CPU` is the most that this process computed in such a time, which others on the machine
do not lengthen.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.benchmarks.tables import markdown_table, number, write_json

if TYPE_CHECKING:
    from pipelines.exports.surface.shells import Method

MIB = 2**20
_MAX_FACES = 200_000
_PHOTO_PX, _NUM_PHOTOS = 3000, 24


@dataclass
class Row:
    """Bytes: before, at most, of children at most. told: how it went, in words."""

    label: str
    before_bytes: int
    peak_bytes: int
    child_bytes: int
    wall_s: float
    longest_pause_s: float
    longest_pause_cpu_s: float
    told: str


class Watch:
    """What is told of progress: the longest time in which nothing moved, from the first word on."""

    def __init__(self) -> None:
        self.longest_s = self.longest_cpu_s = 0.0
        self._last: float | None = None
        self._at = self._cpu_at = 0.0

    def __call__(self, done: float) -> None:
        now, cpu = time.monotonic(), time.process_time()
        if self._last is not None:
            if done <= self._last:
                return
            self.longest_s = max(self.longest_s, now - self._at)
            self.longest_cpu_s = max(self.longest_cpu_s, cpu - self._cpu_at)
        self._last, self._at, self._cpu_at = done, now, cpu


def fused(method: Method, num_views: int, resolution: int, watch: Watch) -> str:
    """A ball of radius 1 in its bounds."""
    from pipelines.exports.surface.shells import Shell, affordable, fuse_shells
    from pipelines.scene.bounds import SceneBounds
    from pipelines.scene.depth_views import Pinhole, ViewStore
    from tests.unit.pipelines.scene.synthetic_views import ring, sphere_view

    center = np.zeros(3)
    bounds = SceneBounds(center, 3.0, 6.0, center - 1.1, center + 1.1)
    lens = Pinhole(640, 480, 560.0, 560.0, 320.0, 240.0)
    with tempfile.TemporaryDirectory() as folder:
        store = ViewStore(Path(folder))
        for pose in ring(num_views, center):
            store.append(sphere_view(lens, pose, center))
        watch(0.0)
        asked = [Shell(bounds, bounds.longest_side / resolution)]
        shells = affordable(store, asked, lambda done: watch(0.2 * done))
        mesh = fuse_shells(store, shells, _MAX_FACES, lambda done: watch(0.2 + 0.8 * done), method)
    used = bounds.longest_side / shells[0].voxel
    return f"{used:.0f} voxels a side, {len(mesh.faces):,} faces"


def painted(texture_px: int, watch: Watch) -> str:
    """The ball with a picture of photos, as large as that."""
    from PIL import Image

    from pipelines.exports.mesh import TriangleMesh
    from pipelines.exports.texture.bake import texture_from_photos
    from pipelines.exports.texture.photos import Photos
    from pipelines.scene.cameras_file import Intrinsics, PosedImage
    from tests.unit.pipelines.exports.test_reduction import ball
    from tests.unit.pipelines.scene.synthetic_views import ring

    lens = Intrinsics(_PHOTO_PX, _PHOTO_PX, 4200.0, 4200.0, _PHOTO_PX / 2, _PHOTO_PX / 2)
    noise = np.random.default_rng(0).integers(0, 256, (_PHOTO_PX, _PHOTO_PX, 3), np.uint8)
    mesh: TriangleMesh = ball(np.zeros(3), 1.0, 224)
    with tempfile.TemporaryDirectory() as folder:
        images = []
        for index, pose in enumerate(ring(_NUM_PHOTOS, np.zeros(3))):
            Image.fromarray(noise).save(Path(folder) / f"{index}.jpg", quality=80)
            rows = tuple(tuple(map(float, row)) for row in pose)
            images.append(PosedImage(f"{index}.jpg", 0, rows))
        photos = Photos(Path(folder), images, [lens] * len(images))
        watch(0.0)
        made = texture_from_photos(mesh, photos, texture_px, watch)
    height, width = made.texture.shape[:2]
    return f"{len(mesh.faces):,} faces, a picture of {width} x {height} px"


def decimated(triangles: int, watch: Watch) -> str:
    """A ball of so many triangles, a tenth of them kept."""
    from pipelines.exports.reduction import reduced
    from tests.unit.pipelines.exports.test_reduction import ball

    mesh = ball(np.zeros(3), 1.0, round((triangles / 4) ** 0.5))
    watch(0.0)
    few = reduced(mesh, len(mesh.faces) // 10, watch)
    return f"{len(mesh.faces):,} faces to {len(few.faces):,}"


def measure_here(label: str, work: Callable[[Watch], str]) -> Row:
    """The work in this process, with what it imports in `before`."""
    import pipelines.exports.kinds.mesh
    import pipelines.exports.surface.shells
    import pipelines.exports.texture.bake  # noqa: F401  all that is imported counts before
    from tests.benchmarks.machine import peak_memory_bytes

    before = peak_memory_bytes()
    watch = Watch()
    begun = time.monotonic()
    told = work(watch)
    wall_s = time.monotonic() - begun
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    peak, pauses = peak_memory_bytes(), (watch.longest_s, watch.longest_cpu_s)
    return Row(label, before, peak, children, wall_s, *pauses, told)


def work_of(label: str, num_views: int) -> Callable[[Watch], str]:
    """What the row of that label does."""
    kind, _, size = label.partition(" ")
    if kind == "tsdf":
        return lambda watch: fused("tsdf", num_views, int(size), watch)
    if kind == "poisson":
        return lambda watch: fused("poisson", num_views, int(size), watch)
    if kind == "paint":
        return lambda watch: painted(int(size), watch)
    return lambda watch: decimated(int(size), watch)


def measure_apart(label: str, num_views: int) -> Row:
    """`measure_here` in a process of its own."""
    command = [sys.executable, "-m", "tests.benchmarks.mesh_memory", "--child", label]
    answer = subprocess.run(
        [*command, "--views", str(num_views)], capture_output=True, text=True, timeout=7200
    )
    if answer.returncode != 0:
        raise RuntimeError(f"the process of {label} failed:\n{answer.stderr[-2000:]}")
    return Row(**json.loads(answer.stdout.splitlines()[-1]))


def print_report(rows: list[Row]) -> None:
    """The table."""
    cells = [
        [
            row.label,
            row.told,
            number(row.before_bytes / MIB, 0),
            number((row.peak_bytes - row.before_bytes) / MIB, 0),
            number(row.child_bytes / MIB, 0),
            number(row.wall_s, 1),
            number(row.longest_pause_s, 1),
            number(row.longest_pause_cpu_s, 1),
        ]
        for row in rows
    ]
    header = [
        "work",
        "",
        "before MiB",
        "beyond MiB",
        "child MiB",
        "s",
        "longest pause s",
        "of CPU s",
    ]
    print("\n" + markdown_table(header, cells))


def main() -> None:
    """Measure all rows and print; as a child, one."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--views", type=int, default=300)
    parser.add_argument("--resolutions", default="256,2048")
    parser.add_argument("--texture-px", type=int, default=8192)
    parser.add_argument("--triangles", type=int, default=2_000_000)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child is not None:
        row = measure_here(arguments.child, work_of(arguments.child, arguments.views))
        print(json.dumps(asdict(row)))
        return
    from tests.benchmarks.machine import describe, heading

    machine = describe()
    print(heading(machine))
    sizes = arguments.resolutions.split(",")
    labels = [f"{method} {size}" for method in ("tsdf", "poisson") for size in sizes]
    labels += [f"paint {arguments.texture_px}", f"reduce {arguments.triangles}"]
    rows = []
    for label in labels:
        rows.append(measure_apart(label, arguments.views))
        print(json.dumps(asdict(rows[-1])), flush=True)
    print_report(rows)
    values: dict[str, Any] = {"benchmark": "mesh_memory", "machine": machine}
    write_json(arguments.json, {**values, "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    main()
