"""The network with its lanes coloured by how much data and simulation disagree, as SVG."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from ugat_marl.reporting import diagnosis_words as words
from ugat_marl.reporting.diagnosis_style import level
from ugat_marl.reporting.diagnosis_words import Record
from ugat_marl.scenarios import Network

Point = tuple[float, float]

_NAMED = 30
"""With more intersections than this their names would cover the roads."""
_LANE_M = 2.6
_MARGIN_M = (90.0, 220.0)


def disagreement_map(lanes: Sequence[Record], network: Network, key: str, title: str) -> str:
    """One map.

    Args:
        lanes: Records with ``lane``, ``tls`` and the root mean square of the standardised
            differences under `key`.
        network: Where the lanes are.
        key: ``before`` or ``after``.
        title: For those who cannot see it.

    Returns:
        An ``<svg>``; empty if no lane of the record is in the network.
    """
    known = [item for item in lanes if item["lane"] in network.lanes]
    if not known:
        return ""
    shown = {item["tls"] for item in known}
    centres = {item.id: item.position for item in network.intersections if item.id in shown}
    low, high = _frame(centres.values() or [network.lanes[known[0]["lane"]].shape[-1]])
    width, height = high[0] - low[0], high[1] - low[1]
    wide = width > 2 * height
    stroke = max(_LANE_M, max(width, height) / (180 if wide else 130))
    parts = [
        f'<svg class="{"wide" if wide else "square"}" '
        f'viewBox="{low[0]:.1f} {-high[1]:.1f} {width:.1f} {height:.1f}" role="img" '
        f'aria-label="{escape(title, quote=True)}">',
        f'<path class="road" stroke-width="{stroke:.2f}" d="{_roads(network, low, high)}"/>',
    ]
    for item in sorted(known, key=lambda one: one[key]):  # the strongest is drawn on top
        text = f"{item['lane']}: {words.number(item[key])} standard deviations"
        parts.append(
            f'<polyline class="lane d{level(item[key])}" stroke-width="{stroke:.2f}" points="'
            f'{" ".join(_point(p) for p in network.lanes[item["lane"]].shape)}">'
            f"<title>{escape(text)}</title></polyline>"
        )
    if len(centres) <= _NAMED:
        parts += _names(centres, max(width, height) / (42 if wide else 28))
    return "".join([*parts, "</svg>"])


def _frame(points: Iterable[Point]) -> tuple[Point, Point]:
    """What is shown: the intersections and some road around them."""
    x, y = zip(*points, strict=True)
    extent = max(max(x) - min(x), max(y) - min(y))
    margin = min(max(_MARGIN_M[0], 0.3 * extent), _MARGIN_M[1])
    return (min(x) - margin, min(y) - margin), (max(x) + margin, max(y) + margin)


def _roads(network: Network, low: Point, high: Point) -> str:
    """All lanes that reach into the frame, as one path."""
    found: list[str] = []
    for lane in network.lanes.values():
        x = [point[0] for point in lane.shape]
        y = [point[1] for point in lane.shape]
        if not x or max(x) < low[0] or min(x) > high[0] or max(y) < low[1] or min(y) > high[1]:
            continue
        found.append("M" + "L".join(_point(point) for point in lane.shape))
    return "".join(found)


def _names(centres: dict[str, Point], size: float) -> list[str]:
    return [
        f'<text class="place" x="{x:.1f}" y="{-y:.1f}" font-size="{size:.1f}" '
        f'stroke-width="{size / 4:.1f}" text-anchor="middle" dominant-baseline="central">'
        f"{escape(name if len(name) <= 14 else name[:13] + '…')}</text>"
        for name, (x, y) in centres.items()
    ]


def _point(point: Point) -> str:
    return f"{point[0]:.1f},{-point[1]:.1f}"
