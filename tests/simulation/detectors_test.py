"""Passages read from the events of SUMO's loops, written by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ugat_marl.scenarios import Detector, DetectorClock, Passages
from ugat_marl.simulation import read_passages

POINT = Detector("d", "in_0", 10.0, 0.0, "stop", clock="signals")
ZONE = Detector("d", "in_0", 10.0, 5.0, "stop", clock="signals")


def passages(file: Path, detector: Detector, *events: tuple[str, float, str]) -> Passages:
    """Return the passages of one vehicle, from its events at the loops of a detector."""
    rows = (
        f'<instantOut id="{loop}" time="{time:.2f}" state="{state}" vehID="v" '
        'speed="5.00" length="5.00" type="car"/>\n'
        for loop, time, state in events
    )
    file.write_text("".join(rows))
    return read_passages(file, [detector], 0.0, 1000.0, 0.0)["d"]


@pytest.mark.parametrize(("detector", "end"), [(POINT, "d"), (ZONE, "d@end")])
def test_a_vehicle_that_comes_twice_passes_twice(
    detector: Detector, end: str, tmp_path: Path
) -> None:
    seen = passages(
        tmp_path / "loops.xml",
        detector,
        *(("d", 100, "enter"), (end, 101, "leave"), ("d", 400, "enter"), (end, 401, "leave")),
    )
    assert seen.on_s.tolist() == [100, 400]
    assert seen.off_s.tolist() == [101, 401]


def test_visits_without_an_entry_or_an_exit_keep_their_own_times(tmp_path: Path) -> None:
    """A vehicle may change lanes onto a zone, and off it; it comes back after some minutes."""
    seen = passages(
        tmp_path / "loops.xml",
        ZONE,
        ("d@end", 50, "leave"),
        ("d", 100, "enter"),
        *(("d", 400, "enter"), ("d@end", 401, "leave")),
        ("d@end", 700, "leave"),
    )
    order = np.argsort(np.where(np.isnan(seen.on_s), seen.off_s, seen.on_s))
    nan = np.nan
    np.testing.assert_array_equal(seen.on_s[order], [nan, 100, 400, nan])
    np.testing.assert_array_equal(seen.off_s[order], [50, nan, 401, 700])


@pytest.mark.parametrize(("clock", "later_s"), [("signals", 0.5), ("sumo", 0.0), (None, 0.0)])
def test_stamps_of_sumo_are_a_step_ahead_of_the_signals(
    clock: DetectorClock | None, later_s: float, tmp_path: Path
) -> None:
    file = tmp_path / "loops.xml"
    passages(file, POINT, ("d", 100, "enter"), ("d", 101, "leave"))
    seen = read_passages(file, [replace(POINT, clock=clock)], 0.0, 1000.0, 0.5)["d"]
    assert (seen.on_s.tolist(), seen.off_s.tolist()) == ([100 + later_s], [101 + later_s])


@pytest.mark.parametrize("elsewhere", [False, True])
def test_who_was_seen_elsewhere_since_is_not_on_the_zone(elsewhere: bool, tmp_path: Path) -> None:
    """It entered before the period; without another event it stands there throughout."""
    file = tmp_path / "loops.xml"
    passages(file, ZONE, ("d", 100, "enter"), *(elsewhere * [("other", 150, "enter")]))
    seen = read_passages(file, [ZONE], 200.0, 1000.0, 0.0)
    assert len(seen.get("d", ())) == (0 if elsewhere else 1)
