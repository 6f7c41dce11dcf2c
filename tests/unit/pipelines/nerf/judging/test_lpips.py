"""LPIPS with generated weights against loops in numpy, and its weights put together and refused."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging.lpips import (
    BACKBONES,
    NO_WEIGHTS,
    Lpips,
    load_lpips,
    lpips_if_configured,
    main,
    merge_published,
)

FloatArray = NDArray[np.float64]

# torchvision's numbering, written down from its published networks:
# ("conv", number, stride, padding), ("pool", window, stride), and after which a layer is compared.
STEPS: dict[str, list[tuple[str, int, int, int]]] = {
    "alex": [
        ("conv", 0, 4, 2),
        ("tap", 0, 0, 0),
        ("pool", 3, 2, 0),
        ("conv", 3, 1, 2),
        ("tap", 1, 0, 0),
        ("pool", 3, 2, 0),
        ("conv", 6, 1, 1),
        ("tap", 2, 0, 0),
        ("conv", 8, 1, 1),
        ("tap", 3, 0, 0),
        ("conv", 10, 1, 1),
        ("tap", 4, 0, 0),
    ],
    "vgg": [
        *(("conv", 0, 1, 1), ("conv", 2, 1, 1), ("tap", 0, 0, 0), ("pool", 2, 2, 0)),
        *(("conv", 5, 1, 1), ("conv", 7, 1, 1), ("tap", 1, 0, 0), ("pool", 2, 2, 0)),
        *(("conv", n, 1, 1) for n in (10, 12, 14)),
        *(("tap", 2, 0, 0), ("pool", 2, 2, 0)),
        *(("conv", n, 1, 1) for n in (17, 19, 21)),
        *(("tap", 3, 0, 0), ("pool", 2, 2, 0)),
        *(("conv", n, 1, 1) for n in (24, 26, 28)),
        ("tap", 4, 0, 0),
    ],
}
SHAPES: dict[str, dict[int, tuple[int, int, int]]] = {
    "alex": {
        0: (64, 3, 11),
        3: (192, 64, 5),
        6: (384, 192, 3),
        8: (256, 384, 3),
        10: (256, 256, 3),
    },
    "vgg": {
        **{0: (64, 3, 3), 2: (64, 64, 3), 5: (128, 64, 3), 7: (128, 128, 3), 10: (256, 128, 3)},
        **{12: (256, 256, 3), 14: (256, 256, 3), 17: (512, 256, 3), 19: (512, 512, 3)},
        **{21: (512, 512, 3), 24: (512, 512, 3), 26: (512, 512, 3), 28: (512, 512, 3)},
    },
}
WIDTHS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}


def generated(backbone: str) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Random weights under the published names: (as torchvision's file, as the lpips package's)."""
    generator = torch.Generator().manual_seed(7)
    convolutions: dict[str, Tensor] = {}
    for number, (out, into, side) in SHAPES[backbone].items():
        spread = (2.0 / (into * side * side)) ** 0.5
        weight = spread * torch.randn(out, into, side, side, generator=generator)
        convolutions[f"features.{number}.weight"] = weight
        convolutions[f"features.{number}.bias"] = 0.1 * torch.randn(out, generator=generator)
    # The published files have a classifier, which the metric does not use.
    convolutions["classifier.6.bias"] = torch.zeros(1000)
    linear = {
        f"lin{number}.model.1.weight": torch.rand(1, width, 1, 1, generator=generator) / width
        for number, width in enumerate(WIDTHS[backbone])
    }
    return convolutions, linear


def slow_lpips(
    backbone: str, weights: dict[str, Tensor], one: FloatArray, two: FloatArray
) -> float:
    """Equation 1, one output pixel after the other. one, two: [H, W, 3] in [0, 1]."""
    numbers = {name: value.numpy().astype(np.float64) for name, value in weights.items()}
    layers = [slow_features(backbone, numbers, picture) for picture in (one, two)]
    total = 0.0
    for number, (left, right) in enumerate(zip(*layers, strict=True)):
        weight = numbers[f"lin{number}.model.1.weight"].reshape(-1)
        height, width = left.shape[1:]
        for y in range(height):
            for x in range(width):
                a, b = left[:, y, x], right[:, y, x]
                a = a / (np.sqrt((a * a).sum()) + 1e-10)
                b = b / (np.sqrt((b * b).sum()) + 1e-10)
                total += float((weight * (a - b) ** 2).sum()) / (height * width)
    return total


def slow_features(
    backbone: str, numbers: dict[str, FloatArray], picture: FloatArray
) -> list[FloatArray]:
    signed = 2.0 * picture - 1.0
    scaled = (signed - np.array([-0.030, -0.088, -0.188])) / np.array([0.458, 0.448, 0.450])
    value = scaled.transpose(2, 0, 1)
    taken = []
    for kind, first, stride, padding in STEPS[backbone]:
        if kind == "tap":
            taken.append(value)
        elif kind == "pool":
            value = slow_pool(value, first, stride)
        else:
            weight = numbers[f"features.{first}.weight"]
            bias = numbers[f"features.{first}.bias"]
            value = np.maximum(slow_convolution(value, weight, bias, stride, padding), 0.0)
    return taken


def slow_convolution(
    value: FloatArray, weight: FloatArray, bias: FloatArray, stride: int, padding: int
) -> FloatArray:
    side = weight.shape[-1]
    padded = np.pad(value, ((0, 0), (padding, padding), (padding, padding)))
    height = (padded.shape[1] - side) // stride + 1
    width = (padded.shape[2] - side) // stride + 1
    flat = weight.reshape(len(weight), -1)
    result = np.zeros((len(weight), height, width))
    for y in range(height):
        for x in range(width):
            window = padded[:, y * stride : y * stride + side, x * stride : x * stride + side]
            result[:, y, x] = flat @ window.reshape(-1) + bias
    return result


def slow_pool(value: FloatArray, side: int, stride: int) -> FloatArray:
    height = (value.shape[1] - side) // stride + 1
    width = (value.shape[2] - side) // stride + 1
    result = np.zeros((len(value), height, width))
    for y in range(height):
        for x in range(width):
            window = value[:, y * stride : y * stride + side, x * stride : x * stride + side]
            result[:, y, x] = window.max(axis=(1, 2))
    return result


def pictures(height: int, width: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    one = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    noise = 0.2 * torch.randn(height, width, 3, generator=generator, dtype=torch.float64)
    return one, (one + noise).clamp(0.0, 1.0)


def model_of(backbone: str) -> Lpips:
    convolutions, linear = generated(backbone)
    model = Lpips(backbone)
    missing, unexpected = model.load_state_dict(convolutions | linear, strict=False)
    assert not missing
    assert unexpected == ["classifier.6.bias"]
    return model


@pytest.fixture(scope="module")
def alex() -> Lpips:
    return model_of("alex")


@pytest.mark.parametrize(("backbone", "height", "width"), [("alex", 64, 67), ("vgg", 18, 17)])
def test_equals_loops_over_every_pixel(backbone: str, height: int, width: int) -> None:
    convolutions, linear = generated(backbone)
    one, two = pictures(height, width)
    expected = slow_lpips(backbone, convolutions | linear, one.numpy(), two.numpy())
    assert expected > 1e-3
    model = model_of(backbone)
    assert model.distance(one, two) == pytest.approx(expected, rel=1e-4)
    assert model.double().distance(one, two) == pytest.approx(expected, rel=1e-7)


def test_equal_pictures_have_no_distance_and_order_does_not_matter(alex: Lpips) -> None:
    one, two = pictures(40, 50)
    assert alex.distance(one, one) == 0.0
    assert alex.distance(one, two) == alex.distance(two, one)
    assert alex.distance(one, two) > alex.distance(one, 0.5 * (one + two)) > 0.0


def test_pictures_without_any_response_have_no_distance() -> None:
    """Where nothing fires the features are 0, not 0 / 0."""
    model = model_of("alex")
    for number in (0, 3, 6, 8, 10):
        layer = model.features[number]
        assert isinstance(layer, torch.nn.Conv2d)
        assert layer.bias is not None
        layer.bias.fill_(0.0 if number else -1e6)
    assert model.distance(*pictures(40, 40)) == 0.0


@pytest.mark.parametrize("backbone", ["alex", "vgg"])
def test_smallest_pictures_work_and_smaller_are_refused(backbone: str) -> None:
    side = BACKBONES[backbone].min_side
    model = model_of(backbone)
    assert model.distance(*pictures(side, side + 3)) > 0.0
    with pytest.raises(NerfError, match=f"at least {side} pixels"):
        model.distance(*pictures(side + 3, side - 1))
    with pytest.raises(NerfError, match="cannot be compared"):
        model.distance(pictures(side, side)[0], pictures(side, side + 1)[0])


def test_unknown_backbone_is_refused_with_those_there_are() -> None:
    with pytest.raises(NerfError, match="alex, vgg") as caught:
        Lpips("squeeze")
    assert caught.value.code == "bad_config"


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The two files of AlexNet as they are published, with generated numbers."""
    folder = tmp_path_factory.mktemp("published")
    convolutions, linear = generated("alex")
    torch.save(convolutions, folder / "alexnet.pth", _use_new_zipfile_serialization=False)
    torch.save(linear, folder / "alex.pth")
    return folder / "alexnet.pth", folder / "alex.pth"


@pytest.fixture(scope="module")
def merged(published: tuple[Path, Path]) -> Path:
    out = published[0].parent / "alex.safetensors"
    merge_published(*published, out, sha256=(sha256(published[0]), sha256(published[1])))
    return out


def test_two_published_files_and_the_merged_one_give_the_same(
    alex: Lpips, published: tuple[Path, Path], merged: Path, tmp_path: Path
) -> None:
    two = load_lpips("alex", [str(p) for p in published], [sha256(p) for p in published], tmp_path)
    one, reason = lpips_if_configured("alex", str(merged), sha256(merged).upper(), tmp_path)
    assert reason is None
    assert one is not None
    assert "classifier.6.bias" not in safetensors.torch.load_file(merged)
    expected = alex.distance(*pictures(40, 40))
    assert expected == two.distance(*pictures(40, 40)) == one.distance(*pictures(40, 40))
    assert list(tmp_path.iterdir()) == [], "local files are not copied"


def test_without_weights_there_is_no_number_but_a_reason(tmp_path: Path) -> None:
    model, reason = lpips_if_configured("vgg", "", "", tmp_path)
    assert model is None
    assert reason == NO_WEIGHTS


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("lin3.model.1.weight", None, "lin3.model.1.weight is missing"),
        ("features.8.weight", torch.zeros(256, 384, 5, 5), "has shape"),
        ("features.8.bias", torch.full((256,), torch.nan), "finite"),
    ],
)
def test_weights_that_do_not_fit_are_refused_by_name(
    tmp_path: Path, name: str, value: Tensor | None, message: str
) -> None:
    convolutions, linear = generated("alex")
    tensors = convolutions | linear
    if value is None:
        del tensors[name]
    else:
        tensors[name] = value
    path = tmp_path / "weights.safetensors"
    safetensors.torch.save_file(tensors, path)
    with pytest.raises(NerfError, match=message):
        load_lpips("alex", str(path), sha256(path), tmp_path)


def test_each_file_needs_its_sha256(tmp_path: Path, merged: Path) -> None:
    with pytest.raises(NerfError, match=r"1 files .* with 2 sha256"):
        load_lpips("alex", str(merged), ["0" * 64, "1" * 64], tmp_path)
    with pytest.raises(NerfError, match="is not the file that was configured"):
        load_lpips("alex", str(merged), "0" * 64, tmp_path)


def test_converter_takes_published_files_unless_told_otherwise(
    published: tuple[Path, Path],
    merged: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out.safetensors"
    names = [str(published[0]), str(published[1]), str(out)]
    with pytest.raises(SystemExit) as stopped:
        main(names)
    assert stopped.value.code == 1
    assert "not a pair of published files" in capsys.readouterr().err
    assert not out.exists()
    assert main([*names, "--sha256", sha256(published[0]), sha256(published[1])]) == 0
    assert sha256(out) in capsys.readouterr().out
    assert out.read_bytes() == merged.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["out.safetensors"]
