"""HDR clips of a chart come out as an SDR screen shows HLG, close to the phone's own SDR clip."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from pipelines.captures.hdr import hlg_from_pq, hlg_signal, pq_light
from pipelines.captures.video_frames import DecodePlan, Frame, decode
from pipelines.tools.ffmpeg import probe
from tests.unit.pipelines.captures.archives import context
from tests.unit.pipelines.captures.hdr_chart import (
    Reading,
    read_chart,
    scene,
    write_clip,
)
from tests.unit.pipelines.captures.hdr_chart import (
    hlg_signal as chart_hlg,
)
from tests.unit.pipelines.captures.hdr_chart import (
    pq_signal as chart_pq,
)

HDR = ("hlg", "pq")


def shown(tmp_path: Path, kind: str) -> Reading:
    """The first frame of the chart's clip, decoded as the product does, saved, and read again."""
    clip = write_clip(tmp_path / f"{kind}.mp4", kind)
    info = probe(clip)
    frames: list[Frame] = []
    plan = DecodePlan(info.width, info.height, hdr=info.hdr)
    decode(clip, plan, context(tmp_path, f"frames-{kind}"), frames.append)
    frames[0].save(tmp_path / "frame.jpg", 98)
    with PIL.Image.open(tmp_path / "frame.jpg") as image:
        return read_chart(np.asarray(image.convert("RGB")))


@pytest.mark.parametrize("kind", HDR)
def test_bright_plain_walls_keep_their_contrast(tmp_path: Path, kind: str) -> None:
    """The same everywhere, about what the SDR clip keeps of a wall a little brighter than white."""
    hdr, sdr = shown(tmp_path, kind), shown(tmp_path, "sdr")
    assert (hdr.contrast > 3.3).all(), hdr.contrast
    assert hdr.contrast[3] > 0.8 * sdr.contrast[3]
    assert (hdr.contrast[4:] > 2 * sdr.contrast[4:]).all(), (hdr.contrast, sdr.contrast)
    assert (np.diff(hdr.wall_levels[:, 1]) > 5).all(), "brighter walls are brighter"
    assert hdr.wall_levels.max() < 230, "nothing is near clipping"


@pytest.mark.parametrize("kind", HDR)
def test_hues_are_those_of_the_sdr_clip(tmp_path: Path, kind: str) -> None:
    hdr, sdr = shown(tmp_path, kind), shown(tmp_path, "sdr")
    turned = hdr.hue_errors_deg(sdr)
    assert turned.mean() < 3.5, turned
    assert turned.max() < 9, turned
    assert 0.75 < (hdr.chroma() / sdr.chroma()).mean() < 1.05
    tints = [np.ptp(reading.wall_levels, axis=1) for reading in (hdr, sdr)]
    assert (np.abs(tints[0] - tints[1]) < 4).all(), "a wall is no more pink than in SDR"


def test_hlg_and_pq_of_one_scene_look_alike(tmp_path: Path) -> None:
    hlg, pq = shown(tmp_path, "hlg"), shown(tmp_path, "pq")
    assert np.abs(hlg.wall_levels - pq.wall_levels).max() < 2.5
    assert np.linalg.norm(hlg.swatches - pq.swatches, axis=1).max() < 3


def test_grey_hlg_keeps_its_signal(tmp_path: Path) -> None:
    """A wall at 0.77 of the signal is at 0.77 of 255: what players show that know no HDR."""
    wall = shown(tmp_path, "hlg").wall_levels[3]
    assert wall.mean() == pytest.approx(0.77 * 255, abs=4)


def test_pq_is_turned_into_the_hlg_of_the_same_scene() -> None:
    light = scene()[::16, ::8]
    np.testing.assert_allclose(hlg_from_pq(chart_pq(light)), chart_hlg(light), atol=2e-4)


def test_pq_and_hlg_at_published_points() -> None:
    """BT.2408 table 1: HLG 38 % and 75 % are PQ 38 % and 58 %, 26 and 203 cd/m2."""
    assert pq_light(np.array(0.38)) == pytest.approx(26, abs=1)
    assert pq_light(np.array(0.58)) == pytest.approx(203, abs=3)
    grey = hlg_from_pq(np.array([[0.38] * 3, [0.58] * 3]))
    np.testing.assert_allclose(grey[:, 0], [0.38, 0.75], atol=0.01)
    assert hlg_signal(np.array(1 / 12)) == pytest.approx(0.5, abs=1e-6)
    assert hlg_signal(np.array(1.0)) == pytest.approx(1.0, abs=1e-6)


def test_any_scratch_folder_will_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    odd = tmp_path / "a,b;c[d] 'e':f\\g"
    odd.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(odd))
    assert shown(tmp_path, "pq").wall_levels.mean() > 100
    assert not list(odd.iterdir()), "nothing is left behind"
