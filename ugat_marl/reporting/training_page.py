"""Trainings as one page of HTML that needs no other file, and its pictures as files.

Trainings may be unfinished and files may be damaged. The page shows all that can be read, and names
each missing part in its place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ugat_marl.data import MEASURES
from ugat_marl.envs import OBJECTIVE_MEASURES
from ugat_marl.errors import counted
from ugat_marl.experiments import (
    DIRECT,
    GROUNDED_NAME,
    ORACLE,
    RULE,
    Estimate,
    Evaluation,
    check_run,
    is_grounded,
    outcome_of,
)
from ugat_marl.reporting import charts
from ugat_marl.reporting.figures import NamedFigure, picture_name, printable
from ugat_marl.reporting.formats import flat_settings, number, share, signed
from ugat_marl.reporting.intersection_findings import findings_maps, findings_table
from ugat_marl.reporting.light_names import LightNames
from ugat_marl.reporting.network_maps import minutes_picture, node_map
from ugat_marl.reporting.page import Figure, Grid, Page, render
from ugat_marl.reporting.places import AgentPlaces, places_of
from ugat_marl.reporting.run_groups import groups, seeds_of_one
from ugat_marl.reporting.run_records import RunRecord, TableRecord, as_number
from ugat_marl.reporting.service_tables import LEGEND, service_grid
from ugat_marl.reporting.street_found import found_on_street

Commands = Mapping[Path, Sequence[str]]
"""Folder of a training to the commands that repeat the training."""
Queues = Mapping[str, Sequence[float]]
"""Intersection to its mean queue in each minute."""

_ARTICLES = 12
"""Largest number of trainings of which each has a section. Of more, those do that have a gate, are
not finished, or miss a file."""
_OPEN = 4
"""Largest number of sections that are shown unfolded."""
_WORST = 10
"""Number of intersections in the table of the longest queues."""
_RADAR = "Every axis is scaled by its best value, at the rim; the middle is worst."
_STRETCH = "Mean of a stretch of episodes, with its 95 % interval over "


def runs_page(records: Sequence[RunRecord | TableRecord], commands: Commands) -> Page:
    """Return the page of some trainings.

    Args:
        records: Records of the trainings and tables.
        commands: Folder to the commands that repeat its training.
    """
    page = Page()
    runs = [record for record in records if isinstance(record, RunRecord)]
    tables = [record for record in records if isinstance(record, TableRecord)]
    alone = len(records) == 1
    few = len(runs) <= _ARTICLES
    shown = [
        run
        for run in runs
        if few or run.missing or not run.finished or run.series("iteration", "gate/acceptance")
    ]
    heading, note = _heading(runs, tables)
    heading = _title(records[0]) if alone else heading
    page.text = render(
        "training.html.j2",
        title=heading,
        heading=heading,
        note="" if alone else note,
        single=alone,
        overview=_overview(runs) if len(runs) > 1 else None,
        overview_folded=not few,
        groups=[
            {
                "title": group.title,
                "note": group.note + _left_out(group.left_out),
                "settings": _settings(page, group.title, group.rows),
            }
            for group in groups(runs)
        ],
        tables=[_table(page, record, commands) for record in tables],
        seeds=_seeds(page, runs),
        trainings=[_training(page, record, commands) for record in shown],
        trainings_folded=not alone and len(shown) > _OPEN,
        left_out=len(runs) - len(shown),
    )
    return page


def write_pictures(pictures: Sequence[NamedFigure], directory: Path) -> None:
    """Write every picture as SVG and as PNG."""
    for picture in pictures:
        picture.write(directory)


# --- the head -------------------------------------------------------------------------------------


def _title(record: RunRecord | TableRecord) -> str:
    kind = "Training " * isinstance(record, RunRecord)
    return printable(f"{kind}{record.name}")


def _heading(runs: Sequence[RunRecord], tables: Sequence[TableRecord]) -> tuple[str, str]:
    """Return heading and note of a page of several trainings."""
    parts = [
        counted(len(runs), "training") * bool(runs),
        counted(len(tables), "table") * bool(tables),
    ]
    scenarios = list(dict.fromkeys(r.scenario for r in runs if r.scenario))
    text = " and ".join(filter(None, parts))
    text += f" on {', '.join(scenarios)}" if scenarios else ""
    unfinished = sum(not record.finished for record in runs)
    return text, f"{unfinished} of them are not finished." if unfinished else ""


def _left_out(reasons: Mapping[str, str]) -> str:
    named: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        named.setdefault(reason, []).append(name)
    texts = [f"{', '.join(names)} ({reason})" for reason, names in named.items()]
    return f" Left out: {'; '.join(texts)}." if texts else ""


def _status(record: RunRecord) -> tuple[str, str]:
    """Return the CSS class of a training's badge, and the text on it."""
    if record.finished:
        return ("mixed", "incomplete") if record.missing else ("good", "whole")
    if record.metrics is not None or record.state is not None or record.settings:
        return "mixed", "not finished"
    return "bad", "unreadable"


def _progress(record: RunRecord) -> str:
    """Return the progress of an unfinished training; "" for a finished one."""
    if record.finished:
        return ""
    state, parts = record.state or {}, list[str]()
    for key, whole, unit in (
        ("pretrained", "pretrain_episodes", "episodes of plain training"),
        ("iteration", "iterations", "iterations"),
    ):
        if key in state and whole in record.ugat:
            parts.append(f"{state[key]} of {record.ugat[whole]} {unit}")
    if not parts and (episodes := record.series("episode", "return")):
        parts.append(f"{episodes[-1][0] + 1} training episodes")
    text = f"So far: {', '.join(parts)}. " if parts else ""
    if math.isfinite(record.written):
        last = datetime.fromtimestamp(record.written, UTC)
        text += f"Last written {last:%Y-%m-%d %H:%M} UTC."
    return text


def _headline(record: RunRecord) -> str:
    """Return the outcome of a training in one sentence."""
    evaluation = record.evaluation
    title = f"{record.scenario or record.name}: {record.sim}"
    title += f" → {record.real}" if record.real not in ("", record.sim) else ""
    if evaluation is None or not evaluation.policies:
        return f"{title}, no result yet"
    if record.job:
        return f"{title}, {record.setting}"
    last = evaluation.domains[-1]
    parts = [
        f"{policy} {number(evaluation.estimate(policy, last, 'att_s').mean)} s"
        for policy in _main_policies(evaluation)
    ]
    return f"{title}. Travel time in {last}: {', '.join(parts)}."


# --- several trainings ----------------------------------------------------------------------------


def _overview(records: Sequence[RunRecord]) -> Grid:
    """Return a table with a row per training."""
    headings = (
        "training", "scenario", "domains", "policy", "seed", "state", "in sim, s",
        "direct transfer, s", "in real, s", "best rule, s", "accepted",
    )  # fmt: skip
    return Grid(headings, [_overview_row(record) for record in records], headings[6:])


def _overview_row(record: RunRecord) -> list[str]:
    evaluation = record.evaluation
    accepted = record.series("iteration", "gate/acceptance")
    cells = dict.fromkeys(("sim", "direct", "real", "rule"), "–")
    policy = record.setting if record.job else record.grounding
    reals = [record.real] if record.real else []
    if evaluation is not None and evaluation.policies:
        shown = _main_policies(evaluation)
        policy = next(filter(is_grounded, shown), shown[0])
        sim, *reals = evaluation.domains
        cells["sim"] = _with_interval(evaluation.estimate(policy, sim, "att_s"))
        cells["real"] = _in_each(evaluation, dict.fromkeys(reals, policy))
        if not record.job:
            direct = dict.fromkeys(reals, evaluation.policies[0])
            cells["direct"] = _in_each(evaluation, direct)
        judged = {
            real: rule
            for real in reals
            if (rule := evaluation.best_rule_policy(real)) and rule in evaluation.policies
        }
        cells["rule"] = _in_each(evaluation, judged, named=len(reals) > 1)
    return [
        record.name, record.scenario or "–", f"{record.sim} → {', '.join(reals) or '–'}",
        policy or "–", record.seed or "–", _status(record)[1], *cells.values(),
        share(accepted[-1][1]) if accepted else "–",
    ]  # fmt: skip


def _in_each(evaluation: Evaluation, policies: Mapping[str, str], *, named: bool = False) -> str:
    """Return the travel time of a policy for each domain, with the domain if there are several."""
    texts = {
        domain: _with_interval(evaluation.estimate(policy, domain, "att_s"))
        for domain, policy in policies.items()
    }
    if named or len(texts) > 1:
        return ", ".join(f"{domain} {text}" for domain, text in texts.items()) or "–"
    return next(iter(texts.values()), "–")


def _table(page: Page, record: TableRecord, commands: Commands) -> dict[str, Any]:
    given = commands.get(record.directory) or ([record.command] if record.command else [])
    return {
        "name": record.name,
        "missing": record.missing,
        "settings": _settings(page, record.name, record.rows) if record.rows else None,
        "commands": given,
    }


def _fewer_seeds(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence on settings with fewer training seeds than others; "" without any."""
    counts: dict[str, int] = {}
    for row in rows:
        seeds = row.get("training_seeds")
        if isinstance(seeds, int | float) and math.isfinite(seeds):
            counts[str(row["setting"])] = max(int(seeds), counts.get(str(row["setting"]), 0))
    most = max(counts.values(), default=0)
    fewer = [f"{setting} ({count})" for setting, count in counts.items() if count < most]
    return f" Of fewer than {most} trainings: {', '.join(fewer)}." if fewer else ""


def _settings(page: Page, title: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return tables and pictures of settings in several real domains."""
    labels, domains, cells = charts.cells_of(rows)
    headings = [f"{domain}, s" for domain in domains]

    def grid(key: str, *, sign: bool = False) -> Grid:
        lines = [
            [s, *(_cell(cells.get((s, d), {}), key, sign=sign) for d in domains)] for s in labels
        ]
        return Grid(["policy", *headings], lines, headings)

    def estimates(domain: str) -> list[charts.Estimated]:
        rows = [cells.get((label, domain), {}) for label in labels]
        return [
            (as_number(r.get("att_s")), as_number(r.get("att_s_low")),
             as_number(r.get("att_s_high")))
            for r in rows
        ]  # fmt: skip

    scores = charts.scores_picture(
        title, labels, {d: estimates(d) for d in domains}, picture_name(title, "travel-times")
    )
    radars = [
        charts.radar_picture(
            f"the simulation against {domain}",
            _radar_lines(labels, cells, domain),
            picture_name(title, "radar", domain),
        )
        for domain in domains
    ]
    several = any(math.isfinite(as_number(row.get("att_s_low"))) for row in rows)
    caption = (
        "Mean over training seeds with its 95 % interval." if several else "One training seed."
    )
    caption += _fewer_seeds(rows)
    return {
        "att": grid("att_s"),
        "gap": grid("att_s_gap", sign=True),
        "sim": grid("att_s_sim"),
        "figures": page.figures((scores, caption), *((radar, _RADAR) for radar in radars)),
    }


def _cell(row: Mapping[str, Any], key: str, *, sign: bool) -> str:
    mean, low, high = (as_number(row.get(name)) for name in (key, f"{key}_low", f"{key}_high"))
    if not math.isfinite(mean):
        return "–"
    text = signed(mean) if sign else number(mean)
    return f"{text} {_ends(low, high)}" if low < high else text


def _radar_lines(labels: Sequence[str], cells: charts.Cells, domain: str) -> dict[str, list[float]]:
    grounded = (charts.row_of(grounding, labels) for grounding in GROUNDED_NAME)
    begins = (DIRECT, *grounded, ORACLE, RULE)  # of a row's label, each with room for one line
    known = [label for label in labels if (label, domain) in cells]
    first = (next((x for x in known if x.startswith(begin)), None) for begin in begins)
    lines: dict[str, list[float]] = {}
    for place, label in enumerate(x for x in first if x is not None):
        row = cells[label, domain]
        if place == 0:
            lines[f"{label} in the simulation"] = [
                as_number(row.get(f"{m}_sim")) for m in charts.RADAR_AXES
            ]
        lines[f"{label} in {domain}"] = [as_number(row.get(m)) for m in charts.RADAR_AXES]
    return lines


def _seeds(page: Page, runs: Sequence[RunRecord]) -> list[Figure]:
    """Return curves of trainings that differ in their seed alone."""
    figures: list[Figure] = []
    over = "Mean over the seeds, with its 95 % interval."
    for members in seeds_of_one(runs):
        # Without metrics a training has no curve; the interval of a single one is over episodes
        trainings = [record for record in members if record.series("episode", "return")]
        if len(trainings) < 2:
            continue
        first = trainings[0]
        name = picture_name(first.scenario, first.real, first.grounding, "seeds")
        figures += page.figures(
            (charts.learning_picture(trainings, f"{name}-learning"), f"{_STRETCH}the seeds."),
            (charts.travel_time_picture(trainings, f"{name}-att"), over),
            (charts.gate_picture(trainings, f"{name}-gate"), over),
        )
    return figures


# --- one training ---------------------------------------------------------------------------------


def _training(page: Page, record: RunRecord, commands: Commands) -> dict[str, Any]:
    places, remark = places_of(record)
    evaluation = record.evaluation
    judged = evaluation is not None and evaluation.policies
    learning = charts.learning_picture([record], picture_name(record.name, "learning"))
    travel = charts.travel_time_picture([record], picture_name(record.name, "att"))
    once = "One episode after each iteration, on a seed of the search for rules: no interval."
    hashes = [(f"hash of {name}", text) for name, text in record.hashes.items()]
    versions = [(f"version of {name}", text) for name, text in record.versions.items()]
    notes = list(evaluation.notes.items()) if evaluation is not None else []
    return {
        "name": record.name,
        "status": _status(record),
        "headline": _headline(record),
        "progress": _progress(record),
        "missing": record.missing,
        "boxes": _boxes(record),
        "scores": _scores(page, record, evaluation, places)
        if evaluation is not None and judged
        else None,
        "curves": page.figures((learning, f"{_STRETCH}its episodes."), (travel, once)),
        "street": found_on_street(record),
        "found": _found(page, record, places),
        "places": remark,
        "gate": _gate(page, record, places),
        "queues": _worst(page, record, places),
        "commands": commands.get(record.directory, ()),
        "provenance": [("folder", str(record.directory)), *versions, *hashes, *notes],
        "settings": flat_settings(record.settings),
    }


def _boxes(record: RunRecord) -> list[tuple[str, str]]:
    """Return the most important numbers with their labels, for boxes at the top."""
    evaluation = record.evaluation
    if evaluation is None or record.job or len(evaluation.domains) < 2 or not evaluation.policies:
        return []
    real, direct = evaluation.domains[1], evaluation.policies[0]
    boxes: list[tuple[str, str]] = []
    for name in _main_policies(evaluation):
        travel = evaluation.estimate(name, real, "att_s")
        boxes.append((f"{number(travel.mean)} s", f"{name} in {real}{_between(travel)}"))
    grounded = next(filter(is_grounded, evaluation.policies), None)
    if grounded is not None:
        start, now = (evaluation.gap(p, real, "att_s").mean for p in (direct, grounded))
        if start > 0 and math.isfinite(now):
            if abs(now) <= start:  # below 0 the street is faster than the simulation says
                box = share(1 - abs(now) / start), f"of the gap Δ is gone with {grounded}"
            else:  # a share of a small gap would say little
                box = f"{number(abs(now) - start)} s", f"longer gap Δ with {grounded}"
            boxes.append(box)
        times = [evaluation.values(policy, real, "att_s") for policy in (direct, grounded)]
        saved, word = Estimate.of(times[0] - times[1]), "less"
        if saved.mean < 0:
            saved, word = Estimate.of(times[1] - times[0]), "more"
        boxes.append(
            (f"{number(saved.mean)} s", f"{word} in {real} with {grounded}{_between(saved)}")
        )
        regret = evaluation.regret(grounded, real)
        boxes.append((f"{number(regret.mean)} s", f"regret of {grounded}{_between(regret)}"))
    return boxes


def _between(estimate: Estimate) -> str:
    """Return the 95 % interval of a number in a box; "" without one."""
    if not estimate.is_wide:
        return ""
    return f", 95 %: {number(estimate.low)} to {number(estimate.high)} s"


def _main_policies(evaluation: Evaluation) -> list[str]:
    """Return those of direct transfer, grounded ones and the best rule that were evaluated."""
    rule = evaluation.best_rule_policy(evaluation.domains[-1])
    return [
        name
        for place, name in enumerate(evaluation.policies)
        if place == 0 or is_grounded(name) or name == rule
    ]


def _scores(
    page: Page, record: RunRecord, evaluation: Evaluation, places: AgentPlaces | None
) -> dict[str, Any]:
    """Return travel times with gap and regret, levels of service, and all measures."""
    first, *others = evaluation.domains
    headings = ["policy", f"in {first}, s"]
    for domain in others:
        headings += [f"in {domain}, s", f"Δ {domain}, s", f"regret {domain}, s"]
    rows: list[list[str]] = []
    for policy in evaluation.policies:
        cells = [policy, _with_interval(evaluation.estimate(policy, first, "att_s"))]
        for domain in others:
            cells += [
                _with_interval(evaluation.estimate(policy, domain, "att_s")),
                signed(evaluation.gap(policy, domain, "att_s").mean),
                number(evaluation.regret(policy, domain).mean),
            ]
        rows.append(cells)
    radars = [
        charts.radar_picture(
            f"{first} against {real}",
            charts.radar_lines(evaluation, real),
            picture_name(record.name, "radar", real),
        )
        for real in others
    ]
    scores = charts.scores_picture(
        f"{record.name}: travel time",
        evaluation.policies,
        charts.travel_times(evaluation),
        picture_name(record.name, "travel-times"),
    )
    seeds = len(evaluation.seeds)
    caption = "Mean over the episodes with its 95 % interval." if seeds > 1 else "One episode."
    network = places.network if places is not None else None
    check, outcome = check_run(evaluation), outcome_of(evaluation)
    return {
        "sim": first,
        "outcome": None if outcome is None else outcome.sentence(),
        "trained": None if check is None else check.sentence("--pretrain-episodes"),
        "episodes": seeds,
        "table": Grid(headings, rows, headings[1:]),
        "measures": _measures(evaluation),
        "service": service_grid(evaluation, _main_policies(evaluation), network),
        "real": evaluation.domains[-1],
        "levels": LEGEND,
        "figures": page.figures((scores, caption), *((radar, _RADAR) for radar in radars)),
    }


def _measures(evaluation: Evaluation) -> Grid:
    hidden = list(dict.fromkeys(name for r in evaluation.results for name in r.scores.hidden))
    headings = ["policy", "domain", *MEASURES.values(), "never entered [veh]"]
    headings += [OBJECTIVE_MEASURES.get(name, name) for name in hidden]
    rows = [
        [
            policy,
            domain,
            *(_with_half(evaluation.estimate(policy, domain, measure)) for measure in MEASURES),
            number(evaluation.estimate(policy, domain, "backlog").mean),
            *(number(evaluation.estimate(policy, domain, name).mean) for name in hidden),
        ]
        for policy in evaluation.policies
        for domain in evaluation.domains
    ]
    return Grid(headings, rows, headings[2:])


def _found(page: Page, record: RunRecord, places: AgentPlaces | None) -> dict[str, Any] | None:
    """Return what was found at each intersection; None if nothing was looked for there."""
    table = findings_table(record, places)
    if table is None:
        return None
    return {
        "figures": page.figures(*(findings_maps(record, places) if places is not None else ())),
        "table": table,
    }


def _gate(page: Page, record: RunRecord, places: AgentPlaces | None) -> dict[str, Any] | None:
    """Return the gate over the iterations and, for the last iteration, by intersection."""
    curve = charts.gate_picture([record], picture_name(record.name, "gate"))
    if curve is None:
        return None
    caption = "Means over the intersections. A grounded action is taken where u is below α."
    return {
        "figures": page.figures((curve, caption)),
        "table": _gate_grid(record, places),
    }


def _gate_grid(record: RunRecord, places: AgentPlaces | None) -> Grid:
    columns = {
        "gate/acceptance": "accepted", "gate/mean_u": "mean u", "gate/alpha": "α",
        "gate/change_rate": "changed", "gate/trusted": "f and h are proven",
    }  # fmt: skip
    last = {key: record.parts(key) for key in columns}
    shown = {key: text for key, text in columns.items() if last[key]}
    rows: list[list[str]] = []
    for agent in last["gate/acceptance"]:
        tls = places.intersection_of.get(agent) if places is not None else None
        cells = [_of_gate(key, last[key].get(agent, math.nan)) for key in shown]
        rows.append([agent, tls or "–", *cells])
    headings = ["agent", "traffic light", *shown.values()]
    return Grid(headings, rows, headings[2:])


def _of_gate(key: str, value: float) -> str:
    if key == "gate/trusted":
        return "–" if math.isnan(value) else "yes" if value else "no"
    if math.isinf(value):
        return "∞"
    is_share = key in ("gate/acceptance", "gate/change_rate")
    return share(value) if is_share and math.isfinite(value) else number(value)


def _worst(page: Page, record: RunRecord, places: AgentPlaces | None) -> dict[str, Any] | None:
    """Return the intersections and minutes with the longest queues in the real domain."""
    if record.queues is None or record.evaluation is None:
        return None
    domain, known = record.evaluation.domains[-1], record.evaluation.policies
    policies = [p for p in known if is_grounded(p)]
    policies = [*policies, *(p for p in known[:1] if p not in policies)]
    by_policy: dict[str, dict[str, list[float]]] = {}
    for policy, where, minute, tls, queue, _ in record.queues.sort("minute").rows():
        if where == domain and policy in policies:
            row = by_policy.setdefault(policy, {}).setdefault(tls, [])
            # a minute without a decision has the queue of the decision before it
            row += [row[-1] if row else queue] * (minute - len(row))
            row.append(queue)
    by_policy = {policy: by_policy[policy] for policy in policies if policy in by_policy}
    if not by_policy:
        return None
    most = max(max(row) for queues in by_policy.values() for row in queues.values())
    caption = "Longest queues first; the same colours for all policies."
    figures: list[tuple[NamedFigure | None, str]] = []
    for policy, queues in by_policy.items():
        name = picture_name(record.name, "minutes", policy)
        figures.append((minutes_picture(name, f"{policy} in {domain}", queues, most), caption))
    first, queues = next(iter(by_policy.items()))
    means = {tls: sum(row) / len(row) for tls, row in queues.items()}
    if places is not None and len(means.keys() & set(places.intersection_of.values())) > 1:
        picture = node_map(
            picture_name(record.name, "map-queue"), f"mean queue, {first} in {domain}",
            places.network, {tls: (mean, f"{mean:.1f}") for tls, mean in means.items()},
            (0.0, max(means.values()) or 1.0), "vehicles standing",
        )  # fmt: skip
        figures.append((picture, "Halting vehicles before each intersection."))
    names = LightNames() if places is None else LightNames.of(places.network)
    table = _worst_grid(by_policy, names)
    return {"domain": domain, "table": table, "figures": page.figures(*figures)}


def _worst_grid(by_policy: Mapping[str, Queues], names: LightNames) -> Grid:
    """Return the intersections with the longest queues, in the order of the first policy."""
    policies = list(by_policy)
    means = {p: {tls: sum(q) / len(q) for tls, q in by_policy[p].items() if q} for p in policies}
    order = sorted(means[policies[0]], key=lambda tls: -means[policies[0]][tls])[:_WORST]
    headings, numbers = ["intersection"], list[str]()
    for policy in policies:
        numbers += [f"{policy}: queue, veh", f"{policy}: longest, veh"]
        headings += [*numbers[-2:], f"{policy}: when"]
    rows: list[list[str]] = []
    for tls in order:
        cells = [names.whole(tls)]
        for policy in policies:
            row = by_policy[policy].get(tls, ())
            if not row:
                cells += ["–", "–", "–"]
                continue
            worst = max(range(len(row)), key=lambda k: row[k])
            cells += [number(means[policy][tls]), number(row[worst]), f"minute {worst}"]
        rows.append(cells)
    return Grid(headings, rows, numbers)


def _with_interval(estimate: Estimate) -> str:
    """Return a mean with its interval, if it has one."""
    if not estimate.is_wide:
        return number(estimate.mean)
    return f"{number(estimate.mean)} {_ends(estimate.low, estimate.high)}"


def _with_half(estimate: Estimate) -> str:
    """Return a mean with half of its interval, if it has one, for narrow columns."""
    if not estimate.is_wide:
        return number(estimate.mean)
    return f"{number(estimate.mean)} ±{number(estimate.half, 2)}"


def _ends(low: float, high: float) -> str:
    """Return an interval with spaces at which no browser breaks the line."""
    return f"({number(low)}\u00a0to\u00a0{number(high)})"
