"""Curves that every eye can tell apart."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from ugat_marl.reporting import charts, formats
from ugat_marl.reporting.figures import add_axes, new_picture
from ugat_marl.reporting.style import CURVES, DARK, DISAGREEMENT, LIGHT, STEPS, curve_style

# Machado, Oliveira, Fernandes 2009, severity 1: linear RGB as a colour-blind eye sees it.
EYES = {
    "all cones": np.eye(3),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "tritanopia": np.array(
        [
            [1.255528, -0.076749, -0.178779],
            [-0.078411, 0.930809, 0.147602],
            [0.004733, 0.691367, 0.303900],
        ]
    ),
}
TO_XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)
WHITE = np.array([0.95047, 1.0, 1.08883])
LEAST = {**dict.fromkeys(EYES, 12.0), "tritanopia": 10.0}
"""Smallest CIE76 difference of two curves; 2.3 is just noticeable side by side."""


def linear(colour: str) -> NDArray[np.float64]:
    """Linear RGB of a colour in hexadecimal sRGB (IEC 61966-2-1)."""
    values = np.array([int(colour[place : place + 2], 16) for place in (1, 3, 5)]) / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def lab(rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIELAB of linear RGB."""
    x = TO_XYZ @ np.clip(rgb, 0, 1) / WHITE
    f = np.where(x > 216 / 24389, np.cbrt(x), (24389 / 27 * x + 16) / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def seen(colour: str, eye: str) -> NDArray[np.float64]:
    """CIELAB of a colour for an eye."""
    return lab(EYES[eye] @ linear(colour))


def difference(one: str, other: str, eye: str) -> float:
    """CIE76 difference of two colours for an eye."""
    return float(np.linalg.norm(seen(one, eye) - seen(other, eye)))


def test_the_measure_is_the_one_of_the_book() -> None:
    assert difference("#ffffff", "#000000", "all cones") == pytest.approx(100, abs=0.01)
    assert lab(linear("#ff0000")) == pytest.approx([53.24, 80.09, 67.20], abs=0.02)
    # Red and green of equal lightness, which a deuteranope confuses.
    assert difference("#c04000", "#707000", "all cones") > 50
    assert difference("#c04000", "#707000", "deuteranopia") < 20


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("palette", [LIGHT, DARK], ids=["light", "dark"])
def test_colours_of_curves_differ_for_every_eye(palette: dict[str, str], eye: str) -> None:
    for one, other in itertools.combinations(CURVES, 2):
        assert difference(palette[one], palette[other], eye) > LEAST[eye], (one, other)
    for one in CURVES:
        assert difference(palette[one], palette["paper"], eye) > 25


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("palette", [LIGHT, DARK], ids=["light", "dark"])
def test_scales_become_lighter_or_darker_all_the_way(palette: dict[str, str], eye: str) -> None:
    classes = tuple(f"d{number}" for number in range(len(DISAGREEMENT)))
    for scale in (STEPS, classes):
        changes = np.diff([seen(palette[name], eye)[0] for name in scale])
        assert (changes < -4).all() or (changes > 4).all()


def test_every_colour_has_one_name() -> None:
    assert len(set(LIGHT.values())) == len(LIGHT)
    assert LIGHT.keys() == DARK.keys()


def test_curves_differ_without_colour_too() -> None:
    styles = [curve_style(number) for number in range(12)]
    for one, other in itertools.combinations(styles, 2):
        assert (one["marker"], one["linestyle"]) != (other["marker"], other["linestyle"])
        assert one["color"] != other["color"] or one["linestyle"] != other["linestyle"]


@pytest.mark.parametrize(
    ("made", "text"),
    [
        (formats.number(999.6), "1\u00a0000"),
        (formats.number(-999.7), "−1\u00a0000"),
        (formats.number(99.6, 2), "100"),
        (formats.number(999.4), "999"),
        (formats.tick_text(9999.7), "10\u2009000"),
        (formats.tick_text(9999.2), "9999"),
        (formats.share(float("nan")), "–"),
    ],
)
def test_numbers_that_round_up_to_another_length_stay_readable(made: str, text: str) -> None:
    assert made == text


@pytest.mark.parametrize(("markers", "points"), [(True, [5.0, 6, 7, 8]), (False, [5.0, 8])])
def test_a_value_that_no_line_reaches_has_a_marker(markers: bool, points: list[float]) -> None:
    picture = new_picture("curve", "A curve", 300)
    axes = add_axes(picture, 58, 54, 14, 46)
    means = [5.0, math.nan, 6.0, 7.0, math.nan, 8.0]
    rows = [(float(x), mean, mean, mean) for x, mean in enumerate(means)]
    charts._draw_curve(picture, axes, 0, rows, markers=markers)
    _, *dots = axes.lines
    assert [float(dot.get_ydata()[0]) for dot in dots] == points


def test_a_single_point_has_its_interval_and_whole_ticks() -> None:
    picture, axes = charts._plot("curve", "A curve", "episode", "return")
    charts._draw_curve(picture, axes, 0, [(1.5, 5.0, 4.0, 7.0)])
    (line,) = axes.collections[-1].get_segments()
    assert line[:, 1].tolist() == [4.0, 7.0]
    assert all(float(tick).is_integer() for tick in axes.get_xticks())
