"""Depth of a sensor: numbers as they were sent, damage refused by name, no picture lost by it."""

from __future__ import annotations

import io
import random
import struct
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from pipelines.captures.archive_rules import ArchiveLimits
from pipelines.captures.contents import SensorDepth
from pipelines.captures.depth_files import DepthWriter
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.options import IngestOptions
from pipelines.sample.scene import depth_image, pose_matrix
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.sensor_depth import load_sensor_depth
from pipelines.stages.ingest import run
from tests.capture_writers import reduced, write_nerfstudio, write_polycam, write_record3d
from tests.unit.pipelines.captures.archives import (
    context,
    depth_exr,
    depth_npy,
    depth_png,
    depth_tiff,
    write_zip,
)

SIZE = (64, 48)


@contextmanager
def writer_of(tmp_path: Path, **files: bytes) -> Iterator[DepthWriter]:
    tmp_path.mkdir(exist_ok=True)
    path = write_zip(tmp_path / "c.zip", files)
    with CaptureArchive(path, ArchiveLimits()) as archive:
        yield DepthWriter(archive, tmp_path / "out", max_pixels=100_000)


def read(tmp_path: Path, depth: bytes, confidence: bytes | None = None, least: int = 0) -> Any:
    files = {"d": depth} if confidence is None else {"d": depth, "c": confidence}
    with writer_of(tmp_path, **files) as writer:
        rated = None if confidence is None else "c"
        return writer.read(SensorDepth("d", 0.001, rated, least), SIZE)


def test_counts_of_16_bits_become_units(tmp_path: Path) -> None:
    counts = np.random.default_rng(3).integers(0, 65536, (48, 64), np.uint16)
    z = read(tmp_path, depth_png(counts))
    assert z.dtype == np.float32
    np.testing.assert_allclose(z, counts * 0.001, rtol=1e-6)


def test_what_is_not_known_or_not_trusted_is_0(tmp_path: Path) -> None:
    values = np.ones((48, 64))
    values[0, :5] = [0.0, -2.0, np.nan, np.inf, -np.inf]
    confidence = np.full((48, 64), 2, np.uint8)
    confidence[1, 0], confidence[1, 1] = 1, 0
    z = read(tmp_path, depth_exr(values), depth_png(confidence), 2)
    known = np.ones((48, 64), bool)
    known[0, :5] = known[1, :2] = False
    np.testing.assert_array_equal(z, np.where(known, np.float32(0.001), 0))


@pytest.mark.parametrize(("width", "fits"), [(64, True), (65, True), (63, True), (66, False)])
def test_aspect_may_differ_by_two_percent(tmp_path: Path, width: int, fits: bool) -> None:
    depth = depth_png(np.ones((48, width), np.uint16))
    if fits:
        assert read(tmp_path, depth).shape == (48, width)
    else:
        with pytest.raises(CaptureError, match="66x48, its picture 64x48: not the same view"):
            read(tmp_path, depth)


def test_a_unit_beyond_all_numbers_leaves_nothing(tmp_path: Path) -> None:
    counts = depth_png(np.ones((48, 64), np.uint16))
    with (
        writer_of(tmp_path, d=counts) as writer,
        pytest.raises(CaptureError, match="can be trusted"),
    ):
        writer.read(SensorDepth("d", 1e300), SIZE)


def test_writer_tells_what_it_refused_and_removes_an_empty_folder(tmp_path: Path) -> None:
    with writer_of(tmp_path, a=b"text", b=depth_png(np.zeros((48, 64), np.uint16))) as writer:
        assert [writer.store(SensorDepth(name, 1.0), 1, SIZE) for name in "ab"] == [None, None]
        writer.close()
        (told,) = writer.warnings
    assert "2 of 2 depth maps cannot be used" in told
    assert '"a" is neither a PNG, a TIFF, OpenEXR nor NumPy' in told
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("dtype", ["u2", ">u2", "i4", "i8", "f2", "f4", ">f8"])
@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 1), (1, 48, 64)])
def test_arrays_of_numpy_are_read_as_they_are(
    tmp_path: Path, dtype: str, shape: tuple[int, ...]
) -> None:
    counts = np.random.default_rng(3).integers(0, 2000, (48, 64)).astype(dtype)
    z = read(tmp_path, depth_npy(counts.reshape(shape)))
    np.testing.assert_allclose(z, counts.astype(float) * 0.001, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.float32])
def test_tiffs_of_one_channel_are_read(tmp_path: Path, dtype: type) -> None:
    counts: np.ndarray = np.random.default_rng(3).integers(0, 60_000, (48, 64)).astype(dtype)
    np.testing.assert_allclose(read(tmp_path, depth_tiff(counts)), counts * 0.001, rtol=1e-6)


@pytest.mark.parametrize("channel", ["R", "Z", "Y", "V", "ViewLayer.Depth.Z", "Depth.V"])
def test_openexr_has_its_depth_in_the_channel_that_its_writer_calls_so(
    tmp_path: Path, channel: str
) -> None:
    values = np.full((48, 64), 1.5, np.float16)
    np.testing.assert_allclose(read(tmp_path, depth_exr(values, channel)), 0.0015)
    with pytest.raises(CaptureError, match="no channel Z, V, R or Y"):
        read(tmp_path / "other", depth_exr(values, "Blue"))


DEEP, COLORS = np.full((48, 64), 3.0, np.float16), np.full((48, 64), 0.2, np.float16)


def test_depth_beside_colours_and_normals_is_the_depth_or_is_refused(tmp_path: Path) -> None:
    for number, channels in enumerate(
        (
            {"R": COLORS, "G": COLORS, "B": COLORS, "Z": DEEP},
            {"Combined.R": COLORS, "Combined.G": 2 * COLORS, "Depth.Z": DEEP},
            {"Depth.Z": DEEP, "Normal.X": COLORS, "Normal.Y": COLORS, "Normal.Z": -COLORS},
            {"R": DEEP, "G": DEEP, "B": DEEP},  # one number, as a picture
        )
    ):
        (first, values), *more = channels.items()
        z = read(tmp_path / f"read{number}", depth_exr(values, first, **dict(more)))
        np.testing.assert_allclose(z, 0.003, rtol=1e-3)
    for number, (channels, why) in enumerate(
        (
            ({"X": COLORS, "Y": COLORS, "Z": COLORS}, "no channel Z"),
            ({"A.Z": DEEP, "B.Z": COLORS}, "no channel Z"),
            ({"R": COLORS, "G": 2 * COLORS, "B": COLORS}, "has colours"),
        )
    ):
        (first, values), *more = channels.items()
        with pytest.raises(CaptureError, match=why):
            read(tmp_path / f"refused{number}", depth_exr(values, first, **dict(more)))


def npy_saying(header: str, version: int = 1) -> bytes:
    """An array's bytes behind any header."""
    size = len(header).to_bytes(2 if version == 1 else 4, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + size + header.encode("latin1") + bytes(48 * 64 * 8)


@pytest.mark.parametrize(
    "descr",
    [
        "'<m8[s/0]'",
        "'<M8[s/0]'",
        "()",
        "('<f4',)",
        "[('a', '<f4')]",
        "'<f4', 'descr': '<m8[s/0]'",
        "'|O'",
        "'<f16'",
        "7",
        "None",
    ],
)
def test_no_array_of_another_kind_ends_the_process(tmp_path: Path, descr: str) -> None:
    """NumPy divides by zero in C for the first ones."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': (48, 64), }}"
    for version in (1, 2, 3):
        with pytest.raises(CaptureError, match="not one number for each pixel"):
            read(tmp_path / str(version), npy_saying(header, version))


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (48, -64)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (48, True)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': 64}",
        "{'descr': '<f4', 'shape': (48, 64)}",
        "(" * 5000,
        "__import__('os')",
        "[1, 2]",
        "",
    ],
)
def test_headers_that_make_no_sense_are_refused(tmp_path: Path, header: str) -> None:
    with pytest.raises(CaptureError, match="does not decode"):
        read(tmp_path, npy_saying(header))


def test_arrays_by_columns_stand_as_they_are(tmp_path: Path) -> None:
    values = np.arange(1, 48 * 64 + 1, dtype=np.float32).reshape(48, 64)
    z = read(tmp_path, depth_npy(np.asfortranarray(values)))
    np.testing.assert_allclose(z, 0.001 * values, rtol=1e-6)


def test_what_was_refused_is_not_held(tmp_path: Path) -> None:
    """Hundreds of maps of another aspect were kept by the errors' frames, with their files."""
    wrong = depth_npy(np.ones((64, 64), np.float32))
    with writer_of(tmp_path, **{f"d{number}": wrong for number in range(40)}) as writer:
        tracemalloc.start()
        try:
            for number in range(40):
                assert writer.store(SensorDepth(f"d{number}", 1.0), number, SIZE) is None
            held, _ = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert held < 10 * 64 * 64 * 4
        assert isinstance(writer.warnings[0], str)


@pytest.mark.parametrize("write", [depth_npy, depth_tiff])
def test_what_a_renderer_met_nothing_at_is_not_known(
    tmp_path: Path, write: Callable[[Any], bytes]
) -> None:
    values = np.full((48, 64), 2.0, np.float32)
    values[0, :5] = [65504.0, 1e10, np.inf, 70_000.0, 65_000.0]
    assert (read(tmp_path, write(values)) > 0).sum() == values.size - 3


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (depth_npy(np.array([[{}]], object), pickled=True), "not one number for each pixel"),
        (depth_npy(np.ones((48, 64, 3))), "not one number for each pixel"),
        (depth_npy(np.ones((48, 64), complex)), "not one number for each pixel"),
        (depth_npy(np.ones(48)), "not one number for each pixel"),
        (depth_npy(np.ones((48, 64), np.uint8)), "has 8 bits"),
        (depth_npy(np.ones((480, 640), np.uint16)), "100000 are allowed"),
        (depth_npy(np.ones((0, 64))), "64x0 pixels"),
        (depth_npy(np.ones((48, 64)))[:-1], "does not decode"),
        (depth_npy(np.ones((48, 64)))[:9], "does not decode"),
        (depth_npy(np.ones((48, 64)))[:6], "does not decode"),
        (b"\x93NUMPY\x09\x00" + bytes(100), "does not decode"),
        (
            depth_npy(np.ones((48, 64))).replace(
                b"(48, 64), }" + b" " * 18, b"(48, 6" + b"0" * 20 + b"), "
            ),
            "does not decode",
        ),
        (depth_tiff(np.zeros((48, 64, 3), np.uint8)), "has colours"),
        (depth_tiff(np.ones((48, 64), np.uint16))[:200], "does not decode"),
    ],
)
def test_damage_and_other_arrays_are_refused_by_name(tmp_path: Path, data: bytes, why: str) -> None:
    with pytest.raises(CaptureError, match=why) as caught:
        read(tmp_path, data)
    assert caught.value.code == "image_undecodable"
    assert '"d"' in caught.value.message


def _boxed(data: bytes, *box: int) -> bytes:
    """An OpenEXR whose header says another data window."""
    changed = bytearray(data)
    struct.pack_into("<4i", changed, data.index(b"dataWindow\0box2i\0") + 21, *box)
    return bytes(changed)


@pytest.mark.parametrize(
    "box",
    [
        (0, 0, 100_000, 100_000),
        (0, 0, 191, 40_000_000),
        (0, 0, 2**30, 255),
        (-(2**31), -(2**31), 2**31 - 1, 2**31 - 1),
        (0, 0, -1, -1),
        (0, 0, 128, 47),
    ],
)
def test_openexr_of_an_absurd_size_is_refused_before_it_is_read(
    tmp_path: Path, box: tuple[int, int, int, int]
) -> None:
    with pytest.raises(CaptureError) as caught:
        read(tmp_path, _boxed(depth_exr(np.ones((48, 64))), *box))
    assert caught.value.code == "image_undecodable"
    assert '"d"' in caught.value.message
    assert caught.value.hint


def _several_parts() -> bytes:
    parts = [OpenEXR.Part({}, {"R": np.ones((48, 64), np.float16)}, name) for name in "ab"]
    return _written(OpenEXR.File(parts))


def _tiled() -> bytes:
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    header = {"type": OpenEXR.tiledimage, "tiles": tiles}
    return _written(OpenEXR.File(header, {"R": np.ones((48, 64), np.float16)}))


def _of_integers() -> bytes:
    return _written(OpenEXR.File({}, {"R": np.ones((48, 64), np.uint32)}))


def _written(file: OpenEXR.File) -> bytes:
    stream = io.BytesIO()
    file.write(stream)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (_several_parts, "2 images"),
        (_tiled, "tiled"),
        (_of_integers, "no channel Z, V, R or Y of plain"),
    ],
)
def test_openexr_of_another_kind_is_refused(
    tmp_path: Path, make: Callable[[], bytes], why: str
) -> None:
    with pytest.raises(CaptureError, match=why):
        read(tmp_path, make())


@pytest.mark.parametrize("kind", ["png", "exr"])
def test_damaged_files_are_read_or_refused_and_nothing_else(tmp_path: Path, kind: str) -> None:
    rng = random.Random(kind)
    values = np.random.default_rng(0).uniform(0.5, 4.0, (48, 64))
    whole = depth_exr(values) if kind == "exr" else depth_png((values * 1000).astype(np.uint16))
    found: Counter[str] = Counter()
    for n in range(200):
        changed = bytearray(whole)
        for _ in range(rng.randint(1, 5)):
            place = rng.randrange(4, 400 if rng.random() < 0.6 else len(changed))
            changed[place] = rng.choice([0, 1, 3, 0x7F, 0x80, 0xFF, rng.randrange(256)])
        if rng.random() < 0.1:
            del changed[rng.randrange(8, len(changed)) :]
        try:
            z = read(tmp_path / str(n), bytes(changed))
        except CaptureError as error:
            found[error.code if error.hint else "no hint"] += 1
        else:
            assert np.isfinite(z).all()
            found["read"] += 1
    assert set(found) <= {"read", "image_undecodable"}
    assert found["image_undecodable"] > 50


@pytest.mark.parametrize(
    ("write", "given"),
    [
        (write_polycam, {}),
        (write_record3d, {"depth": True}),
        (write_nerfstudio, {"depth": True}),
    ],
)
def test_depth_of_every_format_is_that_of_the_scene(
    tmp_path: Path, write: Callable[..., CamerasFile], given: dict[str, bool]
) -> None:
    """Within half a millimetre, or half a step of a half float."""
    ctx = context(tmp_path)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    truth = write(ctx.workspace.capture_file, num=8, **given)
    run(IngestOptions(), ctx)
    file = CamerasFile.load(ctx.out / "cameras.json")
    assert len(file.images) == len(truth.images)
    for image in file.images:
        lens = reduced(file.cameras[image.camera])
        exact = depth_image(lens, pose_matrix(image))
        z = load_sensor_depth(ctx.out / str(image.depth))
        assert z.shape == exact.shape
        known = z > 0
        assert known.mean() > 0.3
        error = np.abs(z - exact)[known]
        assert (error <= np.maximum(0.00051, exact[known] / 2000)).all()
