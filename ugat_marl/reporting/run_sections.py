"""Tables and texts of the page of trainings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from typing import Any

from ugat_marl.data import MEASURES
from ugat_marl.envs import HIDDEN
from ugat_marl.experiments import Estimate, Evaluation
from ugat_marl.reporting import diagnosis_words as words
from ugat_marl.reporting.diagnosis_sections import pairs
from ugat_marl.reporting.job_names import grounding_of, job_name
from ugat_marl.reporting.page import folded, grid
from ugat_marl.reporting.run_places import Places
from ugat_marl.reporting.run_records import RunRecord, TableRecord, number

Queues = Mapping[str, Sequence[float]]
"""Intersection to its mean queue in each minute."""

_WORST = 10


def status(record: RunRecord) -> tuple[str, str]:
    """How far a training is: the class of its badge, and what stands on it."""
    if record.finished:
        return ("partially_explained", "incomplete") if record.missing else ("explained", "whole")
    if record.metrics is not None or record.state is not None or record.settings:
        return "partially_explained", "not finished"
    return "unknown", "unreadable"


def progress(record: RunRecord) -> str:
    """Where an unfinished training stands; "" for a finished one."""
    if record.finished:
        return ""
    state, parts = record.state or {}, list[str]()
    for key, whole, what in (
        ("pretrained", "pretrain_episodes", "episodes of plain training"),
        ("iteration", "iterations", "iterations"),
    ):
        if key in state and whole in record.ugat:
            parts.append(f"{state[key]} of {record.ugat[whole]} {what}")
    if not parts and (episodes := record.series("episode", "return")):
        parts.append(f"{episodes[-1][0] + 1} training episodes")
    text = f"So far: {', '.join(parts)}. " if parts else ""
    if math.isfinite(record.written):
        last = datetime.fromtimestamp(record.written, UTC)
        text += f"Last written {last:%Y-%m-%d %H:%M} UTC."
    return text


def headline(record: RunRecord) -> str:
    """One sentence: what came out."""
    found = record.evaluation
    title = f"{record.scenario or record.name}: {record.sim}"
    title += f" → {record.real}" if record.real else ""
    if found is None or not found.policies:
        return f"{title}, no result yet"
    if record.job:
        return f"{title}, {job_name(record.settings)}"
    last = found.domains[-1]
    parts = [
        f"{policy} {words.number(found.estimate(policy, last, 'att_s').mean)} s"
        for policy in _shown(found)
    ]
    return f"{title}. Travel time in {last}: {', '.join(parts)}."


def missing(record: RunRecord | TableRecord) -> str:
    """What a folder lacks."""
    if not record.missing:
        return ""
    items = "".join(f"<li>{escape(text)}</li>" for text in record.missing)
    return f'<div class="partial">Missing here:<ul class="plain">{items}</ul></div>'


def overview(records: Sequence[RunRecord]) -> str:
    """All trainings side by side."""
    rows = [_overview_row(record) for record in records]
    headings = (
        "training", "scenario", "domains", "policy", "seed", "state", "in sim, s",
        "direct transfer, s", "in real, s", "best rule, s", "accepted",
    )  # fmt: skip
    numbers = headings[6:]
    legend = (
        '<p class="soft">Average travel times over all vehicles due, with 95 % intervals '
        "(Student's) over the episodes; direct transfer and the rule in the real domain. Accepted: "
        "share of decisions in which the grounded action was taken, last iteration.</p>"
    )
    return f"{legend}{grid(headings, rows, numbers)}"


def _overview_row(record: RunRecord) -> list[str]:
    found = record.evaluation
    accepted = record.series("iteration", "gate/acceptance")
    cells = dict.fromkeys(("sim", "direct", "real", "rule"), "–")
    policy = job_name(record.settings) if record.job else grounding_of(record.settings)
    if found is not None and found.policies:
        shown = _shown(found)
        main = next((name for name in shown if name.startswith("UGAT")), shown[0])
        policy = main
        sim, real = found.domains[0], found.domains[-1]
        cells["sim"] = with_interval(found.estimate(main, sim, "att_s"))
        if real != sim:
            cells["real"] = with_interval(found.estimate(main, real, "att_s"))
        if not record.job:
            cells["direct"] = with_interval(found.estimate(found.policies[0], real, "att_s"))
        if (rule := f"rule {found.notes.get(f'best rule in {real}')}") in found.policies:
            cells["rule"] = with_interval(found.estimate(rule, real, "att_s"))
    return [
        record.name, record.scenario or "–", f"{record.sim} → {record.real or '–'}",
        policy or "–", record.seed or "–", status(record)[1], *cells.values(),
        words.share(accepted[-1][1]) if accepted else "–",
    ]  # fmt: skip


def boxes(record: RunRecord) -> str:
    """The numbers one asks for first."""
    found = record.evaluation
    if found is None or record.job or len(found.domains) < 2 or not found.policies:
        return ""
    real, direct = found.domains[1], found.policies[0]
    items: list[tuple[str, str]] = []
    for name in _shown(found):
        text = words.number(found.estimate(name, real, "att_s").mean)
        items.append((f"{text} s", f"{name} in {real}"))
    ugat = next((name for name in found.policies if name.startswith("UGAT")), None)
    if ugat is not None:
        start, now = (found.gap(p, real, "att_s").mean for p in (direct, ugat))
        if start > 0 and math.isfinite(now):
            items.append((words.share(1 - now / start), "of the gap Δ is gone with UGAT"))
        items.append((f"{words.number(found.regret(ugat, real).mean)} s", "regret of UGAT"))
    cells = "".join(f"<div><b>{escape(a)}</b><span>{escape(b)}</span></div>" for a, b in items)
    return f'<div class="big">{cells}</div>'


def _shown(found: Evaluation) -> list[str]:
    """Direct transfer, UGAT and the best rule, of what there is."""
    rules = [f"rule {found.notes.get(f'best rule in {domain}')}" for domain in found.domains[-1:]]
    return [
        name
        for place, name in enumerate(found.policies)
        if place == 0 or name.startswith("UGAT") or name in rules
    ]


def scores_table(found: Evaluation) -> str:
    """Travel times with gap and regret; all measures on request."""
    first, *others = found.domains
    headings = ["policy", f"in {first}, s"]
    for domain in others:
        headings += [f"in {domain}, s", f"Δ {domain}, s", f"regret {domain}, s"]
    rows: list[list[str]] = []
    for policy in found.policies:
        cells = [policy, with_interval(found.estimate(policy, first, "att_s"))]
        for domain in others:
            cells += [
                with_interval(found.estimate(policy, domain, "att_s")),
                words.signed(found.gap(policy, domain, "att_s").mean),
                words.number(found.regret(policy, domain).mean),
            ]
        rows.append(cells)
    seeds = len({result.seed for result in found.results})
    legend = (
        '<p class="soft">Average travel time over all vehicles due, mean of '
        f"{seeds} episodes (Student's 95 % interval over them). Δ: minus {escape(first)}. Regret: "
        "above the best of these policies in that domain.</p>"
    )
    return f"{legend}{grid(headings, rows, headings[1:])}{_measures(found)}"


def _measures(found: Evaluation) -> str:
    hidden = list(dict.fromkeys(name for r in found.results for name in r.scores.hidden))
    headings = ["policy", "domain", *MEASURES.values(), "never entered [veh]"]
    headings += [HIDDEN.get(name, name) for name in hidden]
    rows = [
        [
            policy,
            domain,
            *(_with_half(found.estimate(policy, domain, measure)) for measure in MEASURES),
            words.number(found.estimate(policy, domain, "backlog").mean),
            *(words.number(found.estimate(policy, domain, name).mean) for name in hidden),
        ]
        for policy in found.policies
        for domain in found.domains
    ]
    legend = '<p class="soft">±: half of the 95 % interval over the episodes.</p>'
    return folded("All measures", legend + grid(headings, rows, headings[2:]))


def group_tables(rows: Sequence[Mapping[str, Any]]) -> str:
    """Travel times of settings in every real domain, and what of it is gap."""
    settings = list(dict.fromkeys(str(row["setting"]) for row in rows))
    domains = list(dict.fromkeys(str(row["domain"]) for row in rows))
    cells = {(str(row["setting"]), str(row["domain"])): row for row in rows}

    def table(key: str, sign: bool = False) -> str:
        lines = [
            [s, *(_cell(cells.get((s, d), {}), key, sign=sign) for d in domains)] for s in settings
        ]
        return grid(["policy", *(f"{d}, s" for d in domains)], lines, [f"{d}, s" for d in domains])

    return (
        f"<h3>Travel time in the real domain</h3>{table('att_s')}"
        f"<h3>The gap Δ: real minus simulation</h3>{table('att_s_gap', sign=True)}"
        + folded("Travel time in the simulation", table("att_s_sim"))
    )


def _cell(row: Mapping[str, Any], key: str, *, sign: bool) -> str:
    mean, low, high = (number(row.get(name)) for name in (key, f"{key}_low", f"{key}_high"))
    if not math.isfinite(mean):
        return "–"
    text = words.signed(mean) if sign else words.number(mean)
    return f"{text} {_ends(low, high)}" if low < high else text


def gate_table(record: RunRecord, places: Places | None) -> str:
    """The gate by intersection, in the last iteration."""
    columns = {
        "gate/acceptance": "accepted", "gate/mean_u": "mean u", "gate/alpha": "α",
        "gate/change_rate": "changed", "gate/trusted": "f and h are proven",
        "lost_time/best_s": "lost time, s",
    }  # fmt: skip
    last = {
        key: {agent: rows[-1][1] for agent, rows in record.agents(key).items()} for key in columns
    }
    agents = list(last["gate/acceptance"])
    shown = {key: text for key, text in columns.items() if last[key]}
    rows: list[list[str]] = []
    for agent in agents:
        tls = places.intersection_of.get(agent) if places is not None else None
        cells = [_of_gate(key, last[key].get(agent, math.nan)) for key in shown]
        rows.append([agent, tls or "–", *cells])
    headings = ["agent", "traffic light", *shown.values()]
    return folded("The gate, intersection by intersection", grid(headings, rows, headings[2:]))


def _of_gate(key: str, value: float) -> str:
    if key == "gate/trusted":
        return "yes" if value else "no"
    if math.isinf(value):
        return "∞"
    share = key in ("gate/acceptance", "gate/change_rate")
    return words.share(value) if share and math.isfinite(value) else words.number(value)


def worst_table(queues: Mapping[str, Queues], domain: str) -> str:
    """The intersections with the longest queues, and when they were longest.

    Args:
        queues: Policy to its queues; the first decides the order.
        domain: Where they were measured.
    """
    policies = list(queues)
    means = {p: {tls: sum(q) / len(q) for tls, q in queues[p].items() if q} for p in policies}
    order = sorted(means[policies[0]], key=lambda tls: -means[policies[0]][tls])[:_WORST]
    headings, numbers = ["intersection"], list[str]()
    for policy in policies:
        numbers += [f"{policy}: queue, veh", f"{policy}: longest, veh"]
        headings += [*numbers[-2:], f"{policy}: when"]
    rows: list[list[str]] = []
    for tls in order:
        cells = [tls]
        for policy in policies:
            row = queues[policy].get(tls, ())
            if not row:
                cells += ["–", "–", "–"]
                continue
            worst = max(range(len(row)), key=lambda k: row[k])
            mean, longest = words.number(means[policy][tls]), words.number(row[worst])
            cells += [mean, longest, f"minute {worst}"]
        rows.append(cells)
    return (
        f'<p class="soft">Halting vehicles on the lanes that lead to an intersection, in '
        f"{escape(domain)}, means over the episodes of the evaluation.</p>"
        + grid(headings, rows, numbers)
    )


def again(record: RunRecord | TableRecord, commands: Sequence[str]) -> str:
    """How to run it again, and with what it was made."""
    text = escape("\n".join(commands))
    parts = [f"<h3>Run it again</h3><pre><code>{text}</code></pre>" if commands else ""]
    if isinstance(record, TableRecord):
        return "".join(parts)
    items = [
        ("folder", str(record.directory)),
        *((f"version of {name}", version) for name, version in record.versions.items()),
        *((f"hash of {name}", text) for name, text in record.hashes.items()),
    ]
    notes = dict(record.evaluation.notes) if record.evaluation is not None else {}
    settings = [(key, value) for key, value in _flat(record.settings)]
    parts.append(pairs([*items, *notes.items()]))
    if settings:
        parts.append(folded(f"All {len(settings)} settings on record", pairs(settings)))
    return "".join(parts)


def _flat(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = []
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            found += _flat(value, f"{prefix}{key}.")
        else:
            shown = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            found.append((f"{prefix}{key}", shown))
    return found


def with_interval(found: Estimate) -> str:
    """A mean with its interval, if it has one."""
    if not math.isfinite(found.low) or found.low == found.high:
        return words.number(found.mean)
    return f"{words.number(found.mean)} {_ends(found.low, found.high)}"


def _with_half(found: Estimate) -> str:
    """A mean with half of its interval, if it has one, where there is little room."""
    if not math.isfinite(found.low) or found.low == found.high:
        return words.number(found.mean)
    return f"{words.number(found.mean)} ±{words.number((found.high - found.low) / 2, 2)}"


def _ends(low: float, high: float) -> str:
    """An interval that stays on one line."""
    return f"({words.number(low)}\u00a0to\u00a0{words.number(high)})"
