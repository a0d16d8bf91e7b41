"""Trainings as one page of HTML that needs nothing else, and its pictures as files.

Works on whatever is there: a training under way, one that was broken off, files cut short. What is
missing is said where it would stand.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from ugat_marl.experiments import Evaluation
from ugat_marl.files import write_whole
from ugat_marl.reporting import run_sections as sections
from ugat_marl.reporting.drawing import Drawing, printable
from ugat_marl.reporting.job_names import grounding_of
from ugat_marl.reporting.page import document, folded
from ugat_marl.reporting.run_groups import Group, groups, seeds_of_one
from ugat_marl.reporting.run_maps import minutes_picture, node_map
from ugat_marl.reporting.run_pictures import (
    MEASURES,
    gate_picture,
    learning_picture,
    radar_lines,
    radar_picture,
    scores_picture,
    travel_time_picture,
)
from ugat_marl.reporting.run_places import Places, places_of
from ugat_marl.reporting.run_records import RunRecord, TableRecord, number
from ugat_marl.reporting.run_style import RUN_STYLE

Commands = Mapping[Path, Sequence[str]]
"""Folder to how to run it again."""

_ARTICLES = 12
"""With more trainings than this only those with a gate have a part of their own."""
_OPEN = 4
"""With more, those parts are folded."""
_RADARS = ("direct transfer", "UGAT", "trained in real", "best rule")
_EPISODES = "Mean of a stretch of episodes, with its 95 % interval over "


@dataclass
class RunPage:
    """A page under construction.

    Attributes:
        text: The page, once it is made.
        pictures: All pictures on it.
    """

    text: str = ""
    pictures: list[Drawing] = field(default_factory=list)

    def figure(self, drawing: Drawing | None, caption: str) -> str:
        """A picture with what it shows; nothing if there is none."""
        if drawing is None:
            return ""
        names = {other.name for other in self.pictures}
        base, again = drawing.name, 1
        while drawing.name in names:
            again += 1
            drawing.name = f"{base}-{again}"
        self.pictures.append(drawing)
        text = f"<figcaption>{escape(caption)}</figcaption>"
        return f"<figure>{drawing.svg()}{text}</figure>"


def runs_page(records: Sequence[RunRecord | TableRecord], commands: Commands) -> RunPage:
    """The page of some trainings.

    Args:
        records: What was found in their folders.
        commands: How to run them again.
    """
    page = RunPage()
    runs = [record for record in records if isinstance(record, RunRecord)]
    parts = [_head(records)]
    if len(runs) > 1:
        side = sections.overview(runs)
        short = len(runs) <= _ARTICLES
        body = side if short else folded(f"{len(runs)} trainings", side)
        parts.append(f"<section><h2>Side by side</h2>{body}</section>")
    parts += [_group(page, group) for group in groups(runs)]
    parts += [_table(page, r, commands) for r in records if isinstance(r, TableRecord)]
    parts.append(_seeds(page, runs))
    shown = [r for r in runs if len(runs) <= _ARTICLES or r.series("iteration", "gate/acceptance")]
    for record in shown:
        body = _run(page, record, commands, alone=len(records) == 1)
        parts.append(_article(record, body, alone=len(records) == 1, folds=len(shown) > _OPEN))
    if left := len(runs) - len(shown):
        text = f"{left} trainings without a gate stand in the table above only."
        parts.append(f'<p class="soft">{text}</p>')
    title = _title(records)
    page.text = document(
        title, "<main>\n" + "\n".join(filter(None, parts)) + "\n</main>", RUN_STYLE
    )
    page.text = page.text.encode("utf-8", "replace").decode()
    return page


def write_pictures(pictures: Sequence[Drawing], directory: Path) -> None:
    """Writes every picture as SVG and as PNG."""
    for drawing in pictures:
        write_whole(directory / f"{drawing.name}.svg", drawing.svg_file())
        write_whole(directory / f"{drawing.name}.png", drawing.png())


def file_name(*parts: str) -> str:
    """Texts as the name of a file, without an ending."""
    text = re.sub(r"[^A-Za-z0-9_=+.]+", "-", "-".join(filter(None, parts)))
    return text.strip("-.")[-80:].strip("-.") or "picture"


def _title(records: Sequence[RunRecord | TableRecord]) -> str:
    if len(records) == 1 and isinstance(records[0], RunRecord):
        return printable(f"Training {records[0].name}")
    return printable(records[0].name if len(records) == 1 else f"{len(records)} trainings")


def _head(records: Sequence[RunRecord | TableRecord]) -> str:
    record = records[0]
    if len(records) == 1 and isinstance(record, RunRecord):
        kind, text = sections.status(record)
        head = sections.headline(record)
        return (
            f'<header><p class="soft">Training <strong>{escape(record.name)}</strong></p>'
            f'<span class="badge {kind}">{escape(text)}</span><h1>{escape(head)}</h1>'
            f'<p class="soft">{escape(sections.progress(record))}</p></header>'
        )
    if len(records) == 1:
        return f"<header><h1>{escape(_title(records))}</h1></header>"
    runs = [record for record in records if isinstance(record, RunRecord)]
    unfinished = [record for record in runs if not record.finished]
    tables = len(records) - len(runs)
    counted = [f"{len(runs)} trainings" if runs else "", f"{tables} tables" if tables else ""]
    scenarios = list(dict.fromkeys(r.scenario for r in runs if r.scenario))
    text = " and ".join(filter(None, counted)) + (
        f" on {', '.join(scenarios)}" if scenarios else ""
    )
    note = f"{len(unfinished)} of them are not finished." if unfinished else ""
    return f'<header><h1>{escape(text)}</h1><p class="soft">{escape(note)}</p></header>'


def _group(page: RunPage, group: Group) -> str:
    left = f" Left out, since not judged in both domains: {', '.join(group.left_out)}."
    note = group.note + (left if group.left_out else "")
    return (
        f"<section><h2>Over training seeds: {escape(group.title)}</h2>"
        f'<p class="soft">{escape(note)}</p>{_settings(page, group.title, group.rows)}</section>'
    )


def _table(page: RunPage, record: TableRecord, commands: Commands) -> str:
    given = commands.get(record.directory) or ([record.command] if record.command else [])
    body = _settings(page, record.name, record.rows) if record.rows else ""
    return (
        f"<article><h2>Table {escape(record.name)}</h2>{sections.missing(record)}{body}"
        f"{sections.again(record, given)}</article>"
    )


def _settings(page: RunPage, title: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """Table and pictures of settings in several real domains."""
    labels = list(dict.fromkeys(str(row["setting"]) for row in rows))
    domains = list(dict.fromkeys(str(row["domain"]) for row in rows))
    cells = {(str(row["setting"]), str(row["domain"])): row for row in rows}

    def estimates(domain: str) -> list[tuple[float, float, float]]:
        found = (cells.get((label, domain), {}) for label in labels)
        return [
            (number(r.get("att_s")), number(r.get("att_s_low")), number(r.get("att_s_high")))
            for r in found
        ]

    drawing = scores_picture(
        title, labels, {d: estimates(d) for d in domains}, file_name(title, "travel-times")
    )
    figures = [page.figure(drawing, "Mean over training seeds with its 95 % interval.")]
    for domain in domains:
        lines = _radar_of(labels, cells, domain)
        radar = radar_picture(f"sim against {domain}", lines, file_name(title, "radar", domain))
        caption = "Every axis is scaled by its best value, at the rim; the middle is worst."
        figures.append(page.figure(radar, caption))
    return f'{sections.group_tables(rows)}<div class="maps">{"".join(figures)}</div>'


def _radar_of(
    labels: Sequence[str], cells: Mapping[tuple[str, str], Mapping[str, Any]], domain: str
) -> dict[str, list[float]]:
    shown = [label for label in labels if label.startswith(_RADARS) and (label, domain) in cells]
    lines: dict[str, list[float]] = {}
    for place, label in enumerate(shown[:5]):
        row = cells[label, domain]
        if place == 0:
            lines[f"{label} in sim"] = [number(row.get(f"{m}_sim")) for m in MEASURES]
        lines[f"{label} in {domain}"] = [number(row.get(m)) for m in MEASURES]
    return lines


def _seeds(page: RunPage, runs: Sequence[RunRecord]) -> str:
    """Curves of trainings that differ in their seed alone."""
    figures: list[str] = []
    for own in seeds_of_one(runs):
        if len(own) < 2:
            continue
        first = own[0]
        name = file_name(first.scenario, first.real, grounding_of(first.settings), "seeds")
        figures.append(
            page.figure(learning_picture(own, f"{name}-learning"), f"{_EPISODES}the seeds.")
        )
        over = "Mean over the seeds, with its 95 % interval."
        figures.append(page.figure(travel_time_picture(own, f"{name}-att"), over))
        figures.append(page.figure(gate_picture(own, f"{name}-gate"), over))
    if not any(figures):
        return ""
    return (
        "<section><h2>Curves over training seeds</h2>"
        f'<div class="maps">{"".join(figures)}</div></section>'
    )


def _run(page: RunPage, record: RunRecord, commands: Commands, *, alone: bool) -> str:
    head = (
        f"<p>{escape(sections.headline(record))}</p>"
        f'<p class="soft">{escape(sections.progress(record))}</p>'
    )
    found = places_of(record)
    places = found if isinstance(found, Places) else None
    parts = ["" if alone else head, sections.missing(record), sections.boxes(record)]
    if record.evaluation is not None and record.evaluation.policies:
        parts.append(_scores(page, record, record.evaluation))
    parts += [
        _curves(page, record),
        _gate(page, record, found, places),
        _worst(page, record, places),
    ]
    parts.append(sections.again(record, commands.get(record.directory, ())))
    return "".join(parts)


def _article(record: RunRecord, body: str, *, alone: bool, folds: bool) -> str:
    """The part of one training; of many, on request."""
    if alone:
        return f"<article>{body}</article>"
    kind, text = sections.status(record)
    badge = f'<span class="badge {kind}">{escape(text)}</span>'
    if folds:
        body = folded("Its table, curves, maps, settings", body)
    return f"<article><h2>{escape(record.name)} {badge}</h2>{body}</article>"


def _scores(page: RunPage, record: RunRecord, found: Evaluation) -> str:
    def estimates(domain: str) -> list[tuple[float, float, float]]:
        own = (found.estimate(policy, domain, "att_s") for policy in found.policies)
        return [(e.mean, e.low, e.high) for e in own]

    drawing = scores_picture(
        f"{record.name}: travel time", found.policies,
        {f"in {d}": estimates(d) for d in found.domains}, file_name(record.name, "travel-times"),
    )  # fmt: skip
    figures = [page.figure(drawing, "Mean over the episodes with its 95 % interval.")]
    for real in found.domains[1:]:
        radar = radar_picture(
            f"{found.domains[0]} against {real}", radar_lines(found, real),
            file_name(record.name, "radar", real),
        )  # fmt: skip
        caption = "Every axis is scaled by its best value, at the rim; the middle is worst."
        figures.append(page.figure(radar, caption))
    table = sections.scores_table(found)
    return f'<h3>What came out</h3>{table}<div class="maps">{"".join(figures)}</div>'


def _curves(page: RunPage, record: RunRecord) -> str:
    learning = learning_picture([record], file_name(record.name, "learning"))
    travel = travel_time_picture([record], file_name(record.name, "att"))
    figures = page.figure(learning, f"{_EPISODES}its episodes.") + page.figure(
        travel, "One episode after each iteration, on a seed that decides nothing: no interval."
    )
    return f'<h3>Learning curves</h3><div class="maps">{figures}</div>' if figures else ""


def _gate(page: RunPage, record: RunRecord, found: Places | str, places: Places | None) -> str:
    curve = gate_picture([record], file_name(record.name, "gate"))
    if curve is None:
        return ""
    figures = page.figure(
        curve, "Means over the intersections. A grounded action is taken where u is below α."
    )
    if places is not None:
        for key, what, unit in (
            ("gate/acceptance", "accepted grounded actions", "% of decisions"),
            ("gate/mean_u", "mean uncertainty u", "from 0 to 1"),
            ("gate/alpha", "threshold α", "as u; ∞ takes everything"),
        ):
            figures += _map(page, record, places, key, what, unit)
    note = places.note if places is not None else str(found)
    return (
        f'<h3>The gate</h3><div class="maps">{figures}</div>'
        + (f'<p class="soft">{escape(note)}</p>' if note else "")
        + sections.gate_table(record, places)
    )


def _map(page: RunPage, record: RunRecord, places: Places, key: str, what: str, unit: str) -> str:
    series = record.agents(key)
    last = max((rows[-1][0] for rows in series.values() if rows), default=0)
    scale = 100.0 if unit.startswith("%") else 1.0
    values: dict[str, tuple[float, str]] = {}
    for agent, tls in places.intersection_of.items():
        value = dict(series.get(agent, [])).get(last, math.nan) * scale
        text = "∞" if math.isinf(value) else f"{value:.0f}" if scale > 1 else f"{value:.2f}"
        values[tls] = (value, "" if math.isnan(value) else text)
    if len(values) < 2 or not any(text for _, text in values.values()):
        return ""  # a single intersection needs no map
    title = f"{what}, iteration {last}"
    name = file_name(record.name, "map", key.rpartition("/")[2])
    drawing = node_map(name, title, places.network, values, (0.0, scale), unit)
    return page.figure(drawing, f"{what[0].upper()}{what[1:]} at each intersection ({unit}).")


def _worst(page: RunPage, record: RunRecord, places: Places | None) -> str:
    """Where and when vehicles stood, in the real domain."""
    if record.queues is None or record.evaluation is None:
        return ""
    domain = record.evaluation.domains[-1]
    policies = [p for p in record.evaluation.policies if p.startswith("UGAT")]
    policies = [*policies, *(p for p in record.evaluation.policies[:1] if p not in policies)]
    queues: dict[str, dict[str, list[float]]] = {}
    rows = record.queues.sort("minute").rows()
    for policy, where, _, tls, queue, _ in rows:
        if where == domain and policy in policies:
            queues.setdefault(policy, {}).setdefault(tls, []).append(queue)
    queues = {policy: queues[policy] for policy in policies if policy in queues}
    if not queues:
        return ""
    most = max(max(row) for own in queues.values() for row in own.values())
    figures = ""
    for policy, own in queues.items():
        drawing = minutes_picture(
            file_name(record.name, "minutes", policy), f"{policy} in {domain}", own, most
        )
        figures += page.figure(drawing, "Longest queues first; the same colours for all policies.")
    if places is not None:
        first, own = next(iter(queues.items()))
        means = {tls: sum(row) / len(row) for tls, row in own.items()}
        values = {tls: (mean, f"{mean:.1f}") for tls, mean in means.items()}
        title = f"mean queue, {first} in {domain}"
        name = file_name(record.name, "map-queue")
        unit = "vehicles standing"
        if len(values.keys() & set(places.intersection_of.values())) > 1:
            ends = (0.0, max(means.values()) or 1.0)
            drawing = node_map(name, title, places.network, values, ends, unit)
            figures += page.figure(drawing, "Halting vehicles before each intersection.")
    table = sections.worst_table(queues, domain)
    return f'<h3>The worst intersections and minutes</h3>{table}<div class="maps">{figures}</div>'
