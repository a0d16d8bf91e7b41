"""Every measure against a crossing of two lanes that is counted by hand.

Each way is 490 m + 20 m + 490 m = 1000 m with 10 m/s; a car accelerates with 2.5 m/s^2, does not
dawdle and drives exactly the limit. SUMO moves cars first and lets new ones in after that, so a car
that departs in second t moves for the first time in second t + 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from ugat_marl import parallel_env
from ugat_marl.data import MEASURES, EpisodeRecorder, Scores
from ugat_marl.data.scores import relative_slowness
from ugat_marl.scenarios import LaneTable
from ugat_marl.simulation import HALTING_MPS, Snapshot, Trips

Crossing = Callable[..., Path]
NORTH, EAST = 0, 1  # phases: green for the road to the north, for the road to the east


def car(name: str, route: str, depart: float, position: float = 0, speed: float = 10) -> str:
    return (
        f'<vehicle id="{name}" type="car" route="{route}" depart="{depart:g}" '
        f'departPos="{position:g}" departSpeed="{speed:g}"/>'
    )


def waiting(name: str, depart: float, place: int = 0) -> str:
    """A car that stands before the stop line of the road east: 5 m long with 2.5 m between them."""
    return car(name, "east", depart, 490 - 7.5 * place, 0)


def play(directory: Path, phases: Sequence[int]) -> tuple[Scores, list[Snapshot]]:
    """One episode with a phase per decision of 10 s."""
    env = parallel_env(directory, duration_s=10 * len(phases), simulator="inprocess")
    try:
        env.reset(seed=1)
        snapshots: list[Snapshot] = []
        for phase in phases:
            env.step({"signal_0": phase})
            snapshots.append(env.snapshot)
        return env.scores(), snapshots
    finally:
        env.close()


def test_a_car_alone_takes_length_over_speed(crossing: Crossing) -> None:
    scores, snapshots = play(crossing(vehicles=car("a", "north", 0)), [NORTH] * 12)
    assert scores == Scores(
        att_s=100, att_finished_s=100, throughput=1, reward=0, queue=0, delay=0, delay_s=0,
        due=1, departed=1, backlog=0,
    )  # fmt: skip
    # On its first road while its front is there: 490 m are passed in second 50.
    assert [s.vehicles.tolist() for s in snapshots[:6]] == [[1, 0, 0, 0]] * 5 + [[0, 0, 1, 0]]
    assert [s.time_s for s in snapshots] == [10.0 * n for n in range(1, 13)]


def test_a_car_at_a_red_light_waits_for_known_seconds(crossing: Crossing) -> None:
    # Red until second 30. Then 2.5 + 5 + 7.5 + 10 m in four seconds, and 10 m/s for the remaining
    # 485 m: 53 moves, the first in second 30, the last in second 82.
    scores, snapshots = play(crossing(vehicles=waiting("a", 0)), [NORTH] * 3 + [EAST] * 7)
    assert scores.att_s == scores.att_finished_s == 82
    # It moves for the first time in second 30: 29 s lost standing (of seconds 1 to 29), then three
    # quarters, a half and a quarter of a second while it is slower than the limit.
    assert scores.delay_s == pytest.approx(29 + 0.75 + 0.5 + 0.25, abs=0.01)
    assert [s.halting.tolist() for s in snapshots[:4]] == [[0, 1, 0, 0]] * 3 + [[0, 0, 0, 0]]
    # Three of ten decisions with one car standing.
    assert scores.queue == pytest.approx(0.3)
    assert scores.reward == pytest.approx(-0.3)
    # At these three the lane's speed is 0 of 10 m/s; the other lane is empty and counts 0.
    assert scores.delay == pytest.approx(0.3 / 2)
    assert [s.mean_speed_mps.tolist() for s in snapshots[:3]] == [[10, 0, 10, 10]] * 3


def test_the_queue_is_the_cars_that_stand(crossing: Crossing) -> None:
    cars = "".join(waiting(f"w{place}", 0, place) for place in range(4)) + car("n", "north", 0)
    scores, snapshots = play(crossing(vehicles=cars), [NORTH] * 4)
    # Four stand in the east lane, the fifth drives north.
    assert [s.halting[1] for s in snapshots] == [4] * 4
    assert [s.vehicles.tolist()[:2] for s in snapshots] == [[1, 4]] * 4
    assert scores.queue == 4
    assert scores.reward == -4
    assert scores.delay == pytest.approx(1 / 2)
    assert (scores.due, scores.departed, scores.throughput) == (5, 5, 0)
    assert math.isnan(scores.att_finished_s)
    assert scores.att_s == 40


def test_a_slow_lane_is_as_late_as_its_mean_speed_says(crossing: Crossing) -> None:
    # One car stands at the line, one enters 490 m behind it with 10 m/s: mean speed 5, then 0.
    cars = waiting("a", 0) + car("b", "east", 15)
    scores, snapshots = play(crossing(vehicles=cars), [NORTH] * 2)
    assert snapshots[1].mean_speed_mps[1] == pytest.approx(5)
    assert snapshots[1].halting[1] == 1
    assert scores.delay == pytest.approx((1 / 2 + 0.5 / 2) / 2)


def test_cars_that_never_get_in_count(crossing: Crossing) -> None:
    # a stands on the only place where b and c may depart; d is due after the end.
    cars = waiting("a", 0) + waiting("b", 10) + waiting("c", 150) + waiting("d", 250)
    scores, snapshots = play(crossing(vehicles=cars), [NORTH] * 20)
    assert (scores.due, scores.departed, scores.backlog, scores.throughput) == (3, 1, 2, 0)
    assert scores.att_s == pytest.approx((200 + 190 + 50) / 3)
    # a moves in no second from 1 to 199; b and c wait outside from the moment they are due.
    assert scores.delay_s == pytest.approx((199 + 190 + 50) / 3)
    assert [s.backlog for s in snapshots[:2]] == [0, 1]
    assert snapshots[-1].backlog == 2
    assert snapshots[-1].departed == 1


def test_waiting_outside_counts_for_a_car_that_gets_in_later(crossing: Crossing) -> None:
    # b is due at 10, while a stands in its place until second 30.
    inside, _ = play(crossing(vehicles=waiting("a", 0)), [NORTH] * 3 + [EAST] * 7)
    both, _ = play(crossing(vehicles=waiting("a", 0) + waiting("b", 10)), [NORTH] * 3 + [EAST] * 7)
    late_s = 2 * both.att_s - inside.att_s
    # Alone, b would need 53 s; it cannot begin before a has driven off.
    assert 20 + 53 < late_s < 20 + 53 + 5
    assert both.throughput == 2


def test_unfinished_cars_count_until_the_end(crossing: Crossing) -> None:
    cars = car("a", "north", 0) + car("b", "north", 80)
    scores, _ = play(crossing(vehicles=cars), [NORTH] * 12)
    assert scores.att_s == (100 + 40) / 2
    assert scores.att_finished_s == 100
    assert (scores.throughput, scores.due, scores.departed) == (1, 2, 2)


@pytest.mark.filterwarnings("ignore:.*no vehicle has entered")
def test_an_episode_that_begins_later_counts_from_there(crossing: Crossing) -> None:
    directory = crossing(
        vehicles=car("a", "north", 3610),
        toml=lambda text: text.replace("duration_s", "begin_s = 3600\nduration_s"),
    )
    scores, snapshots = play(directory, [NORTH] * 12)
    assert scores.att_s == 100
    assert snapshots[0].time_s == 3610


@pytest.mark.filterwarnings("ignore:.*no vehicle has entered")
def test_nothing_due_is_not_a_number(crossing: Crossing) -> None:
    scores, _ = play(crossing(vehicles=car("a", "north", 29)), [NORTH] * 2 + [EAST])
    assert scores.att_s == 1
    empty = EpisodeRecorder(TABLE, [np.array([0])]).scores(trips([]))
    assert math.isnan(empty.att_s)
    assert math.isnan(empty.delay_s)
    assert (empty.due, empty.queue, empty.delay) == (0, 0, 0)


# --- the arithmetic alone

TABLE = LaneTable(("a", "b", "c"), np.array([10.0, 10.0, 1.0]), np.array([10.0, 20.0, 5.0]))


def snapshot(halting: Sequence[float], speed: Sequence[float]) -> Snapshot:
    full = np.array(halting, dtype=np.float64)
    return Snapshot(0.0, full, full, np.array(speed, dtype=np.float64), np.empty(0), 0, 0)


def trips(rows: Sequence[tuple[float, float, bool, bool]]) -> Trips:
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return Trips(table[:, 0], table[:, 1], table[:, 2] > 0, table[:, 3] > 0)


def test_relative_slowness() -> None:
    speeds, limits = np.array([10.5, 5.0, 0.0]), TABLE.speed_mps
    np.testing.assert_allclose(relative_slowness(speeds, limits), [0, 0.75, 1])
    np.testing.assert_allclose(relative_slowness(speeds[2:], limits[2:]), [1])


def test_means_over_decisions_intersections_and_lanes() -> None:
    # Two intersections: one with lanes a and b, one with c.
    recorder = EpisodeRecorder(TABLE, [np.array([0, 1]), np.array([2])])
    recorder.add(snapshot([1, 2, 3], [10, 20, 5]), -3.0)
    recorder.add(snapshot([0, 0, 1], [5, 20, 0]), -0.5)
    scores = recorder.scores(
        trips([(10, 1, True, True), (30, 9, False, True), (5, 5, False, False)])
    )
    assert scores == Scores(
        att_s=15, att_finished_s=10, throughput=1, reward=-1.75, queue=(6 / 2 + 1 / 2) / 2,
        delay=(0 + (0.5 + 0 + 1) / 3) / 2, delay_s=5, due=3, departed=2, backlog=1,
    )  # fmt: skip


def test_every_measure_is_a_score() -> None:
    names = set(Scores.__dataclass_fields__)
    assert set(MEASURES) <= names
    assert HALTING_MPS == 0.1
