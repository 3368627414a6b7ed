"""Charts, and which frames of long runs they draw."""

import json
import re

import numpy as np
import pytest

from spslam.evaluation.charts import Series, line_chart, trajectory_chart
from spslam.evaluation.thinning import MAX_FRAMES, thin_frames


def values_of(chart):
    return json.loads(re.search(r'<script type="application/json">(.*?)</script>', chart)[1])


def test_short_runs_are_drawn_whole():
    assert np.array_equal(thin_frames([(np.zeros(MAX_FRAMES), True)]), np.arange(MAX_FRAMES))


def test_thinning_keeps_every_peak_and_gap():
    values = np.random.default_rng(0).random(50_000)
    peaks = [0, 17, 20_001, 49_999]
    values[peaks] = 100.0
    values[[5, 33_333]] = -100.0
    values[41_234] = np.nan
    frames = thin_frames([(values, True)])
    assert set(peaks) | {5, 33_333, 41_234} <= set(frames.tolist())
    assert len(frames) <= 3 * 500 + 2
    assert (np.diff(frames) > 0).all()


@pytest.mark.parametrize("values", [np.full(5000, np.nan), np.zeros(5000)])
def test_thinning_of_lines_without_values_keeps_the_ends(values):
    assert {0, 4999} <= set(thin_frames([(values, True)]).tolist())


def test_a_chart_has_the_values_that_it_draws():
    values = np.array([1.0, np.nan, 3.14159265, 2.0])
    chart = line_chart([Series("a <b>", "tracking", values)], "cm", np.array([False, True, False, False]))
    assert values_of(chart)["series"][0]["values"] == [1.0, None, 3.142, 2.0]
    assert values_of(chart)["frames"] == [0, 1, 2, 3]
    assert "a &lt;b&gt;" in chart
    line = re.search(r'<path class="line tracking" d="([^"]*)"', chart)[1]
    assert line.count("M") == 2  # interrupted at the gap
    assert "h.01" in line  # the one value before it
    assert re.search(r'<path class="lost" d="M166.7 0H500.0V100', chart)


def test_many_losses_make_one_short_path():
    lost = np.arange(100_000) % 2 == 0
    chart = line_chart([Series("a", "tracking", np.ones(100_000))], "cm", lost)
    assert len(chart) < 200_000


def test_marks_of_another_length_are_left_out():
    assert 'class="lost"' not in line_chart([Series("a", "tracking", np.ones(3))], "cm", np.ones(2, bool))


def test_a_chart_without_values_is_empty():
    assert line_chart([Series("a", "tracking", np.full(3, np.nan))], "cm") == ""
    assert trajectory_chart(np.zeros((0, 2)), None, np.zeros(0, bool)) == ""


def test_a_trajectory_has_equal_scales_and_its_meters():
    estimate = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]])
    chart = trajectory_chart(estimate, None, np.array([False, False, True]))
    data = values_of(chart)
    assert data["meters"] == [0, 0, 2, 0, 2, 1]
    assert data["points"][4:] == [None, None]
    (x0, y0), (x1, y1) = np.reshape(data["points"][:4], (2, 2))
    assert y0 == pytest.approx(y1, abs=0.1)
    width, height = map(float, re.search(r'viewBox="0 0 (\d+) (\d+)"', chart).groups())
    assert x1 - x0 == pytest.approx(width * 2 / 2.32, abs=1)
    assert height == pytest.approx(width * 1.32 / 2.32, abs=1)
