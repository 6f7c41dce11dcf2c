"""Posed captures as the benchmarks train on them, read with `pipelines.nerf` and nothing else.

Two kinds of folder: `transforms.json` with its pictures (nerfstudio, Instant-NGP), and the
synthetic scenes of NeRF (`transforms_train.json`, `transforms_val.json`, RGBA over white). The
job's own readers check more and need packages that a bare GPU machine has not; these believe what
they read.

Poses are `world_from_camera` [N, 3, 4], OpenGL. Of a real capture the world is turned until the
cameras' mean up is +Z, as the reference implementation does (`orientation_method up`); centre and
scale are left to `SceneTransform`. A synthetic scene keeps its world: it lies in [-1.5, 1.5]^3
around the origin, which `SceneTransform` brings to [-1, 1]^3, with cameras 4 world units away.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.nerf.data.images import ImageData, load_images, split_indices
from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.train import DataConfig, TrainConfig
from pipelines.nerf.space.cameras import Cameras, SceneTransform

Poses = NDArray[np.float64]

BLENDER_HALF_SIDE = 1.5
"""Half the side of the cube that holds a synthetic scene, world units."""
BLENDER_NEAR, BLENDER_FAR = 2.0, 6.0
"""Where rays of a synthetic scene begin and end, world units."""
DISTORTION_TERMS = ("k1", "k2", "k3", "k4", "p1", "p2")
CAMERA_MODELS = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "OPENCV": "OPENCV",
    "OPENCV_FISHEYE": "OPENCV_FISHEYE",
}


@dataclass(frozen=True)
class BenchmarkCapture:
    """A capture in memory, all N images and cameras at the same size.

    name: of the folder. names: [N], of the picture files without ending. train, test: positions.
    num_missing: pictures that are listed and are not there. bounds: (near, far) in scene units
    where the scene is known to lie between them, else None. background: what to composite on.
    """

    name: str
    images: ImageData
    cameras: Cameras
    scene: SceneTransform
    names: list[str]
    train: list[int]
    test: list[int]
    num_missing: int = 0
    bounds: tuple[float, float] | None = None
    background: str | None = None

    def suited(self, config: TrainConfig) -> TrainConfig:
        """The options with what is known of this scene: near, far and the background."""
        model = config.model
        if self.bounds is not None:
            model = replace(model, near=self.bounds[0], far=self.bounds[1])
        if self.background is not None:
            model = replace(model, background=self.background)
        return replace(config, model=model)

    def find(self, names: Sequence[str]) -> list[int]:
        """Positions of the images with these names, those that there are."""
        return [self.names.index(name) for name in names if name in self.names]

    def describe(self) -> str:
        """One line for the head of a table."""
        width, height = self.images.sizes[0].tolist()
        missing = f", {self.num_missing} listed ones not there" if self.num_missing else ""
        return (
            f"{self.name}: {len(self.names)} images of {width}x{height}{missing}; "
            f"{len(self.train)} trained on, {len(self.test)} held out"
        )


def load_capture(folder: Path, data: DataConfig, *, orient: bool = True) -> BenchmarkCapture:
    """Read a capture folder at the long side and with the split of `data`.

    The split of a synthetic scene is that of its files, whatever `data` says. orient: turn the
    world of a real capture upright.
    Raises NerfError `bad_capture` where the folder is neither kind, or lists no picture that is
    there, and those of `load_images` and `Cameras.from_arrays`.
    """
    if (folder / "transforms.json").is_file():
        return _load_posed(folder, data, orient)
    if (folder / "transforms_train.json").is_file():
        return _load_blender(folder, data)
    raise NerfError(
        "bad_capture",
        f"{folder} holds neither transforms.json nor transforms_train.json.",
        "Name the folder of a posed capture.",
    )


def upright_rotation(poses: Poses) -> Poses:
    """[3, 3]: the smallest rotation that brings the cameras' mean +Y to +Z.

    poses: [N, 3, 4]. Rodrigues' formula for two unit vectors: R = I + K + K^2 / (1 + c) with K the
    cross-product matrix of up x z and c = up . z.
    """
    up = poses[:, :, 1].mean(axis=0)
    up = up / np.linalg.norm(up)
    x, y, z = np.cross(up, [0.0, 0.0, 1.0])
    cosine = float(up[2])
    if cosine < -1.0 + 1e-9:  # upside down: any half turn about a level axis will do
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: Poses = np.eye(3) + cross + cross @ cross / (1.0 + cosine)
    return turn


def _load_posed(folder: Path, data: DataConfig, orient: bool) -> BenchmarkCapture:
    transforms = _read(folder / "transforms.json")
    listed = sorted(transforms["frames"], key=lambda frame: str(frame["file_path"]))
    frames = [frame for frame in listed if (folder / frame["file_path"]).is_file()]
    if not frames:
        raise NerfError(
            "bad_capture", f"Of {len(listed)} listed pictures in {folder} none is there."
        )
    poses = _poses(frames)
    if orient:
        poses = upright_rotation(poses) @ poses
    scene = SceneTransform.fit(poses[:, :, 3], scale_poses=data.scale_poses)
    lenses = [_lens({**transforms, **frame}) for frame in frames]
    cameras = Cameras.from_arrays(
        world_from_camera=poses,
        scene=scene,
        widths=[lens["size"][0] for lens in lenses],
        heights=[lens["size"][1] for lens in lenses],
        focal=[lens["focal"] for lens in lenses],
        principal=[lens["principal"] for lens in lenses],
        models=[lens["model"] for lens in lenses],
        distortion=[lens["distortion"] for lens in lenses],
    )
    paths = [folder / frame["file_path"] for frame in frames]
    train, test = split_indices(len(frames), data)
    return BenchmarkCapture(
        name=folder.resolve().name,
        images=load_images(paths, data.long_side_px),
        cameras=cameras.resized(data.long_side_px),
        scene=scene,
        names=[path.stem for path in paths],
        train=train,
        test=test,
        num_missing=len(listed) - len(frames),
    )


def _lens(values: Mapping[str, Any]) -> dict[str, Any]:
    """Size, focal length, principal point, model and distortion of one frame."""
    width, height = round(values["w"]), round(values["h"])
    if "fl_x" in values:
        focal = (values["fl_x"], values.get("fl_y", values["fl_x"]))
    else:
        fl_x = _focal(width, values["camera_angle_x"])
        angle_y = values.get("camera_angle_y")
        focal = (fl_x, fl_x if angle_y is None else _focal(height, angle_y))
    terms = [float(values.get(name, 0.0)) for name in DISTORTION_TERMS]
    given = values.get("camera_model", "OPENCV" if any(terms) else "PINHOLE")
    if given not in CAMERA_MODELS:
        known = ", ".join(CAMERA_MODELS)
        raise NerfError("bad_capture", f"The camera model {given} is none of {known}.")
    return {
        "size": (width, height),
        "focal": focal,
        "principal": (values.get("cx", width / 2), values.get("cy", height / 2)),
        "model": CAMERA_MODELS[given],
        "distortion": terms,
    }


def _focal(pixels: int, angle: float) -> float:
    """Focal length in px of a field of view in radians over so many pixels."""
    return 0.5 * pixels / math.tan(0.5 * angle)


def _load_blender(folder: Path, data: DataConfig) -> BenchmarkCapture:
    parts = [
        _read(path)
        for name in ("train", "val")
        if (path := folder / f"transforms_{name}.json").is_file()
    ]
    listed = [
        (folder / f"{frame['file_path']}.png", frame, transforms["camera_angle_x"], part)
        for part, transforms in enumerate(parts)
        for frame in transforms["frames"]
    ]
    found = [item for item in listed if item[0].is_file()]
    if not found:
        raise NerfError(
            "bad_capture", f"Of {len(listed)} listed pictures in {folder} none is there."
        )
    paths = [path for path, *_ in found]
    sizes = [_picture_size(path) for path in paths]
    scene = SceneTransform(center=(0.0, 0.0, 0.0), scale=1.0 / BLENDER_HALF_SIDE)
    focal = [_focal(size[0], item[2]) for size, item in zip(sizes, found, strict=True)]
    cameras = Cameras.from_arrays(
        world_from_camera=_poses([frame for _, frame, *_ in found]),
        scene=scene,
        widths=[width for width, _ in sizes],
        heights=[height for _, height in sizes],
        focal=[(length, length) for length in focal],
        principal=[(width / 2, height / 2) for width, height in sizes],
    )
    return BenchmarkCapture(
        name=folder.resolve().name,
        images=load_images(paths, data.long_side_px),
        cameras=cameras.resized(data.long_side_px),
        scene=scene,
        names=[path.stem for path in paths],
        train=[index for index, item in enumerate(found) if item[3] == 0],
        test=[index for index, item in enumerate(found) if item[3] == 1],
        num_missing=len(listed) - len(found),
        bounds=(BLENDER_NEAR * scene.scale, BLENDER_FAR * scene.scale),
        background="white",
    )


def _poses(frames: Sequence[Mapping[str, Any]]) -> Poses:
    return np.array([frame["transform_matrix"][:3] for frame in frames], np.float64)


def _picture_size(path: Path) -> tuple[int, int]:
    with Image.open(path) as opened:
        return opened.size


def _read(path: Path) -> dict[str, Any]:
    values: dict[str, Any] = json.loads(path.read_text("utf-8"))
    if not values.get("frames"):
        raise NerfError("bad_capture", f"{path} lists no frames.")
    return values
