"""Observations and rewards of a network drawn by hand, with numbers worked out by hand.

w, n -> [A] -> ab -> [B] -> x -> [C] -> y          (e joins at B, s leaves at A)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ugat_marl.data import AgentLayout
from ugat_marl.effects import ControllerPart
from ugat_marl.effects.sensors import (
    CountingNoise,
    DetectionZone,
    DetectorFailure,
    LostReadings,
    ObservationDelay,
)
from ugat_marl.envs import OBSERVATION_UNITS, Observer
from ugat_marl.envs.rewards import IntersectionView, Rewarder
from ugat_marl.envs.sensors import Sensors
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.scenarios import Intersection, Lane, Link, Network
from ugat_marl.simulation import Snapshot

CAPACITY = {"w": 10, "n": 20, "ab": 5, "s": 10, "e": 40, "x": 8, "y": 1}
LANES = tuple(CAPACITY)  # the order in which the intersections name them


def intersection(
    name: str, links: list[tuple[str, str]], phases: int, neighbours: tuple[str, ...]
) -> Intersection:
    made = tuple(Link(i, a, b, "s") for i, (a, b) in enumerate(links))
    return Intersection(
        id=name,
        incoming_lanes=tuple(dict.fromkeys(a for a, _ in links)),
        outgoing_lanes=tuple(dict.fromkeys(b for _, b in links)),
        links=made,
        phases=tuple("r" * i + "G" + "r" * (len(links) - i - 1) for i in range(phases)),
        programme=(),
        neighbours=neighbours,
        position=(0.0, 0.0),
    )


NETWORK = Network(
    lanes={
        name: Lane(name, f"edge_{name}", 7.5 * capacity, 13.9, ((0.0, 0.0), (1.0, 0.0)))
        for name, capacity in CAPACITY.items()
    },
    intersections=(
        intersection("A", [("w", "ab"), ("w", "s"), ("n", "s")], 3, ("B",)),
        intersection("B", [("ab", "x"), ("e", "x")], 2, ("A", "C")),
        intersection("C", [("x", "y"), ("x", "y")], 2, ("B",)),
    ),
    uncontrolled=(),
)


def snapshot(**lanes: tuple[float, float, float]) -> Snapshot:
    """Vehicles, halting and waiting time of the lanes named; others are empty."""
    table = np.array([lanes.get(name, (0.0, 0.0, 0.0)) for name in LANES])
    return Snapshot(
        time_s=30.0,
        vehicles=table[:, 0],
        halting=table[:, 1],
        mean_speed_mps=np.full(len(LANES), 13.9),
        waiting_s=table[:, 2],
        departed=100,
        backlog=0,
        queued_upstream=np.zeros(len(LANES)),
    )


SEEN = snapshot(
    w=(5, 4, 100),
    n=(30, 20, 4000),  # more than fit: short vehicles
    ab=(4, 1, 50),
    s=(2, 0, 0),
    e=(50, 44, 1000),
    x=(8, 8, 80),
)
PHASES = [2, 0, 1]  # shown by A, B, C

FEATURES: dict[str, tuple[list[float], list[float], list[float]]] = {
    "count": ([5 / 40, 30 / 40], [4 / 40, 1.0], [8 / 40]),
    "queue": ([4 / 40, 20 / 40], [1 / 40, 1.0], [8 / 40]),
    "density": ([0.5, 1.0], [0.8, 1.0], [1.0]),
    "waiting": ([0.1, 1.0], [0.1, 0.25], [0.1]),
    # w leads to ab (0.8) and s (0.2); n to s; ab and e to x (1.0); x to y (empty)
    "pressure": ([0.5 - 0.5, 1.0], [0.8 - 1.0, 1.25 - 1.0], [1.0]),
    "movements": (
        [0.4, 1.0, 0.5, 1.0, 0.8, 0.2],
        [0.2, 1.0, 0.8, 1.0, 1.0],
        [1.0, 1.0, 0.0],
    ),
}
ONE_HOT = ([0, 0, 1], [1, 0], [0, 1])


@pytest.mark.parametrize("name", FEATURES)
def test_every_observation_is_what_it_says(name: str) -> None:
    observer = Observer(NETWORK, name)
    vectors = observer.observe(SEEN, PHASES)
    for vector, features, phase, layout, space in zip(
        vectors, FEATURES[name], ONE_HOT, observer.layouts, observer.spaces, strict=True
    ):
        np.testing.assert_allclose(vector, [*features, *phase], rtol=1e-6)
        assert layout == AgentLayout(len(features), len(phase))
        assert space.shape == vector.shape and space.contains(vector)
        assert vector.dtype == np.float32


def test_all_observations_are_tested_and_have_units() -> None:
    assert set(FEATURES) == set(OBSERVATION_UNITS)


def test_pressure_is_clipped_on_both_sides() -> None:
    observer = Observer(NETWORK, "pressure")
    a, b, _ = observer.observe(snapshot(w=(99, 0, 0), x=(99, 0, 0)), PHASES)
    assert a[0] == 1.0 and b[0] == -1.0
    assert observer.spaces[0].low.tolist() == [-1, -1, 0, 0, 0]


def test_neighbours_follow_with_features_and_phase_nearest_first() -> None:
    own = Observer(NETWORK, "count").observe(SEEN, PHASES)
    one = Observer(NETWORK, "count", neighbours=1)
    a, b, c = one.observe(SEEN, PHASES)
    np.testing.assert_array_equal(a, np.concatenate((own[0], own[1])))
    np.testing.assert_array_equal(b, np.concatenate((own[1], own[0], own[2])))
    np.testing.assert_array_equal(c, np.concatenate((own[2], own[1])))
    assert one.layouts[1] == AgentLayout(features=2, phases=2, context=5 + 3)
    two = Observer(NETWORK, "count", neighbours=2)
    a, b, c = two.observe(SEEN, PHASES)
    np.testing.assert_array_equal(a, np.concatenate((own[0], own[1], own[2])))
    np.testing.assert_array_equal(c, np.concatenate((own[2], own[1], own[0])))
    for observer in (one, two):
        for vector, space in zip(observer.observe(SEEN, PHASES), observer.spaces, strict=True):
            assert space.contains(vector)
    pressure = Observer(NETWORK, "pressure", neighbours=1)
    assert pressure.spaces[0].low.tolist() == [-1, -1, 0, 0, 0, -1, -1, 0, 0]


def test_more_neighbours_than_there_are_change_nothing_more() -> None:
    assert Observer(NETWORK, neighbours=9).layouts == Observer(NETWORK, neighbours=2).layouts


def test_vectors_are_fresh_at_each_call() -> None:
    observer = Observer(NETWORK)
    first = observer.observe(SEEN, PHASES)
    first[0][:] = 7
    assert observer.observe(SEEN, PHASES)[0].max() <= 1


def test_only_waiting_needs_waiting_times() -> None:
    assert [name for name in OBSERVATION_UNITS if Observer(NETWORK, name).needs_waiting] == [
        "waiting"
    ]
    blind = replace(SEEN, waiting_s=np.empty(0))
    for name in set(OBSERVATION_UNITS) - {"waiting"}:
        Observer(NETWORK, name).observe(blind, PHASES)


def test_impossible_settings_name_the_nearest_or_the_allowed() -> None:
    with pytest.raises(UnknownNameError, match=r"'presure'.* mean 'pressure'"):
        Observer(NETWORK, "presure")
    with pytest.raises(OptionError, match="neighbours = -1"):
        Observer(NETWORK, neighbours=-1)


# --- rewards ------------------------------------------------------------------------------------

BEFORE = snapshot(w=(9, 9, 300), n=(1, 0, 20), ab=(5, 5, 500), e=(2, 1, 3), x=(3, 3, 7))


def test_queue_is_minus_the_halting_vehicles_on_incoming_lanes() -> None:
    assert Rewarder(NETWORK, "queue").rewards(BEFORE, SEEN) == [-24.0, -45.0, -8.0]


def test_total_queue_adds_the_vehicles_that_queue_upstream() -> None:
    upstream = np.zeros(len(LANES))
    upstream[[LANES.index("n"), LANES.index("y")]] = 2.5, 9.0  # y is not an incoming lane
    longer = replace(SEEN, queued_upstream=upstream)
    assert Rewarder(NETWORK, "total-queue").rewards(BEFORE, longer) == [-26.5, -45.0, -8.0]


def test_pressure_is_minus_the_imbalance_of_incoming_and_outgoing_lanes() -> None:
    # A: 5 + 30 in, 4 + 2 out; B: 4 + 50 in, 8 out; C: 8 in, 0 out
    assert Rewarder(NETWORK, "pressure").rewards(BEFORE, SEEN) == [-29.0, -46.0, -8.0]
    reverse = snapshot(ab=(5, 0, 0))
    assert Rewarder(NETWORK, "pressure").rewards(BEFORE, reverse)[0] == -5.0


def test_waiting_is_the_decrease_of_the_summed_waiting_time() -> None:
    # A: 320 before, 4100 after; B: 503, 1050; C: 7, 80
    assert Rewarder(NETWORK, "waiting").rewards(BEFORE, SEEN) == [-3780.0, -547.0, -73.0]
    assert Rewarder(NETWORK, "waiting").rewards(SEEN, BEFORE) == [3780.0, 547.0, 73.0]


def test_a_function_gets_the_views_before_and_after() -> None:
    views: list[tuple[IntersectionView, IntersectionView]] = []

    def cleared(before: IntersectionView, after: IntersectionView) -> float:
        views.append((before, after))
        return before.vehicles.sum() - after.vehicles.sum()

    rewards = Rewarder(NETWORK, cleared).rewards(BEFORE, SEEN)
    assert rewards == [10 - 35, 7 - 54, 3 - 8]
    assert all(type(reward) is float for reward in rewards)
    before, after = views[0]
    assert after.vehicles.tolist() == [5, 30] and after.outgoing_vehicles.tolist() == [4, 2]
    assert after.halting.tolist() == [4, 20] and before.waiting_s.tolist() == [300, 20]
    assert after.time_s == 30.0 and after.mean_speed_mps.tolist() == [13.9, 13.9]


def test_a_function_that_changes_its_length_is_told() -> None:
    lengths = iter([2, 2, 2, 2, 2, 3])

    def some(view: IntersectionView) -> list[float]:
        return [0.0] * next(lengths)

    with pytest.raises(OptionError, match="returned 3 numbers .* returned 2 before"):
        Observer(NETWORK, some).observe(SEEN, PHASES)
    with pytest.raises(OptionError, match=r"an array of shape \(0,\)"):
        Observer(NETWORK, lambda view: [])


def test_functions_and_waiting_need_waiting_times() -> None:
    assert Rewarder(NETWORK, lambda before, after: 0.0).needs_waiting
    assert Rewarder(NETWORK, "waiting").needs_waiting
    assert not Rewarder(NETWORK, "queue").needs_waiting
    assert not Rewarder(NETWORK, "pressure").needs_waiting


def test_an_unknown_reward_names_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match=r"'que'.* mean 'queue'.* function works as well"):
        Rewarder(NETWORK, "que")


def test_commands_follow_with_the_age_of_the_green_the_latest_first() -> None:
    observer = Observer(NETWORK, "count", neighbours=1, commands=2)
    plain = Observer(NETWORK, "count", neighbours=1)
    memory = observer.memory(10.0)
    assert memory is not None and plain.memory(10.0) is None
    assert observer.layouts[1] == AgentLayout(features=2, phases=2, context=5 + 3 + 2 * 2 + 1)

    def remembered() -> list[list[float]]:
        vectors = observer.observe(SEEN, PHASES, memory)
        for vector, before, space in zip(
            vectors, plain.observe(SEEN, PHASES), observer.spaces, strict=True
        ):
            np.testing.assert_array_equal(vector[: len(before)], before)
            assert space.contains(vector)
        widths = [len(before) for before in plain.observe(SEEN, PHASES)]
        own = [v[width:].astype(float) for v, width in zip(vectors, widths, strict=True)]
        return [np.round(row, 3).tolist() for row in own]

    memory.reset([0, 0, 0])
    assert remembered()[1] == [0, 0, 0, 0, 0]  # nothing was asked for
    memory.add([2, 1, 0], [0, 1, 0])
    assert remembered()[1] == [0, 1, 0, 0, 0.167]  # its green began in this decision
    memory.add([1, 0, 0], [0, 1, 0])
    assert remembered() == [
        [0, 1, 0, 0, 0, 1, 0.333],
        [1, 0, 0, 1, 0.333],
        [1, 0, 1, 0, 0.333],
    ]
    for _ in range(9):
        memory.add([0, 0, 0], [0, 1, 0])
    assert remembered()[0][-1] == 1.0  # older than a minute
    memory.reset([0, 0, 0])
    assert remembered()[0] == [0, 0, 0, 0, 0, 0, 0]


def views_through(*effects: ControllerPart, snapshots: int = 1) -> IntersectionView:
    """View of intersection A that a function gets behind these effects, at the last snapshot."""
    views: list[IntersectionView] = []

    def features(view: IntersectionView) -> list[float]:
        views.append(view)
        return [0.0]

    queued = replace(
        SEEN,
        mean_speed_mps=np.full(len(LANES), 2.0),
        queued_upstream=np.full(len(LANES), 3.0),
        near=np.tile([[2.0], [1.0], [9.0], [12.9]], len(LANES)),
    )
    observer = Observer(NETWORK, features)
    sensors = Sensors.of(effects, NETWORK, 10.0)
    assert sensors is not None
    sensors.reset(1)
    for _ in range(snapshots):
        seen = sensors.see(queued)
    views.clear()
    observer.observe(seen, PHASES)
    return views[0]


@pytest.mark.parametrize(
    "effect", [DetectorFailure(1.0), ObservationDelay(20.0), LostReadings(1.0)]
)
def test_a_function_sees_empty_lanes_where_no_counts_arrive(effect: ControllerPart) -> None:
    view = views_through(effect, snapshots=2)
    assert not np.any([view.vehicles, view.halting, view.waiting_s, view.outgoing_vehicles])
    assert view.queued_upstream.tolist() == [0, 0]
    assert view.mean_speed_mps.tolist() == [13.9, 13.9]
    late = views_through(ObservationDelay(20.0), snapshots=3)
    assert late.vehicles.tolist() == [5, 30] and late.queued_upstream.tolist() == [3, 3]
    assert late.mean_speed_mps == pytest.approx([2.0, 2.0])


def test_a_function_sees_the_zone_and_the_noise_that_others_see() -> None:
    view = views_through(DetectionZone(30.0))
    assert view.vehicles.tolist() == [2, 2] and view.queued_upstream.tolist() == [0, 0]
    assert view.mean_speed_mps == pytest.approx([1.0, 1.0])
    view = views_through(CountingNoise(0.5))
    assert view.queued_upstream / 3 == pytest.approx(view.vehicles / [5, 30])
    assert view.vehicles.tolist() != [5, 30] and view.mean_speed_mps == pytest.approx([2.0, 2.0])
