"""LPIPS: the distance of two pictures in the features of a pretrained network.

The two backbones are written out here and keep torchvision's parameter names
(`features.0.weight`...), the linear layers those of the lpips package (`lin0.model.1.weight`...),
so that the published files can be read as they are. The weights are not part of this program: they
come from a configured file or URL with its sha256, or there is no value. Symbols: l one of the five
layers, C_l its channels, H_l and W_l its size.

`python -m pipelines.nerf.judging.lpips BACKBONE.pth LIN.pth OUT.safetensors` merges the two
published files into one.

Source: Zhang et al., "The unreasonable effectiveness of deep features as a perceptual metric",
CVPR 2018, eq. 1; values those of the lpips package 0.1 with the weights of its version 0.1.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor, nn

from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging.weight_files import file_digest, read_weights

NO_WEIGHTS = (
    "LPIPS was not measured: it needs the weights of a pretrained network, which are not part of "
    "this program, and no file or URL of them is configured."
)
_NORM_EPS = 1e-10

# Mean and spread of ImageNet's pictures, for values in [-1, 1]: part of the metric's definition.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


@dataclass(frozen=True)
class Backbone:
    """A network's convolutional part.

    layers: in order; (outputs, kernel, stride, padding) of a convolution with its ReLU, or the
        (kernel, stride) of a maximum pool. They are numbered as in torchvision: a convolution and
        its ReLU count two.
    taps: positions, in `layers`, of the five whose output is compared.
    min_side: smallest picture side with at least one value in every tapped layer, px.
    """

    layers: tuple[tuple[int, ...], ...]
    taps: tuple[int, int, int, int, int]
    min_side: int


_POOL = (2, 2)


def _conv3(outputs: int) -> tuple[int, ...]:
    return (outputs, 3, 1, 1)


BACKBONES: dict[str, Backbone] = {
    # Krizhevsky, "One weird trick for parallelizing convolutional neural networks", 2014.
    "alex": Backbone(
        layers=(
            (64, 11, 4, 2),
            (3, 2),
            (192, 5, 1, 2),
            (3, 2),
            _conv3(384),
            _conv3(256),
            _conv3(256),
        ),
        taps=(0, 2, 4, 5, 6),
        min_side=31,
    ),
    # Simonyan and Zisserman, ICLR 2015, configuration D.
    "vgg": Backbone(
        layers=(
            *(_conv3(64), _conv3(64), _POOL),
            *(_conv3(128), _conv3(128), _POOL),
            *(_conv3(256), _conv3(256), _conv3(256), _POOL),
            *(_conv3(512), _conv3(512), _conv3(512), _POOL),
            *(_conv3(512), _conv3(512), _conv3(512)),
        ),
        taps=(1, 4, 8, 12, 16),
        min_side=16,
    ),
}

# Not downloaded when this was written: each sha256 is the one that several independent public
# projects record for this file, and torchvision's begin with the digits in the file's name.
PUBLISHED_SHA256: dict[str, tuple[str, str]] = {
    "alex": (
        "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
        "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    ),
    "vgg": (
        "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
        "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
    ),
}
"""Per backbone: sha256 of torchvision's file and of the lpips package's linear layers."""


class Lpips(nn.Module):
    """The metric. Its parameters have the names of the published files; it never learns.

    backbone: a key of `BACKBONES`. Raises NerfError `bad_config` for another.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, backbone: str) -> None:
        super().__init__()
        if backbone not in BACKBONES:
            raise NerfError(
                "bad_config",
                f"There is no LPIPS backbone {backbone}.",
                f"Use one of: {', '.join(BACKBONES)}.",
            )
        self.backbone = backbone
        plan = BACKBONES[backbone]
        modules: list[nn.Module] = []
        channels, widths, self._taps = 3, list[int](), list[int]()
        for position, layer in enumerate(plan.layers):
            if len(layer) == 2:
                modules.append(nn.MaxPool2d(*layer))
                continue
            outputs, kernel, stride, padding = layer
            modules += [nn.Conv2d(channels, outputs, kernel, stride, padding), nn.ReLU()]
            channels = outputs
            if position in plan.taps:
                self._taps.append(len(modules) - 1)
                widths.append(outputs)
        self.features = nn.Sequential(*modules)
        for number, width in enumerate(widths):
            # Position 0 is the dropout of the lpips package, which does nothing outside training.
            linear = nn.Sequential(nn.Identity(), nn.Conv2d(width, 1, 1, bias=False))
            self.add_module(f"lin{number}", nn.ModuleDict({"model": linear}))
        self.register_buffer("shift", torch.tensor(_SHIFT)[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor(_SCALE)[:, None, None], persistent=False)
        self.requires_grad_(False)
        self.eval()

    def forward(self, predicted: Tensor, truth: Tensor) -> Tensor:
        """Distances [N] >= 0 of pictures [N, 3, H, W] in [0, 1].

        d = sum_l mean_{h,w} sum_c w_lc (f_lc(predicted) - f_lc(truth))^2, where f_l is the ReLU
        output of layer l divided by its length over channels (plus 1e-10).
        Source: Zhang et al. 2018, eq. 1.
        """
        maps = zip(self._unit_features(predicted), self._unit_features(truth), strict=True)
        total = torch.zeros(len(predicted), dtype=predicted.dtype, device=predicted.device)
        for number, (one, other) in enumerate(maps):
            weighted = self.get_submodule(f"lin{number}.model")((one - other).square())
            total = total + weighted.mean(dim=(1, 2, 3))
        return total

    def distance(self, predicted: Tensor, truth: Tensor) -> float:
        """LPIPS of two pictures [H, W, 3] in [0, 1]; 0 for equal ones, larger for less alike.

        Raises NerfError `bad_image` unless both have that shape and are large enough.
        """
        if predicted.shape != truth.shape or predicted.ndim != 3 or predicted.shape[2] != 3:
            raise NerfError(
                "bad_image",
                f"Pictures of shapes {tuple(predicted.shape)} and {tuple(truth.shape)} cannot be "
                "compared; both must be [H, W, 3].",
            )
        min_side = BACKBONES[self.backbone].min_side
        if min(predicted.shape[:2]) < min_side:
            raise NerfError(
                "bad_image",
                f"LPIPS with {self.backbone} needs pictures of at least {min_side} pixels a side.",
            )
        with torch.no_grad():
            pair = [p.to(self.shift).permute(2, 0, 1)[None] for p in (predicted, truth)]
            return float(self(*pair))

    def _unit_features(self, pictures: Tensor) -> list[Tensor]:
        """Five [N, C_l, H_l, W_l], of length 1 over channels, or 0 where nothing fires."""
        value = (2.0 * pictures - 1.0 - self.shift) / self.scale
        taken = []
        for position, module in enumerate(self.features):
            value = module(value)
            if position in self._taps:
                taken.append(value / (value.norm(dim=1, keepdim=True) + _NORM_EPS))
        return taken


def load_lpips(
    backbone: str,
    source: str | Sequence[str],
    sha256: str | Sequence[str],
    cache_dir: Path,
) -> Lpips:
    """The metric with its weights.

    backbone: a key of `BACKBONES`. source: a path or http(s) URL of one file that holds
    everything, or several whose tensors are put together, .safetensors or .pth. sha256: one for
    each, hexadecimal; it is compared before anything of the file is read as more than bytes.
    cache_dir: where downloads are kept, under their sha256.
    Raises NerfError `lpips_weights` that says which file failed and why; `bad_config` for an
    unknown backbone.
    """
    model = Lpips(backbone)
    sources = [source] if isinstance(source, str) else list(source)
    digests = [sha256] if isinstance(sha256, str) else list(sha256)
    if not sources or len(sources) != len(digests):
        raise NerfError(
            "lpips_weights",
            f"{len(sources)} files of LPIPS weights are configured, with {len(digests)} sha256.",
            "Give the sha256 of each file, in the same order.",
        )
    tensors: dict[str, Tensor] = {}
    for place, digest in zip(sources, digests, strict=True):
        tensors |= read_weights(place, digest, cache_dir)
    _fill(model, tensors)
    return model


def lpips_if_configured(
    backbone: str, source: str | Sequence[str], sha256: str | Sequence[str], cache_dir: Path
) -> tuple[Lpips | None, str | None]:
    """(the metric, None), or (None, why there is none) where `source` is empty.

    Weights that are configured and cannot be had are an error, not None: see `load_lpips`.
    """
    if not source:
        return None, NO_WEIGHTS
    return load_lpips(backbone, source, sha256, cache_dir), None


def merge_published(
    backbone_file: Path, linear_file: Path, out: Path, sha256: tuple[str, str] | None = None
) -> tuple[str, str]:
    """One safetensors file from the two published ones; returns (backbone, sha256 of the file).

    sha256: what the two must have; None for those of `PUBLISHED_SHA256`.
    Raises NerfError `lpips_weights` where they are others or do not belong together.
    """
    files = (backbone_file, linear_file)
    if sha256 is None:
        found = tuple(file_digest(path) for path in files)
        if found not in PUBLISHED_SHA256.values():
            raise NerfError(
                "lpips_weights",
                f"{backbone_file.name} and {linear_file.name} are not a pair of published files: "
                f"their sha256 are {found[0]} and {found[1]}.",
                "Download them again, or, if these are your own weights, say so with --sha256.",
            )
        sha256 = (found[0], found[1])
    tensors: dict[str, Tensor] = {}
    for path, digest in zip(files, sha256, strict=True):
        tensors |= read_weights(str(path), digest, out.parent)
    first = tensors.get("features.0.weight")
    name = "alex" if first is not None and first.shape[-1] == 11 else "vgg"
    model = Lpips(name)
    _fill(model, tensors)
    kept = {key: value.contiguous() for key, value in model.state_dict().items()}
    handle, temporary = tempfile.mkstemp(dir=out.parent, prefix=".lpips-")
    os.close(handle)
    try:
        safetensors.torch.save_file(kept, temporary, metadata={"backbone": name})
        Path(temporary).replace(out)
    finally:
        Path(temporary).unlink(missing_ok=True)
    return name, file_digest(out)


def _fill(model: Lpips, tensors: dict[str, Tensor]) -> None:
    """Put the weights into the model; others, such as the classifier's, are left out."""
    for name, own in model.state_dict().items():
        given = tensors.get(name)
        problem = None
        if given is None:
            problem = "is missing"
        elif given.shape != own.shape:
            problem = f"has shape {tuple(given.shape)} and not {tuple(own.shape)}"
        elif not (given.is_floating_point() and bool(torch.isfinite(given).all())):
            problem = "is not made of finite numbers"
        if given is None or problem is not None:
            raise NerfError(
                "lpips_weights",
                f"The LPIPS weights do not fit the backbone {model.backbone}: {name} {problem}.",
                "Configure the weights of this backbone: its convolutions and the linear layers.",
            )
        own.copy_(given)


def main(arguments: Sequence[str] | None = None) -> int:
    """Merge the two published files of a backbone into one; prints its sha256."""
    parser = argparse.ArgumentParser(
        prog="python -m pipelines.nerf.judging.lpips", description=main.__doc__
    )
    parser.add_argument(
        "backbone", type=Path, help="torchvision's file, such as vgg16-397923af.pth"
    )
    parser.add_argument("linear", type=Path, help="the lpips package's weights/v0.1/vgg.pth")
    parser.add_argument("out", type=Path, help="the safetensors file to write")
    parser.add_argument(
        "--sha256", nargs=2, metavar=("BACKBONE", "LINEAR"), help="of files that are not published"
    )
    given = parser.parse_args(arguments)
    pair = (given.sha256[0].lower(), given.sha256[1].lower()) if given.sha256 else None
    try:
        name, digest = merge_published(given.backbone, given.linear, given.out, pair)
    except NerfError as error:
        parser.exit(1, f"{error}\n")
    print(f"{given.out.name}: LPIPS weights of {name}, sha256 {digest}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
