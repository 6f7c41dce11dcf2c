"""The catalogue of exports, and what the registry and the options make of it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import pipelines.exports.kinds
from pipelines.exports.catalogue import EXPORTS, KINDS, get_export
from pipelines.exports.export import Export
from pipelines.exports.surface.surface_file import SURFACE
from pipelines.options import STAGE_OPTIONS
from pipelines.registry import STAGE_NAMES, STAGES, get_stage
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job

HEAVY = ("torch", "numpy", "open3d", "pycolmap", "PIL")


def test_every_file_of_the_room_is_in_the_catalogue_under_its_own_name() -> None:
    files = {path.stem for path in Path(pipelines.exports.kinds.__path__[0]).glob("[!_]*.py")}
    assert files == set(KINDS) == {export.kind for export in EXPORTS}


@pytest.mark.parametrize("export", EXPORTS, ids=KINDS)
def test_an_export_is_a_stage_behind_training(export: Export) -> None:
    stage = get_stage(export.kind)
    others = tuple(kind for kind in export.reads if kind in KINDS)
    assert (stage.after, stage.reads) == (("train", *others), (*export.reads, "train"))
    before = STAGE_NAMES[: STAGE_NAMES.index("train")]
    assert set(before) >= set(export.reads) - set(others), "of what lies before training"
    assert all(KINDS.index(kind) < KINDS.index(export.kind) for kind in others)
    assert not others or export.on_request or export.kind in ("pointcloud", "video"), (
        "a mesh that fails takes no other export with it but the cloud that lies on it and the "
        "film that shows it"
    )
    assert (stage.version, stage.artifacts) == (export.version, export.artifacts)
    assert STAGE_OPTIONS[export.kind] is export.options
    assert stage.options == export.options.__name__
    assert export.artifacts


def test_the_report_waits_for_all_exports_and_reads_them() -> None:
    report = STAGES[-1]
    assert report.name == "report"
    assert set(KINDS) <= set(report.after)
    assert set(KINDS) <= set(report.reads)


def test_names_of_artifacts_are_given_once() -> None:
    names = [artifact.name for stage in STAGES for artifact in stage.artifacts]
    assert len(set(names)) == len(names)


def test_an_unknown_kind_is_a_key_error() -> None:
    with pytest.raises(KeyError):
        get_export("hologram")


def test_the_catalogue_loads_nothing_heavy() -> None:
    program = (
        "import sys, pipelines.exports.catalogue, pipelines.registry, pipelines.options;"
        f"print(*sorted(name for name in {HEAVY!r} if name in sys.modules))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    )
    assert loaded.stdout.split() == []


def test_preloading_brings_what_exports_import_when_they_run() -> None:
    program = (
        "import sys, pipelines.stages.export as stage; stage.preload();"
        "print('open3d' in sys.modules, 'pipelines.exports.formats.mp4' in sys.modules)"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    )
    assert loaded.stdout.split() == ["True", "True"]


@pytest.mark.parametrize("kind", ["mesh", "pointcloud", "video"])
def test_a_job_that_asks_for_nothing_has_what_is_not_on_request(job: Workspace, kind: str) -> None:
    manifest = tiny_job.run(job, kind)
    made = {entry["path"] for entry in manifest["files"]} - {SURFACE}
    expected = {one.path for one in get_export(kind).artifacts if not one.on_request}
    assert made == expected
