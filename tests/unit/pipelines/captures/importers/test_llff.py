"""LLFF: rows of bare poses, whose order the pictures confirm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.options import IngestOptions
from pipelines.stages.ingest import run
from tests.app_writers import write_llff
from tests.unit.pipelines.captures.archives import (
    context,
    llff_files,
    llff_table,
    npy,
    picture,
)
from tests.unit.pipelines.captures.ingesting import (
    cameras,
    failure,
    ingest,
    poses_as_sent,
    sources,
    warning_with,
)


def test_columns_are_down_right_back_and_the_lens_is_scaled(tmp_path: Path) -> None:
    table = llff_table(4)
    table[:, [4, 9, 14]] *= 2  # stated for pictures of twice the size
    summary, ctx = ingest(tmp_path, llff_files(4) | {"poses_bounds.npy": npy(table)})
    file = cameras(ctx)
    assert (summary["kind"], file.metric) == ("llff", False)
    expected = [[1, 0, 0, 2], [0, 1, 0, 0.5], [0, 0, 1, -2]]
    np.testing.assert_allclose(poses_as_sent(ctx)[2], np.array(expected), atol=1e-12)
    (lens,) = file.cameras
    assert (lens.width, lens.fl_x, lens.fl_y, lens.cx, lens.cy) == (64, 60.0, 60.0, 32.0, 24.0)


def test_a_plain_order_that_pictures_cannot_confirm_is_taken_and_told(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, llff_files(5))
    assert sources(ctx) == [f"images/{n:03d}.jpg" for n in range(5)]
    assert warning_with(summary, "Too few of the pictures match")


@pytest.mark.parametrize("padded", [False, True])
def test_rows_one_picture_late_are_refused(tmp_path: Path, padded: bool) -> None:
    """As many rows as pictures, but a picture was added and another taken away."""
    ctx = context(tmp_path)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    write_llff(ctx.workspace.capture_file, shift=1, padded=padded)
    with pytest.raises(Exception, match="do not fit the pictures") as caught:
        run(IngestOptions(), ctx)
    assert getattr(caught.value, "code", "") == "poses_malformed"
    assert not list(ctx.out.glob("**/*.db"))


def test_small_floats_are_read_too(tmp_path: Path) -> None:
    data = npy(llff_table(4).astype(np.float32))
    summary, _ = ingest(tmp_path, llff_files(4) | {"poses_bounds.npy": data})
    assert summary["num_posed"] == 4


WHOLE = npy(llff_table(5))
NAN, NO_LENS, MIRRORED = llff_table(11), llff_table(11), llff_table(11)
NAN[6, 3] = np.nan
NO_LENS[6, 14] = 0.0
MIRRORED[6, 1] = -1.0


@pytest.mark.parametrize(
    ("data", "code", "why"),
    [
        (WHOLE[:-8], "poses_malformed", "says that it has 5 rows"),
        (WHOLE + b"\0", "poses_malformed", "says that it has 5 rows"),
        (WHOLE[:40], "poses_malformed", "no array"),
        (WHOLE[:8], "poses_malformed", "no array"),
        (WHOLE[:6], "poses_malformed", "no array"),
        (npy(llff_table(0)), "poses_missing", "no rows"),
        (npy(llff_table(4)), "poses_malformed", "poses of 4 pictures, and 5 pictures"),
        (npy(llff_table(6)), "poses_malformed", "poses of 6 pictures"),
        (npy(llff_table(5)[:, :15]), "poses_malformed", "rows of 17"),
        (npy(np.asfortranarray(llff_table(5))), "poses_malformed", "rows of 17"),
        (npy(llff_table(5).astype(np.int64)), "poses_malformed", "no array"),
        (npy(np.array([{}], object), allow_pickle=True), "poses_malformed", "no array"),
        (npy(llff_table(5) * np.nan), "poses_malformed", "Row 0"),
        (WHOLE.replace(b"(5, 17)", b"(-5,17)"), "poses_malformed", "no array"),
        (WHOLE.replace(b"(5, 17)", b"(10**9,)"[:7]), "poses_malformed", "no array"),
        (WHOLE.replace(b"(5, 17), }    ", b"(99999999999,)"), "poses_malformed", "no array"),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path: Path, data: bytes, code: str, why: str) -> None:
    error = failure(tmp_path, llff_files(5) | {"poses_bounds.npy": data})
    assert error.code == code
    assert why in error.message


@pytest.mark.parametrize(
    ("table", "why"),
    [(NAN, "Row 6"), (NO_LENS, "Row 6"), (MIRRORED, "images/006.jpg")],
)
def test_a_row_that_makes_no_sense_is_left_out(
    tmp_path: Path, table: np.ndarray[tuple[int, int], np.dtype[np.float64]], why: str
) -> None:
    summary, ctx = ingest(tmp_path, llff_files(11) | {"poses_bounds.npy": npy(table)})
    assert "images/006.jpg" not in sources(ctx)
    assert len(cameras(ctx).images) == 10
    assert warning_with(summary, "Left out", why)


def test_text_of_that_name_is_not_this_format(tmp_path: Path) -> None:
    files = {f"{n}.jpg": picture(seed=n) for n in range(8)}
    summary, _ = ingest(tmp_path, files | {"poses_bounds.npy": "1 2 3"})
    assert summary["kind"] == "images"
