"""The GPU benchmark on a machine without one: its imports, its scene, its whole way on the CPU."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.benchmarks import gpu_scene
from tests.benchmarks.gpu_checks import Check, print_checks
from tests.benchmarks.gpu_scene import ball_capture, ring_cameras, seen_color

ROOT = Path(__file__).resolve().parents[3]
LIMIT_S = 200

ONLY_BARE = """
import importlib.abc, sys, sysconfig
from pathlib import Path
ALLOWED = {"torch", "triton", "numpy", "numba", "llvmlite", "PIL", "skimage", "safetensors"}
# What the allowed ones import themselves comes in through them: only our own imports are looked at.
class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in ALLOWED | set(sys.stdlib_module_names) | {"pipelines", "tests"}:
            return None
        frame = sys._getframe(1)
        while frame and "importlib" in frame.f_code.co_filename:
            frame = frame.f_back
        if frame and str(Path.cwd()) in frame.f_code.co_filename and "site-packages" not in (
            frame.f_code.co_filename
        ):
            raise ModuleNotFoundError(f"{name} is not on a bare machine", name=name)
        return None
sys.meta_path.insert(0, Refuse())
"""

WHOLE_WAY = """
import argparse, json, sys
from dataclasses import replace
from pathlib import Path
import torch
from pipelines.nerf.engines.gpu import self_check
from pipelines.nerf.models.nerfacto import Nerfacto
from tests.benchmarks import gpu_speed, gpu_training
from tests.unit.pipelines.nerf.toy_scene import tiny_config

def set_engine(model, engine):  # both engines are PyTorch's
    model.engine = "plain"
Nerfacto.set_engine = set_engine
self_check.NUM_STEPS = 2
gpu_training.PHASE_STEPS = gpu_training.PROFILED_STEPS = 1
gpu_speed.MADE_IMAGES, gpu_speed.MADE_WIDTH, gpu_speed.MADE_HEIGHT = 8, 24, 16
gpu_speed.FRAME_WIDTH, gpu_speed.FRAME_HEIGHT, gpu_speed.FRAME_SAMPLES = 12, 8, (None,)
gpu_speed.CHECKED_POINTS = 20
given = argparse.Namespace(vs="plain", rays=16, steps=2, skip=1, rounds=2, run_steps=3, frames=1,
    hbm_tb_s=None, half_tflops=None, l2_tb_s=None, capture=None, json=None)
config = replace(tiny_config(rays_per_step=16), device="cpu", engine="plain")
values = {}
status = gpu_speed.measured(given, config, torch.device("cpu"), values)
gpu_speed.write_json(Path(sys.argv[1]), values)
sys.exit(status)
"""


def python(code: str, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, *arguments],
        cwd=ROOT,
        env=dict(os.environ, OMP_NUM_THREADS="1", **variables),
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )


def test_it_imports_on_a_machine_with_eight_packages() -> None:
    code = "import tests.benchmarks.gpu_speed, tests.benchmarks.gpu_checks"
    answer = python(ONLY_BARE + code)
    assert answer.returncode == 0, answer.stderr[-2000:]
    refused = python(ONLY_BARE + "import pipelines.options")
    assert "pydantic is not on a bare machine" in refused.stderr


def test_the_whole_way_is_gone_on_a_cpu(tmp_path: Path) -> None:
    file = tmp_path / "gpu.json"
    answer = python(WHOLE_WAY, str(file), TRITON_INTERPRET="1")
    assert answer.returncode == 0, answer.stdout[-2000:] + answer.stderr[-3000:]
    values = json.loads(file.read_text())
    assert len(values["checks"]) == 2 * 7 + 3 * 2 + 3 + 1
    assert all(check["passed"] for check in values["checks"])
    assert [speed["way"] for speed in values["speeds"]] == 2 * ["graph", "eager", "plain"]
    assert set(values["ratios_to_plain"]) == {"graph", "eager"}
    assert values["run"]["steps"] == 3
    assert 3.0 < values["run"]["psnr"] < 40.0
    assert values["frames"]["plain"]["psnr"] is None
    assert values["frames"]["tiles, samples of the model"]["psnr"] > 30.0
    for text in ("1080p", "steps/s", "MB scattered in L2", "graph / plain"):
        assert text in answer.stdout


def test_a_wrong_kernel_is_shown_and_fails(capsys: pytest.CaptureFixture[str]) -> None:
    right, wrong = Check("one", 1e-4, 1e-3), Check("two", 2e-3, 1e-3)
    assert print_checks([right])
    assert not print_checks([right, wrong])
    assert not print_checks([Check("three", float("nan"), 1.0)])
    assert not print_checks([Check("four", 0.0, 1.0, "RuntimeError: no compiler")])
    assert "four: RuntimeError: no compiler" in capsys.readouterr().out


def test_cameras_of_the_scene_look_at_the_ball_from_distance_one() -> None:
    cameras = ring_cameras(6, 40, 30)
    rays = cameras.generate_rays(torch.arange(6), torch.tensor([[20.0, 15.0]]).expand(6, 2))
    torch.testing.assert_close(rays.origins.norm(dim=-1), torch.ones(6))
    torch.testing.assert_close(rays.directions, -rays.origins, atol=1e-6, rtol=0.0)


def test_colors_are_those_of_a_march_along_the_ray() -> None:
    """The slow twin: small steps until the ball or the floor is met."""
    rays = ring_cameras(2, 12, 8).image_rays(0)
    found = seen_color(rays).numpy()
    phases = np.array(gpu_scene.PHASES)
    kinds = set()
    for origin, direction, color in zip(
        rays.origins.numpy(), rays.directions.numpy(), found, strict=True
    ):
        t = np.arange(0.0, 60.0, 1e-3)[:, None]
        points = origin + t * direction
        ball = np.linalg.norm(points, axis=1) < gpu_scene.BALL_RADIUS
        floor = points[:, 2] < gpu_scene.FLOOR_Z
        met = np.nonzero(ball | floor)[0]
        if len(met) and ball[met[0]]:
            kinds.add("ball")
            normal = points[met[0]] / gpu_scene.BALL_RADIUS
            waves = np.sin(gpu_scene.BALL_WAVES * normal + phases)
            expected = (0.6 + 0.4 * normal[2]) * (0.5 + 0.45 * waves)
            np.testing.assert_allclose(color, np.clip(expected, 0, 1), atol=0.05)
        elif len(met):
            kinds.add("floor")
            x, y, _ = gpu_scene.FLOOR_WAVES * points[met[0]]
            contrast = 0.4 / (1.0 + (t[met[0], 0] / gpu_scene.FLOOR_FADES_AT) ** 2)
            expected = 0.45 + contrast * np.sin(x) * np.sin(y + phases)
            np.testing.assert_allclose(color, np.clip(expected, 0, 1), atol=0.05)
        elif direction[2] >= 0.0:
            kinds.add("sky")
            assert color[0] == pytest.approx(0.75)
    assert kinds == {"ball", "floor", "sky"}


def test_pictures_hold_out_some_of_their_views() -> None:
    capture = ball_capture(20, 16, 12, torch.device("cpu"))
    assert len(capture.images) == len(capture.cameras) == 20
    assert sorted([*capture.train, *capture.test]) == list(range(20))
    seen = seen_color(capture.cameras.image_rays(3)).reshape(12, 16, 3)
    torch.testing.assert_close(capture.images.image(3), seen, atol=0.003, rtol=0.0)
