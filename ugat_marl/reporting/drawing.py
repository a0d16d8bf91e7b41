"""Pictures drawn once and written as SVG for a page, as an SVG file, and as PNG.

Coordinates go right and down, in units of about a pixel. Colours are names of `palette`, so that
a page shows the same picture in light and in dark. Texts are other people's: they are escaped, and
never read as formulas.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from ugat_marl.reporting.palette import LIGHT

Point = tuple[float, float]
_ANCHORS = {"start": "left", "middle": "center", "end": "right"}
_FONTS = 'system-ui, "Segoe UI", Roboto, Arial, sans-serif'


@dataclass(frozen=True)
class _Shape:
    points: tuple[Point, ...]
    fill: str | None
    stroke: str | None
    width: float = 0.0
    dash: tuple[float, ...] = ()
    opacity: float = 1.0
    closed: bool = True
    title: str = ""


@dataclass(frozen=True)
class _Text:
    x: float
    y: float
    text: str
    size: float
    colour: str
    anchor: str
    bold: bool
    halo: str | None


@dataclass
class Drawing:
    """One picture.

    Attributes:
        name: What its files are called, without an ending.
        title: What it shows, for those who cannot see it and for its files.
        width: In units.
        height: In units.
    """

    name: str
    title: str
    width: float
    height: float
    _parts: list[_Shape | _Text] = field(default_factory=list)

    def line(
        self,
        points: Sequence[Point],
        colour: str,
        width: float = 1.5,
        dash: Sequence[float] = (),
        *,
        title: str = "",
    ) -> None:
        """An open line through the points."""
        parts = tuple(points), None, colour, width, tuple(dash)
        self._parts.append(_Shape(*parts, closed=False, title=title))

    def area(
        self, points: Sequence[Point], colour: str, opacity: float = 1.0, *, title: str = ""
    ) -> None:
        """A filled polygon."""
        self._parts.append(_Shape(tuple(points), colour, None, opacity=opacity, title=title))

    def box(
        self, x: float, y: float, width: float, height: float, colour: str, *, title: str = ""
    ) -> None:
        """A filled rectangle from its upper left corner."""
        ends = (x, y), (x + width, y), (x + width, y + height), (x, y + height)
        self.area(ends, colour, title=title)

    def dot(
        self, at: Point, size: float, colour: str, marker: str = "circle", *, title: str = ""
    ) -> None:
        """A marker of `palette.MARKERS` with `size` units from the middle to its rim."""
        points = _marker(marker, at, size)
        if marker == "cross":
            for half in (points[:2], points[2:]):
                self.line(half, colour, 2.0, title=title)
        elif marker == "ring":
            self._parts.append(_Shape(points, "paper", colour, 2.0, title=title))
        else:
            self._parts.append(_Shape(points, colour, "paper", 0.8, title=title))

    def disc(self, at: Point, size: float, fill: str, stroke: str, *, title: str = "") -> None:
        """A circle with a rim."""
        self._parts.append(_Shape(_marker("circle", at, size), fill, stroke, 1.2, title=title))

    def text(
        self,
        at: Point,
        text: str,
        size: float = 13,
        colour: str = "ink",
        anchor: str = "start",
        *,
        bold: bool = False,
        halo: str | None = None,
    ) -> None:
        """One line of text; `at` is on its base line."""
        self._parts.append(_Text(*at, printable(text), size, colour, anchor, bold, halo))

    def svg(self) -> str:
        """An ``<svg>`` for a page whose style defines the palette as custom properties."""
        return self._svg("", lambda name: f"var(--{name})")

    def svg_file(self) -> str:
        """An SVG document of its own, in the light colours."""
        size = f'xmlns="http://www.w3.org/2000/svg" width="{self.width:g}" height="{self.height:g}"'
        background = f'<rect width="100%" height="100%" fill="{LIGHT["paper"]}"/>'
        body = self._svg(f" {size} font-family='{_FONTS}'", lambda name: LIGHT[name], background)
        return f'<?xml version="1.0" encoding="utf-8"?>\n{body}\n'

    def png(self) -> bytes:
        """The picture in pixels, two per unit, in the light colours."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(self.width / 100, self.height / 100), dpi=200)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_xlim(0, self.width)
        axes.set_ylim(self.height, 0)
        axes.axis("off")
        for number, part in enumerate(self._parts):
            if isinstance(part, _Text):
                _draw_text(axes, part, number)
            else:
                _draw_shape(axes, part, number)
        content = io.BytesIO()
        figure.savefig(content, format="png", facecolor=LIGHT["paper"], metadata={"Software": None})
        return content.getvalue()

    def _svg(self, attributes: str, colour: Any, background: str = "") -> str:
        label = escape(printable(self.title), quote=True)
        parts = [
            f'<svg{attributes} viewBox="0 0 {self.width:g} {self.height:g}" role="img" '
            f'aria-label="{label}"><title>{label}</title>{background}'
        ]
        for part in self._parts:
            text = isinstance(part, _Text)
            parts.append(_svg_text(part, colour) if text else _svg_shape(part, colour))
        return "".join([*parts, "</svg>"])


def printable(text: str) -> str:
    """Text without what no XML or font can hold: control characters and halves of characters."""
    whole = text.encode("utf-8", "replace").decode()
    return "".join(c if c.isprintable() else " " for c in whole)


def width_of(text: str, size: float = 13) -> float:
    """About how many units a text is wide."""
    return 0.56 * size * len(text)


def shortened(text: str, most: int) -> str:
    """A text with an ellipsis in place of what is too much."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


def _marker(marker: str, at: Point, size: float) -> tuple[Point, ...]:
    x, y = at
    if marker == "square":
        r = 0.88 * size
        return (x - r, y - r), (x + r, y - r), (x + r, y + r), (x - r, y + r)
    if marker == "cross":
        r = size
        return (x - r, y - r), (x + r, y + r), (x - r, y + r), (x + r, y - r)
    corners = {"triangle": 3, "diamond": 4}.get(marker, 24)
    r = size * (1.15 if corners < 24 else 1.0)
    angles = [2 * math.pi * k / corners - math.pi / 2 for k in range(corners)]
    return tuple((x + r * math.cos(angle), y + r * math.sin(angle)) for angle in angles)


def _svg_shape(shape: _Shape, colour: Any) -> str:
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in shape.points)
    tag = "polygon" if shape.closed else "polyline"
    found = [f'<{tag} points="{points}" fill="{colour(shape.fill) if shape.fill else "none"}"']
    if shape.stroke:
        found.append(f' stroke="{colour(shape.stroke)}" stroke-width="{shape.width:g}"')
        found.append(' stroke-linejoin="round"' * (not shape.closed))
    if shape.dash:
        found.append(f' stroke-dasharray="{" ".join(f"{n:g}" for n in shape.dash)}"')
    if shape.opacity < 1:
        found.append(f' fill-opacity="{shape.opacity:g}"')
    if shape.title:
        return "".join([*found, f"><title>{escape(printable(shape.title))}</title></{tag}>"])
    return "".join([*found, "/>"])


def _svg_text(text: _Text, colour: Any) -> str:
    style = f"fill:{colour(text.colour)}"
    if text.halo:
        style += f";stroke:{colour(text.halo)};stroke-width:{text.size / 4:.1f};paint-order:stroke"
        style += ";stroke-linejoin:round"
    bold = ' font-weight="600"' if text.bold else ""
    return (
        f'<text x="{text.x:.1f}" y="{text.y:.1f}" font-size="{text.size:g}" '
        f'text-anchor="{text.anchor}"{bold} style="{style}">{escape(text.text)}</text>'
    )


_POINTS = 0.72  # of type, in a unit


def _draw_shape(axes: Any, shape: _Shape, order: int) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Polygon

    if shape.closed:
        patch = Polygon(
            shape.points,
            facecolor=(LIGHT[shape.fill] if shape.fill else "none"),
            alpha=shape.opacity,
            edgecolor=(LIGHT[shape.stroke] if shape.stroke else "none"),
            linewidth=shape.width * _POINTS,
            zorder=order,
        )
        axes.add_patch(patch)
        return
    x, y = zip(*shape.points, strict=True)
    line = Line2D(x, y, color=LIGHT[str(shape.stroke)], linewidth=shape.width * _POINTS)
    line.set_zorder(order)
    if shape.dash:
        dash = [length / max(shape.width, 1e-9) for length in shape.dash]
        line.set_linestyle((0, dash if len(dash) % 2 == 0 else dash * 2))
    axes.add_line(line)


def _draw_text(axes: Any, text: _Text, order: int) -> None:
    from matplotlib.patheffects import withStroke

    drawn = axes.text(
        text.x, text.y, text.text, fontsize=text.size * _POINTS, color=LIGHT[text.colour],
        ha=_ANCHORS[text.anchor], va="baseline", fontweight="bold" if text.bold else "normal",
        parse_math=False, zorder=order,
    )  # fmt: skip
    if text.halo:
        effect = withStroke(linewidth=text.size / 4 * _POINTS, foreground=LIGHT[text.halo])
        drawn.set_path_effects([effect])
