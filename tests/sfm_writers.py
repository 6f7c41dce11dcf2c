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


def _text(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def metashape_sensor(number: int, lens: Intrinsics, *, kind: str = "adjusted") -> str:
    """A sensor with a calibration; Agisoft's p1 and p2 are OpenCV's p2 and p1."""
    fisheye = lens.model == "OPENCV_FISHEYE"
    terms = {
        "f": lens.fl_y,
        "cx": lens.cx - lens.width / 2,
        "cy": lens.cy - lens.height / 2,
        "b1": lens.fl_x - lens.fl_y,
        "k1": lens.k1,
        "k2": lens.k2,
        "k3": lens.k3,
        "k4": lens.k4,
        **({} if fisheye else {"p1": lens.p2, "p2": lens.p1}),
    }
    size = f'<resolution width="{lens.width}" height="{lens.height}"/>'
    inner = "".join(f"<{key}>{value!r}</{key}>" for key, value in terms.items() if value)
    name = "fisheye" if fisheye else "frame"
    return (
        f'<sensor id="{number}" label="lens {number}" type="{name}">{size}'
        '<property name="pixel_width" value="0.01"/><property name="focal_length" value="0.6"/>'
        f'<calibration type="{name}" class="initial">{size}<f>1.0</f></calibration>'
        f'<calibration type="{name}" class="{kind}">{size}{inner}</calibration>{{rig}}</sensor>'
    )


def metashape_pose(world_from_camera: Floats) -> Floats:
    """The 4x4 matrix of an OpenCV camera, of our pose."""
    return np.vstack([world_from_camera * [1.0, -1.0, -1.0, 1.0], [0.0, 0.0, 0.0, 1.0]])


def metashape_transform(
    rotation: Floats, translation: Sequence[float] | Floats, scale: float
) -> str:
    return (
        f'<transform><rotation locked="false">{_text(rotation)}</rotation>'
        f'<translation locked="false">{_text(translation)}</translation>'
        f'<scale locked="true">{scale!r}</scale></transform>'
    )


def metashape_xml(
    truth: CamerasFile,
    *,
    world: tuple[Floats, Floats, float] | None = None,
    in_component: bool = False,
    reference: str = 'LOCAL_CS["Local Coordinates (m)"]',
    labels: Sequence[str] | None = None,
    extra: str = "",
) -> str:
    """Metashape's camera export. world: rotation [3, 3], translation [3] and scale that bring the
    cameras as written to the truth; in_component: whether a component has it, else the chunk.
    extra: further elements among the cameras. Labels are names without folder and suffix."""
    rotation, translation, scale = world or (np.eye(3), np.zeros(3), 1.0)
    rows = []
    for index, image in enumerate(truth.images):
        pose = metashape_pose(pose_matrix(image)[:3])
        pose[:3, :3] = rotation.T @ pose[:3, :3]
        pose[:3, 3] = rotation.T @ (pose[:3, 3] - translation) / scale
        label = labels[index] if labels else image.file.rpartition("/")[2].removesuffix(".jpg")
        component = ' component_id="0"' if in_component else ""
        rows.append(
            f'<camera id="{index}" sensor_id="{image.camera}"{component} label="{label}">'
            f"<transform>{_text(pose)}</transform><orientation>1</orientation></camera>"
        )
    sensors = [metashape_sensor(n, lens).format(rig="") for n, lens in enumerate(truth.cameras)]
    moved = metashape_transform(rotation, translation, scale) if world else ""
    component = f'<component id="0" label="Component 1">{moved}</component>'
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.5.0">'
        f'<chunk label="Chunk 1" enabled="true"><sensors>{"".join(sensors)}</sensors>'
        f"{f'<components>{component}</components>' if in_component else ''}"
        f"<cameras>{''.join(rows)}{extra}</cameras>"
        f"<reference>{reference}</reference>{'' if in_component else moved}"
        "</chunk></document>"
    )


def realitycapture_csv(truth: CamerasFile, *, count: bool = False) -> str:
    """RealityCapture's "Internal/External camera parameters", all sixteen columns."""
    lines = [f"#cameras {len(truth.images)}"] if count else []
    lines.append("#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2")
    for image in truth.images:
        pose, lens = pose_matrix(image)[:3], truth.cameras[image.camera]
        # Intrinsic rotations about Z, X and Y, in this order.
        angles = Rotation.from_matrix(pose[:, :3]).as_euler("ZXY", degrees=True)
        side = max(lens.width, lens.height)
        numbers = [
            *pose[:, 3],
            -angles[0],
            angles[1],
            angles[2],
            lens.fl_x * 36.0 / side,
            (lens.cx - lens.width / 2) / side,
            (lens.cy - lens.height / 2) / side,
            *(lens.k1, lens.k2, lens.k3, lens.k4, lens.p1, lens.p2),
        ]
        name = image.file.rpartition("/")[2]
        lines.append(",".join([name, *(repr(float(number)) for number in numbers)]))
    return "\r\n".join(lines) + "\r\n"
