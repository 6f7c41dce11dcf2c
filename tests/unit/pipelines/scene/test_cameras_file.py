"""`cameras.json` and the cameras inside a model file: one reading for both."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipelines.scene.cameras_file import CamerasFile
from tests.unit.pipelines.exports.posed import FISHEYE, OPENCV, posed


def test_cameras_come_back_from_a_file_and_from_plain_data(tmp_path: Path) -> None:
    cameras = posed(OPENCV, FISHEYE, masks=True)
    cameras.save(tmp_path / "cameras.json")
    assert CamerasFile.load(tmp_path / "cameras.json") == cameras
    assert CamerasFile.from_dict(json.loads(json.dumps(cameras.as_dict()))) == cameras


@pytest.mark.parametrize(
    ("field", "value", "problem"),
    [
        ("world_from_camera", [[1.0, 0.0, 0.0, 0.0]] * 2, "not 3x4"),
        ("world_from_camera", [[1.0, 0.0, 0.0, float("nan")]] * 3, "not finite"),
        ("camera", 7, "camera 7 does not exist"),
        ("light", [1.0, 1.0, 1.0], "three gains and a bend"),
        ("light", [1.0, 0.0, 1.0, 0.5], "three gains and a bend"),
        ("light", [1.0, float("nan"), 1.0, 0.5], "three gains and a bend"),
        ("light", [1.0, 1.0, 1.0, 2.0], "three gains and a bend"),
    ],
)
def test_what_makes_no_sense_is_named(field: str, value: Any, problem: str) -> None:
    raw = posed(OPENCV).as_dict()
    raw["images"][1][field] = value
    with pytest.raises(ValueError, match=rf"00002\.jpg.*{problem}"):
        CamerasFile.from_dict(raw)


def test_light_comes_back_and_tells_the_bend(tmp_path: Path) -> None:
    plain = posed(OPENCV)
    assert plain.bend is None
    first, *others = plain.images
    lit = replace(plain, images=(replace(first, light=(1.1, 0.9, 1.0, 0.8)), *others))
    lit.save(tmp_path / "cameras.json")
    assert CamerasFile.load(tmp_path / "cameras.json") == lit
    assert CamerasFile.from_dict(json.loads(json.dumps(lit.as_dict()))).bend == 0.8


def test_a_file_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    posed(OPENCV).save(path)
    path.write_text(path.read_text("utf-8").replace('"version": 1', '"version": 9'), "utf-8")
    with pytest.raises(ValueError, match="version 9"):
        CamerasFile.load(path)
