"""Stretches of time with other counts than expected, on counts made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ugat_marl.data import occupied_between
from ugat_marl.diagnosis.features import BIN_FEATURES, DetectorLayout, IncomingLane
from ugat_marl.diagnosis.places import largest_stretches, most_unusual
from ugat_marl.diagnosis.statistics import Distance
from ugat_marl.diagnosis.thresholds import Thresholds

THRESHOLDS = Thresholds()

Array = NDArray[np.float64]

LANES = tuple(
    IncomingLane(f"{edge}_{lane}", edge, 0, (0,), 14.0, {})
    for edge, lane in (("a", 0), ("a", 1), ("b", 0))
)
LAYOUT = DetectorLayout(("C",), LANES, (), (), {})
BINS = 6
MINUTES = 60


def largest(difference: dict[tuple[str, int], list[float]], variance: float) -> dict[str, float]:
    """Of differences by kind of count and lane, each with the same noise; others are unused."""
    values = np.zeros((len(BIN_FEATURES) * len(LANES), BINS))
    for (kind, lane), row in difference.items():
        values[BIN_FEATURES.index(kind) * len(LANES) + lane] = row
    z = values / np.sqrt(variance)
    return largest_stretches(LAYOUT, Distance(0.0, {}, 0.0, {}, {"time": z}, {"time": values}))


def test_lanes_of_an_edge_are_added() -> None:
    row = [0.0, 2.0, 2.0, 0.0, 0.0, 0.0]
    found = largest({("count_stop", 0): row, ("count_stop", 1): row}, variance=1.0)
    assert found["lane window"] == pytest.approx((2 + 2) ** 2 / 2)
    assert found["window"] == pytest.approx((4 + 4) ** 2 / 4)


def test_a_stretch_is_as_long_as_it_helps() -> None:
    found = largest({("count_advance", 2): [-1.0, 3.0, 3.0, 3.0, -1.0, -1.0]}, variance=1.0)
    assert found == pytest.approx({"window": 9**2 / 3, "lane window": 9**2 / 3})


def test_kinds_of_counts_and_edges_are_kept_apart() -> None:
    row = [2.0, 2.0, 2.0, 2.0, 2.0, 2.0]
    one = largest({("count_stop", 0): row}, variance=1.0)
    others = {("count_stop", 0): row, ("count_advance", 0): row, ("count_exit", 2): row}
    assert largest(others, variance=1.0) == pytest.approx(one)


def test_vehicles_on_the_other_lane_are_not_missing_from_the_edge() -> None:
    row = [0.0, 3.0, 3.0, 3.0, 0.0, 0.0]
    moved = {("count_stop", 0): row, ("count_stop", 1): [-value for value in row]}
    found = largest(moved, variance=1.0)
    assert found["window"] == 0.0
    assert found["lane window"] == pytest.approx(9**2 / 3)


def test_occupied_seconds_are_those_of_a_lane() -> None:
    found = largest({("occupied", 1): [0.0, 0.0, 50.0, 0.0, 0.0, 0.0]}, variance=25.0)
    assert found == pytest.approx({"window": 0.0, "lane window": 100.0})


def test_without_counts_nothing_departs() -> None:
    assert largest({}, variance=1.0) == {"window": 0.0, "lane window": 0.0}


# --- scans over minutes --------------------------------------------------------------------------


def scan(
    changed: dict[tuple[int, int], float], side: int = 0, begin_s: float = 0.0
) -> tuple[float, float, float, float] | None:
    """An hour of 10 vehicles a minute with as much variance; others between some minutes."""
    plain = np.full(MINUTES, 10.0)
    measured = plain.copy()
    for (first, last), rate in changed.items():
        measured[first:last] = rate
    return most_unusual(measured, plain, plain, begin_s, 60.0, THRESHOLDS, side)


@pytest.mark.parametrize("side", [0, 1])
def test_a_surge_is_found_to_the_minute(side: int) -> None:
    # 225 of 150 vehicles; the noise of 150, and a third of it for the ratio of the others.
    z, begin, end, ratio = scan({(20, 35): 15.0}, side, begin_s=25200.0) or pytest.fail("none")
    assert (begin, end) == (25200.0 + 1200.0, 25200.0 + 2100.0)
    assert ratio == pytest.approx(1.5)
    assert z == pytest.approx(75.0 / np.sqrt(150.0 * (1 + 150.0 / 450.0)))


def test_a_departure_to_the_other_side_is_none() -> None:
    assert scan({(20, 35): 15.0}, side=-1) is None
    assert scan({(20, 35): 4.0}, side=1) is None
    assert scan({}) is None


def test_a_closure_is_found_and_not_the_queue_that_is_let_go() -> None:
    changed = {(20, 30): 3.0, (30, 36): 30.0}
    *_, ratio = scan(changed) or pytest.fail("none")
    assert ratio > 1, "the release is the larger of the two"
    z, begin, end, ratio = scan(changed, side=-1) or pytest.fail("none")
    assert (begin, end) == (1200.0, 1800.0)
    assert ratio < 0.4
    assert z > 4.0
    found = scan(changed, side=1) or pytest.fail("none")
    assert found[1:3] == (1800.0, 2160.0)


def test_a_period_shorter_than_any_stretch_is_not_scanned() -> None:
    rows = np.full(4, 10.0)
    assert most_unusual(3 * rows, rows, rows, 0.0, 60.0, THRESHOLDS) is None
    assert most_unusual(rows, 0 * rows, rows, 0.0, 60.0, THRESHOLDS) is None


def test_occupied_seconds_are_shared_among_minutes() -> None:
    on, off = np.array([50.0, 130.0]), np.array([70.0, 135.0])
    assert occupied_between(on, off, np.array([0.0, 60.0, 120.0, 180.0])) == pytest.approx(
        [10.0, 10.0, 5.0]
    )
