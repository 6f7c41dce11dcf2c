"""Captures with poses in the formats of photogrammetry programs, from cameras that are known.

Each writer takes true cameras (`CamerasFile`, +Z up, OpenGL axes) and gives the archive's files.
COLMAP's own library writes COLMAP's. Pictures are of noise, of the lenses' sizes: importers never
look into them.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.sample.film import walk
from pipelines.sample.scene import pose_matrix
from pipelines.scene.cameras_file import CamerasFile, Intrinsics
from tests.unit.pipelines.captures.archives import picture

Floats = NDArray[np.float64]
Files = dict[str, bytes]

LENS = Intrinsics(64, 48, 61.5, 61.5, 32.75, 23.5, "OPENCV", k1=-0.03)


def walked(*lenses: Intrinsics, num: int = 10, folder: str = "images/") -> CamerasFile:
    """True cameras around the sample's table, metres; lenses in turn, some pictures in folders."""
    lenses = lenses or (LENS,)
    truth = walk(num)
    images = tuple(
        replace(
            image,
            file=f"{folder}{'left/' if index % 3 else ''}IMG_{index + 9}.jpg",
            camera=index % len(lenses),
        )
        for index, image in enumerate(truth.images)
    )
    return replace(truth, cameras=lenses, images=images)


def pictures_of(truth: CamerasFile) -> Files:
    """A picture for each image of the truth."""
    sizes = [truth.cameras[image.camera] for image in truth.images]
    return {
        image.file: picture(lens.width, lens.height, seed=n)
        for n, (image, lens) in enumerate(zip(truth.images, sizes, strict=True))
    }


def opencv_pose(world_from_camera: Floats) -> tuple[Floats, Floats]:
    """camera_from_world of an OpenCV camera, rotation [3, 3] and translation [3], of our pose."""
    rotation = (world_from_camera[:, :3] * [1.0, -1.0, -1.0]).T
    return rotation, -rotation @ world_from_camera[:, 3]


def sparse_points(count: int = 40) -> tuple[Floats, NDArray[np.uint8]]:
    """Places [P, 3] around the table, and colours."""
    rng = np.random.default_rng(1)
    return rng.uniform(-1.0, 1.0, (count, 3)), rng.integers(0, 256, (count, 3), np.uint8)


def colmap_files(
    truth: CamerasFile,
    *,
    form: str = "binary",
    folder: str = "sparse/0/",
    images: str = "images/",
    lenses: Sequence[pycolmap.Camera] | None = None,
    indices: Sequence[int] | None = None,
) -> Files:
    """A model as pycolmap writes it. images: the folder that names are relative to.

    form: "binary" or "text". lenses: cameras in place of the truth's. indices: images to register.
    Points are those of `sparse_points`, seen by three images, and one that two have seen.
    """
    model = pycolmap.Reconstruction()
    for number, lens in enumerate(lenses or [colmap_lens(lens) for lens in truth.cameras], 1):
        lens.camera_id = number
        model.add_camera_with_trivial_rig(lens)
    places, colors = sparse_points()
    chosen = list(indices if indices is not None else range(len(truth.images)))
    for index in chosen:
        image = truth.images[index]
        rotation, translation = opencv_pose(pose_matrix(image)[:3])
        observed = [pycolmap.Point2D(np.array([1.0, 2.0])) for _ in range(len(places) + 1)]
        model.add_image_with_trivial_frame(
            pycolmap.Image(
                name=image.file.removeprefix(images),
                camera_id=image.camera + 1,
                image_id=100 - index,
                points2D=pycolmap.Point2DList(observed),
            ),
            pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation),
        )
    for number, (place, color) in enumerate(zip(places, colors, strict=True)):
        _add_point(model, place, color, [100 - index for index in chosen[:3]], number)
    _add_point(model, np.full(3, 9.0), colors[0], [100 - i for i in chosen[:2]], len(places))
    with tempfile.TemporaryDirectory() as scratch:
        getattr(model, f"write_{form}")(scratch)
        return {f"{folder}{path.name}": path.read_bytes() for path in Path(scratch).iterdir()}


def _add_point(
    model: pycolmap.Reconstruction,
    place: Floats,
    color: NDArray[np.uint8],
    images: Sequence[int],
    observation: int,
) -> None:
    track = pycolmap.Track()
    for image in images:
        track.add_element(image, observation)
    model.add_point3D(place, track, color)


def colmap_lens(lens: Intrinsics) -> pycolmap.Camera:
    """A lens of ours without higher terms, as COLMAP's OPENCV, OPENCV_FISHEYE or PINHOLE."""
    terms = {
        "PINHOLE": [],
        "OPENCV": [lens.k1, lens.k2, lens.p1, lens.p2],
        "OPENCV_FISHEYE": [lens.k1, lens.k2, lens.k3, lens.k4],
    }[lens.model]
    return pycolmap.Camera(
        model=lens.model,
        width=lens.width,
        height=lens.height,
        params=[lens.fl_x, lens.fl_y, lens.cx, lens.cy, *terms],
    )


def angle_axis(rotation: Floats) -> list[float]:
    """The axis times the angle of a rotation [3, 3], radians."""
    vector: list[float] = Rotation.from_matrix(rotation).as_rotvec().tolist()
    return vector


def opensfm_camera(lens: Intrinsics) -> dict[str, object]:
    """A lens as OpenSfM writes it: brown or fisheye_opencv, in units of the longer side."""
    side = max(lens.width, lens.height)
    brown = {"k1": lens.k1, "k2": lens.k2, "k3": lens.k3, "p1": lens.p1, "p2": lens.p2}
    fisheye = {"k1": lens.k1, "k2": lens.k2, "k3": lens.k3, "k4": lens.k4}
    is_fisheye = lens.model == "OPENCV_FISHEYE"
    return {
        "projection_type": "fisheye_opencv" if is_fisheye else "brown",
        "width": lens.width,
        "height": lens.height,
        "focal_x": lens.fl_x / side,
        "focal_y": lens.fl_y / side,
        "c_x": (lens.cx - lens.width / 2) / side,
        "c_y": (lens.cy - lens.height / 2) / side,
        **(fisheye if is_fisheye else brown),
    }


def opensfm_reconstruction(
    truth: CamerasFile, *, gps: bool = False, images: str = "images/"
) -> dict[str, Any]:
    """One reconstruction, its points those of `sparse_points`."""
    shots = {}
    for image in truth.images:
        rotation, translation = opencv_pose(pose_matrix(image)[:3])
        shots[image.file.removeprefix(images)] = {
            "rotation": angle_axis(rotation),
            "translation": translation.tolist(),
            "camera": f"v2 maker {image.camera}",
            "orientation": 1,
            "capture_time": 1286894631.0,
            "gps_dop": 5.0 if gps else 999999.0,
            "gps_position": [0.0, 0.0, 0.0],
        }
    places, colors = sparse_points()
    return {
        "cameras": {f"v2 maker {n}": opensfm_camera(lens) for n, lens in enumerate(truth.cameras)},
        "shots": shots,
        "points": {
            str(n): {"color": color.astype(float).tolist(), "coordinates": place.tolist()}
            for n, (place, color) in enumerate(zip(places, colors, strict=True))
        },
        "reference_lla": {"latitude": 48.77, "longitude": 2.3, "altitude": 80.0},
    }


def odm_files(truth: CamerasFile, place: Sequence[float] = (449_123.0, 5_411_804.0, 80.0)) -> Files:
    """What OpenDroneMap leaves: cameras.json and odm_report/shots.geojson, in map coordinates."""
    features = []
    for image in truth.images:
        rotation, _ = opencv_pose(pose_matrix(image)[:3])
        features.append(
            {
                "type": "Feature",
                "properties": {
                    "filename": image.file.rpartition("/")[2],
                    "camera": f"v2 maker {image.camera}",
                    "rotation": angle_axis(rotation),
                    "translation": (pose_matrix(image)[:3, 3] + place).tolist(),
                },
                "geometry": {"type": "Point", "coordinates": [2.3, 48.77, 80.0]},
            }
        )
    cameras = {f"v2 maker {n}": opensfm_camera(lens) for n, lens in enumerate(truth.cameras)}
    collection = {"type": "FeatureCollection", "features": features}
    return {
        "cameras.json": json.dumps(cameras).encode(),
        "odm_report/shots.geojson": json.dumps(collection).encode(),
    }


def nvm_text(truth: CamerasFile, *, r: float = 0.0, images: str = "") -> str:
    """A model as VisualSFM writes it; the truth's lenses have one focal length and nothing else."""
    lines = ["NVM_V3 ", "", str(len(truth.images))]
    for image in truth.images:
        pose = pose_matrix(image)[:3]
        x, y, z, w = Rotation.from_matrix(opencv_pose(pose)[0]).as_quat()
        focal = truth.cameras[image.camera].fl_x
        numbers = [focal, w, x, y, z, *pose[:, 3], r]
        name = image.file.removeprefix(images)
        lines.append(f"{name}\t{' '.join(repr(float(value)) for value in numbers)} 0 ")
    places, colors = sparse_points()
    lines += ["", str(len(places))]
    for place, color in zip(places, colors, strict=True):
        numbers = [*map(repr, place.tolist()), *map(str, color.tolist())]
        lines.append(" ".join(numbers) + " 3 0 5 1.5 -2.5 1 6 30.5 -2.5 2 7 1.5 -2.5")
    return "\n".join([*lines, "", "0", "", "#the last part of NVM file", "0", "0"]) + "\n"
