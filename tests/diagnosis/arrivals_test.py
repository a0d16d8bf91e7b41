"""Measured arrivals: when vehicles came, where they went, and days that have them."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ugat_marl.data import is_actuated
from ugat_marl.diagnosis import Reference, Tally
from ugat_marl.diagnosis.arrivals import (
    Arrivals,
    DemandBalance,
    _Coming,
    _filled,
    by_lane_left,
    corrected,
    unhindered,
)
from ugat_marl.diagnosis.engine import Budget, Engine
from ugat_marl.diagnosis.features import BIN_FEATURES, FEATURES, INDEX, DetectorLayout, tally
from ugat_marl.diagnosis.replay import Replay
from ugat_marl.diagnosis.statistics import Pools
from ugat_marl.diagnosis.supplementary_data import TURNING
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.diagnosis.unmeasured import Unmeasured
from ugat_marl.effects import Effect, depart_s, load_scenario, parse_domain
from ugat_marl.experiments import policy_factory, record
from ugat_marl.files import xml_bytes
from ugat_marl.scenarios import Network, Passages, Period, Scenario, draw_day
from ugat_marl.simulation import standard_detectors

THRESHOLDS = Thresholds()

LIMIT = 10.0


def a_period(passages: dict[str, Passages] | None = None, end: float = 200.0) -> Period:
    return Period("day1", 0.0, end, "fit", {"C": ((0.0, "Gr"),)}, passages or {})


def seen(times: Sequence[float], speeds: Sequence[float]) -> Passages:
    on = np.array(times)
    speed = np.array(speeds)
    return Passages(on, on + 5.0 / np.where(np.isnan(speed), 1.0, speed), speed, on * np.nan)


def test_who_comes_freely_came_when_he_was_seen() -> None:
    times = [3.0, 50.0, 90.0]
    found = unhindered(seen(times, [9.0, 10.0, 11.0]), LIMIT, a_period(), THRESHOLDS, 0.0)
    assert found.tolist() == times


def test_who_came_through_a_queue_is_spread_between_free_neighbours_and_never_later() -> None:
    # Free at 20 and at 60; three between them in a queue: evenly at 30, 40, 50, but the first
    # was seen at 25 and cannot have come after that.
    found = unhindered(
        seen([20.0, 25.0, 45.0, 58.0, 60.0], [9, 1, 2, 3, 9]), LIMIT, a_period(), THRESHOLDS, 0.0
    )
    assert found.tolist() == [20.0, 25.0, 40.0, 50.0, 60.0]


def test_a_queue_at_the_ends_is_spread_to_the_ends_of_the_period() -> None:
    found = unhindered(seen([80.0, 190.0], [1.0, 1.0]), LIMIT, a_period(end=300.0), THRESHOLDS, 0.0)
    np.testing.assert_allclose(found, [80.0, 190.0])  # 100 and 200 would be later than seen
    found = unhindered(
        seen([180.0, 190.0], [1.0, 1.0]), LIMIT, a_period(end=240.0), THRESHOLDS, 0.0
    )
    np.testing.assert_allclose(found, [80.0, 160.0])


def test_who_drives_on_behind_a_queue_belongs_to_it() -> None:
    close = unhindered(
        seen([20.0, 40.0, 42.0], [9.0, 1.0, 7.0]), LIMIT, a_period(end=80.0), THRESHOLDS, 0.0
    )
    np.testing.assert_allclose(close, [20.0, 40.0, 42.0])  # both spread: 40 and 60, cut to seen
    far = unhindered(
        seen([20.0, 40.0, 46.0], [9.0, 1.0, 7.0]), LIMIT, a_period(end=80.0), THRESHOLDS, 0.0
    )
    np.testing.assert_allclose(far, [20.0, 33.0, 46.0])  # the last came freely


def test_without_speeds_time_on_the_detector_tells() -> None:
    one = dataclasses.replace(seen([20.0, 39.0, 60.0], [9, 1, 9]), speed_mps=np.full(3, np.nan))
    assert unhindered(one, LIMIT, a_period(), THRESHOLDS, 0.0).tolist() == [20.0, 39.0, 60.0]
    one = dataclasses.replace(seen([20.0, 50.0, 60.0], [9, 1, 9]), speed_mps=np.full(3, np.nan))
    assert unhindered(one, LIMIT, a_period(), THRESHOLDS, 0.0).tolist() == [20.0, 40.0, 60.0]


def test_a_long_zone_is_left_later() -> None:
    # 5 m of vehicle and 15 m of zone at 10 m/s: 2 s, and nobody was held up.
    on = np.array([150.0, 190.0])
    free = Passages(on, on + 2.0, on * np.nan, on * np.nan)
    assert unhindered(free, LIMIT, a_period(), THRESHOLDS, 15.0).tolist() == [150.0, 190.0]
    assert unhindered(free, LIMIT, a_period(), THRESHOLDS, 0.0).tolist() != [150.0, 190.0]


def test_who_changes_lanes_is_counted_where_he_left() -> None:
    came = [np.array([1.0, 2.0, 3.0]), np.array([4.0])]
    crossed = [np.array([10.0, 11.0]), np.array([12.0, 13.0])]
    found = by_lane_left(came, crossed, [2.0, 2.0])
    assert [item.tolist() for item in found] == [[1.0, 2.0], [3.0, 4.0]]


def test_nobody_leaves_before_he_can_have_come() -> None:
    found = by_lane_left([np.array([9.0]), np.array([1.0])], [np.array([10.0])], [2.0, 2.0])
    assert [item.tolist() for item in found] == [[1.0, 9.0], []]  # the second still stands there
    found = by_lane_left([np.array([9.0])], [np.array([10.0])], [2.0])
    assert found[0].tolist() == [9.0]


@pytest.fixture(scope="module")
def crossing(data: Path) -> tuple[Scenario, Network, DetectorLayout]:
    scenario = load_scenario(data / "crossing")
    network = Network.read(scenario)
    return scenario, network, DetectorLayout.of(network, standard_detectors(network))


def passages(times: Mapping[str, Sequence[float]]) -> dict[str, Passages]:
    return {name: seen(found, [13.0] * len(found)) for name, found in times.items()}


def departs(scenario: Scenario) -> dict[str, list[float]]:
    """Departures by origin."""
    found: dict[str, list[float]] = {}
    for item in scenario.routes[0].parse().iter("vehicle"):
        route = item.find("route")
        assert route is not None
        origin = route.get("edges", "").split()[0]
        found.setdefault(origin, []).append(float(item.get("depart", "nan")))
    return found


def test_vehicles_depart_so_that_they_come_when_others_came(
    crossing: tuple[Scenario, Network, DetectorLayout],
) -> None:
    scenario, network, layout = crossing
    day = draw_day(scenario, 3)
    came = {"advance:S_C_0": [60.0, 75.0, 99.0], "stop:S_C_0": [65.0, 80.0, 105.0]}
    period = a_period(passages(came))
    found, due, earliest_s = Arrivals(layout, network, THRESHOLDS).given(day, day, period)
    position = {item.id: item.position_m for item in layout.detectors}["advance:S_C_0"]
    way = position / network.lanes["S_C_0"].speed_mps
    rows = departs(found)
    assert set(rows) == {"S_C"}, "nobody was seen to come from the west"
    np.testing.assert_allclose(rows["S_C"], np.array([60.0, 75.0, 99.0]) - way, atol=0.006)
    assert earliest_s == min(rows["S_C"])
    assert due.given["S_C"].sum() == 3
    assert due.given["W_C"].sum() == 0
    assert due.asked["W_C"].sum() > 0, "the demand asks for them all the same"


def test_more_came_than_the_model_has(crossing: tuple[Scenario, Network, DetectorLayout]) -> None:
    scenario, network, layout = crossing
    day = draw_day(scenario, 3)
    times = np.linspace(20.0, 180.0, 60).tolist()
    period = a_period(passages({"advance:S_C_0": times, "stop:S_C_0": times}))
    found, *_ = Arrivals(layout, network, THRESHOLDS).given(day, day, period)
    names = [item.get("id") for item in found.routes[0].parse().iter("vehicle")]
    assert len(names) == len(set(names)) == 60


def test_who_departs_before_the_warm_up_comes_all_the_same(
    crossing: tuple[Scenario, Network, DetectorLayout],
) -> None:
    scenario, network, layout = crossing
    times = np.linspace(101.0, 150.0, 8).tolist()
    period = dataclasses.replace(
        a_period(passages({"advance:S_C_0": times, "stop:S_C_0": times})), begin_s=100.0
    )
    short = dataclasses.replace(THRESHOLDS, warm_up_s=2.0)
    replay = Replay(scenario, network, layout.detectors, layout.owner, short, answering=True)
    came = replay.simulate((), period, 1).period.passages["advance:S_C_0"].on_s
    np.testing.assert_allclose(came, times, atol=2.0)


@pytest.mark.parametrize("count", [360, 720, 1440])
def test_next_edges_stay_at_their_time_of_day(count: int) -> None:
    """The model has 720 vehicles, to x in the first half of the hour, and to y in the second."""
    pool = [
        _Coming("a", 5.0 * i, 60.0, "x" if i < 360 else "y", ET.Element("vehicle", id=str(i)))
        for i in range(720)
    ]
    times = (np.arange(count) + 0.5) * 3600.0 / count
    found = _filled(pool, [(time, frozenset("xy")) for time in times], -60.0, THRESHOLDS)
    following = {str(i): one.following for i, one in enumerate(pool)}
    names = [item.get("id", "") for item in found]
    np.testing.assert_allclose([depart_s(item) + 60.0 for item in found], times, atol=0.006)
    assert len(set(names)) == count
    away = np.abs(times - 1800.0) > THRESHOLDS.bin_s
    late = np.array([following[name.partition("+")[0]] == "y" for name in names])
    np.testing.assert_array_equal(late[away], times[away] > 1800.0)


def test_arrivals_get_vehicles_that_turn_where_their_lane_leads_to() -> None:
    pool = [
        _Coming("a", 10.0 * i, 0.0, "xyy"[i % 3], ET.Element("vehicle", id=str(i)))
        for i in range(30)
    ]
    lanes = [frozenset("x"), frozenset("y"), frozenset("y"), frozenset("z")]
    came = [(10.0 * i, lanes[i % 4]) for i in range(28)]
    for item, (_, edges) in zip(_filled(pool, came, 0.0, THRESHOLDS), came, strict=True):
        number = int(item.get("id", "").partition("+")[0])
        assert pool[number].following in edges or edges == {"z"}, "a lane that nobody takes"


def test_effects_on_demand_leave_what_is_simulated_alone(
    crossing: tuple[Scenario, Network, DetectorLayout],
) -> None:
    scenario, network, layout = crossing
    times = np.linspace(20.0, 180.0, 8).tolist()
    period = a_period(passages({"advance:S_C_0": times, "stop:S_C_0": times}))
    replay = Replay(scenario, network, layout.detectors, layout.owner, THRESHOLDS, answering=True)
    plain, more = (replay.simulate(parse_domain(x), period, 1) for x in ("sim", "demand_level=*,3"))
    for name, item in plain.period.passages.items():
        np.testing.assert_array_equal(item.on_s, more.period.passages[name].on_s)
    assert plain.due is not None
    assert more.due is not None
    assert more.due.asked["S_C"].sum() > 1.5 * plain.due.asked["S_C"].sum()


def test_effects_on_demand_cost_no_simulation(
    crossing: tuple[Scenario, Network, DetectorLayout], tmp_path: Path
) -> None:
    scenario, network, layout = crossing
    times = np.linspace(20.0, 180.0, 8).tolist()
    period = a_period(passages({"advance:S_C_0": times, "stop:S_C_0": times}))

    def engine(budget: Budget) -> Engine:
        replay = Replay(
            scenario, network, layout.detectors, layout.owner, THRESHOLDS, answering=True
        )
        return Engine(
            scenario, layout, replay, [period], 5, THRESHOLDS,
            budget=budget, unmeasured=Unmeasured.of([period]), cache=tmp_path,
        )  # fmt: skip

    one_day_h = period.length_s / 3600.0
    first = engine(budget := Budget())
    more = parse_domain("demand_level=*,3+headway=1.5")
    (found,) = first.replicates(more, [0])
    assert budget.spent_h == pytest.approx(one_day_h)
    (plain,) = first.replicates(parse_domain("headway=1.5"), [0])
    assert budget.spent_h == pytest.approx(one_day_h)
    again = engine(budget := Budget())
    (remembered,) = again.replicates(parse_domain("demand_level=*,2+headway=1.5"), [0])
    assert budget.spent_h == 0.0
    counts = [
        item.tally.sums[INDEX["count_stop"], :, 0].sum() for item in (plain, remembered, found)
    ]
    assert counts[0] < counts[1] < counts[2]
    for name in ("lost", "gap2", "occupied_in_red"):
        np.testing.assert_array_equal(found.tally.sums[INDEX[name]], plain.tally.sums[INDEX[name]])


def test_approaches_without_advance_detectors_keep_the_vehicles_asked_for(
    crossing: tuple[Scenario, Network, DetectorLayout],
) -> None:
    scenario, network, layout = crossing
    few = [one for one in layout.detectors if one.id != "advance:W_C_0"]
    layout = DetectorLayout.of(network, few)
    times = np.linspace(20.0, 180.0, 8).tolist()
    log = tuple((30.0 * turn, ("Gr", "rG")[turn % 2]) for turn in range(6))
    period = dataclasses.replace(
        a_period(passages({"advance:S_C_0": times, "stop:S_C_0": times})), signals={"C": log}
    )
    replay = Replay(scenario, network, few, layout.owner, THRESHOLDS, answering=True)
    engine = Engine(
        scenario, layout, replay, [period], 5, THRESHOLDS,
        budget=(budget := Budget()), unmeasured=Unmeasured.of([period]),
    )  # fmt: skip
    place = [lane.id for lane in layout.lanes].index("W_C_0")
    own, west, south = (
        engine.replicates(parse_domain(text), [0])[0]
        for text in ("sim", "demand_level=W_C,3", "demand_level=S_C,3")
    )
    assert budget.spent_h == pytest.approx(2 * period.length_s / 3600.0), "not the south"
    queued = [day.tally.sums[INDEX["discharged"], place, 0] for day in (own, west, south)]
    assert queued[1] > 1.5 * queued[0] > 0.0
    assert queued[2] == queued[0]
    assert west.due is not None and own.due is not None
    np.testing.assert_array_equal(west.due.given["W_C"], west.due.asked["W_C"])
    np.testing.assert_array_equal(west.due.given["S_C"], own.due.given["S_C"])


@pytest.mark.parametrize(("stop_s", "others_s"), [(5, (-6.0, 60.0)), (60, (-6.0, 1.0))])
def test_who_stops_on_the_way_takes_an_arrival(
    stop_s: int, others_s: tuple[float, float], crossing: tuple[Scenario, Network, DetectorLayout]
) -> None:
    scenario, network, layout = crossing
    day = draw_day(scenario, 3)
    document = day.routes[0]
    root = document.parse()
    south = [x for x in root.iter("vehicle") if x.find("route[@edges='S_C C_N']") is not None]
    ET.SubElement(south[2], "stop", lane="S_C_0", endPos="50", duration=str(stop_s))
    changed = dataclasses.replace(document, content=xml_bytes(root))
    day = dataclasses.replace(day, routes=(changed, *day.routes[1:]))
    position = {item.id: item.position_m for item in layout.detectors}["advance:S_C_0"]
    way = position / network.lanes["S_C_0"].speed_mps
    own = depart_s(south[2])
    times = [own + way + later for later in (-6.0, 1.0, 60.0)]
    period = a_period(passages({"advance:S_C_0": times, "stop:S_C_0": times}))
    found, due, _ = Arrivals(layout, network, THRESHOLDS).given(day, day, period)
    expected = sorted([own, *(own + later for later in others_s)])
    assert departs(found)["S_C"] == pytest.approx(expected, abs=0.006)
    assert due.given["S_C"].sum() == 3


def test_detectors_that_missed_vehicles_do_not_keep_them_away(
    crossing: tuple[Scenario, Network, DetectorLayout],
) -> None:
    scenario, network, layout = crossing
    day = draw_day(scenario, 3)
    times = np.linspace(5.0, 195.0, 40)
    few = {"advance:S_C_0": times[::2].tolist(), "stop:S_C_0": (times + 3).tolist()}
    found, due, _ = Arrivals(layout, network, THRESHOLDS).given(day, day, a_period(passages(few)))
    assert len(departs(found)["S_C"]) >= 38
    assert due.given["S_C"].sum() >= 36


def test_counts_are_those_asked_for(crossing: tuple[Scenario, Network, DetectorLayout]) -> None:
    _, _, layout = crossing
    place = [lane.id for lane in layout.lanes].index("S_C_0")
    sums = np.zeros((len(FEATURES), len(layout.places), 2))
    bins = np.zeros((len(BIN_FEATURES), len(layout.places), 2))
    sums[INDEX["count_stop"], place] = (8.0, 10.0)
    sums[INDEX["platoon_gap"], place] = (8.0, 10.0)
    bins[BIN_FEATURES.index("count_stop"), place] = (6.0, 2.0)
    none = {edge: np.zeros(2) for _, edge, _ in layout.places}
    due = DemandBalance(none | {"S_C": np.array([9.0, 3.0])}, none | {"S_C": np.array([5.0, 5.0])})
    found = corrected(Tally(sums, bins), layout, due, {})
    # 8 of 10 that came were counted, so 8 of 10 of the two more that were due would have been.
    assert found.sums[INDEX["count_stop"], place].tolist() == pytest.approx([9.6, 10.0])
    assert found.bins[BIN_FEATURES.index("count_stop"), place].tolist() == pytest.approx([9.2, 0.4])
    assert not found.sums[INDEX["platoon_gap"]].any()


def test_turning_counts_are_those_asked_for(
    crossing: tuple[Scenario, Network, DetectorLayout],
) -> None:
    """In the first half of the first bin, in the whole second bin, and not at all."""
    _, _, layout = crossing
    sums = np.zeros((len(FEATURES), len(layout.places), 2))
    turning = np.array([[[4.0, 5.0]], [[2.0, 5.0]], [[0.0, 0.0]]])
    day = Tally(
        sums,
        np.zeros((len(BIN_FEATURES), len(layout.places), 2)),
        supplementary={TURNING: turning},
        window=(0.0, 1200.0),
    )
    edges = {edge: np.zeros(2) for _, edge, _ in layout.places}
    asked = edges | {"S_C C_N": np.array([12.0, 16.0]), "W_C C_E": np.array([1.0, 0.0])}
    given = edges | {"S_C C_N": np.array([10.0, 10.0]), "W_C C_E": np.array([9.0, 9.0])}
    asked["E_C C_W"], given["E_C C_W"] = np.array([7.0, 7.0]), np.array([6.0, 6.0])
    spans = {("S_C", "C_N"): [(0.0, 300.0)], ("W_C", "C_E"): [(600.0, 900.0), (900.0, 1200.0)]}
    spans["E_C", "C_W"] = []
    found = corrected(day, layout, DemandBalance(asked, given), spans)
    assert found.supplementary[TURNING][:, 0].tolist() == [[4.0 + 2.0 / 2, 5.0], [0.0, 5.0], [0, 0]]
    assert day.supplementary[TURNING] is turning and turning[0, 0, 0] == 4.0


def test_who_turns_is_asked_for_by_his_way(
    crossing: tuple[Scenario, Network, DetectorLayout],
) -> None:
    scenario, network, layout = crossing
    day = draw_day(scenario, 3)
    turns = [("S_C", "C_N"), ("W_C", "C_N")]
    _, due, _ = Arrivals(layout, network, THRESHOLDS, turns).given(day, day, a_period({}))
    np.testing.assert_array_equal(due.asked["S_C C_N"], due.asked["S_C"])
    assert due.asked["S_C C_N"].sum() > 0
    assert not due.given["S_C C_N"].any()
    assert not due.asked["W_C C_N"].any()


def test_of_vehicles_between_two_lights_both_count_all() -> None:
    """No vehicle was given, so that two lanes share alike."""
    lanes = [("e", "e_0"), ("e", "e_1")]
    layout: Any = SimpleNamespace(places=[(light, *lane) for light in (1, 0) for lane in lanes])
    sums, bins = np.zeros((len(FEATURES), 4, 2)), np.zeros((len(BIN_FEATURES), 4, 2))
    sums[INDEX["count_stop"], :2, 1] = sums[INDEX["count_exit"], 2:, 1] = 60.0
    due = DemandBalance({"e": np.array([10.0, 10.0])}, {"e": np.zeros(2)})
    found = corrected(Tally(sums, bins), layout, due, {}).sums
    assert found[INDEX["count_stop"], :, 0].tolist() == [10.0, 10.0, 0.0, 0.0]
    assert found[INDEX["count_exit"], :, 0].tolist() == [0.0, 0.0, 10.0, 10.0]


@pytest.mark.slow
def test_days_under_signals_that_answered_others_are_like_the_measured_one(data: Path) -> None:
    """Closed loop: nothing is hidden, and only measured arrivals make the replay agree."""
    scenario = load_scenario("single-v1").with_duration(1200.0)
    measured = record(scenario, "sim", policy_factory("max-pressure:10"), periods=4, seed=21)
    network = Network.read(scenario)
    layout = DetectorLayout.of(network, measured.detectors)
    assert is_actuated(measured.periods, layout.intersections[0])

    def distance(answering: bool) -> float:
        replay = Replay(
            scenario, network, measured.detectors, layout.owner, THRESHOLDS, answering=answering
        )
        engine = Engine(
            scenario, layout, replay, measured.periods, 5, THRESHOLDS,
            budget=Budget(), unmeasured=Unmeasured.of(measured.periods),
        )  # fmt: skip
        days = [day.tally for day in engine.replicates(NOTHING, range(16))]
        reference = Reference(Pools.of(layout, THRESHOLDS), days)
        seen = [tally(layout, x, layout.greens(x), THRESHOLDS) for x in measured.periods]
        return reference.distance(seen).parts["network"]

    assert distance(True) < 0.5 * distance(False)


NOTHING: tuple[Effect, ...] = ()
