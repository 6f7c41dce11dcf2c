"""A flight filmed: frames drawn one after the other, into videos or a zip of pictures.

Outputs are named; each is a file of its own, or all of them stand side by side in one.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.exports import shades
from pipelines.exports.flight_options import FlightOptions
from pipelines.exports.formats.mp4 import VideoWriter
from pipelines.exports.formats.png_frames import FramesWriter
from pipelines.exports.paths.flight import Flight
from pipelines.exports.shots import Lens, Shot, shot_of, within
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.trained_scene import TrainedScene
from pipelines.stage import StageContext

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Frames = dict[str, Bytes]
Painter = Callable[[Pinhole | Intrinsics, Floats, NDArray[np.bool_] | None], Bytes]
"""`(lens, pose, circle) -> [H, W, 3]`, as `MeshStudio.picture`."""


@dataclass(frozen=True)
class Film:
    """outputs: in order. files: the video of each output, or the one of all. pictures: the zip in
    place of them. together: whether outputs stand side by side."""

    options: FlightOptions
    outputs: Sequence[str]
    files: Mapping[str, str]
    pictures: str
    together: bool

    def width(self, lens: Lens) -> int:
        """Of a picture, px."""
        return lens.size[0] * (len(self.outputs) if self.together else 1)

    def told(self, flight: Flight, lens: Lens, folder: Path) -> dict[str, Any]:
        """What the report says of it."""
        fps, made = self.options.frame_rate(), (*self.files.values(), self.pictures)
        duration_s = len(flight) / fps
        return {
            "path": self.options.path,
            "camera": self.options.camera_type(),
            "codec": self.options.codec,
            "num_frames": len(flight),
            "width": self.width(lens),
            "height": lens.size[1],
            "fps": fps,
            "duration_s": round(duration_s, 3),
            "turn_deg_per_s": round(flight.turned_deg() / duration_s, 1),
            "bytes": sum(
                (folder / name).stat().st_size for name in made if (folder / name).exists()
            ),
        }


def make_film(
    scene: TrainedScene,
    film: Film,
    flight: Flight,
    lens: Lens,
    ctx: StageContext,
    painters: Mapping[str, Painter],
) -> None:
    """Render and write all frames. Raises ToolError.

    painters: by output, where something else than a shot of the trained scene draws it.
    """
    draw = _drawer(scene, film, lens, ctx, painters)
    started, count = time.monotonic(), len(flight)
    with _writer(film, ctx, lens) as write:
        for index, pose in enumerate(flight.poses):
            write(draw(index, pose))
            done = index + 1
            eta = (time.monotonic() - started) / done * (count - done)
            ctx.progress(done / (count + 4), f"frame {done}/{count}", eta)


def _drawer(
    scene: TrainedScene, film: Film, lens: Lens, ctx: StageContext, painters: Mapping[str, Painter]
) -> Callable[[int, Floats], Frames]:
    """What draws a frame of each output."""
    between = None
    if "depth" in film.outputs:
        ctx.progress(0.0, "looking for the range of depths")
        between = shades.range_of_views(scene.probe_views(ctx.check_cancelled))
    of_shot: dict[str, Callable[[Shot], Bytes]] = {
        "rgb": lambda shot: shot.rgb,
        "depth": lambda shot: shades.depth_picture(shot.depth, between),
        "normals": lambda shot: shades.normals_picture(shot.normals()),
        "accumulation": lambda shot: shades.accumulation_picture(shot.accumulation),
    }

    def draw(index: int, pose: Floats) -> Frames:
        seen_through, circle = lens.of(index), lens.circle(index)
        frames = {name: paint(seen_through, pose, circle) for name, paint in painters.items()}
        of_scene = [name for name in film.outputs if name not in painters]
        if of_scene:
            shot = shot_of(scene, seen_through, pose, circle)
            # What is unknown is grey; beyond the circle there is nothing to know.
            frames |= {name: within(circle, of_shot[name](shot)) for name in of_scene}
        return {name: frames[name] for name in film.outputs}

    return draw


@contextlib.contextmanager
def _writer(film: Film, ctx: StageContext, lens: Lens) -> Iterator[Callable[[Frames], None]]:
    """What writes a frame of each output, into files that are whole when the block is left."""
    options = film.options
    with contextlib.ExitStack() as stack:
        if options.codec == "png":
            frames = stack.enter_context(FramesWriter(ctx.out / film.pictures))

            def write_pictures(shown: Frames) -> None:
                if film.together:
                    shown = {"side_by_side": np.concatenate(list(shown.values()), axis=1)}
                for name, picture in shown.items():
                    frames.write(name, picture)

            yield write_pictures
            return
        size = (film.width(lens), lens.size[1])
        writers = {
            name: stack.enter_context(
                VideoWriter(
                    ctx.out / file,
                    *(*size, options.frame_rate(), options.crf, options.codec),
                    equirectangular=options.camera_type() == "equirectangular",
                )
            )
            for name, file in film.files.items()
        }

        def write(shown: Frames) -> None:
            if film.together:
                (only,) = writers.values()
                only.write(np.concatenate(list(shown.values()), axis=1))
                return
            for name, picture in shown.items():
                writers[name].write(picture)

        yield write
