"""Places and windows that are proposed for faults planted in streets made of random numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ugat_marl.diagnosis import Hypothesis, Reference, Routes, Tally
from ugat_marl.diagnosis.features import (
    BIN_FEATURES,
    FEATURES,
    INDEX,
    DetectorLayout,
    IncomingLane,
    tally,
)
from ugat_marl.diagnosis.hypotheses import library
from ugat_marl.diagnosis.places import PlaceFinder, _later, _mixed
from ugat_marl.diagnosis.statistics import Pools
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.diagnosis.unmeasured import without_holes
from ugat_marl.effects import Domain, apply_detector_effects, load_scenario, parse_domain
from ugat_marl.scenarios import Detector, DetectorKind, Passages, Period

THRESHOLDS = Thresholds()

ARMS = ("a", "b", "c", "d")
RATE_PER_HOUR = {"a": 500.0, "b": 320.0, "c": 420.0, "d": 260.0}
LEAVING = {
    "a": {"b": 0.2, "c": 0.5, "d": 0.3},
    "b": {"a": 0.3, "c": 0.3, "d": 0.4},
    "c": {"a": 0.6, "b": 0.2, "d": 0.2},
    "d": {"a": 0.3, "b": 0.4, "c": 0.3},
}
END_S = 3600.0
CYCLE_S = 60.0


def a_layout() -> DetectorLayout:
    """Four arms of one lane in and one lane out."""
    kinds: tuple[DetectorKind, ...] = ("advance", "stop")
    lanes = tuple(
        IncomingLane(
            f"{arm}_in_0", f"{arm}_in", 0, (index,), 14.0, {k: f"{k}:{arm}" for k in kinds}
        )
        for index, arm in enumerate(ARMS)
    )
    exits = tuple((0, f"{arm}_out_0", f"exit:{arm}") for arm in ARMS)
    detectors = [Detector(f"{k}:{arm}", f"{arm}_in_0", 1.0, 0.0, k) for arm in ARMS for k in kinds]
    detectors += [Detector(f"exit:{arm}", f"{arm}_out_0", 1.0, 0.0, "exit") for arm in ARMS]
    return DetectorLayout(
        ("C",), lanes, exits, tuple(detectors), {item.id: "C" for item in detectors}
    )


SITE = a_layout()
ROUTES = Routes(
    {f"{arm}_in": rate for arm, rate in RATE_PER_HOUR.items()},
    {
        f"{arm}_in": {f"{arm}_in": rate}
        | {f"{to}_out": rate * share for to, share in LEAVING[arm].items()}
        for arm, rate in RATE_PER_HOUR.items()
    },
    {
        f"{arm}_in": {f"{to}_out": rate * share for to, share in LEAVING[arm].items()}
        for arm, rate in RATE_PER_HOUR.items()
    },
    {
        f"{arm}_in": {f"{arm}_in": rate}
        | {f"{to}_out": rate * share for to, share in LEAVING[arm].items()}
        for arm, rate in RATE_PER_HOUR.items()
    }
    | {
        f"{to}_out": {f"{to}_out": sum(RATE_PER_HOUR[a] * LEAVING[a].get(to, 0.0) for a in ARMS)}
        | {f"{arm}_in": RATE_PER_HOUR[arm] * LEAVING[arm][to] for arm in ARMS if to in LEAVING[arm]}
        for to in ARMS
    },
)
LOG = tuple(
    (CYCLE_S * cycle + offset, state)
    for cycle in range(int(END_S / CYCLE_S))
    for offset, state in ((0.0, "GrGr"), (27.0, "yryr"), (30.0, "rGrG"), (57.0, "ryry"))
)

Flow = Callable[[np.ndarray], np.ndarray]
"""Factor on the rate of an arm at some times."""


def street(
    seed: int,
    flow: dict[str, Flow] | None = None,
    leaving: dict[str, dict[str, float]] | None = None,
) -> Period:
    """One hour: every vehicle passes its advance, stop and exit detector, 20 s apart."""
    generator = np.random.default_rng(seed)
    times: dict[str, list[np.ndarray]] = {item.id: [] for item in SITE.detectors}
    for arm, rate in RATE_PER_HOUR.items():
        most = 3.0
        came = np.sort(generator.uniform(0, END_S, generator.poisson(most * rate)))
        factor = flow[arm](came) if flow and arm in flow else np.ones_like(came)
        came = came[generator.uniform(0, most, len(came)) < factor]
        shares = (leaving or LEAVING)[arm]
        to = generator.choice(list(shares), len(came), p=list(shares.values()))
        times[f"advance:{arm}"].append(came)
        times[f"stop:{arm}"].append(came + 20.0)
        for target in shares:
            times[f"exit:{target}"].append(came[to == target] + 40.0)
    seen: dict[str, Passages] = {}
    for name, parts in times.items():
        on = np.sort(np.concatenate(parts))
        on = on[on < END_S]
        unknown = np.full(len(on), np.nan)
        seen[name] = Passages(on, on + 0.5, np.full(len(on), 12.0), unknown)
    return Period(f"day{seed}", 0.0, END_S, "fit", {"C": LOG}, seen)


def tallies(periods: Sequence[Period]) -> list[Tally]:
    return [tally(SITE, period, SITE.greens(period), THRESHOLDS) for period in periods]


@pytest.fixture(scope="module")
def reference() -> Reference:
    return Reference(Pools.of(SITE, THRESHOLDS), tallies([street(seed) for seed in range(40)]))


def proposed(
    reference: Reference, data: Sequence[Period], allowed: frozenset[str] | None = None
) -> list[Hypothesis]:
    place_finder = PlaceFinder(SITE, ROUTES, allowed or library(), THRESHOLDS)
    return place_finder.hypotheses(reference, reference.distance(tallies(data)), data)


def first(found: Sequence[Hypothesis], name: str) -> Hypothesis:
    """The strongest proposal of a kind."""
    return next(item for item in found if item.name == name)


def names(found: Sequence[Hypothesis]) -> list[str]:
    return [item.name for item in found]


def fault(domain: Domain) -> list[Period]:
    """Five days whose detectors are at fault."""
    effects = parse_domain(domain)
    return [
        apply_detector_effects(street(900 + day), effects, SITE.detectors, dict(SITE.owner))
        for day in range(5)
    ]


def overlap(window: tuple[float, float], truth: tuple[float, float]) -> float:
    both = max(0.0, min(window[1], truth[1]) - max(window[0], truth[0]))
    return both / (max(window[1], truth[1]) - min(window[0], truth[0]))


def window_of(item: Hypothesis) -> tuple[float, float]:
    fixed = dict(item.fixed)
    return float(fixed["begin_s"]), float(fixed["end_s"])


def test_on_plain_days_no_fault_of_a_detector_is_proposed(reference: Reference) -> None:
    wrong = 0
    for seed in range(10):
        found = names(proposed(reference, [street(100 + 5 * seed + day) for day in range(5)]))
        assert not {"stuck", "dropout", "swapped"} & set(found)
        wrong += bool({"demand_surge", "demand_level", "turning"} & set(found))
    assert wrong <= 4  # they are only proposed; the simulation decides


def test_an_origin_with_more_demand(reference: Reference) -> None:
    more = {"c": lambda t: np.full_like(t, 1.3)}
    item = first(proposed(reference, [street(300 + i, more) for i in range(5)]), "demand_level")
    assert dict(item.fixed) == {"edge": "c_in"}
    assert item.levels[0][0] == pytest.approx(1.3, abs=0.07)


def test_an_origin_with_less_demand(reference: Reference) -> None:
    less = {"b": lambda t: np.full_like(t, 0.7)}
    item = first(proposed(reference, [street(310 + i, less) for i in range(5)]), "demand_level")
    assert dict(item.fixed) == {"edge": "b_in"}
    assert item.levels[0][0] == pytest.approx(0.7, abs=0.07)


@pytest.mark.parametrize("truth", [(600.0, 1500.0), (2400.0, 3000.0)])
def test_a_surge_is_proposed_in_its_window(
    reference: Reference, truth: tuple[float, float]
) -> None:
    surge = {"a": lambda t: np.where((t >= truth[0]) & (t < truth[1]), 1.8, 1.0)}
    item = first(proposed(reference, [street(320 + i, surge) for i in range(5)]), "demand_surge")
    assert dict(item.fixed)["edge"] == "a_in"
    assert overlap(window_of(item), truth) > 0.85
    assert item.levels[0][0] == pytest.approx(1.8, abs=0.25)


@pytest.mark.parametrize("late_s", [300.0, -300.0])
def test_an_origin_that_comes_later_or_sooner(reference: Reference, late_s: float) -> None:
    gone = {"b": lambda t: np.where((t < late_s) | (t >= END_S + late_s), 0.0, 1.0)}
    item = first(proposed(reference, [street(340 + i, gone) for i in range(5)]), "demand_timing")
    assert dict(item.fixed) == {"edge": "b_in"}
    assert item.levels == ((late_s,),)


def test_counts_come_later() -> None:
    counts = np.array([[4.0, 8.0, 2.0, 6.0]])
    assert _later(counts, 1.0).tolist() == [[0.0, 4.0, 8.0, 2.0]]
    assert _later(counts, 0.5).tolist() == [[2.0, 6.0, 5.0, 4.0]]
    assert _later(counts, -1.0).tolist() == [[8.0, 2.0, 6.0, 0.0]]
    assert _later(counts, -1.5).tolist() == [[5.0, 4.0, 3.0, 0.0]]
    for bins in (4.0, 4.5, 9.0, -4.0, -4.5, -9.0):  # a quarter of an hour in a short period
        assert _later(counts, bins).tolist() == [[0.0] * 4], bins


def test_vehicles_that_turn_elsewhere(reference: Reference) -> None:
    # A quarter of those that leave a for c or d now go to b.
    leaving = LEAVING | {"a": {"b": 0.4, "c": 0.375, "d": 0.225}}
    data = [street(330 + i, leaving=leaving) for i in range(5)]
    item = first(proposed(reference, data), "turning")
    assert dict(item.fixed) == {"from_edge": "a_in", "to_edge": "b_out"}
    assert item.levels[0][0] == pytest.approx(0.25, abs=0.08)


@pytest.mark.parametrize("place", ["stop:a", "advance:c", "exit:d"])
def test_a_detector_that_counts_too_few(reference: Reference, place: str) -> None:
    item = first(proposed(reference, fault(f"undercount={place},0.25")), "undercount")
    assert dict(item.fixed) == {"place": place}
    assert item.levels[0][0] == pytest.approx(0.25, abs=0.06)


def test_two_detectors_taken_for_each_other(reference: Reference) -> None:
    item = first(proposed(reference, fault("swapped=stop:d,stop:a")), "swapped")
    assert dict(item.fixed) == {"detector": "stop:a", "other": "stop:d"}


def test_exchanged_detectors_are_seen_though_days_differ() -> None:
    """That all counts of a day are higher says nothing of which detector is which."""
    generator = np.random.default_rng(7)

    def a_day(seed: int) -> Period:
        level = float(generator.normal(1.0, 0.1))
        return street(seed, {arm: lambda t, x=level: np.full_like(t, x) for arm in ARMS})

    usual = Reference(Pools.of(SITE, THRESHOLDS), tallies([a_day(seed) for seed in range(40)]))
    exchanged = parse_domain("swapped=stop:d,stop:b")
    data = [
        apply_detector_effects(a_day(900 + day), exchanged, SITE.detectors, dict(SITE.owner))
        for day in range(5)
    ]
    item = first(proposed(usual, data), "swapped")
    assert dict(item.fixed) == {"detector": "stop:b", "other": "stop:d"}


def test_a_surge_is_seen_on_the_first_measured_road_of_its_origin(reference: Reference) -> None:
    """Vehicles enter a map of a city far from the detectors."""

    def renamed(flows: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
        own = flows["a_in"]
        return flows | {"a_far": {"a_far": RATE_PER_HOUR["a"]} | own}

    passing = renamed(ROUTES.passing)
    del passing["a_in"]
    far = Routes(ROUTES.origins, passing, ROUTES.turns, renamed(ROUTES.joint))
    surge = {"a": lambda t: np.where((t >= 600.0) & (t < 1500.0), 1.8, 1.0)}
    data = [street(320 + i, surge) for i in range(5)]
    finder = PlaceFinder(SITE, far, library(), THRESHOLDS)
    found = finder.hypotheses(reference, reference.distance(tallies(data)), data)
    item = first(found, "demand_surge")
    assert dict(item.fixed)["edge"] == "a_far"
    assert overlap(window_of(item), (600.0, 1500.0)) > 0.85


def test_a_detector_that_sticks(reference: Reference) -> None:
    item = first(proposed(reference, fault("stuck=advance:b,1200,2000")), "stuck")
    assert dict(item.fixed)["detector"] == "advance:b"
    assert overlap(window_of(item), (1200.0, 2000.0)) > 0.95


def test_a_detector_that_is_not_compared_is_no_fault(reference: Reference) -> None:
    on = Passages(np.array([600.0]), np.array([900.0]), np.array([np.nan]), np.array([np.nan]))
    days = [street(900 + day) for day in range(5)]
    beside = [replace(day, passages={**day.passages, "twin": on}) for day in days]
    assert proposed(reference, beside) == proposed(reference, days)


def test_a_detector_that_falls_silent(reference: Reference) -> None:
    item = first(proposed(reference, fault("dropout=exit:c,600,1500")), "dropout")
    assert dict(item.fixed)["detector"] == "exit:c"
    assert overlap(window_of(item), (600.0, 1500.0)) > 0.95


def test_a_detector_that_was_dead_all_day(reference: Reference) -> None:
    item = first(proposed(reference, fault("dropout=stop:b,0,3600")), "dropout")
    assert dict(item.fixed)["detector"] == "stop:b"
    assert window_of(item) == (0.0, 3600.0)


def test_a_hole_of_the_recording_is_no_silence_of_detectors(reference: Reference) -> None:
    holes = ((600.0, 1500.0),)
    data = [without_holes(day, holes) for day in fault("dropout=exit:c,2500,2900")]
    finder = PlaceFinder(SITE, ROUTES, library(), THRESHOLDS, holes)
    found = finder.hypotheses(reference, reference.distance(tallies(data)), data)
    (item,) = (hypothesis for hypothesis in found if hypothesis.name == "dropout")
    assert dict(item.fixed)["detector"] == "exit:c"
    assert overlap(window_of(item), (2500.0, 2900.0)) > 0.95


def test_counts_alone_make_no_detector_silent(reference: Reference) -> None:
    data = [replace(street(320 + i), passages={}) for i in range(5)]
    place_finder = PlaceFinder(SITE, ROUTES, library(), THRESHOLDS)
    distance = reference.distance(tallies([street(320 + i) for i in range(5)]))
    assert "dropout" not in names(place_finder.hypotheses(reference, distance, data))


def test_minutes_hold_the_occupation_of_who_was_there_before_as_a_tally_does() -> None:
    nan = np.nan
    on, off = np.array([nan, nan, 30.0, 3590.0]), np.array([20.0, 300.0, 32.0, nan])
    seen = Passages(on, off, np.full(4, nan), np.full(4, nan))
    index = [lane.id for lane in SITE.lanes].index("b_in_0")
    period = replace(street(1), passages={"advance:b": seen})
    finder = PlaceFinder(SITE, ROUTES, library(), THRESHOLDS)
    minutes = finder._minutes([period], [index], "occupied", "count_exit", 60)
    # 20 s at the begin, 2 s, and 10 s at the end; 300 s from the begin on are a fault
    assert (minutes[0], minutes[-1], minutes.sum()) == pytest.approx((22.0, 10.0, 32.0))
    occupied = tallies([period])[0].bins[BIN_FEATURES.index("occupied"), index]
    assert occupied.sum() == pytest.approx(minutes.sum())


def test_a_closed_lane(reference: Reference) -> None:
    def closed(period: Period) -> Period:
        """From 1200 to 2100 s one vehicle in five comes through, and stands for 30 s."""
        edited = dict(period.passages)
        item = edited["advance:c"]
        inside = (item.on_s > 1200) & (item.on_s < 2100)
        kept = ~inside | (np.cumsum(inside) % 5 == 0)
        off = np.where(inside, item.on_s + 30.0, item.off_s)
        edited["advance:c"] = replace(item, off_s=off).at(kept)
        return replace(period, passages=edited)

    found = proposed(reference, [closed(street(340 + i)) for i in range(5)])
    item = first(found, "lane_closure")
    assert dict(item.fixed)["lane"] == "c_in_0"
    assert overlap(window_of(item), (1200.0, 2100.0)) > 0.8


def test_a_slow_road(reference: Reference) -> None:
    def slow(period: Period) -> Period:
        item = period.passages["advance:d"]
        edited = replace(item, speed_mps=0.8 * item.speed_mps, off_s=item.on_s + 0.6)
        return replace(period, passages={**period.passages, "advance:d": edited})

    found = proposed(reference, [slow(street(350 + i)) for i in range(5)])
    assert dict(first(found, "local_speed").fixed) == {"edge": "d_in"}


def test_only_what_is_allowed_is_proposed(reference: Reference) -> None:
    data = fault("undercount=stop:a,0.25")
    found = proposed(reference, data, frozenset({"demand_level", "turning"}))
    assert set(names(found)) <= {"demand_level", "turning"}


def test_a_window_of_counts_lies_where_the_counts_lie() -> None:
    """Counts of 10 min in a period of 55 min: the last 5 min are in no count."""

    def of_55_min(periods: Sequence[Period]) -> list[Period]:
        return [replace(period, end_s=3300.0) for period in periods]

    pools = Pools.of(SITE, THRESHOLDS, together=2)
    reference = Reference(pools, tallies(of_55_min([street(seed) for seed in range(40)])))
    surge = {"a": lambda t: np.where((t >= 1800) & (t < 3000), 2.0, 1.0)}
    data = of_55_min([street(320 + i, surge) for i in range(5)])
    distance = reference.distance(tallies(data))
    counted = [replace(period, passages={}) for period in data]
    found = PlaceFinder(SITE, ROUTES, library(), THRESHOLDS).hypotheses(
        reference, distance, counted
    )
    item = first(found, "demand_surge")
    assert dict(item.fixed)["edge"] == "a_in"
    assert overlap(window_of(item), (1800.0, 3000.0)) > 0.97


def test_windows_need_periods_of_one_span(reference: Reference) -> None:
    surge = {"a": lambda t: np.where((t >= 600) & (t < 1500), 2.0, 1.0)}
    data = [street(320 + i, surge) for i in range(5)]
    data[0] = replace(data[0], end_s=3500.0)
    assert "demand_surge" not in names(proposed(reference, data))


def test_every_proposal_is_an_effect(reference: Reference) -> None:
    surge = {"a": lambda t: np.where((t >= 600) & (t < 1500), 2.0, 1.0)}
    for item in proposed(reference, [street(320 + i, surge) for i in range(5)]):
        for level in item.levels:
            assert item.effect(level).name == item.name
        assert len(item.levels[0]) == len(item.free)


def test_the_same_data_give_the_same_proposals(reference: Reference) -> None:
    data = fault("undercount=stop:a,0.25")
    found = proposed(reference, data)
    assert dict(first(found, "undercount").fixed) == {"place": "stop:a"}
    assert proposed(reference, data) == found


def test_the_traffic_light_that_starts_late() -> None:
    lanes = tuple(IncomingLane(f"in{i}_0", f"in{i}", i, (0,), 14.0, {}) for i in range(4))
    layout = DetectorLayout(("A", "B", "C", "D"), lanes, (), (), {})

    def day(seed: int, late: float) -> Tally:
        sums = np.zeros((len(FEATURES), 4, 2))
        values = 2.0 + 0.3 * np.random.default_rng(seed).standard_normal(4)
        values[2] += late
        sums[INDEX["lost"]] = np.stack([40 * values, np.full(4, 40.0)], axis=-1)
        return Tally(sums, np.zeros((len(BIN_FEATURES), 4, 1)))

    reference = Reference(Pools.of(layout, THRESHOLDS), [day(seed, 0.0) for seed in range(50)])
    place_finder = PlaceFinder(
        layout, Routes({}, {}, {}, {}), {"late_green", "signal_clock"}, THRESHOLDS
    )
    distance = reference.distance([day(100 + seed, 1.5) for seed in range(5)])
    found = place_finder.hypotheses(reference, distance, [replace(street(1), passages={})])
    for name in ("late_green", "signal_clock"):
        assert dict(first(found, name).fixed) == {"place": "C"}
        assert first(found, name).levels[0][0] > 0


@pytest.mark.parametrize(
    ("moved", "lanes"),
    [
        # Traffic goes round what stands on one lane, and fills the other.
        ({("b_0", "count_stop"): -6.0, ("b_1", "count_stop"): 9.0}, {"b_0", "b_1"}),
        # It cannot, and queues there.
        ({("b_0", "gap_long"): 8.0, ("b_0", "count_stop"): -4.0}, {"b_0"}),
        ({}, None),
    ],
)
def test_lanes_are_examined_for_parking_that_traffic_avoids_or_queues_on(
    moved: dict[tuple[str, str], float], lanes: set[str] | None
) -> None:
    names_ = ("a_0", "a_1", "b_0", "b_1", "c_0")
    layout = DetectorLayout(
        ("A",), tuple(IncomingLane(x, x[0], 0, (0,), 14.0, {}) for x in names_), (), (), {}
    )

    def day(seed: int, planted: dict[tuple[str, str], float]) -> Tally:
        values = 20.0 + 0.3 * np.random.default_rng(seed).standard_normal((len(FEATURES), 5))
        for (lane, feature), size in planted.items():
            values[INDEX[feature], names_.index(lane)] += 0.3 * size
        sums = np.stack([40 * values, np.full_like(values, 40.0)], axis=-1)
        return Tally(sums, np.zeros((len(BIN_FEATURES), 5, 1)))

    reference = Reference(Pools.of(layout, THRESHOLDS), [day(seed, {}) for seed in range(50)])
    distance = reference.distance([day(100 + seed, moved) for seed in range(5)])
    place_finder = PlaceFinder(layout, Routes({}, {}, {}, {}), {"parking"}, THRESHOLDS)
    found = place_finder.hypotheses(reference, distance, [replace(street(1), passages={})])
    parked = [str(dict(item.fixed)["lane"]) for item in found]
    assert len(parked) == len(set(parked)) <= 4, "two edges, two lanes of each"
    if lanes is not None:
        assert {lane for lane in parked if lane.startswith("b")} == lanes
        assert parked[0].startswith("b"), "the edge that departs most comes first"


def test_routes_are_counted_per_hour(data: Path) -> None:
    # A vehicle every 20 s on each of two roads, for 200 s.
    routes = Routes.of(load_scenario(data / "crossing"))
    assert routes.origins == pytest.approx({"S_C": 180.0, "W_C": 180.0})
    assert routes.passing["S_C"] == pytest.approx({"S_C": 180.0, "C_N": 180.0})
    assert routes.turns == {
        "S_C": {"C_N": pytest.approx(180.0)},
        "W_C": {"C_E": pytest.approx(180.0)},
    }


def test_routes_are_counted_in_the_periods(data: Path) -> None:
    scenario = load_scenario(data / "crossing").with_duration(1600.0)  # vehicles up to 400 s

    def north(*windows: tuple[float, float]) -> float:
        periods = [replace(street(1), begin_s=begin, end_s=end) for begin, end in windows]
        return Routes.of(scenario, periods).turns["S_C"]["C_N"]

    assert north() == pytest.approx(45.0)
    assert north((0.0, 1600.0)) == pytest.approx(45.0)
    assert north((100.0, 300.0), (100.0, 300.0)) == pytest.approx(180.0)
    assert north((0.0, 200.0), (400.0, 600.0), (400.0, 600.0)) == pytest.approx(60.0)
    assert Routes.of(scenario, [replace(street(1), begin_s=500.0, end_s=900.0)]).origins == {}


def test_parking_is_tried_on_every_lane_of_a_small_site() -> None:
    allowed = library([])
    found = PlaceFinder(SITE, ROUTES, allowed, THRESHOLDS).everywhere()
    assert [dict(item.fixed)["lane"] for item in found] == [f"{arm}_in_0" for arm in ARMS]
    assert {item.name for item in found} == {"parking"}
    assert PlaceFinder(SITE, ROUTES, allowed - {"parking"}, THRESHOLDS).everywhere() == []
    many = replace(SITE, lanes=SITE.lanes * 7)
    assert PlaceFinder(many, ROUTES, allowed, THRESHOLDS).everywhere() == []


def test_a_closure_may_begin_as_one_detector_saw_and_end_as_another() -> None:
    """The queue reached the first at 30, and the second had the end of the closure at 50."""
    windows = [("c", 40.0, 60.0), ("d", 0.0, 9.0), ("c", 30.0, 45.0), ("c", 10.0, 50.0)]
    mixed = _mixed(windows)
    assert ("c", 30.0, 50.0) in mixed
    assert not set(mixed) & set(windows)
    assert all(lane == "c" and begin < end for lane, begin, end in mixed)
    assert _mixed([]) == []
