"""Statistics before and after with their noise band, as strips of SVG that fit any width."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

from ugat_marl.diagnosis import statistic
from ugat_marl.reporting import diagnosis_words as words
from ugat_marl.reporting.diagnosis_words import Record

BAND = 2.0
"""Half of the noise band, in standard deviations."""
_TICKS = (0, 10, 100, 1000)


def speaking(rows: Iterable[Record]) -> tuple[list[Record], list[Record]]:
    """The statistics outside of their noise before or after, strongest first; and the others."""

    def size(row: Record) -> float:
        return max(abs(row["z_before"]), abs(row["z_after"]))

    ordered = sorted(rows, key=size, reverse=True)
    loud = [row for row in ordered if size(row) > BAND]
    return loud, ordered[len(loud) :]


def strips(rows: Sequence[Record], most: float, *, after: bool) -> str:
    """One strip per statistic: where the measured value lies in standard deviations.

    Args:
        rows: Of ``record["statistics"]``.
        most: Largest deviation on the scale.
        after: Whether there is a model to compare with.
    """
    scale = _Scale(most)
    parts = [
        '<div class="strips">',
        f'<div class="strip"><span class="soft">measured minus simulated, in standard deviations'
        f"</span>{_axis(scale)}</div>",
    ]
    for row in rows:
        text = f"measured {words.number(row['measured'])}, simulated {words.number(row['before'])}"
        if after:
            text += f" → {words.number(row['after'])}"
        text += f"\u00a0±\u00a0{words.number(row['noise'], 2)}"
        text += f"\u00a0{row['unit']}" if row["unit"] else ""
        parts.append(
            f'<div class="strip"><div>{escape(statistic(row["statistic"]))}'
            f"<small>{escape(row['regime'])} · {escape(text)}</small></div>"
            f"{_strip(row, scale, after=after)}</div>"
        )
    return "".join([*parts, "</div>"])


class _Scale:
    """Deviations to per cent of the width: straight near zero, in decades far out."""

    def __init__(self, most: float) -> None:
        self.most = max(most, 10.0)
        self._end = math.asinh(self.most / BAND)

    def __call__(self, z: float) -> str:
        z = min(max(z, -self.most), self.most)
        return f"{50 + 47 * math.asinh(z / BAND) / self._end:.2f}%"


def _axis(scale: _Scale) -> str:
    ticks = [tick for tick in _TICKS if tick <= scale.most]
    ticks = sorted({sign * tick for tick in ticks for sign in (-1, 1)})
    texts = "".join(
        f'<text x="{scale(tick)}" y="15" text-anchor="middle">{words.number(tick)}</text>'
        for tick in ticks
    )
    return f'<svg aria-hidden="true">{texts}</svg>'


def _strip(row: Record, scale: _Scale, *, after: bool) -> str:
    before, now = row["z_before"], row["z_after"]
    label = f"before {words.signed(before)}" + (f", after {words.signed(now)}" if after else "")
    low, high = (float(scale(end).rstrip("%")) for end in (-BAND, BAND))
    parts = [
        f'<svg role="img" aria-label="{escape(label, quote=True)}"><title>{escape(label)}</title>',
        f'<rect class="band" x="{low:.2f}%" y="0" width="{high - low:.2f}%" height="22"/>',
        '<line class="axis" x1="50%" x2="50%" y1="0" y2="22"/>',
    ]
    if after:
        parts.append(f'<line class="way" x1="{scale(before)}" x2="{scale(now)}" y1="11" y2="11"/>')
    parts.append(f'<circle class="dot-before" cx="{scale(before)}" cy="11" r="5"/>')
    if after:
        parts.append(f'<circle class="dot-after" cx="{scale(now)}" cy="11" r="4.5"/>')
    return "".join([*parts, "</svg>"])
