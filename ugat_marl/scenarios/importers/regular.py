"""Grids and arterials of any size, as the shipped scenarios are: one lane for left turns."""

from __future__ import annotations

import re
from pathlib import Path

from ugat_marl.errors import OptionError
from ugat_marl.files import write_whole
from ugat_marl.progress import Reporter
from ugat_marl.scenarios.importers.making import NETWORK, Draft, Roads
from ugat_marl.scenarios.importers.plan import Plan, convert, grid, plain_xml

SIDE_STREET = ("sr", "l")
MAIN_ROAD = ("sr", "s", "l")
_NETCONVERT = {
    "tls.cycle.time": 90, "tls.left-green.time": 10, "tls.minor-left.max-speed": 0,
    "tls.yellow.time": 3, "tls.allred.time": 2,
}  # fmt: skip
MOST = 2500
"""Intersections in a grid."""


def rectangle(text: str, spacing_m: float, speed_mps: float) -> Roads:
    """A grid.

    Args:
        text: ``RxC``, rows and columns.
        spacing_m: Between intersections, and of the roads into the network.
        speed_mps: Speed limit.

    Raises:
        OptionError: Not a size, or an impossible one.
    """
    match = re.fullmatch(r"(\d{1,4})[x×X](\d{1,4})", text.strip())
    rows, columns = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (rows and columns and rows * columns <= MOST):
        raise OptionError(
            f"--grid {text!r}: give rows and columns, as in 4x4; at most {MOST} intersections"
        )
    _check(spacing_m, speed_mps)
    plan = grid(columns, rows, spacing_m, spacing_m, SIDE_STREET, SIDE_STREET)
    words = f"{rows} by {columns} intersections, {spacing_m:g} m apart"
    return _drawn(plan, speed_mps, f"A grid of {words}")


def arterial(count: int, spacing_m: float, speed_mps: float) -> Roads:
    """A main road from west to east with side streets.

    Args:
        count: Intersections.
        spacing_m: Between them, and of the roads into the network.
        speed_mps: Speed limit.

    Raises:
        OptionError: An impossible size.
    """
    if not 1 <= count <= MOST:
        raise OptionError(f"--arterial {count}: give 1 to {MOST} intersections")
    _check(spacing_m, speed_mps)
    plan = grid(count, 1, spacing_m, spacing_m, MAIN_ROAD, SIDE_STREET)
    words = f"{count} intersections, {spacing_m:g} m apart"
    return _drawn(plan, speed_mps, f"A main road with {words}")


def _check(spacing_m: float, speed_mps: float) -> None:
    if not 50 <= spacing_m <= 5000:
        raise OptionError(f"--spacing-m {spacing_m:g} is not within 50 to 5000 m")
    if not 1 <= speed_mps <= 60:
        raise OptionError(f"--speed-mps {speed_mps:g} is not within 1 to 60 m/s")


def _drawn(plan: Plan, speed_mps: float, description: str) -> Roads:
    def roads(folder: Path, reporter: Reporter) -> Draft:
        del reporter
        write_whole(folder / NETWORK, convert(plain_xml(plan, speed_mps), _NETCONVERT))
        return Draft(
            description,
            "Drawn by the suite and built by SUMO's netconvert: every approach has a lane for left "
            f"turns beside those straight on and right; the speed limit is {speed_mps:g} m/s, and "
            "there are no U-turns. Nobody else has rights in it.",
            settings={"control": {"phases": "conflict-free"}},
        )

    return roads
