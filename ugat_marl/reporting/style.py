"""The look of every page and picture: one palette in light and dark, markers, dashes, one style.

Curves have the colours of Okabe and Ito (Color Universal Design, 2008), which differ for every kind
of colour blindness. Each curve also has its own marker and dashes, so that colour is never the only
difference. Scales of areas go from light to dark, on a dark page from dark to light.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

LIGHT = {
    "paper": "#ffffff", "ink": "#1b2430", "soft": "#5a6675", "line": "#d9dfe6",
    "card": "#f5f7f9", "road": "#d3d9e1", "stop": "#b4bcc6",
    "c0": "#0072b2", "c1": "#d55e00", "c2": "#009e73", "c3": "#cc79a7", "c4": "#1c2430",
    "c5": "#7711dd",
    "q0": "#eaf1f8", "q1": "#c9ddf0", "q2": "#9dc4e3", "q3": "#63a3d0", "q4": "#3580bb",
    "q5": "#185a98", "q6": "#08306b",
    "d0": "#bccdd8", "d1": "#dba53f", "d2": "#d5752a", "d3": "#b5361f", "d4": "#5e0f22",
    "band": "#dce6f0", "good": "#1f7a4d", "mixed": "#9a5b00", "bad": "#a3283c",
}  # fmt: skip
"""Name to colour on light pages and in files. No two names have the same colour."""
DARK = {
    "paper": "#12161b", "ink": "#e5eaf0", "soft": "#9ba8b6", "line": "#2d3640",
    "card": "#1a2027", "road": "#333d48", "stop": "#5a6672",
    "c0": "#56b4e9", "c1": "#f0833a", "c2": "#2fc79b", "c3": "#e3a3c6", "c4": "#e5eaf0",
    "c5": "#bb33ee",
    "q0": "#1d2a38", "q1": "#1f3f5f", "q2": "#21578a", "q3": "#2b68a2", "q4": "#5f9cd3",
    "q5": "#9cc6ec", "q6": "#e0efff",
    "d0": "#4c6376", "d1": "#9c762e", "d2": "#d5823f", "d3": "#f6a58a", "d4": "#ffe0dd",
    "band": "#26364a", "good": "#63c796", "mixed": "#e6b25c", "bad": "#f08496",
}  # fmt: skip
CURVES = ("c0", "c1", "c2", "c3", "c4", "c5")
"""Colours of curves and dots, in the order of use."""
MARKERS = ("o", "s", "^", "D", "X", "v")
DASHES: tuple[Any, ...] = (
    "solid", (0, (4, 2)), (0, (1, 1.3)), (0, (5, 2, 1, 2)), (0, (3, 1)), (0, (1, 2)),
)  # fmt: skip
STEPS = tuple(f"q{number}" for number in range(7))
"""Colours of areas, from small to large values; the first is nearly the colour of the page."""
DISAGREEMENT = (
    (1.5, "as chance would"), (3.0, "1.5 to 3"), (6.0, "3 to 6"), (15.0, "6 to 15"),
    (float("inf"), "above 15"),
)  # fmt: skip
"""Upper ends of the classes of disagreement in standard deviations, drawn in ``d0`` to ``d4``."""

_RC: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 12,
    "text.color": LIGHT["ink"],
    "text.parse_math": False,  # names of other people are no formulas
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "axes.labelsize": 12,
    "axes.labelcolor": LIGHT["soft"],
    "axes.facecolor": "none",
    "axes.edgecolor": LIGHT["line"],
    "axes.linewidth": 1.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.spines.left": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": LIGHT["line"],
    "grid.linewidth": 1.0,
    "xtick.color": LIGHT["soft"],
    "ytick.color": LIGHT["soft"],
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "lines.linewidth": 2.0,
    "lines.markersize": 6.5,
    "lines.markeredgecolor": LIGHT["paper"],
    "lines.markeredgewidth": 0.8,
    "legend.frameon": False,
    "legend.borderaxespad": 0.0,
    "legend.handlelength": 2.6,
    "figure.facecolor": "none",
    "figure.edgecolor": "none",
    "figure.constrained_layout.use": False,
    "savefig.facecolor": "auto",
    "savefig.bbox": None,
    "svg.fonttype": "none",
}


@contextmanager
def styled(salt: str = "ugat") -> Iterator[None]:
    """Apply the style within a ``with`` block, or to a function as a decorator.

    Args:
        salt: Seed of the ids in SVG. With it a picture has the same bytes every time, and its ids
            differ from those of other pictures on a page.
    """
    import matplotlib as mpl

    with mpl.rc_context():
        mpl.rcdefaults()  # a user's own settings must not change the pictures
        mpl.rcParams.update({**_RC, "svg.hashsalt": salt})
        yield


def curve_style(number: int) -> dict[str, Any]:
    """Return colour, dashes and marker of a curve as arguments of matplotlib.

    Curves beyond the last colour have the same colours again, with other dashes and markers.
    """
    again = number // len(CURVES)
    return {
        "color": LIGHT[CURVES[number % len(CURVES)]],
        "linestyle": DASHES[(number + again) % len(DASHES)],
        "marker": MARKERS[(number + 2 * again) % len(MARKERS)],
    }


def step(value: float, low: float, high: float) -> str:
    """Return the name of a value's colour on a scale of equal steps from `low` to `high`."""
    if high <= low:
        return STEPS[0]
    place = int((value - low) / (high - low) * len(STEPS))
    return STEPS[min(max(place, 0), len(STEPS) - 1)]


def text_on(colour: str) -> str:
    """Return the name of a text colour that is readable on one of `STEPS`."""
    return "paper" if colour in STEPS[4:] else "ink"


def disagreement_level(z: float) -> int:
    """Return the index in `DISAGREEMENT` of a disagreement `z`, in standard deviations."""
    return sum(z >= end for end, _ in DISAGREEMENT[:-1])


def css_variables(colours: dict[str, str]) -> str:
    """Return the palette as custom properties of CSS."""
    return " ".join(f"--{name}: {colour};" for name, colour in colours.items())
