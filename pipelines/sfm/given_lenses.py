"""Lenses that came with given poses, adjusted together with poses that are refined.

Lenses that are written beside poses may be another camera's (of the depth sensor), nominal ones, or
those of a lens without distortion, where the pictures have some. Refined poses then make up for it
as well as they can, and bend the scene. So it is tried whether matches fit better by another focal
length and distortion, one change for all images: they must be one device's, whose focal lengths may
differ by what autofocus does. `objection` says whether to believe it.

A sensor's depth that came along may be as the picture shows it, or as the given lens would: written
for an ideal lens, or by the lens of the sensor itself. What agrees better with the points is taken
(`pipelines.sfm.given_depth`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipelines.scene.cameras_file import Intrinsics
from pipelines.sfm.given_depth import Beside
from pipelines.sfm.given_fit import Fit, px_scale
from pipelines.sfm.given_refinement import (
    LAST,
    LAST_PX,
    PER_IMAGE,
    SLACK,
    WILD,
    Refined,
    Report,
    as_found,
    depth_of,
    settled,
    shared,
    sightings,
)
from pipelines.sfm.tracks import Floats, Observations, thinned, triangulate
from pipelines.tools.colmap_adjustment import Run
from pipelines.tools.colmap_posing import adjusted
from pipelines.tools.colmap_rays import rays_through

ALIKE = 0.1
"""How far focal lengths of one device may be off their median, as a share."""
TURNS = 3
GAIN = 0.95
"""What matches that were set aside must miss at most, in what they miss by the given lenses."""
LOST = 0.002
"""Share of matches that may agree less."""
MOST_ZOOMED = 0.2
MOST_STRETCHED = 0.01
"""By how much pixels may become oblong: no real lens is, and matches that leave the focal length
open leave that open first."""
TELLING = 0.03
"""Share of the focal length from which a correction is told."""


@dataclass(frozen=True)
class LensTrial:
    """What came of it. given, found: the first image's lens before and after. refused: why the
    given lenses were kept, or None. fit: of poses and lenses together, None where too few matches
    are left. depth: beside the points that they give."""

    given: Intrinsics
    found: Intrinsics
    refused: str | None
    fit: Fit | None
    depth: Beside | None

    @property
    def zoom(self) -> float:
        """The focal length in parts of the given one."""
        return float(np.sqrt(self.found.fl_x * self.found.fl_y / self.given.fl_x / self.given.fl_y))

    def as_dict(self) -> dict[str, Any]:
        """As report.json has it."""
        terms = {name: round(getattr(self.found, name), 5) for name in ("k1", "k2", "p1", "p2")}
        return {
            "taken": self.refused is None,
            "refused": self.refused,
            "focal": round(self.zoom, 5),
            **terms,
            "after": None if self.fit is None else self.fit.as_dict(),
            "sensor_depth": None
            if self.depth is None
            else {
                "ratio": round(self.depth.ratio, 5),
                "spread": round(self.depth.spread, 5),
                "shown_by": self.depth.shown_by,
            },
        }


def common_lens(lenses: Sequence[Intrinsics]) -> Intrinsics | None:
    """The first lens, where all may be one device's plain one; None otherwise."""
    first = lenses[0]
    if first.model not in ("PINHOLE", "OPENCV") or first.k3 or first.k4:
        return None
    same = ("model", "width", "height", "k1", "k2", "k3", "k4", "p1", "p2")
    if any(getattr(lens, name) != getattr(first, name) for lens in lenses for name in same):
        return None
    focals = np.array([(lens.fl_x, lens.fl_y) for lens in lenses])
    off = np.abs(np.log(focals / np.median(focals, axis=0)))
    return first if float(off.max()) <= ALIKE else None


def with_lenses(
    given: Floats,
    refined: Refined,
    seen: Observations,
    *,
    error_px: float,
    long_side_px: int,
    run: Run,
    num_threads: int,
    report: Report,
) -> Refined | None:
    """Refined poses with lenses adjusted, too; None where they are not one device's plain ones.

    given: poses. The rest as in `given_refinement.refine`.
    """
    first = common_lens(refined.lenses)
    if first is None:
        return None
    common = replace(seen, xy=as_first_lens(refined.lenses, seen))
    poses, lens, told = refined.poses, first, refined.is_seen
    full = max(first.width, first.height)
    loss_px = full / min(long_side_px, full)

    def points_by(lens: Intrinsics) -> tuple[Floats, Any]:
        limits = np.full(len(poses), LAST_PX / px_scale([lens], long_side_px))
        return triangulate(seen, rays_through(lens, common.xy), poses, limits)

    for turn in range(TURNS):
        report(turn / TURNS, "adjusting the lens")
        points, fits = points_by(lens)
        chosen = thinned(seen, shared(seen, fits), PER_IMAGE)
        radians = error_px / px_scale([lens], long_side_px)
        slack = SLACK * radians * depth_of(seen, fits, points, poses)
        moved, _, changed = adjusted(
            poses,
            [lens] * len(poses),
            points,
            sightings(common, chosen),
            LAST,
            centers={i: given[i, :, 3] for i in np.flatnonzero(~refined.is_anew).tolist()},
            slack=slack,
            loss_px=loss_px,
            run=run,
            num_threads=num_threads,
            refine_lenses=True,
        )
        wild = (WILD * slack, WILD * SLACK * radians)
        poses, told = settled(given, moved, seen.where(chosen), refined.is_anew, wild)
        lens = changed[0]
    points, fits = points_by(lens)
    lenses = [as_changed(old, first, lens) for old in refined.lenses]
    return replace(
        as_found(poses, lenses, points, fits, seen),
        is_seen=told,
        is_anew=refined.is_anew & told,
        before=refined.before,
    )


def as_first_lens(lenses: Sequence[Intrinsics], seen: Observations) -> Floats:
    """Where the first lens would show what the images' own show at `seen.xy`: [K, 2]. They differ
    in focal length and principal point alone."""
    values = np.array([(lens.cx, lens.cy, lens.fl_x, lens.fl_y) for lens in lenses])
    own, first = values[seen.image], values[0]
    found: Floats = (seen.xy - own[:, :2]) / own[:, 2:] * first[2:] + first[:2]
    return found


def as_changed(lens: Intrinsics, first: Intrinsics, changed: Intrinsics) -> Intrinsics:
    """A lens with the change that the first one had."""
    return replace(
        changed,
        fl_x=lens.fl_x * changed.fl_x / first.fl_x,
        fl_y=lens.fl_y * changed.fl_y / first.fl_y,
        cx=lens.cx,
        cy=lens.cy,
    )


def objection(
    before: Fit, after: Fit | None, depths: tuple[Beside | None, Beside | None], trial: Refined
) -> str | None:
    """What speaks against adjusted lenses, or None.

    before, after: the fit of matches that were set aside, by given and adjusted lenses, poses
    refined by each. depths: the points' that each gives, beside the sensor's.
    """
    if after is None:
        return "too few matches are left to tell"
    if after.error_px > GAIN * before.error_px or after.agreement < before.agreement - LOST:
        return (
            f"matches that were set aside miss by {after.error_px:.2f} px, by the given lens "
            f"{before.error_px:.2f}"
        )
    assert trial.before is not None
    given, found = trial.before.lenses[0], trial.lenses[0]
    by_x, by_y = np.log(found.fl_x / given.fl_x), np.log(found.fl_y / given.fl_y)
    if abs(by_x - by_y) > MOST_STRETCHED or abs(by_x + by_y) / 2 > np.log1p(MOST_ZOOMED):
        return (
            f"it would be {np.exp(by_x):.3f} times as long across, {np.exp(by_y):.3f} upwards: "
            "pictures do not tell"
        )
    was, now = depths
    if was is not None and now is not None and now.spread > was.spread:
        return (
            f"points agree less with the measured depth, within {now.spread:.1%} instead of "
            f"{was.spread:.1%}"
        )
    return None
