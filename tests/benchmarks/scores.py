"""How close renderings of held-out images are: PSNR, SSIM, and LPIPS where there are weights.

Rendered with all samples and no early stop, the cameras as given and the mean appearance code,
unless told otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from pipelines.nerf.judging.metrics import psnr, ssim
from pipelines.nerf.options.render import ALL_SAMPLES
from pipelines.nerf.renderer import Renderer
from pipelines.nerf.space.cameras import Cameras
from tests.benchmarks.capture_data import BenchmarkCapture


class PictureDistance(Protocol):
    """What measures LPIPS."""

    def distance(self, predicted: Tensor, truth: Tensor) -> float:
        """Of two pictures [H, W, 3] in [0, 1]."""


@dataclass(frozen=True)
class Score:
    """How close one picture is. psnr: dB. lpips: None where it was not measured."""

    psnr: float
    ssim: float
    lpips: float | None = None


def score(predicted: Tensor, truth: Tensor, lpips: PictureDistance | None = None) -> Score:
    """Measure one picture [H, W, 3] in [0, 1]."""
    perceived = None if lpips is None else lpips.distance(predicted, truth)
    return Score(psnr(predicted, truth), ssim(predicted, truth), perceived)


def render_images(
    model: Any,
    capture: BenchmarkCapture,
    images: Sequence[int],
    *,
    cameras: Cameras | None = None,
    codes: Mapping[int, Tensor] | None = None,
    engine: str = "auto",
) -> dict[int, Tensor]:
    """Renderings [H, W, 3] on the CPU by image number.

    cameras: in place of the capture's. codes: appearance codes by image number, else the mean.
    engine: of the renderer.
    """
    renderer = Renderer(model, capture.scene, engine=engine, config=ALL_SAMPLES)
    posed = capture.cameras if cameras is None else cameras
    pictures = {}
    for index in images:
        code: Any = None if codes is None else codes.get(index)
        pictures[index] = torch.as_tensor(renderer.render(posed, index, appearance=code).rgb)
    return pictures


def evaluate(
    model: Any, capture: BenchmarkCapture, images: Sequence[int], engine: str = "auto"
) -> dict[str, Score]:
    """Measure renderings of these images, by their names."""
    pictures = render_images(model, capture, images, engine=engine)
    return {
        capture.names[index]: score(picture, capture.images.image(index))
        for index, picture in pictures.items()
    }
