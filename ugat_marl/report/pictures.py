"""Evaluations and training runs as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from ugat_marl.evaluation import Evaluation
from ugat_marl.files import replacing
from ugat_marl.training import Metrics

_COLOURS = ("#4c78a8", "#e45756", "#f58518", "#54a24b", "#b279a2")


def transfer_picture(found: Evaluation, metrics: Metrics, path: Path) -> None:
    """Bars of ATT by policy and domain, and ATT over the iterations, as PNG.

    Args:
        found: The final evaluation.
        metrics: The run's metrics; its iterations are drawn.
        path: Where to write.
    """
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(10, 4.2), dpi=120, layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
        _bars(left, found)
        _curves(right, found, metrics)
        figure.suptitle(f"{found.scenario}: average travel time", fontsize=11, x=0.01, ha="left")
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png")


def _bars(axes: Any, found: Evaluation) -> None:
    width = 0.8 / len(found.domains)
    places = np.arange(len(found.policies))
    for number, domain in enumerate(found.domains):
        estimates = [found.estimate(policy, domain, "att_s") for policy in found.policies]
        means = np.array([estimate.mean for estimate in estimates])
        low = np.nan_to_num(means - [estimate.low for estimate in estimates])
        high = np.nan_to_num([estimate.high for estimate in estimates] - means)
        spots = places + (number - (len(found.domains) - 1) / 2) * width
        axes.bar(
            spots, means, width * 0.92, yerr=np.stack([low, high]), label=domain,
            color=_COLOURS[number % len(_COLOURS)], error_kw={"lw": 1, "capsize": 2},
        )  # fmt: skip
        for spot, mean, above in zip(spots, means, high, strict=True):
            axes.annotate(
                f"{mean:.0f}", (spot, mean + above), ha="center", va="bottom", fontsize=8,
                xytext=(0, 2), textcoords="offset points",
            )  # fmt: skip
    breaks = " :-" if len(places) > 5 else " :"  # six names side by side need narrow lines
    axes.set_xticks(places, [_broken(name, breaks) for name in found.policies])
    axes.set_ylabel("ATT [s]")
    seeds = len({result.seed for result in found.results})
    axes.set_title(f"final policies, {seeds} seeds, 95 % intervals", fontsize=9)
    axes.legend(frameon=False, title="domain")


def _broken(name: str, breaks: str) -> str:
    """A name in lines; of the characters it is broken at, only blanks vanish."""
    for character in breaks:
        name = name.replace(character, f"{character.strip()}\n")
    return name


def _curves(axes: Any, found: Evaluation, metrics: Metrics) -> None:
    for number, domain in enumerate(found.domains):
        points = sorted(
            (step, value)
            for stage, step, name, value in metrics.rows
            if stage == "iteration" and name == f"att_s/{domain}"
        )
        colour = _COLOURS[number % len(_COLOURS)]
        if points:
            axes.plot(*zip(*points, strict=True), "o-", color=colour, label=f"in {domain}")
        rule = f"rule {found.notes.get(f'best rule in {domain}')}"
        if rule in found.policies:
            level = found.estimate(rule, domain, "att_s").mean
            axes.axhline(level, color=colour, ls="--", lw=1, label=f"best rule in {domain}")
    axes.set_xlabel("iteration (0: direct transfer)")
    axes.set_ylabel("ATT [s]")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_ylim(bottom=0)
    axes.set_title("UGAT, one seed after each iteration", fontsize=9)
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.14))
