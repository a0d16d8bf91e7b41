"""Pictures of trainings: learning curves, travel times, the gate, sim against real domain."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ugat_marl.experiments import Evaluation, Interval
from ugat_marl.reporting.comparison_pictures import goodness
from ugat_marl.reporting.drawing import Drawing, Point, shortened
from ugat_marl.reporting.job_names import grounding_of
from ugat_marl.reporting.palette import CURVES, DASHES, MARKERS
from ugat_marl.reporting.plot import (
    LEGEND,
    TITLE,
    WIDTH,
    Plot,
    draw_legend,
    legend_rows,
    span,
    tick_text,
    ticks,
)
from ugat_marl.reporting.run_records import RunRecord

MEASURES: dict[str, tuple[str, str]] = {
    "att_s": ("travel time", "s"),
    "throughput": ("throughput", "veh"),
    "reward": ("reward", "per step"),
    "queue": ("queue", "veh"),
    "delay": ("delay, 1 − v/vmax", ""),
}
"""The paper's five measures on a radar, with their units."""
_BINS = 20
_LEAST = 4
_ROW = 30.0

Row = tuple[float, float, float, float]
"""x, mean, low, high."""

Estimated = tuple[float, float, float]
"""Mean, low, high."""


def learning_picture(records: Sequence[RunRecord], name: str) -> Drawing | None:
    """Return per training episode, with 95 % intervals.

    Args:
        records: Trainings that differ in their seed alone; one of them has intervals over the
            episodes of a stretch, several have intervals over the seeds.
        name: Of the picture.
    """
    series = [record.series("episode", "return") for record in records]
    rows = binned([one for one in series if one])
    if not rows:
        return None
    ends = span([end for row in rows for end in row[1:]], 0.06)
    first = min(one[0][0] for one in series if one)
    last = max(one[-1][0] for one in series if one) + 1
    plot = Plot(
        name, f"Learning: {_several(records)}", (first, last), ends,
        "training episode", "return (sum of the reward, mean over agents)", whole=True,
    )  # fmt: skip
    plain = records[0].ugat.get("pretrain_episodes")
    if isinstance(plain, int) and first < plain < max(row[0] for row in rows):
        line = [plot.at(plain, ends[0]), plot.at(plain, ends[1])]
        plot.drawing.line(line, "soft", 1, (4, 3))
        plot.drawing.text((line[1][0] + 4, line[1][1] + 12), "grounded from here", 12, "soft")
    plot.band(0, [(x, low, high) for x, _, low, high in rows])
    plot.curve(0, [(x, mean) for x, mean, _, _ in rows], markers=len(rows) < 3)
    return plot.drawing


def travel_time_picture(records: Sequence[RunRecord], name: str) -> Drawing | None:
    """ATT after each iteration in every domain; with several seeds, 95 % intervals over them."""
    domains: dict[str, list[Row]] = {}
    for domain in _domains(records):
        found = [record.series("iteration", f"att_s/{domain}") for record in records]
        if rows := joined([one for one in found if one]):
            domains[domain] = rows
    if not domains:
        return None
    everything = [value for rows in domains.values() for row in rows for value in row[1:]]
    steps = [row[0] for rows in domains.values() for row in rows]
    plot = Plot(
        name, f"Travel time: {_several(records)}", (0, max(steps)),
        span(everything, 0.06), "iteration (0: direct transfer)", "average travel time, s",
        whole=True, legend=[f"in {domain}" for domain in domains],
    )  # fmt: skip
    for number, rows in enumerate(domains.values()):
        plot.band(number, [(x, low, high) for x, _, low, high in rows])
        plot.curve(number, [(x, mean) for x, mean, _, _ in rows])
    return plot.drawing


def gate_picture(records: Sequence[RunRecord], name: str) -> Drawing | None:
    """Acceptance, α and u over the iterations, means over the intersections."""
    names = {
        "gate/acceptance": "acceptance (share of decisions)",
        "gate/mean_u": "mean u",
        "gate/alpha": "threshold α (none: ∞)",
    }
    curves = {
        key: joined([one for record in records if (one := record.series("iteration", key))])
        for key in names
    }
    if not curves["gate/acceptance"]:
        return None
    steps = [row[0] for rows in curves.values() for row in rows]
    plot = Plot(
        name, f"The gate: {_several(records)}", (min(steps), max(steps)), (0.0, 1.0), "iteration",
        "share, or uncertainty", whole=True, legend=list(names.values()),
    )  # fmt: skip
    for number, rows in enumerate(curves.values()):
        plot.band(number, [(x, low, high) for x, _, low, high in rows])
        plot.curve(number, [(x, mean) for x, mean, _, _ in rows])
    return plot.drawing


def scores_picture(
    title: str, labels: Sequence[str], series: Mapping[str, Sequence[Estimated]], name: str
) -> Drawing | None:
    """Travel times as dots with their 95 % intervals.

    Args:
        title: What they are of.
        labels: Of the rows.
        series: Domain to the mean and interval of every row; nan where there is none.
        name: Of the picture.
    """
    everything = [value for rows in series.values() for row in rows for value in row]
    if not any(map(math.isfinite, everything)):
        return None
    rows = legend_rows(list(series))
    bottom = 40 + _ROW * len(labels)
    drawing = Drawing(name, title, WIDTH, bottom + 46 + LEGEND * len(rows))
    drawing.text((8, 20), shortened(title, TITLE), 14, bold=True)
    low, high = span(everything)
    margin = max(0.05 * (high - low), 1.0)
    left, right = 186.0, WIDTH - 16

    def x(value: float) -> float:
        return left + (right - left) * (value - low + margin) / (high - low + 2 * margin)

    for value in ticks(low - margin, high + margin, most=5):
        drawing.line([(x(value), 34), (x(value), bottom)], "line", 1)
        drawing.text((x(value), bottom + 16), tick_text(value), 12, "soft", "middle")
    drawing.text((left - 12, bottom + 16), "travel time, s", 12, "soft", "end")
    for place, label in enumerate(labels):
        y = 40 + _ROW * (place + 0.5)
        drawing.text((left - 12, y + 4), shortened(label, 26), 12, anchor="end")
        for number, (domain, estimates) in enumerate(series.items()):
            mean, *ends = estimates[place]
            if not math.isfinite(mean):
                continue
            height = y + min(7.0, 22.0 / len(series)) * (number - (len(series) - 1) / 2)
            colour = CURVES[number % len(CURVES)]
            if all(map(math.isfinite, ends)):
                drawing.line([(x(end), height) for end in ends], colour, 2)
            text = f"{label}, {domain}: {tick_text(mean)} s"
            drawing.dot((x(mean), height), 4.5, colour, MARKERS[number % len(MARKERS)], title=text)
    draw_legend(drawing, rows, bottom + 30)
    return drawing


def radar_picture(title: str, lines: Mapping[str, Sequence[float]], name: str) -> Drawing | None:
    """The five measures on axes of their own; the rim is the best value on each.

    Args:
        title: What is compared.
        lines: Label to a value for each of `MEASURES`; one without all of them is left out.
        name: Of the picture.
    """
    known = {label: row for label, row in lines.items() if all(map(math.isfinite, row))}
    if not known:
        return None
    table = np.array(list(known.values()))
    scaled = np.stack(
        [goodness(table[:, i], m == "throughput") for i, m in enumerate(MEASURES)], axis=1
    )
    rows = legend_rows(list(known))
    drawing = Drawing(name, title, WIDTH, 322 + LEGEND * len(rows))
    drawing.text((8, 20), shortened(title, TITLE), 14, bold=True)
    for share in (0.25, 0.5, 0.75, 1.0):
        drawing.line(_ring([share] * len(MEASURES)), "line", 1)
        if share in (0.5, 1.0):
            drawing.text((WIDTH / 2 + 3, _at(0, share)[1] + 12), f"{share:g}", 11, "soft")
    for place, (measure, (what, unit)) in enumerate(MEASURES.items()):
        drawing.line([_at(0, 0.0), _at(place, 1.0)], "line", 1)
        column = np.abs(table[:, place])
        best = table[(column.argmax() if measure == "throughput" else column.argmin()), place]
        _axis_label(drawing, place, what, f"{tick_text(float(f'{best:.3g}'))} {unit}".rstrip())
    for number, row in enumerate(scaled.tolist()):
        colour = CURVES[number % len(CURVES)]
        drawing.area(_ring(row), colour, 0.07)
        drawing.line(_ring(row), colour, 2, DASHES[number % len(DASHES)])
        for place, value in enumerate(row):
            drawing.dot(_at(place, value), 3.5, colour, MARKERS[number % len(MARKERS)])
    draw_legend(drawing, rows, 318)
    return drawing


def radar_lines(found: Evaluation, real: str) -> dict[str, list[float]]:
    """Direct transfer in the simulation, then what a reader compares with it in `real`."""
    sim, policies = found.domains[0], found.policies
    rule = f"rule {found.notes.get(f'best rule in {real}')}"
    shown = [policies[0], *(p for p in policies if p.startswith("UGAT") and p != policies[0])]
    shown += [p for p in policies if p == rule and p not in shown]
    lines = {f"{policies[0]} in {sim}": _means(found, policies[0], sim)}
    return lines | {f"{policy} in {real}": _means(found, policy, real) for policy in shown[:5]}


def binned(series: Sequence[Sequence[tuple[int, float]]]) -> list[Row]:
    """Stretches of episodes: middle, mean, and Student's 95 % interval.

    Of one series the interval is over the episodes of a stretch, of several over the series.
    """
    if not series:
        return []
    last = max(one[-1][0] for one in series) + 1
    size = max(_LEAST, math.ceil(last / _BINS))
    rows: list[Row] = []
    for start in range(0, last, size):
        parts = [[v for x, v in one if start <= x < start + size] for one in series]
        parts = [part for part in parts if part]
        values = parts[0] if len(series) == 1 and parts else [float(np.mean(p)) for p in parts]
        if values and (len(values) > 1 or len(series) > 1 or last < 2 * size):
            rows.append((start + min(size, last - start) / 2, *_interval(values)))
    return rows


def joined(series: Sequence[Sequence[tuple[int, float]]]) -> list[Row]:
    """Mean and Student's 95 % interval over the series at each step (nan for a single one)."""
    steps: dict[int, list[float]] = {}
    for one in series:
        for step, value in one:
            steps.setdefault(step, []).append(value)
    return [(step, *_interval(values)) for step, values in sorted(steps.items())]


def _interval(values: Sequence[float]) -> tuple[float, float, float]:
    finite = np.array([value for value in values if math.isfinite(value)])
    if not finite.size or finite.size < len(values):
        return math.nan, math.nan, math.nan
    found = Interval.of(finite)
    return found.mean, found.low, found.high


def _several(records: Sequence[RunRecord]) -> str:
    if len(records) == 1:
        return shortened(records[0].name, 34)
    first = records[0]
    name = first.scenario + (f" → {first.real}" if first.real else "")
    kind = grounding_of(first.settings)
    return f"{shortened(name, 26)}{f', {kind}' if kind else ''}, {len(records)} seeds"


def _domains(records: Sequence[RunRecord]) -> list[str]:
    names = [
        name.removeprefix("att_s/")
        for record in records
        for stage, _, name, _ in (record.metrics.rows if record.metrics is not None else [])
        if stage == "iteration" and name.startswith("att_s/")
    ]
    return list(dict.fromkeys(names))


def _means(found: Evaluation, policy: str, domain: str) -> list[float]:
    return [float(found.values(policy, domain, measure).mean()) for measure in MEASURES]


def _at(place: int, share: float) -> Point:
    angle = 2 * math.pi * place / len(MEASURES) - math.pi / 2
    return WIDTH / 2 + 112 * share * math.cos(angle), 178 + 112 * share * math.sin(angle)


def _ring(shares: Sequence[float]) -> list[Point]:
    points = [_at(place, share) for place, share in enumerate(shares)]
    return [*points, points[0]]


def _axis_label(drawing: Drawing, place: int, what: str, best: str) -> None:
    x, y = _at(place, 1.0)
    side = x - WIDTH / 2
    anchor = "middle" if abs(side) < 5 else ("start" if side > 0 else "end")
    x += 9 * np.sign(round(side))
    y += -20 if place == 0 else (14 if y > 200 else -4)
    drawing.text((float(x), y), what, 12, anchor=anchor)
    drawing.text((float(x), y + 14), f"best: {best}", 12, "soft", anchor)
