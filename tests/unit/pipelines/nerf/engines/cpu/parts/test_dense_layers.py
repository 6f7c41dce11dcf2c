"""What training needs of the small dense layers: transposed layers and sums of products."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.nerf.engines.cpu.parts.dense_layers import (
    TILE,
    add_products,
    apply_layer,
    pack_transposed,
    products_shape,
    round_up,
    unpack_products,
)


@pytest.mark.parametrize(("outputs", "inputs", "count"), [(3, 7, 5), (64, 32, TILE), (16, 10, 17)])
def test_transposed_layer_is_the_product_with_the_transpose(
    outputs: int, inputs: int, count: int
) -> None:
    random = np.random.default_rng(0)
    weight = random.normal(size=(outputs, inputs)).astype(np.float32)
    gradient = np.zeros((round_up(outputs, 4), TILE), np.float32)
    gradient[:outputs] = random.normal(size=(outputs, TILE))
    out = np.zeros((round_up(inputs, 4), TILE), np.float32)
    apply_layer(gradient, pack_transposed(weight), count, False, False, out)
    expected = weight.astype(np.float64).T @ gradient[:outputs, :count]
    np.testing.assert_allclose(out[:inputs, :count], expected, atol=1e-5)


@pytest.mark.parametrize(("outputs", "inputs", "count"), [(3, 7, 5), (64, 32, TILE), (16, 10, 17)])
def test_products_are_summed_over_the_samples_and_added(
    outputs: int, inputs: int, count: int
) -> None:
    random = np.random.default_rng(0)
    left = random.normal(size=(round_up(outputs, 4), TILE)).astype(np.float32)
    right = random.normal(size=(round_up(inputs, 4), TILE)).astype(np.float32)
    left[:, count:] = 0.0
    sums = np.zeros(products_shape(outputs, inputs), np.float32)
    for _ in range(2):
        add_products(left, right, count, sums)
    expected = 2.0 * left[:, :count].astype(np.float64) @ right[:, :count].T
    np.testing.assert_allclose(unpack_products(sums), expected, atol=5e-5)
