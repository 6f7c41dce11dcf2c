"""The reference's measured rows: nerfstudio 1.1.5 on 2 CPU cores, one run.

Nerfacto, PyTorch implementation, float32, camera optimiser off, 1,024 rays a step, `photos-fox` at
270x480, split `fraction 0.9`: 45 images trained on, these five held out.
"""

from __future__ import annotations

from dataclasses import dataclass

HELD_OUT = ("0014", "0031", "0052", "0085", "0110")
MEASURED = ("0014", "0031", "0052")
"""The images that the reference's mean is over."""
LONG_SIDE_PX = 480
RAYS_PER_STEP = 1024
TRAIN_RAYS_PER_S = 512.0
RENDER_RAYS_PER_S = 1430.0
PEAK_BYTES = 1.9e9
MIN_MEAN_PSNR = 18.9
"""What ours must reach after the last mark, in the mean of seeds over `MEASURED`, dB."""


@dataclass(frozen=True)
class ReferencePoint:
    """A moment of the reference's run; PSNR in dB and SSIM by image, as far as measured."""

    step: int
    train_s: float
    psnr: dict[str, float]
    ssim: dict[str, float]

    def mean_psnr(self) -> float | None:
        """Mean over `MEASURED`, or None where not all were measured."""
        if not all(name in self.psnr for name in MEASURED):
            return None
        return sum(self.psnr[name] for name in MEASURED) / len(MEASURED)

    def mean_ssim(self) -> float | None:
        """Mean over `MEASURED`, or None where not all were measured."""
        if not all(name in self.ssim for name in MEASURED):
            return None
        return sum(self.ssim[name] for name in MEASURED) / len(MEASURED)


POINTS = (
    ReferencePoint(57, 121.0, {"0014": 16.99}, {"0014": 0.500}),
    ReferencePoint(146, 301.0, {"0014": 18.64}, {"0014": 0.522}),
    ReferencePoint(
        301,
        601.0,
        {"0014": 19.03, "0031": 21.27, "0052": 16.85},
        {"0014": 0.556, "0031": 0.590, "0052": 0.545},
    ),
)
