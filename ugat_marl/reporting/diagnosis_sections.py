"""The sections of the page of a diagnosis that are tables and text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from ugat_marl.diagnosis import statistic
from ugat_marl.reporting import diagnosis_words as words
from ugat_marl.reporting.diagnosis_words import Record

_PLACES = 10
_NUMBERS = frozenset(
    {"size", "z", "distance", "cost", "before", "after", "measured", "shrink", "p"}
)
"""Headings of columns of numbers."""


def effects(record: Record) -> str:
    """What is named, with intervals."""
    if not record["effects"]:
        return ""
    rows = [
        (
            words.effect_name(item),
            words.place(item),
            words.window(item.get("window")) or "always",
            words.values(item),
            _ground(item.get("evidence") or {}),
        )
        for item in record["effects"]
    ]
    headings = ("effect", "where", "when", "value (95 % interval)", "grounds")
    return f"<section><h2>Effects</h2>{table(headings, rows)}</section>"


def _ground(evidence: Record) -> str:
    if "source" in evidence:
        return str(evidence["source"])
    if evidence.get("runner_up_is_worse_by") is not None:
        return f"next set of effects is worse by {words.number(evidence['runner_up_is_worse_by'])}"
    return ""


def heldout(record: Record) -> str:
    """The held-out periods in numbers."""
    found = record["heldout"]
    if found is None:
        return ""
    fitted = bool(record.get("verified_on_fitted_periods"))
    which = "The fitted periods" if fitted else "The held-out periods"
    boxes = [
        (words.number(found["before"]), "distance before"),
        (words.number(found["floor"]), "noise floor"),
        (words.chance(found["p_before"]), "p before"),
    ]
    if found["shrink"] is not None:
        boxes[1:1] = [(words.number(found["after"]), "distance after")]
        boxes.insert(3, (words.share(found["shrink"]), "of the gap is gone"))
        boxes.append((words.chance(found["p_after"]), "p after"))
    cells = "".join(f"<div><b>{escape(a)}</b><span>{escape(b)}</span></div>" for a, b in boxes)
    warning = (
        '<p class="note">No period was held out: these are the periods that were fitted, and the '
        "numbers flatter.</p>"
        if fitted
        else ""
    )
    return (
        f'<section><h2>{which}</h2>{warning}<div class="big">{cells}</div>'
        '<p class="soft">The distance is between the statistics of the data and those of the '
        f"simulation; data of the simulation itself have {words.number(found.get('expected'))} on "
        "average, and 99 of 100 stay below the noise floor. p is the chance of such a distance if "
        "nothing were missing.</p></section>"
    )


def places(record: Record) -> str:
    """Where data and simulation disagree, before and after."""
    found = record.get("where") or ()
    if not found:
        return ""
    parts = [
        "<section><h2>Disagreements by place</h2>"
        '<p class="soft">Measured minus simulated, on the fitted periods; false discoveries are '
        "kept rare.</p>",
        _where(found[:_PLACES]),
    ]
    if len(found) > _PLACES:
        parts.append(
            f"<details><summary>{len(found) - _PLACES} more</summary>"
            f"{_where(found[_PLACES:])}</details>"
        )
    if left := record.get("left"):
        parts.append(
            f"<details><summary>What is left after the correction: {len(left)}</summary>"
            f"{_where(left)}</details>"
        )
    return "".join([*parts, "</section>"])


def _where(items: Sequence[Record]) -> str:
    rows = [
        (
            words.disagreement_place(item),
            item["regime"],
            statistic(item["statistic"]),
            f"{words.signed(item['size'])} {item['unit']}".rstrip(),
            words.signed(item["z"]),
            words.window(item.get("window")),
        )
        for item in items
    ]
    return table(("place", "regime", "statistic", "size", "z", "window"), rows)


def ranking(record: Record) -> str:
    """The explanations that were simulated, by how well they fit."""
    items: list[tuple[str, Any, Any, bool]] = []
    if record["effects"]:
        evidence = next(
            (e["evidence"] for e in record["effects"] if "distance" in (e.get("evidence") or {})),
            {},
        )
        best = record.get("best") or evidence
        items.append((_set(record["effects"]), best.get("distance"), best.get("cost"), True))
    items += [
        (_set(item["effects"]), item["distance"], item["cost"], False)
        for item in record.get("alternatives") or ()
    ]
    if len(items) < 2 and not record.get("alternatives"):
        return ""
    most = max((float(item[1]) for item in items if item[1] is not None), default=1.0)
    rows = "".join(_rank(n, item, most) for n, item in enumerate(items, start=1))
    return (
        "<section><h2>Explanations that were simulated</h2>"
        '<p class="soft">The distance is what they leave on the fitted periods (bar: logarithm); '
        "the cost adds a price for every effect.</p>"
        '<table class="stack"><thead><tr><th></th><th>effects</th><th class="n">distance</th>'
        f'<th class="n">cost</th><th>left over</th></tr></thead><tbody>{rows}</tbody></table>'
        "</section>"
    )


def _rank(number: int, item: tuple[str, Any, Any, bool], most: float) -> str:
    text, distance, cost, chosen = item
    width = 0.0
    if distance is not None:
        width = 100 * math.log1p(max(float(distance), 0.0)) / math.log1p(max(most, 1.0))
    return (
        f'<tr class="{"best" if chosen else "other"}"><td data-label="rank">{number}</td>'
        f'<td data-label="effects">{escape(text)}</td>'
        f'<td class="n" data-label="distance">{words.number(distance)}</td>'
        f'<td class="n" data-label="cost">{words.number(cost)}</td>'
        f'<td data-label="left over" style="min-width:7rem"><div class="bar" '
        f'style="width:{width:.1f}%"></div></td></tr>'
    )


def _set(items: Sequence[Record]) -> str:
    return " + ".join(_one(item) for item in items)


def _one(item: Record) -> str:
    where = words.place(item)
    text = words.effect_name(item) + ("" if where == "everywhere" else f" at {where}")
    text += f", {words.window(item['window'])}" if item.get("window") else ""
    return f"{text} ({words.values(item, intervals=False)})" if item["parameters"] else text


def courtesy(record: Record) -> str:
    """What traffic engineers are used to see."""
    found = record.get("courtesy") or {}
    if not found:
        return ""
    before, after = found.get("before") or {}, found.get("after") or {}
    rows: list[tuple[str, ...]] = []
    for name, key, say in (
        ("counts with GEH below 5 (usual: 85 %)", "geh_below_5", words.share),
        ("largest GEH", "geh_largest", words.number),
        ("FHWA I: 15 min within 1.96 σ of the typical day (95 %)", "within_2_sigma", words.share),
        ("FHWA II: within 1 σ (two thirds)", "within_1_sigma", words.share),
        ("FHWA III: detectors with bounded absolute error (all)", "absolute_error", words.share),
        ("FHWA IV: with bounded systematic error (all)", "systematic_error", words.share),
    ):
        rows.append((name, "", say(before.get(key)), say(after.get(key))))
    headway = [(found.get(k) or {}).get("saturation_headway_s") for k in ("measured",)]
    headway += [before.get("saturation_headway_s"), after.get("saturation_headway_s")]
    rows.append(("discharge headway, 4th vehicle on (s)", *map(words.number, headway)))
    times = record.get("travel_time") or {}
    if times:
        after_s = words.number(times.get("after_s"))
        rows.append(("mean travel time (s)", "", words.number(times.get("before_s")), after_s))
    line = words.geh_line(record)
    return (
        "<section><h2>As a courtesy: the usual criteria</h2>"
        '<p class="soft">None of them decides anything here.</p>'
        + (f'<p class="note">{escape(line)}</p>' if line else "")
        + table(("criterion", "measured", "before", "after"), rows)
        + "</section>"
    )


def policy_gap(record: Record) -> str:
    """How far policies do otherwise than promised, if it was measured."""
    found = record.get("policy_gap")
    if not isinstance(found, Mapping) or not found:
        return ""
    rows = [
        (
            str(name),
            *(_mean(item.get(world)) for world in ("sim", "corrected", "real")),
            words.number(item.get("before")),
            words.number(item.get("after")),
            words.share(item.get("shrink")),
        )
        for name, item in found.items()
    ]
    headings = ("policy", "sim (s)", "corrected (s)", "real (s)", "before", "after", "shrink")
    return (
        "<section><h2>Policy gap</h2>"
        '<p class="soft">Average travel time with 95 % intervals. Before: how far the real world '
        "is from the simulation, s; after: from the corrected one.</p>"
        + table(headings, rows)
        + "</section>"
    )


def _mean(item: Any) -> str:
    """A mean with its interval."""
    if not isinstance(item, Mapping):
        return "–"
    if item.get("low") is None or item.get("high") is None:
        return words.number(item.get("mean"))
    low, high = words.number(item["low"]), words.number(item["high"])
    return f"{words.number(item.get('mean'))} ({low} to {high})"


def data(record: Record) -> str:
    """What was measured, and what could not be examined for it."""
    periods = record["periods"]
    items = [
        ("fitted periods", ", ".join(map(str, periods["fit"]))),
        ("held-out periods", ", ".join(map(str, periods["heldout"])) or "none"),
        ("the data cannot show", words.joined(record.get("ruled_out") or ()) or "all can be seen"),
        ("left out on request", words.joined(record.get("left_out") or ()) or "nothing"),
    ]
    notes = "".join(f"<li>{escape(str(text))}</li>" for text in record.get("findings") or ())
    notes = f"<h3>What the check of the files had to say</h3><ul>{notes}</ul>" if notes else ""
    return f"<section><h2>The data</h2>{pairs(items)}{notes}</section>"


def provenance(record: Record, commands: Sequence[str]) -> str:
    """How to run it again, and with what it was made."""
    lines = escape("\n".join(commands or _commands(record)))
    parts = [f"<section><h2>Run it again</h2><pre><code>{lines}</code></pre>"]
    if record.get("corrected"):
        parts.append(
            f'<p class="soft">The corrected scenario is in <code>{escape(record["corrected"])}'
            "/</code> beside this page: plain SUMO files, usable as any other domain.</p>"
        )
    items = [
        ("schema", record["schema"]),
        ("seed", str(record["seed"])),
        ("level of the tests", words.number(record["alpha"])),
        ("budget", f"{words.number(record['budget_s'])} s"),
        *((f"version of {name}", text) for name, text in record["versions"].items()),
        *((f"SHA-256 of the {name}", text) for name, text in record["hashes"].items()),
    ]
    return "".join([*parts, pairs(items), "</section>"])


def _commands(record: Record) -> list[str]:
    """The command with capitals for the paths, which no record holds."""
    options = f"--budget-s {record['budget_s']:g} --alpha {record['alpha']:g}"
    options += f" --seed {record['seed']}"
    if record.get("left_out"):
        options += " --leave-out " + " ".join(map(str, record["left_out"]))
    lines = [f"ugat-marl diagnose {record['scenario']} MEASURED --out DIR {options}"]
    if record.get("corrected"):
        lines.append(
            f"ugat-marl train {record['scenario']} --sim DIR/{record['corrected']} --real REAL"
        )
    return lines


def pairs(items: Sequence[tuple[str, str]]) -> str:
    """A list of names and values."""
    rows = "".join(f"<dt>{escape(str(a))}</dt><dd>{escape(str(b))}</dd>" for a, b in items)
    return f"<dl>{rows}</dl>"


def table(headings: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table that becomes a list of cards where it does not fit."""
    classes = [' class="n"' if name in _NUMBERS else "" for name in headings]
    head = "".join(f"<th{c}>{escape(name)}</th>" for name, c in zip(headings, classes, strict=True))
    body = "".join(
        "<tr>"
        + "".join(
            f'<td{c} data-label="{escape(name, quote=True)}">{escape(str(cell))}</td>'
            for name, c, cell in zip(headings, classes, row, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    return f'<table class="stack"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
