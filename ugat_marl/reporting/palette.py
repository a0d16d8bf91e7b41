"""Colours of pictures: told apart by the colour-blind, in light and in dark.

The first four curves have the colours of Okabe and Ito (Color Universal Design, 2008), and all have
markers and dashes of their own, so that colour is never the only difference.
"""

from __future__ import annotations

LIGHT = {
    "paper": "#ffffff", "ink": "#1b2430", "soft": "#5a6675", "line": "#d9dfe6",
    "card": "#f5f7f9", "road": "#d3d9e0",
    "c0": "#0072b2", "c1": "#d55e00", "c2": "#009e73", "c3": "#cc79a7", "c4": "#1b2430",
    "c5": "#7711dd",
    "q0": "#eaf1f8", "q1": "#c9ddf0", "q2": "#9dc4e3", "q3": "#63a3d0", "q4": "#3580bb",
    "q5": "#185a98", "q6": "#08306b",
}  # fmt: skip
DARK = {
    "paper": "#12161b", "ink": "#e5eaf0", "soft": "#9ba8b6", "line": "#2d3640",
    "card": "#1a2027", "road": "#3a444f",
    "c0": "#56b4e9", "c1": "#f0833a", "c2": "#2fc79b", "c3": "#e3a3c6", "c4": "#e5eaf0",
    "c5": "#bb33ee",
    "q0": "#1d2a38", "q1": "#1f3f5f", "q2": "#21578a", "q3": "#3176b5", "q4": "#5f9cd3",
    "q5": "#9cc6ec", "q6": "#e0efff",
}  # fmt: skip
CURVES = ("c0", "c1", "c2", "c3", "c4", "c5")
"""Of curves and dots, in the order in which they are used."""
MARKERS = ("circle", "square", "triangle", "diamond", "cross", "ring")
DASHES: tuple[tuple[float, ...], ...] = ((), (7, 3), (2, 2.5), (9, 3, 2, 3), (5, 2), (1, 3))
STEPS = tuple(f"q{number}" for number in range(7))
"""Of areas, from little to much; the first is nearly the colour of the page."""


def step(value: float, low: float, high: float) -> str:
    """The colour of a value on a scale that is cut into equal steps."""
    if high <= low:
        return STEPS[0]
    place = int((value - low) / (high - low) * len(STEPS))
    return STEPS[min(max(place, 0), len(STEPS) - 1)]


def on(colour: str) -> str:
    """The colour of text that is read on one of `STEPS`."""
    return "paper" if colour in STEPS[4:] else "ink"
