"""One light for all pictures of a capture: what the camera's automatic exposure did, undone.

A phone measures light and white balance anew while it films, so one wall has another colour in each
picture. A model that must explain that invents haze before the cameras and colours that depend on
the direction, and a texture made of such pictures has seams.

Model: an sRGB value c stands for x = c / (1 - b c), and a picture has x times its *gain*, a factor
per channel, of what the scene has in the capture's mean light. The *bend* b is the camera's: with 0
values are powers of light, whose gains are factors again; with 1 the curve is an S, as phones'
are (a logistic function of the logarithm of light), and what is nearly white changes little. Both
are found by `pipelines.nerf.stereo.light` where pictures overlap.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Light = tuple[float, float, float, float]
"""Of a picture: the gains of red, green and blue, positive, and the bend in [0, 1]."""

DARKEST, BRIGHTEST = 0.06, 0.94
"""Between these a picture's values say how bright something is; beyond, noise or a limit does."""
_SHOULDER = (0.94, 0.99)
"""What is too bright to be shown, a window, is so in any light: from here to there a value that
would become darker goes over to what it was."""
_MIN_PIXELS = 50
_SQUARES = 16
"""Of the chess board along a picture's long side."""


def exposed(colors: NDArray[Any], gain: Any, bend: float) -> Floats:
    """Colours in [0, 1] with another gain: factors that broadcast with them."""
    values = np.asarray(colors, np.float64)
    below = 1.0 - bend * values + bend * values * gain
    return np.asarray(np.clip(values * gain / np.maximum(below, 1e-9), 0.0, 1.0), np.float64)


def in_logarithms(colors: NDArray[Any], bend: float) -> Floats:
    """The logarithms of what colours in (0, 1) stand for: a gain adds its own."""
    values = np.asarray(colors, np.float64)
    return np.asarray(np.log(values) - np.log1p(-bend * values), np.float64)


def _relit(colors: NDArray[Any], gain: Any, bend: float) -> Floats:
    """As `exposed`, but white stays white."""
    values = np.asarray(colors, np.float64)
    even = exposed(values, gain, bend)
    white = np.clip((values - _SHOULDER[0]) / (_SHOULDER[1] - _SHOULDER[0]), 0.0, 1.0)
    return np.asarray(even + white * np.maximum(values - even, 0.0), np.float64)


def light_table(light: Light) -> NDArray[np.uint8]:
    """[256, 3]: what each value of each channel becomes in the mean light."""
    values = np.arange(256.0)[:, None] / 255.0
    return np.rint(255.0 * _relit(values, 1.0 / np.asarray(light[:3]), light[3])).astype(np.uint8)


def levelled(picture: NDArray[np.uint8], light: Light | None) -> NDArray[np.uint8]:
    """A picture [..., 3] in the mean light; as it is for None."""
    if light is None:
        return picture
    table = light_table(light)
    return np.stack([table[picture[..., channel], channel] for channel in range(3)], axis=-1)


def is_measurable(colors: NDArray[Any]) -> NDArray[np.bool_]:
    """Which of colours [..., 3] in [0, 1] are neither clipped nor lost in the dark: [...]."""
    kept: NDArray[np.bool_] = (colors.min(axis=-1) > DARKEST) & (colors.max(axis=-1) < BRIGHTEST)
    return kept


def gain_between(
    scene: NDArray[Any], photo: NDArray[Any], usable: NDArray[np.bool_], bend: float
) -> Floats:
    """[3], the gain of a photo over what shows the same scene in the mean light.

    scene, photo: [H, W, 3] in [0, 1]; usable: [H, W]. The median ratio of each channel, 1 where too
    few pixels tell.
    """
    told = usable & is_measurable(scene) & is_measurable(photo)
    if told.sum() < _MIN_PIXELS:
        return np.ones(3)
    ratios = in_logarithms(photo[told], bend) - in_logarithms(scene[told], bend)
    return np.asarray(np.exp(np.median(ratios, axis=0)), np.float64)


def in_the_light_of(
    scene: NDArray[Any], photo: NDArray[Any], usable: NDArray[np.bool_], bend: float
) -> NDArray[np.float32]:
    """What shows the scene in the mean light, as the photo's exposure would have it, [H, W, 3].

    The picture is halved like a chess board. The gain of its white squares is measured on the black
    ones and the other way round, so that no pixel is compared with a colour that it took part in,
    and both halves show the same things: those that shine would give the left and the right half
    different gains. Arguments as of `gain_between`.
    """
    shown = np.array(scene, np.float32)
    rows, columns = (np.arange(side) * _SQUARES // max(shown.shape) for side in shown.shape[:2])
    white = (rows[:, None] + columns) % 2 == 0
    for asked, told in ((white, ~white), (~white, white)):
        gain = gain_between(scene, photo, usable & asked, bend)
        shown[told] = _relit(shown[told], gain, bend)
    return shown
