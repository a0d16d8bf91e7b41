"""Comparisons of settings as pictures: radar charts of sim against real, bars of the gaps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ugat_marl.experiments import Comparison, Interval
from ugat_marl.files import replacing
from ugat_marl.reporting.pictures import COLOURS

_AXES = {
    "att_s": "ATT", "throughput": "throughput", "reward": "reward", "queue": "queue",
    "delay": "delay",
}  # fmt: skip
_STYLE: dict[Any, Any] = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}


def radar_picture(found: Comparison, settings: Sequence[str], path: Path) -> None:
    """The paper's five measures in sim and in each real domain, as PNG.

    Each axis is scaled by the best value on it: 1, at the rim, is the best, towards the middle it
    gets worse.

    Args:
        found: What was trained and played.
        settings: Which rows to draw; the first is drawn in the simulation, too.
        path: Where to write.
    """
    with mpl.rc_context(_STYLE):
        count = len(found.targets)
        columns = min(count, 4)
        rows = math.ceil(count / columns)
        width, height = max(3.3 * columns, 6.6), 3.4 * rows + 1.1
        figure = Figure(figsize=(width, height), dpi=120)
        for place, target in enumerate(found.targets):
            axes: Any = figure.add_subplot(rows, columns, place + 1, projection="polar")
            _radar(axes, found, [s for s in settings if found.has(s, target)], target)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="lower center", ncols=2, frameon=False)
        figure.suptitle(
            f"{found.scenario}: simulation against real domain; the rim is the best value",
            fontsize=11, x=0.01, y=1 - 0.1 / height, ha="left", va="top",
        )  # fmt: skip
        figure.subplots_adjust(  # inches for the title, the legend, and names around each circle
            left=0.5 / width, right=1 - 0.5 / width, wspace=0.4,
            top=1 - 1.1 / height, bottom=1.0 / height, hspace=0.45,
        )  # fmt: skip
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png")


def gap_picture(found: Comparison, path: Path) -> None:
    """Bars of the gaps of ATT and throughput with intervals over training seeds, as PNG.

    Args:
        found: What was trained and played.
        path: Where to write.
    """
    with mpl.rc_context(_STYLE):
        height = 1.9 + 0.32 * len(found.settings) * max(1.0, 0.45 * len(found.targets))
        figure = Figure(figsize=(10, height), dpi=120, layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        left.invert_yaxis()
        _gaps(left, found, "att_s", "Δ of ATT [s]; shorter is better")
        _gaps(right, found, "throughput", "Δ of throughput [veh]")
        names = right.get_legend_handles_labels()  # outside: no corner is free of bars for certain
        longest_in = 0.55 + 0.085 * max(map(len, found.targets))  # with its coloured box
        columns = max(1, min(4, int(9.6 / longest_in)))
        figure.legend(*names, loc="outside lower center", ncols=columns, frameon=False)
        figure.suptitle(
            f"{found.scenario}: real domain minus simulation", fontsize=11, x=0.01, ha="left"
        )
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png")


def goodness(values: NDArray[np.float64], more_is_better: bool) -> NDArray[np.float64]:
    """Values in (0, 1] with 1 for the best; ratios to it, by size where they are negative.

    Args:
        values: ``(n,)``, all of one sign.
        more_is_better: Of the size.
    """
    sizes = np.abs(values)
    best = sizes.max() if more_is_better else sizes.min()
    if best == 0.0:
        return np.where(sizes == 0.0, 1.0, 0.0)
    return sizes / best if more_is_better else best / sizes


def _radar(axes: Any, found: Comparison, settings: Sequence[str], target: str) -> None:
    lines = [(f"{settings[0]} in {found.sim}", settings[0], found.sim)]
    lines += [(f"{name} in the real domain", name, target) for name in settings]
    table = np.array(
        [[found.values(s, target, m, domain).mean() for m in _AXES] for _, s, domain in lines]
    )
    scaled = np.stack(
        [goodness(table[:, i], m == "throughput") for i, m in enumerate(_AXES)], axis=1
    )
    angles = np.linspace(0, 2 * np.pi, len(_AXES), endpoint=False)
    for number, ((label, _, _), row) in enumerate(zip(lines, scaled, strict=True)):
        closed = [*row, row[0]], [*angles, angles[0]]
        style = {"ls": "--"} if number == 0 else {}
        axes.plot(closed[1], closed[0], color=COLOURS[number % len(COLOURS)], label=label, **style)
        axes.fill(closed[1], closed[0], color=COLOURS[number % len(COLOURS)], alpha=0.06)
    axes.set_xticks(angles, list(_AXES.values()), fontsize=8)
    axes.set_yticks([0.25, 0.5, 0.75, 1.0], ["", "0.5", "", "1"], fontsize=7)
    axes.set_ylim(0, 1.05)
    axes.set_title(target, fontsize=10, pad=14)


def _gaps(axes: Any, found: Comparison, measure: str, label: str) -> None:
    width = 0.8 / len(found.targets)
    places = np.arange(len(found.settings))
    for number, target in enumerate(found.targets):
        rows = [(i, s) for i, s in enumerate(found.settings) if found.has(s, target)]
        intervals = [Interval.of(found.gaps(s, target, measure)) for _, s in rows]
        means = np.array([interval.mean for interval in intervals])
        low = np.nan_to_num(means - [interval.low for interval in intervals])
        high = np.nan_to_num([interval.high for interval in intervals] - means)
        spots = [places[i] + (number - (len(found.targets) - 1) / 2) * width for i, _ in rows]
        axes.barh(
            spots, means, width * 0.92, xerr=np.stack([low, high]), label=target,
            color=COLOURS[number % len(COLOURS)], error_kw={"lw": 1, "capsize": 2},
        )  # fmt: skip
    axes.set_yticks(places, found.settings)
    axes.set_xlabel(label)
    axes.axvline(0, color="black", lw=0.8)
