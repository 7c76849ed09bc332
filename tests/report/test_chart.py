"""Charts by their geometry."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from v2p_data.report.chart import Line, line_chart, ticks


def points(chart) -> list[list[tuple[float, float]]]:
    lines = re.findall(r'<polyline[^>]* points="([^"]*)"', chart)
    return [[tuple(map(float, p.split(","))) for p in line.split()] for line in lines]  # type: ignore[misc]


def a_line(y, name="success") -> Line:
    return Line(name=name, x=np.arange(len(y), dtype=float), y=np.asarray(y, float))


def test_a_straight_line_is_drawn_straight_and_upwards():
    (line,) = points(line_chart([a_line([0, 0.5, 1])], title="t", x_label="x"))
    (x0, y0), (x1, y1), (x2, y2) = line

    assert x1 - x0 == pytest.approx(x2 - x1)
    assert y0 - y1 == pytest.approx(y1 - y2)
    assert y0 > y1 > y2  # SVG counts y downwards


def test_what_is_not_finite_leaves_a_gap():
    drawn = points(line_chart([a_line([0, np.nan, 1, 2, np.inf, 3])], title="t", x_label="x"))

    assert [len(line) for line in drawn] == [1, 2, 1]


def test_nothing_finite_gives_no_chart():
    assert line_chart([a_line([np.nan, np.nan])], title="t", x_label="x") == ""
    assert line_chart([], title="t", x_label="x") == ""


def test_a_constant_curve_is_drawn_in_the_middle():
    (line,) = points(line_chart([a_line([3, 3, 3])], title="t", x_label="x", height_px=144))

    assert {y for _, y in line} == {10 + (144 - 10 - 34) / 2}


def test_a_chart_is_well_formed_and_escapes_names():
    chart = line_chart(
        [a_line([0, 1], '<img src=x onerror="a()">'), a_line([1, 0])],
        title="a & b <",
        x_label="<s>",
    )

    ET.fromstring(chart)
    assert "<img" not in chart


def test_many_points_are_thinned_without_losing_the_range():
    (line,) = points(line_chart([a_line(np.arange(10_000))], title="t", x_label="x"))

    assert 300 < len(line) <= 400


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 1.0, [0, 0.5, 1]),
        (0.0, 2e6, [0, 1e6, 2e6]),
        (-1.0, 1.0, [-1, 0, 1]),
        (0.13, 0.87, [0.5]),
    ],
)
def test_ticks_are_round_numbers_inside_the_range(low, high, expected):
    assert ticks(low, high, 2) == pytest.approx(expected)
