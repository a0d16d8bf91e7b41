"""Turning counts and travel times of probes: sums by hand, planted turns, planted slow roads."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import MeasuredData
from ugat_marl.diagnosis.features import BIN_FEATURES, FEATURES, DetectorLayout, IncomingLane, Tally
from ugat_marl.diagnosis.places import turned
from ugat_marl.diagnosis.replay import Replay
from ugat_marl.diagnosis.residual import MatchedFilters
from ugat_marl.diagnosis.statistics import Pools, Reference, Whitener
from ugat_marl.diagnosis.supplementary_data import (
    EVERY_LANE,
    LANES,
    TRAVEL_TIME,
    TURNING,
    SupplementaryData,
)
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.effects import load_scenario
from ugat_marl.errors import MeasuredDataError
from ugat_marl.experiments import policy_factory, record
from ugat_marl.scenarios import Network, Period, demand_as_vehicles
from ugat_marl.simulation import Place, standard_detectors

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
    found = SupplementaryData.of(MEASURED)
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
    found = SupplementaryData.of(MEASURED)
    assert found is not None
    came = np.array([[10.0, 4.0], [299.0, 5.0], [300.0, 4.0], [700.0, 3.0], [900.0, 3.0]])
    seen = [came, came, np.array([[5.0, 44.0], [6.0, 46.0]]), np.empty((0, 2))]
    one = found.simulated(PERIODS[0], seen, None)
    assert one[TURNING].tolist() == [[[3.0, 10.0]], [[2.0, 5.0]]]
    assert one[TRAVEL_TIME].tolist() == [[[90.0, 2.0]], [[0.0, 0.0]]]
    assert found.simulated(PERIODS[1], seen, None)[TURNING].tolist() == [
        [[0.0, 0.0]],
        [[4.0, 15.0]],
    ]


def test_probes_that_arrive_after_the_period_are_not_compared(data: Path) -> None:
    """A simulation ends with its period: probes of a longer day of the same model agree with it."""
    scenario = demand_as_vehicles(load_scenario(data / "crossing"))
    network = Network.read(scenario)
    detectors = standard_detectors(network)
    owner = DetectorLayout.of(network, detectors).owner
    ways = ((Place("S_C", 20.0), Place("C_N", 100.0)), (Place("W_C", 20.0), Place("C_E", 100.0)))
    replay = Replay(scenario, network, detectors, owner, THRESHOLDS, followed=ways)
    signals = {"C": tuple((25.0 * i, ("Gr", "rG")[i % 2]) for i in range(8))}
    short = Period("one", 0.0, 140.0, "fit", signals, {})
    longer = replay.simulate((), replace(short, end_s=200.0), 3).point_to_point
    measured = [
        ("one", began, first.edge, first.position_m, last.edge, last.position_m, took)
        for (first, last), seen in zip(ways, longer, strict=True)
        for began, took in seen[seen[:, 0] < short.end_s].tolist()
    ]
    found = SupplementaryData.of(MeasuredData((), (short,), travel_times=probes(*measured)))
    assert found is not None and set(found.ways) == set(ways)
    by_way = dict(zip(ways, replay.simulate((), short, 3).point_to_point, strict=True))
    simulated = found.simulated(short, [by_way[way] for way in found.ways], None)[TRAVEL_TIME]
    assert simulated[:, 0, 1].sum() < len(measured), "some arrive after the period"
    assert simulated[:, 0, 1].all()
    np.testing.assert_allclose(found.measured("one")[TRAVEL_TIME], simulated)


def test_without_either_kind_there_is_nothing() -> None:
    assert SupplementaryData.of(MeasuredData((), PERIODS)) is None


def a_reference(
    rates: np.ndarray, supplementary: SupplementaryData
) -> tuple[Reference, list[Tally]]:
    """A model whose turns are Poisson, on an intersection without detectors, 30 min a day."""
    lane = IncomingLane("a_0", "a", 0, (0,), 14.0, {})
    layout = DetectorLayout(("C",), (lane,), (), (), {})
    pools = Pools.of(layout, THRESHOLDS, 1, supplementary.labels)
    generator = np.random.default_rng(4)

    def day() -> Tally:
        sums = np.stack([generator.poisson(30.0 * rates), np.full(len(rates), 30.0)], -1)
        empty = np.zeros((len(FEATURES), 1, 2)), np.zeros((len(BIN_FEATURES), 1, 6))
        return Tally(*empty, supplementary={TURNING: sums[:, None].astype(np.float64)})

    return Reference(pools, [day() for _ in range(60)]), [day() for _ in range(3)]


def test_a_planted_turn_is_proposed_with_its_share_and_no_other() -> None:
    ways = [("a", "x"), ("a", "y"), ("b", "x"), ("b", "y")]
    rows = [("one", 0.0, 900.0, *way, 1.0) for way in ways]
    supplementary = SupplementaryData.of(MeasuredData((), PERIODS[:1], turning=turning(*rows)))
    assert supplementary is not None and supplementary.turns == tuple(ways)
    rates = np.array([8.0, 2.0, 5.0, 5.0])
    reference, same = a_reference(rates, supplementary)
    assert turned(reference, reference.distance(same)) == []
    # A quarter of those who went to x now go to y: of 8 vehicles 2.
    _, other = a_reference(np.array([6.0, 4.0, 5.0, 5.0]), supplementary)
    (found,) = turned(reference, reference.distance(other))
    assert found.fixed == (("from_edge", "a"), ("to_edge", "y"))
    assert found.levels[0][0] == pytest.approx(0.25, abs=0.05)


@pytest.mark.parametrize("periods", [5, 6, 10, 18])
def test_turns_counted_in_one_of_many_periods_are_compared(periods: int) -> None:
    """A quarter of an hour in which twice as many turned as are expected."""
    days = tuple(Period(str(k), 0.0, 3600.0, "fit", {}, {}) for k in range(periods))
    rows = [("0", 0.0, 900.0, "a", "x", 120.0), ("0", 0.0, 900.0, "a", "y", 60.0)]
    own = SupplementaryData.of(MeasuredData((), days, turning=turning(*rows)))
    assert own is not None
    pools = Pools({"network": np.ones((1, 1))}, THRESHOLDS, 1, own.labels)
    generator = np.random.default_rng(1)

    def day(sums: Mapping[str, np.ndarray]) -> Tally:
        empty = np.zeros((len(FEATURES), 1, 2)), np.zeros((len(BIN_FEATURES), 1, 1))
        return Tally(*empty, supplementary=sums)

    def came() -> np.ndarray:
        times = np.sort(generator.uniform(0.0, 3600.0, generator.poisson(240)))
        return np.c_[times, np.zeros_like(times)]

    simulated = [day(own.simulated(days[r % periods], [came(), came()], None)) for r in range(60)]
    reference, data = Reference(pools, simulated), [day(own.measured(d.id)) for d in days]
    distance = reference.distance(data)
    more, same = distance.z[TURNING].ravel()
    assert more > 5.0 and abs(same) < 2.0
    whitener = Whitener(reference, data, 0.0, blocks=[TURNING])
    assert whitener.measured == pytest.approx([more, same]), "fits use what is compared"
    change = {TURNING: np.array([[1.0], [0.0]])}
    filters = MatchedFilters([change], reference, data, [TURNING])
    assert filters(distance) == pytest.approx(more**2)


# --- states of lanes ------------------------------------------------------------------------------


def test_lanes_are_means_over_moments_and_vehicles() -> None:
    rows = [
        ("one", 0.0, "a_0", 2.0, 1.0, 4.0),
        ("one", 450.0, "a_0", 4.0, 0.0, 7.0),
        ("one", 0.0, "b_0", 0.0, 0.0, None),
        ("one", 450.0, "b_0", 1.0, 0.0, 9.0),
    ]
    names = ("period_id", "time_s", "lane_id", "vehicles", "halting", "mean_speed_mps")
    lanes = pl.DataFrame(rows, schema=names, orient="row")
    found = SupplementaryData.of(MeasuredData((), PERIODS, lanes=lanes))
    assert found is not None and found.lanes == ("a_0", "b_0")
    blocks = found.measured("one")
    means = blocks[LANES][..., 0] / blocks[LANES][..., 1]
    assert means.tolist() == [[3.0, 0.5, 36.0 / 6.0], [0.5, 0.0, 9.0]]
    assert blocks[LANES][0, 0].tolist() == [6.0 * 450.0, 900.0], "of 900 s two were seen"
    every = blocks[EVERY_LANE][0, :, 0] / blocks[EVERY_LANE][0, :, 1]
    assert every.tolist() == [7.0 / 4.0, 1.0 / 4.0, 45.0 / 7.0]
    assert not found.measured("two")[LANES].any(), "nothing is known of the other day"
    part = lanes.with_columns(pl.col("time_s") * 0.8)
    with pytest.raises(
        MeasuredDataError, match=r"'[ab]_0' was observed for 12 of 15 min of period"
    ):
        SupplementaryData.of(MeasuredData((), PERIODS, lanes=part))
    ends = pl.DataFrame({"time_s": [*range(30), *range(870, 900)]}).select(
        pl.lit("one").alias("period_id"),
        pl.col("time_s").cast(pl.Float64),
        pl.lit("a_0").alias("lane_id"),
        pl.lit(5.0).alias("vehicles"),
        pl.lit(2.0).alias("halting"),
    )
    with pytest.raises(MeasuredDataError, match="'a_0' was observed for 1 of 15 min"):
        SupplementaryData.of(MeasuredData((), PERIODS, lanes=ends))
    simulated = found.simulated(PERIODS[0], [], np.array([[1800.0, 90.0, 9000.0], [0.0, 0.0, 0.0]]))
    assert simulated[LANES].tolist() == [
        [[1800.0, 900.0], [90.0, 900.0], [9000.0, 1800.0]],
        [[0.0, 900.0], [0.0, 900.0], [0.0, 0.0]],
    ]


def test_a_lane_left_out_of_a_period_is_left_out_of_its_simulated_days() -> None:
    def rows(period: str, lane: str, vehicles: float) -> pl.DataFrame:
        moments = {"time_s": np.arange(600.0), "mean_speed_mps": [10.0] * 600}
        same = {"vehicles": [vehicles] * 600, "halting": [0.0] * 600}
        return pl.DataFrame(
            {"period_id": [period] * 600, "lane_id": [lane] * 600, **moments, **same}
        )

    periods = tuple(Period(name, 0.0, 600.0, "fit", {}, {}) for name in "ab")
    lanes = pl.concat([rows("a", "m_0", 20.0), rows("a", "s_0", 0.0), rows("b", "m_0", 20.0)])
    supplementary = SupplementaryData.of(MeasuredData((), periods, lanes=lanes))
    assert supplementary is not None
    simulated = np.array([[20.0 * 600, 0.0, 20.0 * 600 * 10], [0.0, 0.0, 0.0]])
    for period in periods:
        seen = supplementary.measured(period.id)[EVERY_LANE][0]
        same = supplementary.simulated(period, [], simulated)[EVERY_LANE][0]
        np.testing.assert_allclose(same, seen)


def test_simulated_lanes_are_those_of_positions_second_by_second(data: Path) -> None:
    scenario = demand_as_vehicles(load_scenario(data / "crossing"))
    network = Network.read(scenario)
    measured = record(
        scenario, "sim", policy_factory("fixed-time:30"), periods=1, seed=3, lanes=True,
        same_demand=True,
    )  # fmt: skip
    found = SupplementaryData.of(measured)
    assert found is not None
    (period,) = measured.periods
    layout = DetectorLayout.of(network, measured.detectors)
    replay = Replay(
        scenario, network, measured.detectors, layout.owner, THRESHOLDS, watched=found.lanes
    )
    many = [replay.simulate((), period, seed).lane_states for seed in range(6)]
    states = np.mean([one for one in many if one is not None], axis=0)
    simulated = found.simulated(period, [], states)[EVERY_LANE][0]
    street = found.measured(period.id)[EVERY_LANE][0]
    assert simulated[0, 0] / simulated[0, 1] == pytest.approx(street[0, 0] / street[0, 1], rel=0.3)
    assert simulated[2, 0] / simulated[2, 1] == pytest.approx(street[2, 0] / street[2, 1], rel=0.2)
