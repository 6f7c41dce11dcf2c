"""The small parts of the benchmarks: tables, chart, scores, machine, and the fits of figures."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from tests.benchmarks import reference
from tests.benchmarks.chart import Axes, Series, line_chart, round_ticks
from tests.benchmarks.machine import describe, heading, peak_memory_bytes
from tests.benchmarks.memory import MemoryPoint, fitted_line, fitted_lines
from tests.benchmarks.parity import floor_reached, parity_config, score_rows
from tests.benchmarks.psnr_over_time import draw, time_to_reach
from tests.benchmarks.render_speed import Speed, ratio
from tests.benchmarks.runs import Mark, Run
from tests.benchmarks.scores import Score, score
from tests.benchmarks.tables import markdown_table, mean, number, write_json

RED = (255, 0, 0)


def test_markdown_table_is_padded_and_aligned() -> None:
    assert markdown_table(["a", "long"], [["first", "1"], ["b", "22"]]) == "\n".join(
        ["| a     | long |", "|-------|-----:|", "| first |    1 |", "| b     |   22 |"]
    )
    with pytest.raises(ValueError, match="cells"):
        markdown_table(["a", "b"], [["one"]])


def test_figures_say_when_they_are_unknown() -> None:
    assert number(None) == "-"
    assert number(12345.678, 1) == "12,345.7"
    assert mean([1.0, 2.0]) == 1.5
    assert mean([1.0, None]) is None
    assert mean([]) is None


def test_json_holds_null_for_what_is_not_finite(tmp_path: Path) -> None:
    path = tmp_path / "out" / "a.json"
    write_json(path, {"x": math.inf, "y": [math.nan, 1.5], "z": {"1": (2, None)}})
    assert json.loads(path.read_text()) == {"x": None, "y": [None, 1.5], "z": {"1": [2, None]}}


def test_score_of_a_constant_error_is_known() -> None:
    truth = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
    found = score(truth + 0.1, truth)
    assert found.psnr == pytest.approx(20.0, abs=1e-4)  # -10 log10(0.1^2)
    assert found.lpips is None
    assert score(truth, truth).ssim == pytest.approx(1.0)


def test_chart_draws_a_line_through_its_points() -> None:
    points = [(0.0, 10.0), (50.0, 20.0), (100.0, 20.0)]
    picture = line_chart(
        [Series("line", points, RED)], title="t", x_label="x", y_label="y", size=(500, 400)
    )
    axes = Axes.around(points, 500, 400, log_x=False)
    middles = [(25.0, 15.0), (75.0, 20.0)]
    for point in middles:
        x, y = axes.pixel(point)
        around = [picture.getpixel((round(x), round(y) + shift)) for shift in (-1, 0, 1)]
        assert RED in around, point
    x, y = axes.pixel((75.0, 12.0))
    assert picture.getpixel((round(x), round(y))) != RED
    assert axes.pixel((0.0, 20.0))[1] < axes.pixel((0.0, 10.0))[1]


def test_chart_draws_lone_points_as_dots_and_refuses_nothing() -> None:
    series = [Series("one", [(3.0, 4.0)], RED), Series("other", [(5.0, 5.0)], (0, 0, 255))]
    picture = line_chart(series, title="", x_label="", y_label="")
    axes = Axes.around([(3.0, 4.0), (5.0, 5.0)], *picture.size, log_x=False)
    x, y = axes.pixel((3.0, 4.0))
    assert picture.getpixel((round(x), round(y))) == RED
    with pytest.raises(ValueError, match="nothing"):
        line_chart([], title="", x_label="", y_label="")


def test_logarithmic_axis_gives_equal_room_to_equal_ratios() -> None:
    axes = Axes.around([(1.0, 0.0), (100.0, 1.0)], 600, 400, log_x=True)
    left, middle, right = (axes.pixel((x, 0.0))[0] for x in (1.0, 10.0, 100.0))
    assert middle - left == pytest.approx(right - middle)
    assert {1.0, 10.0, 100.0} <= {round(tick, 9) for tick in axes.x_ticks()}


def test_ticks_are_round_and_inside() -> None:
    assert round_ticks(0.0, 10.0, 5) == [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]
    assert round_ticks(15.3, 19.9, 5) == [16.0, 17.0, 18.0, 19.0]


def test_machine_is_described_and_fits_json() -> None:
    machine = describe()
    json.dumps(machine)
    assert machine["cores"] >= 1
    assert machine["versions"]["torch"] == torch.__version__
    assert machine["cpu"] in heading(machine)


def test_peak_memory_counts_what_was_held() -> None:
    before = peak_memory_bytes()
    held = torch.ones(before // 4 + 64 * 2**18)  # four bytes each: more than ever before
    assert peak_memory_bytes() - before >= 48 * 2**20
    assert held[-1] == 1.0


def test_least_squares_line() -> None:
    assert fitted_line([(1.0, 5.0), (2.0, 8.0), (4.0, 14.0)]) == pytest.approx((2.0, 3.0))
    # Symmetric errors leave the line where it was.
    assert fitted_line([(0.0, 1.0), (0.0, -1.0), (2.0, 5.0), (2.0, 3.0)]) == pytest.approx(
        (0.0, 2.0)
    )
    with pytest.raises(ValueError, match="two different"):
        fitted_line([(1.0, 2.0), (1.0, 3.0)])


def test_memory_slopes_are_apart_for_number_and_size() -> None:
    def point(count: int, side: int, peak: int) -> MemoryPoint:
        return MemoryPoint("", count, side, side, 0, 0, peak)

    points = [point(10, 10, 1000 + 3000), point(20, 10, 1000 + 6000), point(10, 20, 1000 + 20_000)]
    number_line, size_line = fitted_lines(points)
    assert number_line.varied == "number"
    assert number_line.bytes_per_pixel == pytest.approx(3.0)
    assert number_line.base_bytes == pytest.approx(1000.0)
    assert (size_line.varied, size_line.fixed) == ("size", "10 images")
    assert size_line.bytes_per_pixel == pytest.approx((21_000 - 4000) / 3000)


def run_of(seed: int, step: int, values: dict[str, float]) -> Run:
    marks = [Mark(step, 10.0, {name: Score(value, 0.5) for name, value in values.items()})]
    return Run(seed, marks, step, 10.0, 1000.0, None)


def test_parity_rows_put_reference_seeds_and_mean_side_by_side() -> None:
    names = ["0014", "0031", "0052", "0085"]
    runs = [
        run_of(0, 301, dict(zip(names, (18.0, 20.0, 16.0, 10.0), strict=True))),
        run_of(1, 301, dict(zip(names, (20.0, 22.0, 18.0, 12.0), strict=True))),
    ]
    rows = score_rows(runs, [301], names, "psnr")
    assert rows == [
        ["reference", "301", "19.03", "21.27", "16.85", "-", "19.05", "-"],
        ["ours, seed 0", "301", "18.00", "20.00", "16.00", "10.00", "18.00", "16.00"],
        ["ours, seed 1", "301", "20.00", "22.00", "18.00", "12.00", "20.00", "18.00"],
        ["ours, mean", "301", "19.00", "21.00", "17.00", "11.00", "19.00", "17.00"],
    ]
    assert floor_reached(runs) == (19.0, True)
    assert floor_reached(runs[:1]) == (18.0, False)
    assert floor_reached([run_of(0, 57, dict.fromkeys(names, 30.0))]) is None


def test_parity_trains_with_the_references_settings() -> None:
    config = parity_config(301)
    assert (config.rays_per_step, config.data.long_side_px) == (1024, 480)
    assert config.model.camera_mode == "off"


def test_reference_means_are_the_published_ones() -> None:
    last = reference.POINTS[-1]
    assert last.mean_psnr() == pytest.approx(19.05, abs=5e-3)
    assert last.mean_ssim() == pytest.approx(0.563, abs=1e-3)
    assert reference.POINTS[0].mean_psnr() is None


def test_time_to_reach_a_quality_lies_on_the_line_between_marks() -> None:
    points = [(10.0, 15.0), (20.0, 17.0), (40.0, 19.0), (50.0, 18.0)]
    assert time_to_reach(points, 18.0) == pytest.approx(30.0)
    assert time_to_reach(points, 15.0) == 10.0
    assert time_to_reach(points, 17.0) == 20.0
    assert time_to_reach(points, 19.5) is None
    assert time_to_reach([], 1.0) is None


def test_picture_of_runs_shows_ours_and_the_reference() -> None:
    names = list(reference.MEASURED)
    runs = [run_of(0, 5, dict.fromkeys(names, 15.0)), run_of(1, 5, dict.fromkeys(names, 16.0))]
    picture = draw(runs, names, "fox", True, 19.05)
    colors = {color for _, color in picture.getcolors(picture.width * picture.height) or []}
    assert {(31, 119, 180), (255, 127, 14), (200, 30, 30)} <= colors


def test_ratio_of_speeds_is_taken_round_by_round() -> None:
    # A neighbour makes the second round four times as slow for both.
    fast, plain = Speed("fast", 10, [1.0, 4.0, 1.0]), Speed("plain", 10, [3.0, 12.0, 3.0])
    assert ratio(fast, plain) == 3.0
    assert fast.rays_per_s == 10.0
