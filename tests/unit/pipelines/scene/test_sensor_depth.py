"""Depth in files comes back as it was, and nothing else passes for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.scene.sensor_depth import load_sensor_depth, save_sensor_depth


def test_depth_comes_back_exactly(tmp_path: Path) -> None:
    z = np.linspace(0.0, 7.0, 24, dtype=np.float32).reshape(4, 6)
    save_sensor_depth(tmp_path / "00001.npz", z)
    found = load_sensor_depth(tmp_path / "00001.npz")
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, z)


def test_what_is_no_depth_is_refused_by_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", y=np.zeros(3))
    np.savez(tmp_path / "flat.npz", z=np.zeros(3))
    np.savez(tmp_path / "objects.npz", z=np.array([{}], dtype=object))
    (tmp_path / "text.npz").write_bytes(b"no array")
    whole = tmp_path / "whole.npz"
    save_sensor_depth(whole, np.ones((40, 60), np.float32))
    (tmp_path / "cut.npz").write_bytes(whole.read_bytes()[:-40])
    for name in ("other", "flat", "objects", "text", "cut", "absent"):
        with pytest.raises(ValueError, match=f"{name}.npz is no depth map"):
            load_sensor_depth(tmp_path / f"{name}.npz")
