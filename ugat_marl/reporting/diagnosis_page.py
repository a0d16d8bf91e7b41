"""A diagnosis as one page of HTML that loads no other file and runs no script."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from html import unescape
from pathlib import Path
from typing import Any

from ugat_marl.diagnosis import statistic
from ugat_marl.files import write_whole
from ugat_marl.reporting import diagnosis_words as words
from ugat_marl.reporting.charts import BAND, statistics_picture
from ugat_marl.reporting.diagnosis_words import Record
from ugat_marl.reporting.formats import chance, number, share, signed
from ugat_marl.reporting.network_maps import disagreement_map
from ugat_marl.reporting.page import Figure, Grid, Page, render
from ugat_marl.reporting.style import DISAGREEMENT
from ugat_marl.scenarios import Network

_PLACES = 10
"""Number of places in the table of disagreements that is shown at once."""
_LOUD, _QUIET = 16, 6
"""Most strips that are shown at once: of statistics outside their noise, else of those inside."""
_STRIPS = 8
"""Most strips in one picture; two pictures stand side by side."""
_COMMANDS = re.compile(r"<h2>Run it again</h2>\s*<pre><code>(.*?)</code></pre>", re.DOTALL)
_BADGES = {
    "no_discrepancy": "good", "explained": "good", "not_identifiable": "mixed",
    "partially_explained": "mixed", "unknown": "bad",
}  # fmt: skip
_CRITERIA = (
    ("counts with GEH below 5 (usual: 85 %)", "geh_below_5", share),
    ("largest GEH", "geh_largest", number),
    ("FHWA I: 15 min within 1.96 σ of the typical day (95 %)", "within_2_sigma", share),
    ("FHWA II: within 1 σ (two thirds)", "within_1_sigma", share),
    ("FHWA III: detectors with bounded absolute error (all)", "absolute_error", share),
    ("FHWA IV: with bounded systematic error (all)", "systematic_error", share),
)


def write_diagnosis_page(
    record: Record, network: Network, path: Path, commands: Sequence[str] = ()
) -> None:
    """Write the page of a diagnosis.

    Args:
        record: Content of ``diagnosis.json``.
        network: Network of the scenario, for the map.
        path: File to write.
        commands: Commands that repeat the diagnosis and go on from it, one line each.
    """
    write_whole(path, diagnosis_page(record, network, commands))


def diagnosis_page(record: Record, network: Network, commands: Sequence[str] = ()) -> str:
    """Return the page as text; see `write_diagnosis_page`."""
    page = Page()
    verdict = str(record["verdict"])
    name = words.VERDICTS.get(verdict, verdict)
    heldout = record["heldout"]
    return render(
        "diagnosis.html.j2",
        title=f"Diagnosis of {record['scenario']}: {words.VERDICTS.get(verdict, '')}",
        record={"next_measurement": None, "corrected": None, "findings": (), **record},
        verdict=(_BADGES.get(verdict, ""), name),
        partial=words.partial(record),
        meaning=words.meaning(record),
        effects=_effects(record),
        judged="fitted" if record.get("verified_on_fitted_periods") else "held-out",
        heldout=_heldout(heldout) if heldout is not None else None,
        expected=number((heldout or {}).get("expected")),
        maps=_maps(page, record, network),
        map_key=[(f"d{place}", text) for place, (_, text) in enumerate(DISAGREEMENT)],
        statistics=_statistics(page, record),
        where=_where(record),
        ranking=_ranking(record),
        courtesy=_courtesy(record),
        geh=words.geh_line(record),
        policy_gap=_policy_gap(record),
        data=_data(record),
        commands=commands or _usual_commands(record),
        provenance=_provenance(record),
    )


def commands_on_page(path: Path) -> list[str]:
    """Return the commands on a page; none if the page cannot be read.

    The record of a diagnosis does not hold them.
    """
    try:
        match = _COMMANDS.search(path.read_text(encoding="utf-8", errors="replace"))
    except OSError:
        return []
    return unescape(match[1]).splitlines() if match else []


def _effects(record: Record) -> Grid | None:
    """Return a table of the named effects with intervals; None without effects."""
    rows = [
        (
            words.effect_name(effect),
            words.place(effect),
            words.window(effect.get("window")) or "always",
            words.values(effect),
            _grounds(effect.get("evidence") or {}),
        )
        for effect in record["effects"]
    ]
    headings = ("effect", "where", "when", "value (95 % interval)", "grounds")
    return Grid(headings, rows) if rows else None


def _grounds(evidence: Record) -> str:
    if "source" in evidence:
        return str(evidence["source"])
    if evidence.get("runner_up_is_worse_by") is not None:
        return f"next set of effects is worse by {number(evidence['runner_up_is_worse_by'])}"
    return ""


def _heldout(heldout: Record) -> list[tuple[str, str]]:
    """Return the numbers of the held-out periods with their labels."""
    boxes = [(number(heldout["before"]), "distance before")]
    after = heldout["shrink"] is not None
    if after:
        boxes.append((number(heldout["after"]), "distance after"))
    boxes.append((number(heldout["floor"]), "noise floor"))
    if after:
        boxes.append((share(heldout["shrink"]), "of the gap is gone"))
    boxes.append((chance(heldout["p_before"]), "p before"))
    if after:
        boxes.append((chance(heldout["p_after"]), "p after"))
    return boxes


def _changed(record: Record, table: str, before: str, after: str) -> bool:
    """Return True if the values after the correction differ from those before."""
    return any(row[before] != row[after] for row in record.get(table) or ())


def _model(record: Record) -> str:
    """Return the words for the corrected model."""
    return "the effects named" if record["effects"] else "the best attempt, which is not named"


def _maps(page: Page, record: Record, network: Network) -> list[Figure]:
    lanes = record.get("lanes") or ()
    models = [("before", "The scenario as it is")]
    if _changed(record, "lanes", "before", "after"):
        models.append(("after", f"With {_model(record)}"))
    tls = {row["tls"] for row in lanes}
    return page.figures(
        *(
            (
                disagreement_map(
                    f"map-{key}", title, network, {row["lane"]: row[key] for row in lanes}, tls
                ),
                "Point at a lane to read its disagreement.",
            )
            for key, title in models
        )
    )


def _statistics(page: Page, record: Record) -> dict[str, Any] | None:
    rows = record.get("statistics") or ()
    if not rows:
        return None
    after = _changed(record, "statistics", "z_before", "z_after")

    def size(row: Record) -> float:
        return max(abs(row["z_before"]), abs(row["z_after"]))

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
        "model": _model(record) if after else "",
        "shown": pictures("statistics", strips[:first]),
        "rest": pictures("statistics-more", strips[first:]),
        "more": len(strips[first:]),
    }


def _strip(row: Record, *, after: bool) -> tuple[str, str, float, float | None]:
    """Return the texts and deviations of a statistic."""
    text = f"measured {number(row['measured'])}, simulated {number(row['before'])}"
    if after:
        text += f" → {number(row['after'])}"
    text += f" ± {number(row['noise'], 2)}"
    text += f" {row['unit']}" if row["unit"] else ""
    remark = f"{row['regime']} · {text}"
    return statistic(row["statistic"]), remark, row["z_before"], row["z_after"] if after else None


def _where(record: Record) -> dict[str, Grid | None] | None:
    """Return tables of the places where data and simulation disagree, before and after."""
    where, left = record.get("where") or (), record.get("left") or ()
    if not where:
        return None
    return {
        "first": _disagreements(where[:_PLACES]),
        "more": _disagreements(where[_PLACES:]) if len(where) > _PLACES else None,
        "left": _disagreements(left) if left else None,
    }


def _disagreements(items: Sequence[Record]) -> Grid:
    rows = [
        (
            words.disagreement_place(item),
            item["regime"],
            statistic(item["statistic"]),
            f"{signed(item['size'])} {item['unit']}".rstrip(),
            signed(item["z"]),
            words.window(item.get("window")),
        )
        for item in items
    ]
    return Grid(("place", "regime", "statistic", "size", "z", "window"), rows, ("size", "z"))


def _ranking(record: Record) -> list[dict[str, Any]]:
    """Return the simulated explanations, the chosen one first."""
    items: list[tuple[str, Any, Any, bool]] = []
    if record["effects"]:
        grounds = (effect.get("evidence") or {} for effect in record["effects"])
        best = record.get("best") or next((own for own in grounds if "distance" in own), {})
        items.append((_set(record["effects"]), best.get("distance"), best.get("cost"), True))
    items += [
        (_set(item["effects"]), item["distance"], item["cost"], False)
        for item in record.get("alternatives") or ()
    ]
    if not record.get("alternatives"):
        return []
    most = max((float(item[1]) for item in items if item[1] is not None), default=1.0)
    return [
        {
            "effects": text,
            "distance": number(distance),
            "cost": number(cost),
            "width": f"{_logarithm(distance, most):.1f}",
            "chosen": chosen,
        }
        for text, distance, cost, chosen in items
    ]


def _logarithm(distance: Any, most: float) -> float:
    """Return the length of a bar in per cent: 100 log(1 + distance) / log(1 + most)."""
    if distance is None:
        return 0.0
    return 100 * math.log1p(max(float(distance), 0.0)) / math.log1p(max(most, 1.0))


def _set(effects: Sequence[Record]) -> str:
    return " + ".join(map(_in_words, effects))


def _in_words(effect: Record) -> str:
    place = words.place(effect)
    text = words.effect_name(effect) + ("" if place == "everywhere" else f" at {place}")
    text += f", {words.window(effect['window'])}" if effect.get("window") else ""
    return f"{text} ({words.values(effect, intervals=False)})" if effect["parameters"] else text


def _courtesy(record: Record) -> Grid | None:
    """Return the usual criteria of traffic engineering."""
    tables = record.get("courtesy") or {}
    if not tables:
        return None
    before, after = tables.get("before") or {}, tables.get("after") or {}
    measured = tables.get("measured") or {}
    rows = [(name, "", say(before.get(key)), say(after.get(key))) for name, key, say in _CRITERIA]
    key = "saturation_headway_s"
    headways = number(measured.get(key)), number(before.get(key)), number(after.get(key))
    rows.append(("discharge headway, 4th vehicle on (s)", *headways))
    if times := record.get("travel_time"):
        both = number(times.get("before_s")), number(times.get("after_s"))
        rows.append(("mean travel time (s)", "", *both))
    columns = ("measured", "before", "after")
    return Grid(("criterion", *columns), rows, columns)


def _policy_gap(record: Record) -> Grid | None:
    """Return travel times of policies in both simulations and in the real domain, if measured."""
    gap = record.get("policy_gap")
    if not isinstance(gap, Mapping) or not gap:
        return None
    rows = [
        (
            str(name),
            *(_mean(item.get(world)) for world in ("sim", "corrected", "real")),
            number(item.get("before")),
            number(item.get("after")),
            share(item.get("shrink")),
        )
        for name, item in gap.items()
    ]
    headings = ("policy", "sim (s)", "corrected (s)", "real (s)", "before", "after", "shrink")
    return Grid(headings, rows, headings[4:])


def _mean(item: Any) -> str:
    """Return a mean with its interval."""
    if not isinstance(item, Mapping):
        return "–"
    if item.get("low") is None or item.get("high") is None:
        return number(item.get("mean"))
    return f"{number(item.get('mean'))} ({number(item['low'])} to {number(item['high'])})"


def _data(record: Record) -> list[tuple[str, str]]:
    periods = record["periods"]
    return [
        ("fitted periods", ", ".join(map(str, periods["fit"]))),
        ("held-out periods", ", ".join(map(str, periods["heldout"])) or "none"),
        ("the data cannot show", words.joined(record.get("ruled_out") or ()) or "all can be seen"),
        ("left out on request", words.joined(record.get("left_out") or ()) or "nothing"),
    ]


def _provenance(record: Record) -> list[tuple[str, str]]:
    return [
        ("schema", str(record["schema"])),
        ("seed", str(record["seed"])),
        ("level of the tests", number(record["alpha"])),
        ("budget", f"{number(record['budget_s'])} s"),
        *((f"version of {name}", str(text)) for name, text in record["versions"].items()),
        *((f"SHA-256 of the {name}", str(text)) for name, text in record["hashes"].items()),
    ]


def _usual_commands(record: Record) -> list[str]:
    """Return the commands with words in capitals for the paths, which no record holds."""
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
