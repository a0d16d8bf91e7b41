"""A diagnosis as one page of HTML that needs nothing else: no network, no scripts.

Names come from files of other people; every text is escaped, and the page forbids itself scripts.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape, unescape
from pathlib import Path

from ugat_marl.files import write_whole
from ugat_marl.reporting import diagnosis_words as words
from ugat_marl.reporting.diagnosis_charts import speaking, strips
from ugat_marl.reporting.diagnosis_document import document
from ugat_marl.reporting.diagnosis_map import disagreement_map
from ugat_marl.reporting.diagnosis_sections import (
    courtesy,
    data,
    effects,
    heldout,
    places,
    policy_gap,
    provenance,
    ranking,
)
from ugat_marl.reporting.diagnosis_style import ABOVE, LEVELS
from ugat_marl.reporting.diagnosis_words import Record
from ugat_marl.scenarios import Network

_LOUD, _QUIET = 16, 6
"""Strips that are shown at once, of statistics outside of their noise and, if none is, inside."""
_COMMANDS = re.compile(r"<h2>Run it again</h2><pre><code>(.*?)</code></pre>", re.DOTALL)


def write_diagnosis_page(
    record: Record, network: Network, path: Path, commands: Sequence[str] = ()
) -> None:
    """Writes the page of a diagnosis.

    Args:
        record: The content of ``diagnosis.json``.
        network: Network of the scenario, for the map.
        path: Where to write.
        commands: How to run it again and what to do next, one line each.
    """
    write_whole(path, diagnosis_page(record, network, commands))


def diagnosis_page(record: Record, network: Network, commands: Sequence[str] = ()) -> str:
    """The page as text; see `write_diagnosis_page`."""
    sections = (
        effects(record),
        heldout(record),
        _map(record, network),
        _statistics(record),
        places(record),
        ranking(record),
        courtesy(record),
        policy_gap(record),
        data(record),
        provenance(record, commands),
    )
    title = f"Diagnosis of {record['scenario']}: {words.VERDICTS.get(record['verdict'], '')}"
    main = "\n".join(filter(None, sections))
    return document(title, f"{_head(record)}\n<main>\n{main}\n</main>")


def commands_on_page(path: Path) -> list[str]:
    """The commands a page shows, which its record does not hold; none where none can be read."""
    try:
        found = _COMMANDS.search(path.read_text(encoding="utf-8", errors="replace"))
    except OSError:
        return []
    return unescape(found[1]).splitlines() if found else []


def _head(record: Record) -> str:
    verdict = str(record["verdict"])
    parts = [
        f'<header><p class="soft">Diagnosis of <strong>{escape(record["scenario"])}</strong></p>'
    ]
    if (text := words.partial(record)) is not None:
        parts.append(f'<p class="partial">{escape(text)}</p>')
    name = escape(words.VERDICTS.get(verdict, verdict))
    parts.append(f'<span class="badge {escape(verdict, quote=True)}">{name}</span>')
    parts.append(f"<h1>{escape(record['sentence'])}</h1>")
    if meaning := words.meaning(record):
        parts.append(f'<p class="soft">{escape(meaning)}</p>')
    if record.get("next_measurement"):
        text = f"What would tell: {record['next_measurement']}."
        parts.append(f'<p class="note">{escape(text)}</p>')
    return "".join([*parts, "</header>"])


def _changed(record: Record, table: str, before: str, after: str) -> bool:
    """Whether there is a model beside the scenario as it is."""
    return any(row[before] != row[after] for row in record.get(table) or ())


def _map(record: Record, network: Network) -> str:
    lanes = record.get("lanes") or ()
    kinds = [("before", "The scenario as it is")]
    if _changed(record, "lanes", "before", "after"):
        kinds.append(("after", f"With {_model(record)}"))
    figures = [
        f"<figure>{svg}<figcaption>{escape(text)}</figcaption></figure>"
        for key, text in kinds
        if (svg := disagreement_map(lanes, network, key, text))
    ]
    if not figures:
        return ""
    names = [*(text for _, text in LEVELS), ABOVE]
    key = "".join(
        f'<span><i class="d{number}"></i>{text}</span>' for number, text in enumerate(names)
    )
    return (
        "<section><h2>Where they disagree</h2>"
        '<p class="soft">Lanes with detectors, coloured by the mean disagreement of their '
        "statistics in standard deviations, on the "
        f"{'fitted' if record.get('verified_on_fitted_periods') else 'held-out'} periods.</p>"
        f'<div class="key">{key}</div><div class="maps">{"".join(figures)}</div></section>'
    )


def _model(record: Record) -> str:
    """What the corrected side of the page holds."""
    return "the effects named" if record["effects"] else "the best attempt, which is not named"


def _statistics(record: Record) -> str:
    rows = record.get("statistics") or ()
    if not rows:
        return ""
    after = _changed(record, "statistics", "z_before", "z_after")
    loud, quiet = speaking(rows)
    most = max(max(abs(row["z_before"]), abs(row["z_after"])) for row in rows)
    shown, rest = loud[:_LOUD], [*loud[_LOUD:], *quiet]
    heading = "The statistics that speak" if loud else "No statistic speaks"
    if not loud:
        shown, rest = quiet[:_QUIET], quiet[_QUIET:]
    key = _dot("before", "the scenario as it is")
    key += _dot("after", f"with {_model(record)}") if after else ""
    parts = [
        f"<section><h2>{heading}</h2>"
        '<p class="soft">The shaded band is noise: two standard deviations of data sets of this '
        f'size. Beyond it the scale is logarithmic.</p><div class="key">{key}</div>',
        strips(shown, most, after=after),
    ]
    if rest:
        parts.append(
            f"<details><summary>{len(rest)} more statistics</summary>"
            f"{strips(rest, most, after=after)}</details>"
        )
    return "".join([*parts, "</section>"])


def _dot(kind: str, text: str) -> str:
    return (
        f'<span><svg width="14" height="12" aria-hidden="true"><circle class="dot-{kind}" cx="6" '
        f'cy="6" r="4.5"/></svg>{escape(text)}</span>'
    )
