"""Where the levels of a hash grid lie."""

from __future__ import annotations

from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.space.hash_levels import level_layout

SMALL = HashGridConfig(num_levels=4, min_res=3, max_res=24, log2_table_size=8, features_per_level=2)


def test_the_small_grid_has_dense_and_hashed_levels() -> None:
    assert level_layout(SMALL).dense == [True, False, False, False]
    assert level_layout(SMALL).resolutions == [3, 6, 12, 24]


def test_the_default_grid_has_the_paper_s_levels() -> None:
    layout = level_layout(HashGridConfig())
    assert layout.resolutions[0] == 16
    assert layout.resolutions[-1] == 2048
    assert layout.offsets[-1] - layout.offsets[-2] == 2**19
    assert layout.offsets[1] == 17**3


def test_one_level_has_the_smallest_resolution() -> None:
    assert level_layout(HashGridConfig(num_levels=1)).resolutions == [16]


def test_a_level_that_fills_its_table_exactly_is_dense() -> None:
    config = HashGridConfig(num_levels=2, min_res=7, max_res=8, log2_table_size=9)
    assert level_layout(config).dense == [True, False]  # 8^3 = 2^9 < 9^3
    assert level_layout(config).offsets == [0, 512, 1024]
