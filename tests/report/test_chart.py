"""Charts: well-formed SVG with labels, ticks and data in their places."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.report.chart import Axis, Series, _linear_ticks, _log_ticks, bar_chart, curve_chart, standalone


def texts(svg: str) -> list[str]:
    return [element.text or "" for element in ElementTree.fromstring(svg).iter("text")]


def polylines(svg: str) -> list[np.ndarray]:
    lines = [e.attrib["points"] for e in ElementTree.fromstring(svg).iter("polyline")]
    return [np.array([[float(v) for v in pair.split(",")] for pair in line.split()]) for line in lines]


def test_curve_is_drawn_to_scale() -> None:
    svg = curve_chart(
        "A < B",
        Axis("x in m", low=0, high=10),
        Axis("y", low=0, high=1),
        [Series("a", np.array([0, 5.0, 10]), np.array([0, 0.5, 1]))],
    )
    assert {"A < B", "x in m", "y", "a", "0", "10", "0.4"} <= set(texts(svg))
    ((first, middle, last),) = polylines(svg)
    assert np.allclose(middle, (first + last) / 2, atol=0.1)
    assert last[0] > first[0]
    assert last[1] < first[1]


def test_logarithmic_axis() -> None:
    x = np.array([1.0, 10, 100])
    svg = curve_chart("t", Axis("x", log=True, low=1, high=100), Axis("y"), [Series("", x, np.ones(3))])
    ((first, middle, last),) = polylines(svg)
    assert middle[0] == pytest.approx((first[0] + last[0]) / 2, abs=0.1)
    assert "x (log scale)" in texts(svg)
    with pytest.raises(GknetError, match="starts above 0"):
        curve_chart("t", Axis("x", log=True, low=0), Axis("y"), [Series("", x, np.ones(3))])


def test_a_value_without_an_interval_has_no_whisker() -> None:
    low, high = np.array([0.5, np.nan]), np.array([1.5, np.nan])
    series = [Series("", np.arange(2.0), np.ones(2), low, high)]
    svg = bar_chart("t", Axis("x"), ["p", "q"], series)
    assert svg.count('class="whisker"') == 1
    svg = curve_chart("t", Axis("x"), Axis("y"), series)
    assert svg.count('<line class="line s0"') == 1
    assert svg.count("<circle") == 2


@pytest.mark.parametrize("y", [np.full(3, np.nan), np.array([1.0, np.nan, 2]), np.zeros(3), np.full(3, 1e-9)])
def test_odd_data_is_borne(y: np.ndarray) -> None:
    series = [Series("a", np.arange(3.0), y, y - 1, y + 1), Series("b", np.zeros(0), np.zeros(0))]
    ElementTree.fromstring(curve_chart("t", Axis("x"), Axis("y"), series))
    svg = bar_chart("t", Axis("x"), ["p", "q", "r"], series[:1])
    ElementTree.fromstring(svg)
    assert "nan" not in svg


def test_nothing_to_draw_says_so() -> None:
    assert "no data" in texts(curve_chart("t", Axis("x"), Axis("y"), []))
    assert "no data" in texts(bar_chart("t", Axis("x"), [], []))


def test_bars_are_as_long_as_their_values() -> None:
    svg = bar_chart("t", Axis("px", low=0, high=4), ["one", "two"], [Series("", np.zeros(2), np.array([1.0, 2.0]))])
    widths = [
        float(e.attrib["width"]) for e in ElementTree.fromstring(svg).iter("rect") if "fill s0" in e.attrib["class"]
    ]
    assert widths[1] == pytest.approx(2 * widths[0], rel=0.01)
    assert {"one", "two", "px"} <= set(texts(svg))


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-0.05, 1.05), (0, 37), (1e-5, 3e-5), (990, 1010)])
def test_linear_ticks_are_few_even_and_inside(low: float, high: float) -> None:
    ticks = _linear_ticks(low, high)
    assert 3 <= len(ticks) <= 8
    assert low - 1e-12 <= min(ticks)
    assert max(ticks) <= high + 1e-12
    assert np.allclose(np.diff(ticks), ticks[1] - ticks[0])


@pytest.mark.parametrize(("low", "high"), [(1, 100), (0.2, 0.9), (1e-4, 3.2), (3, 5)])
def test_log_ticks_are_inside(low: float, high: float) -> None:
    ticks = _log_ticks(low, high)
    assert 2 <= len(ticks) <= 12
    assert low * 0.99 <= min(ticks)
    assert max(ticks) <= high * 1.01


def test_a_chart_of_its_own_is_a_whole_svg_file_with_its_colours() -> None:
    chart = bar_chart("a < b", Axis("px"), ["one"], [Series("", np.zeros(1), np.ones(1))])
    root = ElementTree.fromstring(standalone(chart))
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert root.get("viewBox") == ElementTree.fromstring(chart).get("viewBox")
    (style,) = (child for child in root if child.tag.endswith("style"))
    assert "--s0:" in (style.text or "")
    assert len([*root.iter()]) == len([*ElementTree.fromstring(chart).iter()]) + 1
