"""Evaluations and training runs as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from ugat_marl.data import Metrics
from ugat_marl.experiments import Evaluation
from ugat_marl.files import replacing

COLOURS = ("#4c78a8", "#e45756", "#f58518", "#54a24b", "#b279a2")


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


def calibration_picture(metrics: Metrics, path: Path) -> bool:
    """What u is worth: risk against coverage, and u on and off the data, as PNG.

    Args:
        metrics: The metrics of a run.
        path: Where to write.

    Returns:
        Whether there was an iteration to draw; if not, nothing is written.
    """
    found: dict[int, dict[str, float]] = {}
    for stage, step, name, value in metrics.rows:
        if stage == "iteration" and name.startswith("calibration/"):
            found.setdefault(step, {})[name.removeprefix("calibration/")] = value
    if not found:
        return False
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(10, 4.2), dpi=120, layout="constrained")
        left, right = figure.subplots(1, 2)
        _risks(left, found)
        _levels(right, found)
        figure.suptitle("uncertainty u of the inverse models", fontsize=11, x=0.01, ha="left")
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png")
    return True


def _risks(axes: Any, found: dict[int, dict[str, float]]) -> None:
    for number, step in enumerate((min(found), max(found)) if len(found) > 1 else found):
        risks = [v for name, v in sorted(found[step].items()) if name.startswith("risk_by_cov")]
        shares = [(i + 1) / len(risks) for i in range(len(risks))]
        label = f"iteration {step} (AUROC {found[step]['auroc']:.2f}, ECE {found[step]['ece']:.2f})"
        axes.plot(shares, risks, "o-", color=COLOURS[number], label=label)
        axes.axhline(risks[-1], color=COLOURS[number], ls="--", lw=1)
    axes.set_xlabel("share of answers taken, lowest u first")
    axes.set_ylabel("wrong among them")
    axes.set_ylim(0, 1.08 * axes.dataLim.ymax or 1)
    axes.set_title("held-out errors of h; dashed: a u that says nothing", fontsize=9)
    axes.legend(frameon=False)


def _levels(axes: Any, found: dict[int, dict[str, float]]) -> None:
    steps = sorted(found)
    for number, (name, label) in enumerate(
        (("mean_u", "on held-out data"), ("mean_u_off_data", "off the data"))
    ):
        axes.plot(steps, [found[s][name] for s in steps], "o-", color=COLOURS[number], label=label)
    axes.set_xlabel("iteration")
    axes.set_xlim(steps[0] - 0.5, steps[-1] + 0.5)  # one alone has no width of its own
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_ylabel("mean u")
    axes.set_ylim(0, 1.03)
    axes.set_title("does u rise where the simulation never was?", fontsize=9)
    axes.legend(frameon=False)


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
            color=COLOURS[number % len(COLOURS)], error_kw={"lw": 1, "capsize": 2},
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
        colour = COLOURS[number % len(COLOURS)]
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
