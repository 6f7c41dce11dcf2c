"""The benchmarks run on a bare GPU machine: what they import, and what pytest makes of them."""

from __future__ import annotations

from pathlib import Path

from tests import benchmarks
from tests.test_architecture import NERF_MAY_IMPORT, imports_of, within

FOLDER = Path(benchmarks.__file__).parent

# Presets are pydantic's: asked for only where a preset is, with an error that says so.
ONLY_FOR_PRESETS = ("settings.py", "pipelines.presets.PRESETS")

# They measure the product around the NeRF, so they need all that it needs.
OF_THE_WHOLE_PRODUCT = (
    "api_process.py",
    "browser.py",
    "delivered.py",
    "film.py",
    "geometry.py",
    "geometry_pictures.py",
    "geometry_truth.py",
    "hung_broker.py",
    "job_overhead.py",
    "long_film.py",
    "mesh_memory.py",
    "pose_accuracy.py",
    "pose_captures.py",
    "poses_both_ways.py",
    "poses_speed.py",
    "poses_ways.py",
    "scene_capture.py",
    "service_load.py",
    "stereo.py",
    "stereo_memory.py",
    "tone_mapping.py",
    "turntable.py",
)


def test_benchmarks_import_only_what_a_bare_machine_has() -> None:
    wrong = []
    for path in FOLDER.glob("*.py"):
        if path.name in OF_THE_WHOLE_PRODUCT:
            continue
        for line, name in imports_of(path):
            ours = within(name, ("pipelines.nerf", "tests.benchmarks"))
            if ours or name.split(".")[0] in NERF_MAY_IMPORT:
                continue
            if (path.name, name) != ONLY_FOR_PRESETS:
                wrong.append(f"{path.name}:{line} imports {name}")
    assert not wrong, "\n".join(wrong)


def test_benchmarks_are_not_collected_as_tests() -> None:
    assert not [path.name for path in FOLDER.glob("*.py") if path.stem.startswith("test_")]
