"""Origins and turns from counts that share vehicles, against closed forms."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from ugat_marl.diagnosis import Hypothesis, Routes
from ugat_marl.diagnosis.features import FEATURES, INDEX, DetectorLayout, IncomingLane
from ugat_marl.diagnosis.places import Volume
from ugat_marl.diagnosis.statistics import Distance
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.effects import load_scenario
from ugat_marl.scenarios import Scenario

THRESHOLDS = Thresholds()

Way = tuple[str, ...]
Counts = Mapping[str, tuple[float, float]]
"""Edge to measured minus expected vehicles per hour, and the standard error of that."""


def a_layout(incoming: tuple[str, ...], outgoing: tuple[str, ...] = ()) -> DetectorLayout:
    lanes = tuple(IncomingLane(f"{edge}_0", edge, 0, (0,), 14.0, {}) for edge in incoming)
    exits = tuple((0, f"{edge}_0", f"exit:{edge}") for edge in outgoing)
    return DetectorLayout(("C",), lanes, exits, (), {})


def routes(ways: Mapping[Way, float]) -> Routes:
    """Counted by hand: vehicles per hour of every way."""
    found = Routes({}, {}, {}, {})

    def add(table: dict[str, dict[str, float]], one: str, other: str, rate: float) -> None:
        row = table.setdefault(one, {})
        row[other] = row.get(other, 0.0) + rate

    for way, rate in ways.items():
        found.origins[way[0]] = found.origins.get(way[0], 0.0) + rate
        for edge in way:
            add(found.passing, way[0], edge, rate)
            for other in way:
                add(found.joint, edge, other, rate)
        for edge, following in zip(way, way[1:], strict=False):
            add(found.turns, edge, following, rate)
    return found


def a_distance(layout: DetectorLayout, counts: Counts) -> Distance:
    """A distance of which nothing but counts is known."""
    difference = np.zeros((len(layout.places), len(FEATURES)))
    z = np.zeros_like(difference)
    for place, (_, edge, _) in enumerate(layout.places):
        if edge in counts:
            row = INDEX["count_stop" if place < len(layout.lanes) else "count_exit"]
            value, error = counts[edge]
            difference[place, row], z[place, row] = value / 60.0, value / error
    return Distance(0.0, {}, 0.0, {}, {"lane": z}, {"lane": difference})


def directed(layout: DetectorLayout, ways: Mapping[Way, float], counts: Counts) -> dict[str, float]:
    return Volume(layout, routes(ways), THRESHOLDS).directed(a_distance(layout, counts))


def proposed(layout: DetectorLayout, ways: Mapping[Way, float], counts: Counts) -> list[Hypothesis]:
    return Volume(layout, routes(ways), THRESHOLDS).hypotheses(a_distance(layout, counts))


def test_one_edge_is_its_squared_z() -> None:
    found = directed(a_layout(("a",)), {("a", "x"): 400.0}, {"a": (60.0, 20.0)})
    assert found == {"best origin": pytest.approx(9.0), "best turn": 0.0}


def test_a_vehicle_that_is_counted_twice_counts_once() -> None:
    layout, counts = a_layout(("a",), ("b",)), {"a": (60.0, 20.0), "b": (60.0, 20.0)}
    # 1' C^-1 1 with correlation 1 - _ALONE between them: 2 / (2 - _ALONE), and not 2.
    shared = directed(layout, {("a", "b"): 400.0}, counts)["best origin"]
    assert shared == pytest.approx(9.0 * 2 / (2 - THRESHOLDS.alone))
    # Two edges of one origin that share no vehicle are two observations.
    apart = directed(a_layout(("a", "c")), {("o", "a"): 400.0, ("o", "c"): 400.0},
                     {"a": (60.0, 20.0), "c": (60.0, 20.0)})["best origin"]  # fmt: skip
    assert apart == pytest.approx(2 * 9.0)


def test_counts_that_share_vehicles_and_disagree_are_no_demand() -> None:
    # One detector has 60 more and the other 60 fewer of the same vehicles: strength 0.
    counts = {"a": (60.0, 20.0), "b": (-60.0, 20.0)}
    found = directed(a_layout(("a",), ("b",)), {("a", "b"): 400.0}, counts)
    assert found["best origin"] == pytest.approx(0.0, abs=1e-9)


def test_exits_towards_another_light_are_counted_there_too() -> None:
    """An edge whose end has no detectors of its own is known from those at its begin."""
    layout = a_layout(("a", "b"), ("b",))
    distance = a_distance(layout, {"b": (60.0, 20.0)})
    row = INDEX["count_stop"]
    for values in (distance.difference["lane"], distance.z["lane"]):
        values[1, row] = 0.0  # nothing at the stop line of b
    found = Volume(layout, routes({("a", "b"): 400.0}), THRESHOLDS).directed(distance)
    assert found["best origin"] == pytest.approx(9.0)


WAYS: dict[Way, float] = {
    ("a", "x"): 100.0, ("a", "y"): 300.0, ("b", "x"): 240.0, ("b", "y"): 80.0, ("b", "z"): 60.0,
}  # fmt: skip
SITE = a_layout(("a", "b"), ("x", "y", "z"))
RATES = {"a": 400.0, "b": 380.0, "x": 340.0, "y": 380.0, "z": 60.0}


def changed(more: Mapping[Way, float]) -> Counts:
    """What counts differ by if ways have so many more vehicles; errors of three hours."""
    value = dict.fromkeys(RATES, 1e-6)  # nothing is exactly as expected
    for way, rate in more.items():
        for edge in way:
            value[edge] += rate
    return {edge: (value[edge], (RATES[edge] / 3.0) ** 0.5) for edge in RATES}


@pytest.mark.parametrize(("origin", "factor"), [("a", 1.2), ("b", 0.7)])
def test_a_planted_origin_comes_out_with_its_factor(origin: str, factor: float) -> None:
    more = {way: (factor - 1.0) * rate for way, rate in WAYS.items() if way[0] == origin}
    first = proposed(SITE, WAYS, changed(more))[0]
    assert first.name == "demand_level"
    assert first.fixed == (("edge", origin),)
    assert first.levels[0][0] == pytest.approx(factor, abs=1e-6)


@pytest.mark.parametrize(("way", "share"), [(("a", "x"), 0.25), (("b", "z"), 0.4)])
def test_a_planted_turn_comes_out_with_its_share(way: Way, share: float) -> None:
    # A share of the vehicles of every other way from there now takes this one.
    leaving = {other: rate for other, rate in WAYS.items() if other[0] == way[0]}
    more: dict[Way, float] = {other: -share * rate for other, rate in leaving.items()}
    more[way] += share * sum(leaving.values())
    found = proposed(SITE, WAYS, changed(more))
    first = next(item for item in found if item.name == "turning")
    assert first.fixed == (("from_edge", way[0]), ("to_edge", way[1]))
    assert first.levels[0][0] == pytest.approx(share, abs=1e-6)
    sizes = directed(SITE, WAYS, changed(more))
    assert sizes["best turn"] > sizes["best origin"]


@pytest.mark.parametrize(("origin", "behind"), [("a", 80.0), ("b", 80.0), ("b", 20.0)])
def test_lanes_tell_from_where_vehicles_turn_elsewhere(origin: str, behind: float) -> None:
    """Two approaches with a lane for each of two ways: where they go is the same for both.

    Of 200 that go to y, 80 go to x instead. Where demand is lower on these days, counts behind the
    light may show a part of them.
    """
    lanes = tuple(
        IncomingLane(f"{edge}_{i}", edge, 0, (i,), 14.0, {}, frozenset({target}))
        for edge in "ab"
        for i, target in enumerate("xy")
    )
    layout = DetectorLayout(("C",), lanes, tuple((0, f"{x}_0", f"exit:{x}") for x in "xy"), (), {})
    ways: dict[Way, float] = {(edge, target): 200.0 for edge in "ab" for target in "xy"}
    exits = {"x": (behind, 20.0), "y": (-behind, 20.0)}
    distance = a_distance(layout, exits)
    row = INDEX["count_stop"]
    for place, lane in enumerate(lanes):
        moved = 80.0 if lane.edge == origin else 1e-6
        value = moved if "x" in lane.following else -moved
        distance.difference["lane"][place, row] = value / 60.0
        distance.z["lane"][place, row] = value / 14.0
    first = next(
        h
        for h in Volume(layout, routes(ways), THRESHOLDS).hypotheses(distance)
        if h.name == "turning"
    )
    assert first.fixed == (("from_edge", origin), ("to_edge", "x"))
    assert first.levels == tuple((share,) for share in dict.fromkeys((0.4, behind / 200.0)))
    # Two lanes, 80 more and 80 fewer, errors of 14: 2 (80 / 14)^2 beside what the exits say.
    counted = a_distance(layout, exits)
    gain = Volume(layout, routes(ways), THRESHOLDS).directed(distance)["best turn"]
    alone = Volume(layout, routes(ways), THRESHOLDS).directed(counted)["best turn"]
    assert gain - alone == pytest.approx(2 * (80.0 / 14.0) ** 2, rel=0.01)


def test_counts_as_expected_propose_nothing() -> None:
    assert proposed(SITE, WAYS, changed({})) == []


def test_the_size_of_a_difference_is_that_of_chi_square_where_vehicles_come_by_chance() -> None:
    # Counts of Poisson vehicles: the squared z of the only origin has a mean of 1 at most, as
    # the counts' own share of the noise is more than there is here.
    generator = np.random.default_rng(1)
    ways = {("a", "x"): 200.0, ("a", "y"): 300.0}
    layout, sizes = a_layout(("a",), ("x", "y")), list[float]()
    for _ in range(400):
        left, right = (generator.poisson(rate) - rate for rate in (200.0, 300.0))
        counts = {"a": (left + right, 500**0.5), "x": (left, 200**0.5), "y": (right, 300**0.5)}
        sizes.append(directed(layout, ways, counts)["best origin"])
    assert 0.8 < np.mean(sizes) < 1.25  # 2 if each vehicle counted at both of its detectors


@pytest.mark.parametrize("known", [{}, {("c", "d"): 100.0}, {("a", "x"): 400.0}])
def test_edges_without_routes_do_no_harm(known: Mapping[Way, float]) -> None:
    layout = a_layout(("a", "b"), ("x",))
    counts = {"a": (60.0, 20.0), "b": (60.0, 20.0), "x": (-60.0, 20.0)}
    found = directed(layout, known, counts)
    assert set(found) == {"best origin", "best turn"}  # "turning" are measured turning counts
    assert all(np.isfinite(value) and value >= 0 for value in found.values())
    proposed(layout, known, counts)


@pytest.mark.parametrize("layout", [a_layout(()), a_layout((), ("x",)), SITE])
def test_without_counts_there_is_nothing_to_tell(layout: DetectorLayout) -> None:
    assert directed(layout, WAYS, {}) == {"best origin": 0.0, "best turn": 0.0}
    assert proposed(layout, WAYS, {}) == []


def test_routes_say_which_edges_share_vehicles(data: Path) -> None:
    found = Routes.of(load_scenario(data / "crossing"))
    assert found.joint["S_C"] == pytest.approx({"S_C": 180.0, "C_N": 180.0})
    for one, row in found.joint.items():
        assert row == {other: found.joint[other][one] for other in row}, "the same both ways"


def few(crossing: Callable[..., Path], departs: tuple[float, ...], used: bool = True) -> Scenario:
    """The crossing for 200 s with single vehicles; the first does not go on behind the light."""
    vehicles = "".join(
        f'<vehicle id="v{i}" type="car" depart="{time_s:g}">'
        f'<route edges="{"S_C C_N" if i else "S_C"}"/></vehicle>'
        for i, time_s in enumerate(departs)
    )
    directory = crossing(vehicles=vehicles)
    if used:
        demand = directory / "demand.rou.xml"
        lines = demand.read_text().splitlines()
        demand.write_text("\n".join(x for x in lines if "<route id=" not in x))
    return load_scenario(directory)


def test_only_vehicles_that_pass_both_edges_are_shared(crossing: Callable[..., Path]) -> None:
    # A vehicle in 200 s is 18 an hour.
    found = Routes.of(few(crossing, (0.0, 10.0, 20.0)))
    assert found.joint["S_C"] == pytest.approx({"S_C": 54.0, "C_N": 36.0})
    assert found.joint["C_N"] == pytest.approx({"S_C": 36.0, "C_N": 36.0})
    assert found.origins == pytest.approx({"S_C": 54.0})


def test_a_route_that_nobody_takes_is_no_vehicle(crossing: Callable[..., Path]) -> None:
    found = Routes.of(few(crossing, (0.0, 10.0, 20.0), used=False))
    assert found.origins == pytest.approx({"S_C": 54.0})


def test_vehicles_of_after_the_end_do_not_come(crossing: Callable[..., Path]) -> None:
    found = Routes.of(few(crossing, (0.0, 10.0, 20.0, 210.0, 900.0)))
    assert found.origins == pytest.approx({"S_C": 54.0})
