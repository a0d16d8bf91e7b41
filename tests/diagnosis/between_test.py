"""Turning counts and travel times of probes: sums by hand, planted turns, planted slow roads."""

from __future__ import annotations

import math

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import MeasuredData
from ugat_marl.diagnosis.between import TRAVEL_TIME, TURNING, Between
from ugat_marl.diagnosis.features import BIN_FEATURES, FEATURES, DetectorLayout, IncomingLane, Tally
from ugat_marl.diagnosis.places import turned
from ugat_marl.diagnosis.statistics import Pools, Reference
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.scenarios import Period
from ugat_marl.simulation import Place

THRESHOLDS = Thresholds()
PERIODS = (Period("one", 0.0, 900.0, "fit", {}, {}), Period("two", 0.0, 900.0, "heldout", {}, {}))


def turning(*rows: tuple[str, float, float, str, str, float]) -> pl.DataFrame:
    names = ("period_id", "begin_s", "end_s", "from_edge", "to_edge", "count")
    return pl.DataFrame(rows, schema=names, orient="row")


def probes(*rows: tuple[str, float, str, float, str, float, float]) -> pl.DataFrame:
    names = ("period_id", "time_s", "from_edge", "from_m", "to_edge", "to_m", "travel_s")
    return pl.DataFrame(rows, schema=names, orient="row")


MEASURED = MeasuredData(
    (),
    PERIODS,
    turning=turning(
        ("one", 0.0, 300.0, "a", "x", 7.0),
        ("one", 600.0, 900.0, "a", "x", 5.0),
        ("one", 0.0, 300.0, "a", "y", 3.0),
        ("two", 0.0, 900.0, "a", "y", 30.0),
    ),
    travel_times=probes(
        ("one", 10.0, "a", 5.0, "x", 80.0, 40.0),
        ("one", 20.0, "a", 5.0, "x", 80.0, 60.0),
        ("two", 30.0, "b", 0.0, "x", 80.0, 33.0),
    ),
)


def test_measured_sums_are_vehicles_and_minutes_and_seconds() -> None:
    found = Between.of(MEASURED)
    assert found is not None
    assert found.turns == (("a", "x"), ("a", "y"))
    assert found.ways == ((Place("a", 5.0), Place("x", 80.0)), (Place("b", 0.0), Place("x", 80.0)))
    assert found.followed[0] == (Place("a", math.inf), Place("x", 0.0))
    one, two = found.measured("one"), found.measured("two")
    assert one[TURNING].tolist() == [[[12.0, 10.0]], [[3.0, 5.0]]]
    assert two[TURNING].tolist() == [[[0.0, 0.0]], [[30.0, 15.0]]]
    assert one[TRAVEL_TIME].tolist() == [[[100.0, 2.0]], [[0.0, 0.0]]]
    assert two[TRAVEL_TIME].tolist() == [[[0.0, 0.0]], [[33.0, 1.0]]]


def test_simulated_vehicles_count_where_the_street_was_counted() -> None:
    found = Between.of(MEASURED)
    assert found is not None
    came = np.array([[10.0, 4.0], [299.0, 5.0], [300.0, 4.0], [700.0, 3.0], [900.0, 3.0]])
    seen = [came, came, np.array([[5.0, 44.0], [6.0, 46.0]]), np.empty((0, 2))]
    one = found.simulated("one", seen)
    assert one[TURNING].tolist() == [[[3.0, 10.0]], [[2.0, 5.0]]]
    assert one[TRAVEL_TIME].tolist() == [[[90.0, 2.0]], [[0.0, 0.0]]]
    assert found.simulated("two", seen)[TURNING].tolist() == [[[0.0, 0.0]], [[4.0, 15.0]]]


def test_without_either_kind_there_is_nothing() -> None:
    assert Between.of(MeasuredData((), PERIODS)) is None


def a_reference(rates: np.ndarray, between: Between) -> tuple[Reference, list[Tally]]:
    """A model whose turns are Poisson, on an intersection without detectors, 30 min a day."""
    lane = IncomingLane("a_0", "a", 0, (0,), 14.0, {})
    layout = DetectorLayout(("C",), (lane,), (), (), {})
    pools = Pools.of(layout, THRESHOLDS, 1, between.labels)
    generator = np.random.default_rng(4)

    def day() -> Tally:
        sums = np.stack([generator.poisson(30.0 * rates), np.full(len(rates), 30.0)], -1)
        empty = np.zeros((len(FEATURES), 1, 2)), np.zeros((len(BIN_FEATURES), 1, 6))
        return Tally(*empty, between={TURNING: sums[:, None].astype(np.float64)})

    return Reference(pools, [day() for _ in range(60)]), [day() for _ in range(3)]


def test_a_planted_turn_is_proposed_with_its_share_and_no_other() -> None:
    ways = [("a", "x"), ("a", "y"), ("b", "x"), ("b", "y")]
    rows = [("one", 0.0, 900.0, *way, 1.0) for way in ways]
    between = Between.of(MeasuredData((), PERIODS[:1], turning=turning(*rows)))
    assert between is not None and between.turns == tuple(ways)
    rates = np.array([8.0, 2.0, 5.0, 5.0])
    reference, same = a_reference(rates, between)
    assert turned(reference, reference.distance(same)) == []
    # A quarter of those who went to x now go to y: of 8 vehicles 2.
    _, other = a_reference(np.array([6.0, 4.0, 5.0, 5.0]), between)
    (found,) = turned(reference, reference.distance(other))
    assert found.fixed == (("from_edge", "a"), ("to_edge", "y"))
    assert found.levels[0][0] == pytest.approx(0.25, abs=0.05)
