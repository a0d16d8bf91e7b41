"""Charts of trainings, evaluations and comparisons: curves, means with intervals, radar charts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.data import Metrics
from ugat_marl.errors import counted
from ugat_marl.experiments import (
    DIRECT,
    GROUNDED_NAME,
    Evaluation,
    best_rule_note,
    is_grounded,
    matched_name,
    means_by_step,
    means_by_stretch,
    variant_name,
)
from ugat_marl.reporting.figures import (
    TOP,
    WIDTH,
    NamedFigure,
    add_axes,
    add_legend,
    add_tip,
    legend_height,
    new_picture,
    printable,
    shortened,
    shortened_apart,
    write_png,
)
from ugat_marl.reporting.formats import tick_text
from ugat_marl.reporting.run_records import RunRecord
from ugat_marl.reporting.style import LIGHT, curve_style, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RADAR_AXES: dict[str, tuple[str, str]] = {
    "att_s": ("travel time", "s"),
    "throughput": ("throughput", "veh"),
    "reward": ("reward", "per step"),
    "queue": ("queue", "veh"),
    "delay": ("delay, 1 − v/vmax", ""),
}
"""The paper's five measures, as named on a radar, with their units."""
_ROW = 30.0
"""Height of a row of dots, in points."""

Estimated = tuple[float, float, float]
"""Mean, lower end and upper end of its interval."""
Cells = Mapping[tuple[str, str], Mapping[str, Any]]
"""Setting and domain to a row of a table."""


# --- curves of trainings --------------------------------------------------------------------------


@styled()
def learning_picture(records: Sequence[RunRecord], name: str) -> NamedFigure | None:
    """Draw the return per training episode, with 95 % intervals.

    Args:
        records: Trainings that differ in their seed alone. For one training, the intervals are over
            the episodes of a stretch; for several, they are over the seeds.
        name: Name of the picture.

    Returns:
        The picture; None if no return was logged.
    """
    series = [rows for record in records if (rows := record.series("episode", "return"))]
    rows = means_by_stretch(series)
    if not rows:
        return None
    picture, axes = _plot(
        name, f"Learning: {_several(records)}", "training episode",
        "return (sum of the reward, mean over agents)",
    )  # fmt: skip
    _draw_curve(picture, axes, 0, rows, markers=len(rows) < 3)
    plain = records[0].ugat.get("pretrain_episodes")
    first, last = series[0][0][0], max(row[0] for row in rows)
    if isinstance(plain, int) and first < plain < last:
        late = plain > (first + last) / 2
        axes.axvline(plain, color=LIGHT["soft"], linewidth=1, linestyle=(0, (4, 3)))
        axes.annotate(
            "grounded from here", (plain, 1), xycoords=("data", "axes fraction"),
            xytext=(-4 if late else 4, -10), textcoords="offset points", color=LIGHT["soft"],
            ha="right" if late else "left",
        )  # fmt: skip
    return picture


@styled()
def travel_time_picture(records: Sequence[RunRecord], name: str) -> NamedFigure | None:
    """Draw ATT after each iteration by domain, with 95 % intervals if there are several seeds."""
    domains: dict[str, list[tuple[float, float, float, float]]] = {}
    for domain in _domains(records):
        series = [record.series("iteration", f"att_s/{domain}") for record in records]
        if rows := means_by_step([points for points in series if points]):
            domains[domain] = rows
    if not domains:
        return None
    picture, axes = _plot(
        name, f"Travel time: {_several(records)}", "iteration (0: direct transfer)",
        "average travel time, s", [f"in {domain}" for domain in domains],
    )  # fmt: skip
    for number, rows in enumerate(domains.values()):
        _draw_curve(picture, axes, number, rows)
    return picture


@styled()
def gate_picture(records: Sequence[RunRecord], name: str) -> NamedFigure | None:
    """Draw acceptance, α and u over the iterations, each as the mean over the intersections."""
    labels = {
        "gate/acceptance": "acceptance (share of decisions)",
        "gate/mean_u": "mean u",
        "gate/alpha": "threshold α (none: ∞)",
    }
    curves = {
        key: means_by_step(
            [rows for record in records if (rows := record.series("iteration", key))]
        )
        for key in labels
    }
    if not curves["gate/acceptance"]:
        return None
    picture, axes = _plot(
        name, f"The gate: {_several(records)}", "iteration", "share, or uncertainty",
        list(labels.values()),
    )  # fmt: skip
    axes.set_ylim(-0.02, 1.02)
    for number, rows in enumerate(curves.values()):
        _draw_curve(picture, axes, number, rows)
    return picture


def _plot(
    name: str, title: str, x_label: str, y_label: str, legend: Sequence[str] = ()
) -> tuple[NamedFigure, Axes]:
    """Return a picture with one pair of axes; the horizontal axis has whole numbers."""
    below = legend_height(legend)
    picture = new_picture(name, title, 300 + below)
    axes = add_axes(picture, 58, 54, 14, 46 + below)
    _label(axes, x_label, y_label)
    if legend:
        add_legend(picture, legend)
    return picture, axes


def _label(axes: Axes, x_label: str, y_label: str) -> None:
    """Label both axes at their ends; the label of the vertical axis is horizontal text."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    axes.set_xlabel(x_label, loc="right")
    axes.set_title(y_label, color=LIGHT["soft"], x=-50 / _points_wide(axes))
    axes.grid(visible=False, axis="x")
    axes.xaxis.set_major_locator(MaxNLocator(7, integer=True, min_n_ticks=1))
    axes.yaxis.set_major_locator(MaxNLocator(6))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(tick_text))


def _points_wide(axes: Any) -> float:
    return float(axes.get_position().width * axes.figure.get_size_inches()[0] * 72)


def _draw_curve(
    picture: NamedFigure,
    axes: Axes,
    number: int,
    rows: Sequence[tuple[float, float, float, float]],
    *,
    markers: bool = True,
) -> None:
    """Draw a curve with its interval; the curve has a gap where there is no value.

    Each row holds x, mean, and lower and upper end of the interval.
    """
    x, mean, low, high = np.array(rows, dtype=float).reshape(-1, 4).T
    style = curve_style(number)
    marker = style.pop("marker")
    axes.fill_between(x, low, high, color=style["color"], alpha=0.18, linewidth=0)
    axes.plot(x, mean, **style)
    known = np.isfinite(mean)
    alone = known & ~np.r_[known[1:], False] & ~np.r_[False, known[:-1]]  # no line reaches it
    bounded = alone & np.isfinite(low) & np.isfinite(high)
    axes.vlines(x[bounded], low[bounded], high[bounded], color=style["color"], alpha=0.5)
    if len(x) == 1:  # ticks of an axis without a length are no whole numbers
        axes.update_datalim([(x[0] - 1.0, mean[0]), (x[0] + 1.0, mean[0])])
        axes.autoscale_view()
    shown = known if markers else alone
    for place, value in zip(x[shown], mean[shown], strict=True):
        (dot,) = axes.plot(place, value, marker=marker, color=style["color"], zorder=3)
        add_tip(dot, f"{place:g}: {tick_text(value)}")


def _several(records: Sequence[RunRecord]) -> str:
    if len(records) == 1:
        return shortened(records[0].name, 34)
    first = records[0]
    name = first.scenario + (f" → {first.real}" if first.real else "")
    kind = first.grounding
    return f"{shortened(name, 26)}{f', {kind}' if kind else ''}, {counted(len(records), 'seed')}"


def _domains(records: Sequence[RunRecord]) -> list[str]:
    names = [
        name.removeprefix("att_s/")
        for record in records
        for stage, _, name, _ in (record.metrics.rows if record.metrics is not None else [])
        if stage == "iteration" and name.startswith("att_s/")
    ]
    return list(dict.fromkeys(names))


# --- means with intervals -------------------------------------------------------------------------


@styled()
def scores_picture(
    title: str, labels: Sequence[str], series: Mapping[str, Sequence[Estimated]], name: str
) -> NamedFigure | None:
    """Draw travel times as dots with their 95 % intervals.

    Args:
        title: Title of the picture.
        labels: Labels of the rows.
        series: Domain to the mean and interval of every row, s; nan for a missing value.
        name: Name of the picture.
    """
    if not any(math.isfinite(v) for rows in series.values() for row in rows for v in row):
        return None
    below = legend_height(list(series))
    row = max(_ROW, 10.0 * len(series) + 6)
    picture = new_picture(name, title, TOP + row * len(labels) + 48 + below)
    axes = add_axes(picture, 186, TOP, 16, 48 + below)
    _draw_estimates(axes, labels, series, "s")
    axes.set_xlabel("travel time, s", loc="right")
    add_legend(picture, list(series), lines=False)
    return picture


def _draw_estimates(
    axes: Axes, labels: Sequence[str], series: Mapping[str, Sequence[Estimated]], unit: str,
    letters: int = 26,
) -> None:  # fmt: skip
    """Draw a row for every label, and in each row a dot with an interval for every series.

    Labels have no more than `letters` letters; with 0 they are left out.
    """
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    for number, (group, estimates) in enumerate(series.items()):
        style: dict[str, Any] = {**curve_style(number), "linestyle": "none"}
        shift = min(0.23, 0.73 / len(series)) * (number - (len(series) - 1) / 2)
        for place, (label, (mean, *ends)) in enumerate(zip(labels, estimates, strict=True)):
            if not math.isfinite(mean):
                continue
            if all(map(math.isfinite, ends)):
                axes.plot(ends, [place + shift] * 2, color=style["color"])
            (dot,) = axes.plot(mean, place + shift, **style, markersize=8, zorder=3)
            add_tip(dot, f"{label}, {group}: {tick_text(mean)} {unit}")
    axes.set_ylim(len(labels) - 0.5, -0.5)
    texts = [printable(text) if letters else "" for text in shortened_apart(labels, letters)]
    axes.set_yticks(range(len(labels)), texts, color=LIGHT["ink"])
    axes.grid(visible=False, axis="y")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(FuncFormatter(tick_text))


@styled()
def transfer_picture(evaluation: Evaluation, metrics: Metrics, path: Path) -> None:
    """Draw ATT by policy and domain, and ATT over the iterations, as PNG.

    Args:
        evaluation: The final evaluation.
        metrics: The run's metrics, with ATT after each iteration.
        path: File to write.
    """
    labels = [f"in {domain}" for domain in evaluation.domains]
    height = max(270.0, TOP + 22 + _ROW * len(evaluation.policies) + 66)
    picture = new_picture("gap", f"{evaluation.scenario}: average travel time", height, 2 * WIDTH)
    left = add_axes(picture, 186, TOP + 22, WIDTH + 10, 66)
    _draw_policies(left, evaluation)
    right = add_axes(picture, WIDTH + 68, TOP + 22, 14, 66)
    _label(right, "iteration (0: direct transfer)", "after each iteration, one seed, s")
    for number, domain in enumerate(evaluation.domains):
        rows = [
            (step, value, math.nan, math.nan)
            for stage, step, name, value in sorted(metrics.rows)
            if stage == "iteration" and name == f"att_s/{domain}"
        ]
        if rows:
            _draw_curve(picture, right, number, rows)
        rule = evaluation.best_rule_policy(domain)
        if rule is not None and rule in evaluation.policies:
            colour, level = (
                curve_style(number)["color"],
                evaluation.estimate(rule, domain, "att_s").mean,
            )
            right.axhline(level, color=colour, linestyle=(0, (1, 2)), linewidth=1)
            # at the left, where direct transfer is far from the rule, and not where curves meet it
            right.annotate(
                printable(shortened(best_rule_note(domain), 34)), (0.12, level), (0, 3),
                color=LIGHT["soft"], xycoords=("axes fraction", "data"), textcoords="offset points",
                ha="left", fontsize=10,
            )  # fmt: skip
    add_legend(picture, labels)
    write_png(picture, path)


def travel_times(evaluation: Evaluation) -> dict[str, list[Estimated]]:
    """Return domain to the travel time of each policy, s, with its interval."""
    return {
        f"in {domain}": [_of(evaluation.estimate(p, domain, "att_s")) for p in evaluation.policies]
        for domain in evaluation.domains
    }


def _draw_policies(axes: Axes, evaluation: Evaluation) -> None:
    _draw_estimates(axes, evaluation.policies, travel_times(evaluation), "s")
    seeds = len(evaluation.seeds)
    intervals = ", 95 % intervals" if seeds > 1 else ""
    title = f"final policies, {counted(seeds, 'seed')}{intervals}, s"
    axes.set_title(title, color=LIGHT["soft"], x=-178 / _points_wide(axes))


def draw_table(rows: Sequence[Mapping[str, Any]], sim: str, folder: Path) -> None:
    """Draw a table of the paper: ``gaps.png``, and ``radar.png`` with direct transfer and UGAT.

    Args:
        rows: Rows of the table, as of `Comparison.rows` or `read_rows`.
        sim: The simulation.
        folder: Folder for the pictures.
    """
    settings = cells_of(rows)[0]
    grounded = [row_of(kind, settings) for kind in GROUNDED_NAME]
    named = (*grounded, matched_name("timed"))
    drawn = [DIRECT, *dict.fromkeys(name for name in named if name in settings)]
    comparison_radar(rows, drawn, sim, folder / "radar.png")
    gap_picture(rows, folder / "gaps.png")


def row_of(grounding: str, settings: Sequence[str]) -> str:
    """Return the name of the row of a grounding: the usual one, or else its first variant."""
    usual = GROUNDED_NAME[grounding]
    variants = (name for name in settings if name.startswith(variant_name(grounding, "")))
    return usual if usual in settings else next(variants, usual)


@styled()
def gap_picture(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the gaps of ATT and throughput with intervals over training seeds, as PNG.

    Args:
        rows: Rows of a table, as of `Comparison.rows` or `read_rows`.
        path: File to write.
    """
    settings, targets, cells = cells_of(rows)
    below = legend_height(targets, 2 * WIDTH)
    row_height = max(24.0, 11.0 * len(targets) + 6)
    height = TOP + 8 + row_height * len(settings) + 48 + below
    title = f"{rows[0]['scenario']}: real domain minus simulation"
    picture = new_picture("gaps", title, height, 2 * WIDTH)
    for place, (measure, label, unit) in enumerate(
        (
            ("att_s", "Δ of ATT, s; shorter is better", "s"),
            ("throughput", "Δ of throughput, veh; more is better", "veh"),
        )
    ):
        side = (242.0, 352.0) if place == 0 else (2 * WIDTH - 335, 16.0)
        axes = add_axes(picture, side[0], TOP + 8, side[1], 48 + below)
        series = {
            target: [_estimated(cells.get((s, target), {}), f"{measure}_gap") for s in settings]
            for target in targets
        }
        _draw_estimates(axes, settings, series, unit, letters=0 if place else 34)
        axes.axvline(0, color=LIGHT["soft"], linewidth=1)
        axes.set_xlabel(label, loc="right")
    add_legend(picture, targets, lines=False)
    write_png(picture, path)


def cells_of(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[str], Cells]:
    """Return the settings and the domains of a table, in their order, and its cells."""
    cells = {(str(row["setting"]), str(row["domain"])): row for row in rows}
    settings, domains = (list(dict.fromkeys(cell[place] for cell in cells)) for place in (0, 1))
    return settings, domains, cells


def _estimated(row: Mapping[str, Any], name: str) -> Estimated:
    """Return a number of a row with its interval; nan for what it lacks."""
    mean, low, high = (float(row.get(f"{name}{end}", math.nan)) for end in ("", "_low", "_high"))
    return mean, low, high


def _of(interval: Any) -> Estimated:
    return interval.mean, interval.low, interval.high


# --- radar charts ---------------------------------------------------------------------------------


@styled()
def radar_picture(
    title: str, lines: Mapping[str, Sequence[float]], name: str
) -> NamedFigure | None:
    """Draw the five measures on axes of their own; the rim is the best value on each.

    Args:
        title: Title of the picture.
        lines: Label to a value for each of `RADAR_AXES`. A line with a missing value is not drawn.
        name: Name of the picture.
    """
    known = {label: row for label, row in lines.items() if all(map(math.isfinite, row))}
    if not known:
        return None
    below = legend_height(list(known))
    picture = new_picture(name, title, 334 + below)
    axes = add_axes(picture, 100, 78, 100, 36 + below, projection="polar")
    _draw_radar(axes, list(known.values()))
    add_legend(picture, list(known))
    return picture


@styled()
def comparison_radar(
    rows: Sequence[Mapping[str, Any]], settings: Sequence[str], sim: str, path: Path
) -> None:
    """Draw the paper's five measures in sim and in each real domain, as PNG.

    Args:
        rows: Rows of a table, as of `Comparison.rows` or `read_rows`.
        settings: Settings to draw. The first one is drawn in the simulation, too.
        sim: The simulation.
        path: File to write.
    """
    _, targets, by_cell = cells_of(rows)
    columns = min(len(targets), 2)
    lines = math.ceil(len(targets) / columns)
    legend = [f"{settings[0]} in {sim}", *(f"{s} in the real domain" for s in settings)]
    wide, high = 440.0, 310.0
    width = max(wide * columns, 560.0)
    below = legend_height(legend, width) + 12
    title = f"{rows[0]['scenario']}: sim and real; the rim is the best"
    picture = new_picture("radar", title, TOP + high * lines + below, width)
    for place, target in enumerate(targets):
        left, top = wide * (place % columns), TOP + high * (place // columns)
        axes = add_axes(
            picture, left + 125, top + 70, width - left - wide + 125,
            below + high * (lines - 1 - place // columns) + 50, projection="polar",
        )  # fmt: skip
        cells = [by_cell.get((setting, target), {}) for setting in settings]
        drawn = [(cells[0], "_sim"), *((cell, "") for cell in cells)]
        table = [
            [float(cell.get(f"{measure}{end}", math.nan)) for measure in RADAR_AXES]
            for cell, end in drawn
        ]
        _draw_radar(axes, table)
        axes.set_title(printable(shortened(target, 48)), x=-0.6, y=1.24, fontweight="bold")
    add_legend(picture, legend)
    write_png(picture, path)


def radar_lines(evaluation: Evaluation, real: str) -> dict[str, list[float]]:
    """Return the lines of a radar: direct transfer in the simulation, then policies in `real`.

    These policies are direct transfer, grounded ones and the best rule, five at most.
    """
    sim, policies = evaluation.domains[0], evaluation.policies
    rule = evaluation.best_rule_policy(real)
    shown = [policies[0], *(p for p in policies if is_grounded(p) and p != policies[0])]
    shown += [p for p in policies if p == rule and p not in shown]

    def means(policy: str, domain: str) -> list[float]:
        return [float(evaluation.values(policy, domain, measure).mean()) for measure in RADAR_AXES]

    lines = {f"{policies[0]} in {sim}": means(policies[0], sim)}
    return lines | {f"{policy} in {real}": means(policy, real) for policy in shown[:5]}


def goodness(values: NDArray[np.float64], more_is_better: bool) -> NDArray[np.float64]:
    """Return how good each value is, in [0, 1], with 1 for the best.

    With the sizes ``s = |values|``, the result is ``s / max(s)`` if more is better, else
    ``min(s) / s``.

    Args:
        values: ``(n,)``, all of one sign; nan stays nan.
        more_is_better: True if the largest size is the best.
    """
    sizes = np.abs(values)
    best = np.nanmax(sizes) if more_is_better else np.nanmin(sizes)
    if best == 0.0:
        return np.where(np.isnan(sizes), np.nan, sizes == 0.0)
    return sizes / best if more_is_better else best / sizes


def _draw_radar(axes: Any, rows: Sequence[Sequence[float]]) -> None:
    """Draw lines on polar axes, one axis for each of `RADAR_AXES`; skip rows with a nan."""
    table = np.array(rows, dtype=float)
    if not np.isfinite(table).any(axis=0).all():  # no row has some measure
        axes.set_axis_off()
        return
    scaled = np.stack([goodness(table[:, i], m == "throughput") for i, m in enumerate(RADAR_AXES)])
    angles = np.linspace(0, 2 * np.pi, len(RADAR_AXES), endpoint=False)
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    for number, row in enumerate(scaled.T):
        if not np.isfinite(row).all():
            continue
        closed = np.r_[angles, angles[0]], np.r_[row, row[0]]
        style = curve_style(number)
        axes.fill(*closed, color=style["color"], alpha=0.07, linewidth=0)
        axes.plot(*closed, **style, markersize=5.5, clip_on=False)
    axes.set_ylim(0, 1)
    axes.set_yticks([0.25, 0.5, 0.75, 1.0], ["", "0.5", "", ""], fontsize=11)
    axes.set_rlabel_position(36)
    axes.set_xticks(angles, [])
    axes.spines["polar"].set_visible(False)
    best = [_best(table[:, i], m) for i, m in enumerate(RADAR_AXES)]
    for angle, (measure, unit), text in zip(angles, RADAR_AXES.values(), best, strict=True):
        side = round(math.sin(angle), 3)
        anchor = "center" if side == 0 else ("left" if side > 0 else "right")
        up = 10 if side == 0 else 2 if math.cos(angle) > 0 else -28
        for words, colour, y in (
            (measure, "ink", up + 14),
            (f"best: {text} {unit}".rstrip(), "soft", up),
        ):
            axes.annotate(
                words, (angle, 1.0), (9 * np.sign(side), y), textcoords="offset points",
                ha=anchor, color=LIGHT[colour], annotation_clip=False,
            )  # fmt: skip


def _best(column: NDArray[np.float64], measure: str) -> str:
    sizes = np.abs(column)
    place = np.nanargmax(sizes) if measure == "throughput" else np.nanargmin(sizes)
    return tick_text(float(f"{column[place]:.3g}"))


# --- calibration ----------------------------------------------------------------------------------


@styled()
def calibration_picture(metrics: Metrics, path: Path) -> bool:
    """Draw how well u predicts errors: risk against coverage, and u on and off the data, as PNG.

    Args:
        metrics: The metrics of a run.
        path: File to write.

    Returns:
        True if there was an iteration to draw; otherwise no file is written.
    """
    steps: dict[int, dict[str, float]] = {}
    for stage, step, name, value in metrics.rows:
        if stage == "iteration" and name.startswith("calibration/"):
            steps.setdefault(step, {})[name.removeprefix("calibration/")] = value
    if not steps:
        return False
    picture = new_picture("calibration", "Uncertainty u of the inverse models", 330, 2 * WIDTH)
    left = add_axes(picture, 58, TOP + 22, WIDTH + 10, 90)
    right = add_axes(picture, WIDTH + 58, TOP + 22, 14, 90)
    _draw_risks(left, steps)
    _draw_levels(right, steps)
    for axes in (left, right):
        axes.legend(loc="upper left", bbox_to_anchor=(-50 / _points_wide(axes), -0.24))
    write_png(picture, path)
    return True


def _draw_risks(axes: Axes, steps: Mapping[int, Mapping[str, float]]) -> None:
    from matplotlib.ticker import AutoLocator

    title = "wrong among the answers taken; dotted: a u that says nothing"
    _label(axes, "share of answers taken, lowest u first", title)
    axes.xaxis.set_major_locator(AutoLocator())
    ends: Iterable[int] = (min(steps), max(steps)) if len(steps) > 1 else steps
    for number, step in enumerate(ends):
        values = steps[step]
        risks = [v for name, v in sorted(values.items()) if name.startswith("risk_by_cov")]
        shares = [(i + 1) / len(risks) for i in range(len(risks))]
        label = f"iteration {step} (AUROC {values['auroc']:.2f}, ECE {values['ece']:.2f})"
        axes.plot(shares, risks, **curve_style(number), label=label)
        axes.axhline(risks[-1], color=curve_style(number)["color"], linestyle=":", linewidth=1)
    axes.set_ylim(0, 1.08 * axes.dataLim.ymax or 1)


def _draw_levels(axes: Axes, steps: Mapping[int, Mapping[str, float]]) -> None:
    _label(axes, "iteration", "mean u: does it rise where the simulation never was?")
    order = sorted(steps)
    for number, (name, label) in enumerate(
        (("mean_u", "on held-out data"), ("mean_u_off_data", "off the data"))
    ):
        axes.plot(order, [steps[s][name] for s in order], **curve_style(number), label=label)
    axes.set_xlim(order[0] - 0.5, order[-1] + 0.5)  # a single iteration gives no range
    axes.set_ylim(0, 1.03)
