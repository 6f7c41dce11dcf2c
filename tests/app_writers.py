"""Captures as further apps and RGB-D programs write them, from the analytic scene.

As in `tests.capture_writers`: each writer returns the exact cameras of the pictures that an
importer should find, whose names are those in the archive.
"""

from __future__ import annotations

import io
import json
import subprocess
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.sample.film import walk
from pipelines.sample.scene import depth_image, pose_matrix, render
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.tools.ffmpeg import ffmpeg_executable
from tests.capture_writers import (
    Floats,
    Given,
    arkit_pose,
    exact,
    jpeg,
    landscape_camera,
    named,
    png,
    quaternion,
    reduced,
)

_CLOCK_S = 104_137.25
"""What the phone's clock shows at the first frame, seconds."""


def counts_of(lens: Intrinsics, pose: Floats, farthest_m: float = 65.0) -> Any:
    """Depth in millimetres, 16 bits, 0 from `farthest_m` on. [h, w]."""
    z = depth_image(lens, pose)
    return np.round(np.where(z < farthest_m, z, 0.0) * 1000.0).astype(np.uint16)


def shown(truth: CamerasFile, image: PosedImage) -> NDArray[np.uint8]:
    """The picture of a camera, [H, W, 3]."""
    picture: NDArray[np.uint8] = render(truth.cameras[image.camera], pose_matrix(image))
    return picture


def breathing(truth: CamerasFile) -> CamerasFile:
    """The same walk with a lens of its own for every picture, as autofocus has it."""
    (lens,) = truth.cameras
    scales = 1.0 + 0.004 * np.sin(np.arange(len(truth.images)))
    lenses = tuple(
        replace(lens, fl_x=lens.fl_x * s, fl_y=lens.fl_y * s, cx=lens.cx + s) for s in scales
    )
    images = tuple(replace(image, camera=index) for index, image in enumerate(truth.images))
    return replace(truth, cameras=lenses, images=images)


def opencv_matrix(pose: Floats) -> Floats:
    """world_from_camera [4, 4] of the OpenCV camera that an OpenGL one [3, 4] is."""
    matrix = np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])
    matrix[:, 1:3] *= -1.0
    return matrix


def numbers(rows: Floats) -> str:
    """Rows of numbers as text, as numpy writes them."""
    stream = io.StringIO()
    np.savetxt(stream, np.atleast_2d(rows))
    return stream.getvalue()


def _projection(lens: Intrinsics) -> list[float]:
    """OpenGL's projection of a lens, row-major, as ARKit has it (far plane at infinity)."""
    rows = np.zeros((4, 4))
    rows[0, 0], rows[1, 1] = 2 * lens.fl_x / lens.width, 2 * lens.fl_y / lens.height
    rows[0, 2], rows[1, 2] = 1 - 2 * lens.cx / lens.width, 2 * lens.cy / lens.height - 1
    rows[2], rows[3, 2] = (0, 0, -1, -0.001), -1
    return [float(value) for value in rows.ravel()]


def write_scanner_app(
    path: Path, num: int = 5, width: int = 160, step: int = 3, given: Given = exact
) -> CamerasFile:
    """3D Scanner App's "All Data": a picture of every third frame, the rest of every frame.

    Intrinsics are for the phone's own size, 1920 wide, and differ between frames; their pixel
    centres are at integers. num: pictures. given: what is written in place of the true poses.
    """
    walked = breathing(walk(num * step, landscape_camera(1920), frame_rate=6.0))
    believed = given(walked)
    pictures: dict[int, str] = {}
    with zipfile.ZipFile(path, "w") as archive:
        for index, image in enumerate(walked.images):
            pose = pose_matrix(image)
            lens = walked.cameras[image.camera]
            as_given = arkit_pose(pose_matrix(believed.images[index]))
            rows = np.vstack([as_given, [0, 0, 0, 1]])
            k = [lens.fl_x, 0, lens.cx - 0.5, 0, lens.fl_y, lens.cy - 0.5, 0, 0, 1]
            values = {
                "cameraGrain": 0,
                "hasGPS": True,
                "latitude": 37.5447,
                "longitude": 126.9639,
                "intrinsics": k,
                "projectionMatrix": _projection(lens),
                "cameraPoseARFrame": [float(value) for value in rows.ravel()],
                "time": _CLOCK_S + index / 6.0,
                "frame_index": index,
                "motionQuality": 1,
            }
            stem = f"{index:05d}"
            archive.writestr(f"All_Data/frame_{stem}.json", json.dumps(values, indent=2))
            depth = counts_of(reduced(lens, 24), pose, 5.0)
            archive.writestr(f"All_Data/depth_{stem}.png", png(depth))
            rated = np.where(depth > 0, 2, 0).astype(np.uint8)
            archive.writestr(f"All_Data/conf_{stem}.png", png(rated))
            if index % step == 0:
                pictures[index] = f"All_Data/frame_{stem}.jpg"
        lenses = tuple(reduced(lens, 1920 // width) for lens in walked.cameras)
        truth = named(replace(walked, cameras=lenses), pictures)
        for picture in truth.images:
            archive.writestr(picture.file, jpeg(shown(truth, picture)))
        archive.writestr("All_Data/info.json", json.dumps({"appVersionString": "1.9.7"}))
        archive.writestr("All_Data/thumb_00000.jpg", jpeg(shown(truth, truth.images[0])[::4, ::4]))
    return truth


def _k(lens: Intrinsics) -> Floats:
    """A lens as OpenCV's matrix [3, 3], pixel centres at integers."""
    return np.array([[lens.fl_x, 0, lens.cx - 0.5], [0, lens.fl_y, lens.cy - 0.5], [0, 0, 1]])


def _padded(matrix: Floats) -> Floats:
    padded = np.eye(4)
    padded[: len(matrix), : len(matrix)] = matrix
    return padded


def write_seven_scenes(path: Path, num: int = 5, width: int = 160) -> CamerasFile:
    """The layout of 7-Scenes with 3DMatch's file of intrinsics, shared by several sequences."""
    truth = walk(num, landscape_camera(width))
    (lens,) = truth.cameras
    names = {index: f"scene/seq-01/frame-{index:06d}.color.png" for index in range(num)}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("scene/camera-intrinsics.txt", numbers(_k(lens)))
        for image, name in zip(truth.images, names.values(), strict=True):
            stem, pose = name.removesuffix(".color.png"), pose_matrix(image)
            archive.writestr(name, png(shown(truth, image)))
            counts = counts_of(reduced(lens, 2), pose, 5.0)
            archive.writestr(f"{stem}.depth.png", png(np.where(counts, counts, np.uint16(65535))))
            archive.writestr(f"{stem}.pose.txt", numbers(opencv_matrix(pose)))
    return named(truth, names)


def write_scannet(path: Path, num: int = 6, width: int = 160, lost: int = 2) -> CamerasFile:
    """A ScanNet scene as its own reader unpacks it; the camera had lost its way in one frame."""
    truth = walk(num, landscape_camera(width))
    (lens,) = truth.cameras
    small = reduced(lens, 2)
    names = {index: f"scene0000_00/color/{index * 20}.jpg" for index in range(num)}
    with zipfile.ZipFile(path, "w") as archive:
        for kind, each in (("color", lens), ("depth", small)):
            file = f"scene0000_00/intrinsic/intrinsic_{kind}.txt"
            archive.writestr(file, numbers(_padded(_k(each))))
            file = f"scene0000_00/intrinsic/extrinsic_{kind}.txt"
            archive.writestr(file, numbers(np.eye(4)))
        for index, image in enumerate(truth.images):
            pose, n = pose_matrix(image), index * 20
            matrix = np.full((4, 4), -np.inf) if index == lost else opencv_matrix(pose)
            archive.writestr(names[index], jpeg(shown(truth, image)))
            archive.writestr(f"scene0000_00/depth/{n}.png", png(counts_of(small, pose, 5.0)))
            archive.writestr(f"scene0000_00/pose/{n}.txt", numbers(matrix))
    del names[lost]
    return named(truth, names)


def write_replica(path: Path, num: int = 11, width: int = 240) -> CamerasFile:
    """Replica as NICE-SLAM publishes it: names without gaps, 6553.5 counts to a metre."""
    scale = 6553.5
    truth = walk(num, landscape_camera(width))
    (lens,) = truth.cameras
    names = {index: f"Replica/room0/results/frame{index:06d}.jpg" for index in range(num)}
    k = _k(lens)
    camera = {"w": lens.width, "h": lens.height, "fx": k[0, 0], "fy": k[1, 1]}
    camera |= {"cx": k[0, 2], "cy": k[1, 2], "scale": scale}
    poses = [pose_matrix(image) for image in truth.images]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("Replica/cam_params.json", json.dumps({"camera": camera}))
        rows = np.array([opencv_matrix(pose).ravel() for pose in poses])
        archive.writestr("Replica/room0/traj.txt", numbers(rows))
        for index, image in enumerate(truth.images):
            z = depth_image(reduced(lens, 4), poses[index])
            counts = np.round(np.where(z < 9.0, z, 0.0) * scale).astype(np.uint16)
            archive.writestr(names[index], jpeg(shown(truth, image)))
            archive.writestr(f"Replica/room0/results/depth{index:06d}.png", png(counts))
    return named(truth, names)


def write_rgbd_list(path: Path, num: int = 11, width: int = 240) -> CamerasFile:
    """A list of poses for pictures whose names count without zeros: `rgb_0` ... `rgb_10`."""
    truth = walk(num, landscape_camera(width))
    (lens,) = truth.cameras
    names = {index: f"rgb/rgb_{index}.png" for index in range(num)}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("K.txt", numbers(_k(lens)))
        rows = [opencv_matrix(pose_matrix(image)).ravel() for image in truth.images]
        archive.writestr("traj_w_c.txt", numbers(np.array(rows)))
        for index, image in enumerate(truth.images):
            archive.writestr(names[index], png(shown(truth, image)))
            counts = counts_of(reduced(lens, 4), pose_matrix(image))
            archive.writestr(f"depth/depth_{index}.png", png(counts))
    return named(truth, names)


def write_llff(
    path: Path,
    num: int = 11,
    width: int = 240,
    shift: int = 0,
    as_text: bool = True,
    padded: bool = False,
) -> CamerasFile:
    """`poses_bounds.npy` for pictures of twice the size. padded: whether names have leading zeros.

    as_text: rows follow the names as text, as the format's own program writes them; else they
    follow the numbers. shift: rows that are this many pictures late, as where a picture was added.
    """
    height = width * 3 // 4
    focal = 0.8 * width
    lens = Intrinsics(width, height, focal, focal, width / 2, height / 2)
    truth = replace(walk(num, lens), metric=False)
    digits = 3 if padded else 1
    names = {index: f"kitchen/images/IMG_7_{index:0{digits}}.jpg" for index in range(num)}
    rows = {}
    for index, image in enumerate(truth.images):
        pose = pose_matrix(image)
        table = np.column_stack(
            [-pose[:, 1], pose[:, 0], pose[:, 2], pose[:, 3], [height * 2, width * 2, focal * 2]]
        )
        rows[names[index]] = [*table.ravel(), 0.4, 9.0]
    order = sorted(rows) if as_text else list(rows)
    stream = io.BytesIO()
    np.save(stream, np.roll([rows[name] for name in order], shift, axis=0))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("kitchen/poses_bounds.npy", stream.getvalue())
        for index, image in enumerate(truth.images):
            picture = shown(truth, image)
            archive.writestr(names[index], jpeg(picture))
            file = names[index].replace("images", "images_4").replace("jpg", "png")
            archive.writestr(file, png(picture[::4, ::4]))
    return named(truth, names)


def write_nerfcapture(path: Path, num: int = 5, width: int = 160) -> CamerasFile:
    """NeRFCapture's offline dataset: pictures without a suffix in the list, a lens a frame.

    Depth is what its first releases wrote: drawn as a picture of four channels.
    """
    truth = breathing(walk(num, landscape_camera(width), frame_rate=2.0))
    names = {index: f"240223175130/images/{index}.png" for index in range(num)}
    frames = []
    with zipfile.ZipFile(path, "w") as archive:
        for index, image in enumerate(truth.images):
            lens, pose = truth.cameras[image.camera], pose_matrix(image)
            frames.append(
                {
                    "file_path": f"images/{index}",
                    "depth_path": f"images/{index}.depth.png",
                    "transform_matrix": np.vstack([arkit_pose(pose), [0, 0, 0, 1]]).tolist(),
                    "timestamp": _CLOCK_S + index / 2.0,
                    **_own_lens(lens),
                }
            )
            picture = shown(truth, image)
            archive.writestr(names[index], png(picture))
            drawn = np.concatenate([picture, np.full_like(picture[..., :1], 255)], axis=2)
            archive.writestr(names[index].replace(".png", ".depth.png"), png(drawn))
        top = {**_own_lens(truth.cameras[0]), "depth_integer_scale": 1, "frames": frames}
        archive.writestr("240223175130/transforms.json", json.dumps(top))
    return named(truth, names)


def _own_lens(lens: Intrinsics) -> dict[str, float]:
    """Keys of `transforms.json`, ARKit's values: pixel centres at integers."""
    return {
        "w": lens.width,
        "h": lens.height,
        "fl_x": lens.fl_x,
        "fl_y": lens.fl_y,
        "cx": lens.cx - 0.5,
        "cy": lens.cy - 0.5,
    }


def write_kiri(path: Path, num: int = 5, width: int = 160) -> CamerasFile:
    """KIRI Engine's camera poses: nerfstudio's layout, of structure from motion."""
    truth = replace(walk(num, landscape_camera(width)), metric=False)
    (lens,) = truth.cameras
    names = {index: f"My scan/images/{index + 1:05d}.jpg" for index in range(num)}
    frames = [
        {
            "file_path": names[index].removeprefix("My scan/"),
            "transform_matrix": np.vstack([pose_matrix(image), [0, 0, 0, 1]]).tolist(),
        }
        for index, image in enumerate(truth.images)
    ]
    top: dict[str, Any] = {"camera_model": "OPENCV", "w": lens.width, "h": lens.height}
    top |= {"fl_x": lens.fl_x, "fl_y": lens.fl_y, "cx": lens.cx, "cy": lens.cy}
    top |= dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("My scan/transforms.json", json.dumps({**top, "frames": frames}))
        for index, image in enumerate(truth.images):
            archive.writestr(names[index], jpeg(shown(truth, image)))
    return named(truth, names)


def film_of(pictures: list[NDArray[np.uint8]]) -> bytes:
    """Pictures as frames of an MP4, nearly lossless, at 30 frames a second."""
    with tempfile.TemporaryDirectory() as folder:
        for number, picture in enumerate(pictures):
            Image.fromarray(picture).save(Path(folder) / f"{number:04d}.png")
        target = Path(folder) / "rgb.mp4"
        command = [ffmpeg_executable(), "-v", "error", "-framerate", "30"]
        command += ["-i", f"{folder}/%04d.png", "-pix_fmt", "yuv420p", "-crf", "8", str(target)]
        subprocess.run(command, check=True)
        return target.read_bytes()


def write_stray_scanner(path: Path, num: int = 6, width: int = 160) -> CamerasFile:
    """Stray Scanner's recording; the row of frame 2 is missing, and rows have their own lens."""
    truth = breathing(walk(num, landscape_camera(width), frame_rate=30.0))
    columns = "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy"
    rows = [columns + ", distortion_center_x, distortion_center_y"]
    labels: dict[int, str] = {}
    with zipfile.ZipFile(path, "w") as archive:
        for index, image in enumerate(truth.images):
            lens, pose = truth.cameras[image.camera], pose_matrix(image)
            matrix = opencv_matrix(arkit_pose(pose))
            values = [_CLOCK_S + index / 30.0, *matrix[:3, 3], *quaternion(matrix[:3, :3])]
            values += [lens.fl_x, lens.fl_y, lens.cx - 0.5, lens.cy - 0.5]
            first, *others = (repr(float(value)) for value in values)
            if index != 2:
                rows.append(", ".join([first, f"{index:06d}", *others, "", ""]))
                labels[index] = f"71de12f9/rgb.mp4 frame {index}"
            counts = counts_of(reduced(lens, 2), pose, 5.0)
            archive.writestr(f"71de12f9/depth/{index:06d}.png", png(counts))
            rated = np.where(counts > 0, 2, 0).astype(np.uint8)
            archive.writestr(f"71de12f9/confidence/{index:06d}.png", png(rated))
        film = film_of([shown(truth, image) for image in truth.images])
        archive.writestr("71de12f9/rgb.mp4", film)
        archive.writestr("71de12f9/odometry.csv", "\n".join(rows) + "\n")
        k = _k(truth.cameras[-1])
        text = "\n".join(", ".join(str(value) for value in row) for row in k)
        archive.writestr("71de12f9/camera_matrix.csv", text)
        archive.writestr("71de12f9/imu.csv", "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z")
    return named(truth, labels)
