"""Charts of a diagnosis: deviations of statistics, and headways.

They stand apart from the charts of trainings, whose records load torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ugat_marl.reporting.figures import (
    TOP,
    NamedFigure,
    add_axes,
    add_legend,
    add_tip,
    legend_height,
    new_picture,
    printable,
    shortened,
)
from ugat_marl.reporting.formats import tick_text
from ugat_marl.reporting.style import LIGHT, curve_style, styled

Deviation = tuple[str, str, float, float | None]
"""Statistic, remark, and deviation before and after, in standard deviations."""

BAND = 2.0
"""Half of the noise band, in standard deviations."""
_STRIP = 51.0
"""Height of the strip of one statistic, in points."""
_WIDEST = 1e12
"""Largest end of an axis, in standard deviations: a file may hold larger numbers."""


@styled()
def statistics_picture(rows: Sequence[Deviation], most: float, name: str) -> NamedFigure:
    """Draw how far measured statistics are from simulated ones, a strip for each.

    The scale is asinh(z / `BAND`): almost linear within the noise band and logarithmic far out.

    Args:
        rows: Statistics with their deviations.
        most: Largest deviation on the scale, in standard deviations; at least 10 is taken.
        name: Name of the picture.
    """
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    most = min(max(most, 10.0), _WIDEST)
    title = "Measured minus simulated, in standard deviations"
    picture = new_picture(name, title, TOP + 24 + _STRIP * len(rows))
    axes = add_axes(picture, 10, TOP + 22, 10, 2)
    axes.set_xscale("asinh", linear_width=BAND)
    end = 1.08 * math.asinh(most / BAND)
    axes.set_xlim(-BAND * math.sinh(end), BAND * math.sinh(end))
    axes.set_ylim(len(rows), 0)
    ticks = [tick for tick in (0, 10, 100, 1000) if tick <= most]
    axes.xaxis.set_major_locator(FixedLocator(sorted({s * t for t in ticks for s in (-1, 1)})))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(tick_text))
    axes.xaxis.tick_top()
    axes.yaxis.set_major_locator(NullLocator())
    axes.spines["bottom"].set_visible(False)
    axes.grid(visible=False)
    for place, (statistic, remark, before, after) in enumerate(rows):
        y = place + 41 / _STRIP
        axes.barh(y, 2 * BAND, 13 / _STRIP, -BAND, color=LIGHT["band"], linewidth=0)
        axes.plot([-most, most], [y, y], color=LIGHT["line"], linewidth=1, zorder=1)
        tip = f"{statistic}: before {before:+.3g}"
        if after is not None:
            tip += f", after {after:+.3g}"
            axes.plot([before, after], [y, y], color=LIGHT["soft"], linewidth=1.5)
        (dot,) = axes.plot(
            before, y, "o", markersize=9, zorder=3, markerfacecolor=LIGHT["paper"],
            markeredgecolor=LIGHT["c1"], markeredgewidth=2.5,
        )  # fmt: skip
        add_tip(dot, tip)
        if after is not None:
            (dot,) = axes.plot(after, y, "o", color=LIGHT["c0"], markersize=9, zorder=4)
            add_tip(dot, tip)
        for text, down, size, colour in (
            (shortened(statistic, 62), 14, 12, "ink"), (shortened(remark, 70), 27, 11, "soft"),
        ):  # fmt: skip
            axes.annotate(
                printable(text), (0, place), (0, -down), xycoords=("axes fraction", "data"),
                textcoords="offset points", fontsize=size, color=LIGHT[colour],
            )  # fmt: skip
    return picture


@styled()
def headway_picture(
    positions: Sequence[str],
    series: Mapping[str, Sequence[float | None]],
    noise_s: Sequence[float],
    name: str,
) -> NamedFigure:
    """Draw discharge headways against the position in the queue.

    Args:
        positions: Positions in the queue, such as "4th–5th".
        series: Headways by name, s, the measured ones first. None where nothing passed.
        noise_s: Standard deviation of each measured headway, s; drawn twofold.
        name: Name of the picture.
    """
    from matplotlib.ticker import FuncFormatter

    below = legend_height(list(series))
    picture = new_picture(name, "Headway by position in the queue, s", 250 + below)
    axes = add_axes(picture, 44, TOP, 16, 48 + below)
    places = np.arange(len(positions))
    for number, (title, gaps_s) in enumerate(series.items()):
        values = np.array([math.nan if gap is None else gap for gap in gaps_s])
        style = curve_style(number)
        if number == 0:
            spread = 2 * np.array(noise_s)
            axes.errorbar(places, values, spread, color=style["color"], fmt="none", capsize=4)
        axes.plot(places, values, **style, markersize=7, zorder=3)
        for place in np.flatnonzero(np.isfinite(values)).tolist():
            (dot,) = axes.plot(place, values[place], "o", alpha=0, markersize=11, zorder=4)
            add_tip(dot, f"{positions[place]}, {title}: {values[place]:.2f} s")
    axes.set_xticks(places, positions)
    axes.set_xlim(-0.4, len(positions) - 0.6)
    axes.yaxis.set_major_formatter(FuncFormatter(tick_text))
    axes.set_xlabel("position in the queue", loc="right")
    add_legend(picture, list(series))
    return picture
