"""Pictures: matplotlib figures that are written as SVG for a page, as an SVG file and as PNG.

On a page every colour is a custom property of CSS. A dark page therefore shows a dark picture. Text
stays text. Names from foreign files are escaped and never read as formulas.
"""

from __future__ import annotations

import io
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ugat_marl.files import write_whole
from ugat_marl.reporting.style import LIGHT, curve_style, styled

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 480.0
"""Width of a picture in points, which are also the units of its SVG."""
TOP = 34.0
"""Height of a picture's title, in points."""
LEGEND = 19.0
"""Height of a line of a legend, in points."""
_DPI = 144
_TIP = "tip: "
_FONTS = 'system-ui, "Segoe UI", Roboto, Arial, sans-serif'
_NAMES = {colour: name for name, colour in LIGHT.items()}
_SVG = "{http://www.w3.org/2000/svg}"
_HREF = "{http://www.w3.org/1999/xlink}href"
_USED = re.compile(r"url\(#([^)]+)\)")


def picture_name(*parts: str) -> str:
    """Return the name of a picture's files made from some texts, without an ending."""
    text = re.sub(r"[^A-Za-z0-9_=+.]+", "-", "-".join(filter(None, parts)))
    return text.strip("-.")[-80:].strip("-.") or "picture"


@dataclass
class NamedFigure:
    """One picture.

    Attributes:
        name: Name of its files, without an ending.
        title: Title, which is also the text for readers who cannot see the picture.
        figure: A `matplotlib.figure.Figure` that pyplot does not know, so that it needs no closing.
    """

    name: str
    title: str
    figure: Figure

    def for_page(self) -> str:
        """Return an ``<svg>`` for a page whose style defines the palette as custom properties."""
        root = self._parsed()
        width, height = root.attrib.pop("width"), root.attrib.pop("height")
        assert width and height
        for element in root.iter():
            element.tag = element.tag.removeprefix(_SVG)
            if _HREF in element.attrib:
                element.set("href", element.attrib.pop(_HREF))
            if "style" in element.attrib:
                element.set("style", re.sub(r"#[0-9a-f]{6}", _variable, element.attrib["style"]))
        return ET.tostring(root, encoding="unicode")

    def svg(self) -> str:
        """Return an SVG document of its own, in the light colours."""
        root = self._parsed()
        root.set("font-family", _FONTS)
        background = ET.Element("rect", width="100%", height="100%", fill=LIGHT["paper"])
        root.insert(1, background)
        for element in root.iter():
            element.tag = element.tag.removeprefix(_SVG)
            if _HREF in element.attrib:
                element.set("xlink:href", element.attrib.pop(_HREF))
        root.set("xmlns", "http://www.w3.org/2000/svg")
        root.set("xmlns:xlink", "http://www.w3.org/1999/xlink")
        body = ET.tostring(root, encoding="unicode")
        return f'<?xml version="1.0" encoding="utf-8"?>\n{body}\n'

    def png(self) -> bytes:
        """Return the picture in pixels, two per point, in the light colours."""
        content = io.BytesIO()
        with styled():
            self.figure.savefig(
                content, format="png", dpi=_DPI, facecolor=LIGHT["paper"],
                metadata={"Software": None},
            )  # fmt: skip
        return content.getvalue()

    def write(self, directory: Path) -> list[Path]:
        """Write the picture as SVG and as PNG, and return the two files."""
        files = directory / f"{self.name}.svg", directory / f"{self.name}.png"
        write_whole(files[0], self.svg())
        write_whole(files[1], self.png())
        return list(files)

    def _parsed(self) -> ET.Element:
        """Return matplotlib's SVG with a title, without parts that may occur once per page."""
        content = io.BytesIO()
        with styled(self.name):
            self.figure.savefig(content, format="svg", metadata={"Date": None})
        root = ET.fromstring(content.getvalue())
        for parent in (root, *root.findall(f"{_SVG}defs")):
            for child in [*parent.findall(f"{_SVG}metadata"), *parent.findall(f"{_SVG}style")]:
                parent.remove(child)  # the style would apply to the whole page
        root.set("style", "stroke-linejoin: round; stroke-linecap: butt")
        root.set("role", "img")
        root.set("aria-label", printable(self.title))
        title = ET.Element(f"{_SVG}title")
        title.text = printable(self.title)
        root.insert(0, title)
        _clean(root)
        return root


def _clean(root: ET.Element) -> None:
    """Turn the ids of `add_tip` into tool tips, and drop all that no page needs.

    These are ids without a reference, fonts, blanks and surplus decimals.
    """
    used = {element.attrib[_HREF][1:] for element in root.iter() if _HREF in element.attrib}
    used |= {m for element in root.iter() for m in _USED.findall(element.get("clip-path", ""))}
    for element in root.iter():
        name = element.get("id", "")
        if name not in used:
            element.attrib.pop("id", None)
        if name.startswith(_TIP):
            tip = ET.Element(f"{_SVG}title")
            tip.text = name.removeprefix(_TIP)
            element.insert(0, tip)
        if element.tag == f"{_SVG}text":
            style = re.sub(r"font-family: [^;]*;? ?", "", element.get("style", ""))
            element.set("style", re.sub(r"font: ([\d.]+px) [^;]*", r"font-size: \1", style))
        if "d" in element.attrib:
            element.set("d", _shortened_path(element.attrib["d"]))
        if element.text is not None and not element.text.strip():
            element.text = None
        if element.tail is not None and not element.tail.strip():
            element.tail = None


def _shortened_path(path: str) -> str:
    """Return a path with two decimals: a hundredth of a point is exact enough."""
    text = re.sub(r"-?\d+\.\d+", lambda m: f"{float(m[0]):.2f}".rstrip("0").rstrip("."), path)
    return re.sub(r"\s*\n\s*", "", text)


def _variable(match: re.Match[str]) -> str:
    name = _NAMES.get(match[0])
    return f"var(--{name})" if name else match[0]


def write_png(picture: NamedFigure, path: Path) -> None:
    """Write a picture as PNG to a given path."""
    write_whole(path, picture.png())


def new_picture(name: str, title: str, height: float, width: float = WIDTH) -> NamedFigure:
    """Return an empty picture with its title at the top; sizes are in points."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / 72, height / 72))
    picture = NamedFigure(name, title, figure)
    text = printable(shortened(title, int((width - 16) / 9.3)))
    figure.text(8 / width, 1 - 20 / height, text, fontsize=14, fontweight="bold")
    return picture


def add_axes(
    picture: NamedFigure, left: float, top: float, right: float, bottom: float, **more: Any
) -> Axes:
    """Return axes whose sides have these distances, in points, from the sides of the picture."""
    width, height = picture.figure.get_size_inches() * 72
    box = left / width, bottom / height, 1 - (left + right) / width, 1 - (top + bottom) / height
    return picture.figure.add_axes(box, **more)


_LETTERS = 60
"""Longest label of a legend, in letters; a longer one would leave the picture."""


def legend_columns(labels: Sequence[str], width: float = WIDTH) -> int:
    """Return the number of labels that fit side by side."""
    longest = min(max(map(len, labels), default=1), _LETTERS)
    return max(1, min(len(labels), int((width - 16) / (46 + 6.9 * longest))))


def legend_height(labels: Sequence[str], width: float = WIDTH) -> float:
    """Return the height in points of the legend of these labels."""
    return LEGEND * -(-len(labels) // legend_columns(labels, width)) if labels else 0.0


def add_legend(picture: NamedFigure, labels: Sequence[str], *, lines: bool = True) -> None:
    """Add a legend of curves, in the order of their numbers, at the bottom."""
    from matplotlib.lines import Line2D

    width, height = picture.figure.get_size_inches() * 72
    handles: list[Line2D] = []
    for number in range(len(labels)):
        style: dict[str, Any] = curve_style(number)
        if not lines:
            style["linestyle"] = "none"
        handles.append(Line2D([], [], **style))
    picture.figure.legend(
        handles, [printable(shortened(label, _LETTERS)) for label in labels],
        loc="lower left", fontsize=12, bbox_to_anchor=(12 / width, 5 / height),
        ncols=legend_columns(labels, width),
        labelspacing=0.35, columnspacing=1.4,
    )  # fmt: skip


def add_tip(artist: Artist, text: str) -> None:
    """Give a shape a text that a page shows when the reader points at the shape."""
    artist.set_gid(f"{_TIP}{printable(text)}")


def printable(text: str) -> str:
    """Return a text without control characters and half characters, which XML cannot hold."""
    whole = text.encode("utf-8", "replace").decode()
    return "".join(c if c.isprintable() else " " for c in whole)


def shortened(text: str, most: int) -> str:
    """Return a text of `most` characters at most, cut with an ellipsis."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


def shortened_apart(texts: Sequence[str], most: int) -> list[str]:
    """Return texts as `shortened`, or cut in the middle where two would be the same.

    Texts that are still the same have a number.
    """
    short = [shortened(text, most) for text in texts]
    counts, begin = Counter(short), most // 2
    cut = [
        label
        if counts[label] == 1 or len(text) <= most
        else f"{text[:begin]}…{text[begin + 1 - most :]}"
        for text, label in zip(texts, short, strict=True)
    ]
    every: dict[str, list[str]] = {}
    for text, label in zip(texts, cut, strict=True):
        own = every.setdefault(label, [])
        own += [] if text in own else [text]
    return [
        label if len(every[label]) == 1 else f"{label} ({every[label].index(text) + 1})"
        for text, label in zip(texts, cut, strict=True)
    ]
