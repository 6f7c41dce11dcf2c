"""Which evaluation protocol a job followed, from the options as they really were. No torch here.

The protocols are described in docs/evaluation.md.
"""

from __future__ import annotations

from typing import Any

from pipelines.nerf.options.evaluate import EvaluateConfig


def protocol(
    train: dict[str, Any], config: EvaluateConfig, codes: bool, *, levelled: bool = False
) -> dict[str, Any]:
    """What was done, and the name of the protocol that it amounts to.

    train: the options that the model was trained with. codes: whether the model has appearance
    codes. levelled: whether its pictures were brought to one light. Names: `mipnerf360` (every 8th
    image, nothing optimised), `nerfstudio` (a tenth at equal intervals, the test-time procedure),
    `stretch` (neighbours held out, nothing fitted), `custom`.
    """
    data, camera_mode = train["data"], train["model"].get("camera_mode", "off")
    mode = data["eval_mode"]
    split = mode
    if mode == "interval":
        split = f"interval {data['eval_interval']}"
    elif mode == "fraction":
        split = f"fraction {1.0 - data['eval_fraction']:g}"
    elif mode == "stretch":
        split = f"stretch {data['eval_stretch_fraction']:g} at {data['eval_stretch_place']:g}"
    appearance = config.fit_appearance and codes
    unfitted = not (config.fit_poses or appearance)
    name = "custom"
    if split == "interval 8" and unfitted and camera_mode == "off" and not codes:
        name = "mipnerf360"
    elif split == "fraction 0.9" and config.fit_poses and (appearance or not codes):
        name = "nerfstudio"
    elif mode == "stretch" and unfitted:
        name = "stretch"
    return {
        "name": name,
        "split": split,
        "fit_poses": config.fit_poses,
        "fit_appearance": appearance,
        "train_camera_optimizer": camera_mode,
        "train_appearance": codes,
        "light": "halves" if levelled else "as it is",
        "description": " ".join(_sentences(config.fit_poses, appearance, levelled)),
    }


_LIGHT = (
    "The capture's exposure drifts and was levelled for training: a rendered picture is halved "
    "like a chess board, and each half has the exposure and white balance, three factors, that "
    "were measured on the other one.",
)


def _sentences(fitted_poses: bool, fitted_appearance: bool, levelled: bool) -> list[str]:
    return [
        "Held-out images were never trained on.",
        "Their poses were fitted to the whole images, the model fixed."
        if fitted_poses
        else "Their poses are those of the capture.",
        "Then their appearance codes were fitted to the left or right half of each image; "
        "half_unseen is measured on the other one."
        if fitted_appearance
        else "They are rendered with the mean appearance code.",
        *_LIGHT[:levelled],
        "PSNR of the mean squared error over all usable pixels and channels of an sRGB image in "
        "[0, 1]; SSIM with an 11x11 Gaussian window, sigma 1.5; means over images.",
    ]
