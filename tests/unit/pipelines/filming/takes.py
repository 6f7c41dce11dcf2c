"""Captures as the report knows them, without a job: a good one, to be spoiled in one respect."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pipelines.filming.looks import Look
from pipelines.filming.shots import Shot, Take

SHARP = Look(blur_px=1.3, streak=1.2, luma=0.5, dark=0.01, bright=0.01)
SMEARED = Look(blur_px=9.0, streak=2.2, luma=0.5, dark=0.01, bright=0.01)
SOFT = Look(blur_px=6.0, streak=1.1, luma=0.5, dark=0.01, bright=0.01)
NUM = 40


def ring(num: int, *, around_deg: float = 360.0, elevation_deg: float = 25.0) -> np.ndarray:
    """world_from_camera [num, 3, 4], OpenGL axes: an arc around the origin, looking at it."""
    poses = []
    for index in range(num):
        azimuth = np.radians(around_deg * index / num)
        up = np.radians(elevation_deg + 12.0 * np.sin(3 * azimuth) * (elevation_deg > 0))
        away = np.array([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
        right = np.cross([0.0, 0.0, 1.0], away)
        right /= np.linalg.norm(right)
        poses.append(np.stack([right, np.cross(away, right), away, 2.0 * away], axis=1))
    return np.array(poses).reshape(-1, 3, 4)


def good_take(*, is_film: bool = True, num: int = NUM) -> Take:
    """All around a subject, sharp, evenly lit, every picture placed."""
    shots = tuple(
        Shot(
            file=f"images/{index:03d}.jpg",
            name="" if is_film else f"IMG_{index}.jpg",
            time_s=0.5 * index if is_film else None,
            look=SHARP,
            is_placed=True,
            group=0,
            num_features=2000,
            best_inliers=400,
            speed=0.08 if is_film else None,
            gain_ev=0.02 * (index % 3) if is_film else None,
        )
        for index in range(num)
    )
    return Take(
        kind="video" if is_film else "images",
        filename="walk.mp4",
        shots=shots,
        is_film=is_film,
        duration_s=0.5 * num if is_film else None,
        poses=ring(num),
        posed=tuple(range(num)),
        points=np.random.default_rng(0).normal(0, 0.3, (50, 3)),
        colors=np.full((50, 3), 90, np.uint8),
        angle_deg=18.0,
        is_metric=False,
    )


def spoiled(take: Take, indices: range, **changes: Any) -> Take:
    """The take with some shots changed; those that lost their pose leave the path."""
    shots = [
        replace(shot, **changes) if index in indices else shot
        for index, shot in enumerate(take.shots)
    ]
    kept = [row for row, index in enumerate(take.posed) if shots[index].is_placed]
    return replace(
        take,
        shots=tuple(shots),
        posed=tuple(take.posed[row] for row in kept),
        poses=take.poses[kept],
    )
