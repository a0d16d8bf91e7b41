"""A diagnosis as one page of HTML that loads no other file and runs no script."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Sequence
from html import unescape
from pathlib import Path
from typing import Any

from ugat_marl.diagnosis import (
    CriteriaRow,
    Diagnosis,
    Disagreement,
    EffectRecord,
    HeldOut,
    LaneRow,
    NamedEffect,
    StatisticRow,
    TravelTimeEstimate,
    Verdict,
    describe_pattern,
    statistic,
)
from ugat_marl.files import write_whole
from ugat_marl.reporting import diagnosis_words as words
from ugat_marl.reporting.diagnosis_charts import BAND, headway_picture, statistics_picture
from ugat_marl.reporting.formats import chance, number, share, signed
from ugat_marl.reporting.light_names import LightNames
from ugat_marl.reporting.network_maps import disagreement_map
from ugat_marl.reporting.page import Figure, Grid, Page, render
from ugat_marl.reporting.style import DISAGREEMENT
from ugat_marl.scenarios import Network

DIAGNOSIS_TITLE = "Diagnosis of"
"""Begin of the titles of these pages."""
_PLACES = 10
"""Number of places in the table of disagreements that is shown at once."""
_LOUD, _QUIET = 16, 6
"""Most strips that are shown at once: of statistics outside their noise, else of those inside."""
_POSITIONS = {
    "lost": "1st", "gap2": "2nd", "gap3": "3rd", "gap4-5": "4th–5th", "gap6-8": "6th–8th",
    "gap9+": "from 9th",
}  # fmt: skip
"""Positions in the queue by the name of their statistic."""
_STRIPS = 8
"""Most strips in one picture; two pictures stand side by side."""
_COMMANDS = re.compile(r"<h2>Run it again</h2>\s*<pre><code>(.*?)</code></pre>", re.DOTALL)
_BADGES: dict[Verdict, str] = {
    "no_discrepancy": "good", "explained": "good", "not_identifiable": "mixed",
    "partially_explained": "mixed", "provisional": "mixed", "unknown": "bad",
}  # fmt: skip
_CRITERIA: tuple[tuple[str, Callable[[CriteriaRow], str]], ...] = (
    ("counts with GEH below 5 (usual: 85 %)", lambda row: share(row.geh_below_5)),
    ("largest GEH", lambda row: number(row.geh_largest)),
    (
        "FHWA I: 15 min within 1.96 σ of the typical day (95 %)",
        lambda row: share(row.within_2_sigma),
    ),
    ("FHWA II: within 1 σ (two thirds)", lambda row: share(row.within_1_sigma)),
    (
        "FHWA III: detectors with bounded absolute error (all)",
        lambda row: share(row.absolute_error),
    ),
    ("FHWA IV: with bounded systematic error (all)", lambda row: share(row.systematic_error)),
)


def write_diagnosis_page(
    diagnosis: Diagnosis, network: Network, path: Path, commands: Sequence[str] = ()
) -> None:
    """Write the page of a diagnosis.

    Args:
        diagnosis: The diagnosis; `Diagnosis.read` reads it from ``diagnosis.json``.
        network: Network of the scenario, for the map.
        path: File to write.
        commands: Commands that repeat the diagnosis and go on from it, one line each.
    """
    write_whole(path, diagnosis_page(diagnosis, network, commands))


def diagnosis_page(diagnosis: Diagnosis, network: Network, commands: Sequence[str] = ()) -> str:
    """Return the page as text; see `write_diagnosis_page`."""
    page, names = Page(), LightNames.of(network)
    verdict, heldout = words.VERDICTS[diagnosis.verdict], diagnosis.heldout
    return render(
        "diagnosis.html.j2",
        title=f"{DIAGNOSIS_TITLE} {diagnosis.scenario}: {verdict}",
        diagnosis=diagnosis,
        verdict=(_BADGES[diagnosis.verdict], verdict),
        partial=words.partial(diagnosis),
        meaning=words.meaning(diagnosis),
        effects=_effects(diagnosis.effects, names),
        as_domain=words.as_domain(diagnosis.effects),
        judged=words.judged(diagnosis),
        heldout=None if heldout is None else _heldout(heldout),
        expected=number(None if heldout is None else heldout.expected),
        traffic=_traffic(diagnosis),
        traffic_check=words.traffic_check_line(diagnosis),
        maps=_maps(page, diagnosis, network),
        map_key=[(f"d{place}", text) for place, (_, text) in enumerate(DISAGREEMENT)],
        statistics=_statistics(page, diagnosis),
        where=_where(diagnosis, names),
        limits=_limits(diagnosis),
        limits_mean=words.LIMITS,
        patterns=_patterns(diagnosis),
        unnamed=_effects(diagnosis.unnamed, names),
        ranking=_ranking(diagnosis, names),
        criteria_table=_criteria(diagnosis),
        headways=_headways(page, diagnosis),
        criteria=words.criteria_line(diagnosis),
        policy_gap=_policy_gap(diagnosis),
        policy_gap_intervals=any(
            gap.sim.low is not None for gap in (diagnosis.policy_gap or {}).values()
        ),
        data=_data(diagnosis),
        commands=commands or _usual_commands(diagnosis),
        provenance=_provenance(diagnosis),
    )


def training_command(scenario: str, corrected: str) -> str:
    """Return the command that trains a policy in a corrected scenario.

    The street itself is no domain, so the policy is also evaluated in the scenario as it is.

    Args:
        scenario: The scenario as it is, as the command line takes it.
        corrected: Folder of the corrected scenario.
    """
    command = ["ugat-marl", "train", scenario, "--sim", corrected]
    return shlex.join([*command, "--real", "sim", "--iterations", "0", "--no-control"])


def commands_on_page(path: Path) -> list[str]:
    """Return the commands on a page; none if the page cannot be read.

    The record of a diagnosis does not hold them.
    """
    try:
        match = _COMMANDS.search(path.read_text(encoding="utf-8", errors="replace"))
    except OSError:
        return []
    return unescape(match[1]).splitlines() if match else []


def _effects(effects: Sequence[NamedEffect], names: LightNames) -> Grid | None:
    """Return a table of the named effects, with intervals where known; None without effects."""
    rows = [
        (
            words.effect_name(effect),
            words.place(effect, names),
            words.window(effect.window) or "always",
            words.values(effect),
            effect.evidence.in_words(number),
        )
        for effect in effects
    ]
    value = "value (95 % interval)" if any(map(words.has_interval, effects)) else "value"
    headings = ("effect", "where", "when", value, "grounds")
    return Grid(headings, rows) if rows else None


def _heldout(heldout: HeldOut) -> list[tuple[str, str]]:
    """Return the numbers of the held-out periods with their labels."""
    boxes = [(number(heldout.before), "distance before")]
    corrected = heldout.shrink is not None
    if corrected:
        boxes.append((number(heldout.after), "distance after"))
    boxes.append((number(heldout.floor), "noise floor"))
    if corrected:
        boxes.append((share(heldout.shrink), "of the gap is gone"))
    boxes.append((chance(heldout.p_before), "p before"))
    if corrected:
        boxes.append((chance(heldout.p_after), "p after"))
    return boxes


def _traffic(diagnosis: Diagnosis) -> Grid | None:
    """Return a table of capacity, queue and delay by approach; None without travel times."""
    corrected = diagnosis.best is not None
    rows = words.traffic_rows(diagnosis.approaches, corrected=corrected)
    columns = ("measured", "before", "after")
    return Grid(("approach", "", *columns), rows, columns) if rows else None


def _model(diagnosis: Diagnosis) -> str:
    """Return the words for the corrected model."""
    return "the effects named" if diagnosis.effects else "the best attempt, which is not named"


def _maps(page: Page, diagnosis: Diagnosis, network: Network) -> list[Figure]:
    lanes = diagnosis.lanes
    traffic_lights = {row.tls for row in lanes}

    def drawn(name: str, title: str, size: Callable[[LaneRow], float]) -> tuple[Any, str]:
        sizes = {row.lane: size(row) for row in lanes}
        picture = disagreement_map(f"map-{name}", title, network, sizes, traffic_lights)
        return picture, "Point at a lane to read its disagreement."

    maps = [drawn("before", "The scenario as it is", lambda row: row.before)]
    if any(row.before != row.after for row in lanes):
        maps.append(drawn("after", f"With {_model(diagnosis)}", lambda row: row.after))
    return page.figures(*maps)


def _statistics(page: Page, diagnosis: Diagnosis) -> dict[str, Any] | None:
    rows = diagnosis.statistics
    if not rows:
        return None
    after = any(row.z_before != row.z_after for row in rows)

    def size(row: StatisticRow) -> float:
        return max(abs(row.z_before), abs(row.z_after))

    ordered = sorted(rows, key=size, reverse=True)
    loud = sum(size(row) > BAND for row in ordered)
    first = min(loud, _LOUD) or _QUIET
    strips = [_strip(row, after=after) for row in ordered]

    def pictures(name: str, rows: Sequence[Any]) -> list[Figure]:
        count = math.ceil(len(rows) / _STRIPS)
        length = math.ceil(len(rows) / max(count, 1))
        parts = [rows[k * length : (k + 1) * length] for k in range(count)]
        most = size(ordered[0])
        caption = "Strongest first. Point at a dot to read its numbers."
        return page.figures(
            *(
                (statistics_picture(part, most, f"{name}-{place}"), caption)
                for place, part in enumerate(parts, 1)
            )
        )

    return {
        "heading": "The statistics that speak" if loud else "No statistic speaks",
        "model": _model(diagnosis) if after else "",
        "shown": pictures("statistics", strips[:first]),
        "rest": pictures("statistics-more", strips[first:]),
        "more": len(strips[first:]),
    }


def _strip(row: StatisticRow, *, after: bool) -> tuple[str, str, float, float | None]:
    """Return the texts and deviations of a statistic."""
    text = f"measured {number(row.measured)}, simulated {number(row.before)}"
    if after:
        text += f" → {number(row.after)}"
    text += f" ± {number(row.noise, 2)}"
    text += f" {row.unit}" if row.unit else ""
    remark = f"{row.regime} · {text}"
    return statistic(row.statistic), remark, row.z_before, row.z_after if after else None


def _where(diagnosis: Diagnosis, names: LightNames) -> dict[str, Grid | None] | None:
    """Return tables of the places where data and simulation disagree, before and after."""
    where, left = diagnosis.where, diagnosis.left
    if not where:
        return None
    return {
        "first": _disagreements(where[:_PLACES], names),
        "more": _disagreements(where[_PLACES:], names) if len(where) > _PLACES else None,
        "left": _disagreements(left, names) if left else None,
    }


def _disagreements(disagreements: Sequence[Disagreement], names: LightNames) -> Grid:
    rows = [
        (
            words.disagreement_place(disagreement, names),
            disagreement.regime,
            statistic(disagreement.statistic),
            f"{signed(disagreement.size)} {disagreement.unit}".rstrip(),
            signed(disagreement.z),
            words.window(disagreement.window),
        )
        for disagreement in disagreements
    ]
    return Grid(("place", "regime", "statistic", "size", "z", "window"), rows, ("size", "z"))


def _patterns(diagnosis: Diagnosis) -> Grid | None:
    """Return a table of the patterns in what is left; None without any."""
    rows = [
        (
            describe_pattern(pattern),
            f"{signed(100 * pattern.change)} % ± {number(100 * pattern.error, 2)}",
            "–" if (again := pattern.heldout_change) is None else f"{signed(100 * again)} %",
            chance(pattern.p),
        )
        for pattern in diagnosis.patterns
    ]
    headings = ("pattern", "change", "held-out", "p")
    return Grid(headings, rows, headings[1:]) if rows else None


def _limits(diagnosis: Diagnosis) -> Grid | None:
    """Return a table of the detection limits; None if they were not found."""
    rows = words.limit_rows(diagnosis.limits)
    return Grid(("effect", "usual value", "would show"), rows) if rows else None


def _ranking(diagnosis: Diagnosis, names: LightNames) -> list[dict[str, Any]]:
    """Return the simulated explanations, the chosen one first."""
    if not diagnosis.alternatives:
        return []
    explanations: list[tuple[str, float | None, float | None, bool, bool]] = []
    if diagnosis.effects:
        best = diagnosis.best
        left, cost = (None, None) if best is None else (best.distance, best.cost)
        explanations.append((_set(diagnosis.effects, names), left, cost, True, False))
    explanations += [
        (_set(x.effects, names), x.distance, x.cost, False, x.indistinct)
        for x in diagnosis.alternatives
    ]
    most = max((distance for _, distance, *_ in explanations if distance is not None), default=1.0)
    return [
        {
            "effects": text,
            "distance": number(distance),
            "cost": number(cost),
            "width": f"{_logarithm(distance, most):.1f}",
            "chosen": chosen,
            "as_good": as_good,
        }
        for text, distance, cost, chosen, as_good in explanations
    ]


def _logarithm(distance: float | None, most: float) -> float:
    """Return the length of a bar in per cent: 100 log(1 + distance) / log(1 + most)."""
    if distance is None:
        return 0.0
    return 100 * math.log1p(max(distance, 0.0)) / math.log1p(max(most, 1.0))


def _set(effects: Sequence[EffectRecord], names: LightNames) -> str:
    return " + ".join(_in_words(effect, names) for effect in effects)


def _in_words(effect: EffectRecord, names: LightNames) -> str:
    place = words.place(effect, names)
    text = words.effect_name(effect) + ("" if place == "everywhere" else f" at {place}")
    text += f", {words.window(effect.window)}" if effect.window else ""
    return f"{text} ({words.values(effect, intervals=False)})" if effect.parameters else text


def _criteria(diagnosis: Diagnosis) -> Grid | None:
    """Return the usual criteria of traffic engineering."""
    criteria = diagnosis.criteria
    if criteria is None:
        return None
    before, after, measured = criteria.before, criteria.after, criteria.measured
    rows = [(name, "", value(before), value(after)) for name, value in _CRITERIA]
    street, sim, repaired = (number(x.saturation_headway_s) for x in (measured, before, after))
    rows.append(("discharge headway, 4th vehicle on (s)", street, sim, repaired))
    if (times := diagnosis.travel_time) is not None:
        rows.append(("mean travel time (s)", "", number(times.before_s), number(times.after_s)))
    columns = ("measured", "before", "after")
    if diagnosis.best is None:  # the scenario as it is stands on both sides
        rows = [(*row[:-1], "–") for row in rows]
    return Grid(("criterion", *columns), rows, columns)


def _headways(page: Page, diagnosis: Diagnosis) -> list[Figure]:
    """Return a picture of the gaps in discharging queues; none with fewer than two positions."""
    rows = [row for row in diagnosis.statistics if row.statistic in _POSITIONS and row.measured]
    if len(rows) < 2:
        return []
    rows.sort(key=lambda row: list(_POSITIONS).index(row.statistic))
    series: dict[str, Sequence[float | None]] = {
        "measured": [row.measured for row in rows], "simulated": [row.before for row in rows],
    }  # fmt: skip
    if any(row.z_before != row.z_after for row in rows):
        series["corrected"] = [row.after for row in rows]
    picture = headway_picture(
        [_POSITIONS[row.statistic] for row in rows], series, [row.noise for row in rows], "headways"
    )
    caption = f"Queues that discharge, {words.judged(diagnosis)} periods; "
    caption += "bars: twice the chance of the measurement."
    return page.figures((picture, caption))


def _policy_gap(diagnosis: Diagnosis) -> Grid | None:
    """Return travel times of policies in both simulations and in the real domain, if measured."""
    if not diagnosis.policy_gap:
        return None
    rows = [
        (
            name,
            *map(_mean, (gap.sim, gap.corrected, gap.real)),
            number(gap.before),
            number(gap.after),
            share(gap.shrink),
        )
        for name, gap in diagnosis.policy_gap.items()
    ]
    headings = ("policy", "sim (s)", "corrected (s)", "real (s)", "before", "after", "shrink")
    return Grid(headings, rows, headings[4:])


def _mean(estimate: TravelTimeEstimate) -> str:
    """Return a mean with its interval."""
    if estimate.low is None or estimate.high is None:
        return number(estimate.mean)
    return f"{number(estimate.mean)} ({number(estimate.low)} to {number(estimate.high)})"


def _data(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    return [
        ("fitted periods", ", ".join(diagnosis.periods.fit)),
        ("held-out periods", ", ".join(diagnosis.periods.heldout) or "none"),
        ("the data cannot show", words.joined(diagnosis.ruled_out) or "all can be seen"),
        ("left out on request", words.joined(diagnosis.left_out) or "nothing"),
    ]


def _provenance(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    return [
        ("schema", diagnosis.schema),
        ("seed", str(diagnosis.seed)),
        ("level of the tests", number(diagnosis.alpha)),
        ("budget", diagnosis.budget_in_words),
        *((f"version of {name}", str(text)) for name, text in diagnosis.versions.items()),
        *((f"SHA-256 of the {name}", text) for name, text in diagnosis.hashes.items()),
    ]


def _usual_commands(diagnosis: Diagnosis) -> list[str]:
    """Return the commands with words in capitals for the paths, which no record holds."""
    options = f"--alpha {diagnosis.alpha:g} --seed {diagnosis.seed}"
    hours = math.inf if diagnosis.budget_h is None else diagnosis.budget_h
    for option, value in (("h", hours), ("s", diagnosis.budget_s)):
        options = options if value is None else f"--budget-{option} {value:.15g} {options}"
    if diagnosis.left_out:
        options += " --leave-out " + " ".join(diagnosis.left_out)
    check = diagnosis.traffic_check
    no_nearer = check is not None and not check.better
    if diagnosis.limits:
        options += " --limits"
    if diagnosis.unnamed:
        options += " --unnamed"
    elif diagnosis.not_corrected is None and (
        no_nearer or diagnosis.verdict == "partially_explained"
    ):
        options += " --correct-anyway"
    scenario = shlex.quote(diagnosis.scenario)
    lines = [f"ugat-marl diagnose {scenario} MEASURED --out DIR {options}"]
    if diagnosis.corrected:
        lines.append(training_command(diagnosis.scenario, f"DIR/{diagnosis.corrected}"))
    return lines
