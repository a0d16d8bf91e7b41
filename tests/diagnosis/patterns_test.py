"""Patterns that are planted into single vehicles, and the sentences that tell them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ugat_marl.diagnosis.features import DetectorLayout, Greens, IncomingLane
from ugat_marl.diagnosis.patterns import (
    AXES,
    QUANTITIES,
    PatternTerm,
    Regression,
    _spread,
    cells_of,
    patterns,
    place_sets,
    sets_of,
    unnamed_effects,
)
from ugat_marl.diagnosis.records import Pattern
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.diagnosis.verdict import describe_pattern
from ugat_marl.effects import load_scenario
from ugat_marl.scenarios import Detector, DetectorKind, Network, Passages, Period
from ugat_marl.simulation import standard_detectors

THRESHOLDS = Thresholds()
HOUR_S = 3600.0
MOVES = {"north_0": "s", "north_1": "s", "north_2": "l", "south_0": "s"}
KINDS: tuple[tuple[DetectorKind, float], ...] = (("advance", 50.0), ("stop", 100.0))
DETECTORS = tuple(
    Detector(f"{kind}:{lane}", lane, place, 0.0, kind) for lane in MOVES for kind, place in KINDS
)
LAYOUT = DetectorLayout(
    ("A",),
    tuple(
        IncomingLane(
            lane, lane[:-2], 0, (n,), 14.0,
            {"advance": f"advance:{lane}", "stop": f"stop:{lane}"},
            directions=frozenset(move),
        )
        for n, (lane, move) in enumerate(MOVES.items())
    ),
    (),
    DETECTORS,
    {},
)  # fmt: skip
STARTS = np.arange(0.0, HOUR_S, 60.0)
GREENS = Greens(STARTS, STARTS + 35, STARTS + 38, STARTS + 60, np.ones(60, np.bool_))


def passages(times: np.ndarray, speeds: np.ndarray, lengths: np.ndarray) -> Passages:
    return Passages(times, times + 0.4, speeds, lengths)


def day(
    seed: int,
    *,
    slower: float = 0.0,
    since_s: float = 0.0,
    vehicle: int = 2,
    lanes: str = "",
    pace: float = 1.0,
    more: float = 1.0,
    missed: float = 0.0,
) -> Period:
    """A period whose queues discharge every 2 s, and whose free vehicles drive 13 m/s.

    Args:
        seed: Seed of the day.
        slower: Share by which gaps are longer, from `since_s` on, from this vehicle on, on lanes
            whose names begin so and go straight on.
        since_s: Start of what is planted, s.
        vehicle: First vehicle of the queue.
        lanes: Start of the names of the lanes.
        pace: Factor of the speeds of long vehicles.
        more: Factor of the number of free vehicles on these lanes.
        missed: Share of vehicles that the stop detectors miss.
    """
    generator = np.random.default_rng(seed)
    seen: dict[str, Passages] = {}
    for lane, move in MOVES.items():
        here = lane.startswith(lanes)
        crossed: list[float] = []
        for start in STARTS:
            gaps = np.append(1.5, generator.normal(2.0, 0.3, generator.integers(6, 11)))
            if here and move == "s" and start >= since_s:
                gaps[vehicle - 1 :] *= 1.0 + slower
            crossed += (start + np.cumsum(gaps)).tolist()
        times = np.array(crossed)
        kept = generator.random(len(times)) >= missed
        times = times[kept]
        full = np.full(len(times), 5.0)
        on = times - 0.4
        on[np.searchsorted(times, STARTS)] = STARTS - 5.0  # the first vehicle waits on the detector
        seen[f"stop:{lane}"] = Passages(on, times, full, full)
        rate = 300 * (more if here else 1.0)
        free = np.sort(
            generator.uniform(since_s if more > 1 else 0.0, HOUR_S, generator.poisson(rate))
        )
        long = generator.random(len(free)) < 0.1
        speeds = generator.normal(13.0, 1.0, len(free)) * np.where(long, pace, 1.0)
        seen[f"advance:{lane}"] = passages(free, speeds, np.where(long, 12.0, 5.0))
    return Period("day", 0.0, HOUR_S, "fit", {}, seen)


def cells(period: Period) -> dict[str, np.ndarray]:
    return cells_of(LAYOUT, period, [GREENS] * 4, THRESHOLDS)


@pytest.fixture(scope="module")
def simulated() -> list[dict[str, np.ndarray]]:
    return [cells(day(1000 + number)) for number in range(24)]


def found(
    simulated: list[dict[str, np.ndarray]], **planted: float | str | int
) -> tuple[Pattern, ...]:
    days = [cells(day(number, **planted)) for number in range(5)]  # pyright: ignore[reportArgumentType]
    span = 0.0, HOUR_S
    return patterns(LAYOUT, days[:3], days[3:], simulated, QUANTITIES, span, THRESHOLDS, 0.05)


def test_slow_discharge_is_told_with_place_time_and_vehicle(
    simulated: list[dict[str, np.ndarray]],
) -> None:
    planted = found(simulated, slower=1 / 0.86 - 1, since_s=1800.0, vehicle=3, lanes="north")
    assert describe_pattern(replace(planted[0], change=-0.14)) == (
        "From 0:30:00 to 1:00:00, the through lanes of north discharge 14 % less from vehicle 3 of "
        "the queue on"
    )
    assert planted[0].heldout_change == pytest.approx(-0.14, abs=0.03)
    assert abs(planted[0].change + 0.14) < 3 * planted[0].error


def test_long_vehicles_that_drive_slower(simulated: list[dict[str, np.ndarray]]) -> None:
    planted = found(simulated, pace=0.8)
    assert describe_pattern(planted[0]) == "Long vehicles on all lanes drive 20 % slower"


def test_detectors_of_one_kind_that_count_fewer(simulated: list[dict[str, np.ndarray]]) -> None:
    planted = found(simulated, missed=0.15)
    (counted,) = (x for x in planted if x.quantity == "count")
    assert describe_pattern(replace(counted, change=-0.15)) == (
        "Stop detectors of all lanes count 15 % fewer vehicles"
    )
    assert counted.change == pytest.approx(-0.15, abs=4 * counted.error)


def test_where_nothing_is_planted_hardly_anything_is_told() -> None:
    told = 0
    for number in range(8):
        model = [cells(day(2000 + 100 * number + k)) for k in range(16)]
        days = [cells(day(100 * number + k)) for k in range(5)]
        span = 0.0, HOUR_S
        left = patterns(LAYOUT, days[:3], days[3:], model, QUANTITIES, span, THRESHOLDS, 0.05)
        told += bool(left)
    assert told <= 1


def test_of_patterns_that_overlap_each_has_what_the_others_leave(
    simulated: list[dict[str, np.ndarray]],
) -> None:
    slower = {0: 1 / 0.7, 1: 1 / 0.85}  # north_0 discharges 30 % less, north_1 15 %

    def street(seed: int) -> dict[str, np.ndarray]:
        cells_there = cells(day(seed))
        for lane, factor in slower.items():
            cells_there["discharge"][lane] *= [1.0, factor, factor**2]
        return cells_there

    days = [street(seed) for seed in range(5)]
    span = 0.0, HOUR_S
    told = patterns(LAYOUT, days[:3], days[3:], simulated, ("discharge",), span, THRESHOLDS, 0.05)
    places = [(one.place, one.movement) for one in told]
    assert len(places) > 1 and len({*places}) == len(places)
    lost = {str(one).split(",")[0]: float(str(one).split(",")[-1])
            for one in unnamed_effects(told, LAYOUT, (), decision_s=10.0)}  # fmt: skip
    assert lost == {
        "lane_service=north_0": pytest.approx(3.0, abs=0.2),
        "lane_service=north_1": pytest.approx(1.5, abs=0.2),
    }


def test_a_pattern_of_the_fitted_periods_alone_is_not_told(
    simulated: list[dict[str, np.ndarray]],
) -> None:
    fitted = [cells(day(number, slower=0.2)) for number in range(3)]
    others = [cells(day(number)) for number in range(3, 5)]
    told = patterns(
        LAYOUT, fitted, others, simulated, ["discharge"], (0.0, HOUR_S), THRESHOLDS, 0.05
    )
    assert told == ()


def test_a_whole_day_has_no_more_bins_than_can_be_compared() -> None:
    long = replace(day(0), end_s=86_400.0)
    assert cells(long)["count"].shape[4] == THRESHOLDS.most_pattern_bins


def test_the_sets_of_every_axis() -> None:
    sets = dict(zip(AXES, sets_of(LAYOUT, (4, 3, 5, 5, 3, 2)), strict=True))
    assert ("north", "s") in sets["place"].names
    place = sets["place"].names.index(("north", "s"))
    assert sets["place"].masks[place].tolist() == [True, True, False, False]
    assert sets["kind"].names == (None, ("advance",), ("stop",), ("exit",))
    assert (3, None) in sets["position"].names
    assert (None, 3) in sets["position"].names
    assert sets["time"].names == (None, (0, 1), (0, 2), (1, 2), (1, 3), (2, 3))
    assert sets["time"].limits == (0, 1, 1, 2, 1, 1)
    assert sets["length"].names == (None, ("long",))


def test_a_lane_between_two_lights_is_a_place_in_front_of_one_and_behind_the_other() -> None:
    scenario = load_scenario("grid2x2-v1")
    network = Network.read(scenario)
    layout = DetectorLayout.of(network, standard_detectors(network))
    sets = place_sets(layout, len(layout.places))
    lanes = [lane for _, _, lane in layout.places]
    inner, outer = "A2_A1_0", "A1_west1_0"
    first = lanes.index(inner)
    second = lanes.index(inner, first + 1)
    for lane, kind, place in (
        (inner, "lane", first),
        (inner, "exit", second),
        (outer, "lane", lanes.index(outer)),
    ):
        assert np.flatnonzero(sets.masks[sets.names.index((lane, kind))]).tolist() == [place]


def test_a_pattern_in_words() -> None:
    pattern = Pattern(
        "count", "north", None, "advance", None, None, None, False, 0.18, 0.01, None, 0.0
    )  # fmt: skip
    assert (
        describe_pattern(pattern) == "Advance detectors of approach north count 18 % more vehicles"
    )
    lane = replace(pattern, quantity="discharge", place="north_1", movement="lane", detectors=None)
    behind = replace(pattern, place="north_1", movement="exit", detectors=None)
    assert describe_pattern(behind) == (
        "The detectors of lane north_1 behind the intersection count 18 % more vehicles"
    )
    late = replace(lane, green_s=(20.0, None), change=-0.3)
    assert describe_pattern(late) == "Lane north_1 discharges 30 % less after 20 s of green"
    early = replace(lane, green_s=(None, 10.0), vehicles=(None, 3.0), place=None, movement="l")
    assert describe_pattern(early) == (
        "The left-turn lanes discharge 18 % more up to vehicle 3 of the queue in the first 10 s of "
        "green"
    )


def test_patterns_become_service_and_demand_without_a_name() -> None:
    slow = Pattern("discharge", "north", "s", None, None, None, None, False, -0.2, 0.01, None, 0.0)
    start = replace(slow, movement=None, green_s=(None, 10.0), change=-0.1)
    more = replace(slow, quantity="count", movement=None, change=0.25)
    surge = replace(more, place="south", window=(600.0, 1200.0), detectors="advance", change=-0.5)
    hidden = [
        replace(slow, window=(0.0, 600.0)),
        replace(slow, long_vehicles=True),
        replace(slow, quantity="free speed"),
        replace(more, place="elsewhere"),
        replace(more, detectors="stop"),
        replace(more, movement="l"),
    ]
    effects = unnamed_effects(
        [slow, start, more, surge, *hidden], LAYOUT, ("north", "south"), decision_s=10.0
    )
    assert list(map(str, effects)) == [
        "demand_level=north,1.25",
        "demand_surge=south,600,1200,0.5",
        "lane_service=north_0,1,2",
        "lane_service=north_1,1,2",
        "lane_service=north_2,1,0",
    ]
    # changes of patterns that overlap add up: 1.25 in all, and 2 from 600 to 1200 s
    beside = replace(surge, place="north", change=0.75)
    much = replace(more, place="south", change=25.0)
    later = replace(beside, window=(900.0, 1500.0), change=0.5)
    none = replace(more, place="east", change=-1.0)
    added = unnamed_effects(
        [beside, more, later, much, none, replace(surge, place="east", change=0.5)],
        LAYOUT,
        ("north", "south", "east"),
        decision_s=10.0,
    )
    assert list(map(str, added)) == [
        "demand_level=north,1.25",
        "demand_surge=north,600,900,1.6",
        "demand_surge=north,900,1200,2",
        "demand_surge=north,1200,1500,1.4",
        "demand_level=south,20",
        "demand_level=east,0",
    ]
    faster = replace(slow, place=None, movement=None, change=0.2)
    assert unnamed_effects([faster], LAYOUT, (), 10.0) == ()
    twice = replace(faster, change=1.0)
    assert unnamed_effects([twice] * 2, LAYOUT, (), 10.0) == ()
    assert unnamed_effects([twice] * 3, LAYOUT, (), 10.0) == ()


def test_errors_know_that_detectors_count_the_same_vehicles() -> None:
    """The error of all counts is that of the vehicles, not of the passages."""
    generator = np.random.default_rng(0)

    def counted() -> np.ndarray:
        seen: dict[str, Passages] = {}
        for lane in MOVES:
            times = np.sort(generator.uniform(0.0, HOUR_S - 60.0, generator.poisson(120)))
            unknown = np.full(len(times), np.nan)
            for kind, later_s in (("advance", 0.0), ("stop", 10.0)):
                seen[f"{kind}:{lane}"] = passages(times + later_s, unknown, unknown)
        return cells(Period("d", 0.0, HOUR_S, "fit", {}, seen))["count"]

    days = [counted() for _ in range(24)]
    sets = sets_of(LAYOUT, days[0].shape[:-1])
    regression = Regression(sets, days, THRESHOLDS, counts=True)
    term = PatternTerm((0,) * len(sets), 0.0, 0.0, 0.0)
    shares, errors = zip(
        *(regression.of(term, np.sum([counted() for _ in range(3)], axis=0)) for _ in range(100)),
        strict=True,
    )
    assert np.mean(errors) < 0.8 * np.std(shares)
    wide, none = _spread(regression, days, (3, 0), THRESHOLDS, term.chosen)
    assert wide == pytest.approx(np.std(shares), rel=0.35)
    assert none == 0.0
