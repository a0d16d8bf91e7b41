"""Vehicles on a lane from its detectors, against hand counts and planted queues."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ugat_marl.errors import OptionError
from ugat_marl.grounding.detected import (
    DetectionConfig,
    LaneCourse,
    LaneEstimate,
    _aligned,
    _Clock,
    _Crossings,
    greens_of,
    staircase,
)
from ugat_marl.scenarios import Detector, Lane, Passages, Period

LANE = Lane("W_0", "W", 300.0, 10.0, ((0.0, 0.0), (300.0, 0.0)))
ADVANCE = Detector("advance", "W_0", 250.0, 0.0, "advance", clock="signals")
STOP = Detector("stop", "W_0", 297.5, 0.0, "stop", clock="signals")
ENTRY = Detector("entry", "W_0", 10.0, 0.0, "exit", clock="signals")


def crossed(times_s: Sequence[float], speed_mps: float | Sequence[float] = 10.0) -> Passages:
    """Cars of 5 m whose fronts reach a point at some times."""
    on_s = np.array(times_s, dtype=np.float64)
    speed = np.broadcast_to(np.array(speed_mps, dtype=np.float64), on_s.shape)
    return Passages(on_s, on_s + 5.0 / speed, speed, np.full(len(on_s), 5.0))


def course(passages: dict[str, Passages], end_s: float = 600.0, lane: Lane = LANE) -> LaneCourse:
    detectors = [d for d in (ADVANCE, STOP, ENTRY) if d.id in passages]
    period = Period("day", 0.0, end_s, "fit", {}, passages)
    (found,) = LaneEstimate([period], {lane.id: lane}, detectors).incoming(lane.id)
    return found


def free(starts_s: Sequence[float]) -> dict[str, Passages]:
    """Cars that enter the lane at some times and drive on at 10 m/s."""
    starts = np.array(starts_s)
    return {"advance": crossed(list(starts + 25.0)), "stop": crossed(list(starts + 29.75))}


def test_free_vehicles_are_on_the_lane_from_its_begin_to_its_end() -> None:
    found = course(free([10, 20, 50]))
    assert found.come_s == pytest.approx([10, 20, 50])
    assert found.leave_s == pytest.approx([40, 50, 80])
    times = np.array([9.0, 11.0, 21.0, 45.0, 55.0, 90.0])
    assert found.vehicles(times).tolist() == [0, 1, 2, 1, 1, 0]
    assert found.unmatched == 0 and found.jams == ()
    assert found.blind_s == pytest.approx(25.0)


def aligned_by_a_whole_table(
    first: _Crossings, last: _Crossings, fastest_s: float, config: DetectionConfig
) -> float:
    """The least cost of all ways to match passages in order, from the table of all pairs."""
    total = np.full((len(last) + 1, len(first) + 1), np.inf)
    total[0] = config.unmatched * np.arange(len(first) + 1)
    total[:, 0] = config.unmatched * np.arange(len(last) + 1)
    for j in range(len(last)):
        for i in range(len(first)):
            cost = cost_of(first, last, i, j, fastest_s, config)
            skipped = min(total[j, i + 1], total[j + 1, i]) + config.unmatched
            total[j + 1, i + 1] = min(total[j, i] + cost, skipped)
    return float(total[-1, -1])


def cost_of(
    first: _Crossings, last: _Crossings, i: int, j: int, fastest_s: float, config: DetectionConfig
) -> float:
    ride_s = last.on_s[j] - first.on_s[i]
    if not fastest_s <= ride_s <= config.longest_s:
        return math.inf
    cost = 2.0 if abs(first.length_m[i] - last.length_m[j]) > 0.5 else 0.0
    if min(first.speed_mps[i], last.speed_mps[j]) >= 7.0:
        expected_s = 50.0 / (0.5 * (first.speed_mps[i] + last.speed_mps[j]))
        off = abs(ride_s - expected_s) / (0.5 + 2.0 * config.speed_spread * expected_s)
        cost += min(off, 2.0 * config.unmatched)
    return cost


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_passages_are_matched_at_the_least_cost(data: st.DataObject) -> None:
    config, fastest_s = DetectionConfig(longest_s=60.0), 2.0
    times = st.lists(st.integers(0, 300), max_size=12).map(sorted)

    def crossings() -> _Crossings:
        on_s = np.array(data.draw(times), dtype=np.float64)
        speed = data.draw(st.lists(st.sampled_from([3.0, 10.0]), min_size=12, max_size=12))
        length = data.draw(st.lists(st.sampled_from([5.0, 12.0]), min_size=12, max_size=12))
        cut = slice(len(on_s))
        return _Crossings(on_s, on_s + 1.0, np.array(speed)[cut], np.array(length)[cut])

    first, last = crossings(), crossings()
    pairs = _aligned(first, last, 50.0, fastest_s, 10.0, config)
    assert (np.diff(pairs, axis=0) > 0).all()
    lone = len(first) + len(last) - 2 * len(pairs)
    cost = sum(cost_of(first, last, i, j, fastest_s, config) for i, j in pairs.tolist())
    cost += config.unmatched * lone
    assert cost == pytest.approx(aligned_by_a_whole_table(first, last, fastest_s, config))


@pytest.mark.slow
def test_a_day_of_passages_needs_no_table_of_all_pairs() -> None:
    on_s = np.cumsum(np.full(10_000, 8.0))
    first = _Crossings(on_s, on_s + 0.5, np.full(10_000, 10.0), np.full(10_000, 5.0))
    last = replace(first, on_s=on_s + 5.0, off_s=on_s + 5.5)
    tracemalloc.start()
    pairs = _aligned(first, last, 50.0, 2.0, 10.0, DetectionConfig())
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (pairs[:, 0] == pairs[:, 1]).all() and len(pairs) == 10_000
    assert most < 100e6


def test_who_leaves_early_counts_for_longer() -> None:
    # Two cars leave 2.5 s and 7.5 s after the decision: 1 to 10 s see 8 and 3 of them.
    found = course(free([12.5, 17.5]))
    assert found.mean_left(np.array([40.0]), 10.0) == pytest.approx([(8 + 3) / 10])


def test_a_queue_that_ends_before_the_advance_detector_is_exact() -> None:
    came = {"advance": crossed([35, 38, 41]), "stop": crossed([60, 62.5, 65], [3, 5, 7])}
    found = course(came)
    assert found.come_s == pytest.approx([10, 13, 16])
    assert found.vehicles(np.array([59.0, 61.5, 64.0, 66.0])).tolist() == [3, 2, 1, 0]
    # all of them stand before the green of 58 s; 2 s later the first one has started
    standing = found.halting(np.array([50.0, 58.5]), [(58.0, 90.0)], DetectionConfig())
    assert standing.tolist() == [3, 2]


def test_vehicles_of_a_jam_are_spread_between_the_free_ones_around_it() -> None:
    # Four slow cars over the advance detector; one was free before, one after.
    advance = crossed([25, 40, 60, 62, 64, 85], [10, 1, 2, 2, 2, 10])
    stop = crossed([29.75, 58, 64, 67, 70, 89.75], [10, 2, 4, 5, 5, 10])
    found = course({"advance": advance, "stop": stop})
    (jam,) = found.jams
    assert (jam.count, jam.open) == (3, False)
    # The first slow one came on time: at 15 s. The others came between it and the one of 60 s, and
    # 25 s before they were seen at 60, 62 and 64 s: by rejection, from a million triples.
    drawn = np.sort(15.0 + 45.0 * np.random.default_rng(1).random((1_000_000, 3)), axis=1)
    drawn = drawn[(drawn <= [35.0, 37.0, 39.0]).all(1)]
    assert found.come_s == pytest.approx([0, 15, *drawn.mean(0), 60], abs=0.05)
    expected = (drawn <= 30.0).sum(1).std()
    assert found.deviation(np.array([30.0])) == pytest.approx([expected], rel=0.01)


def test_without_latest_times_a_jam_is_spread_evenly() -> None:
    mean, grid, variance = staircase(np.ones(4))
    assert mean == pytest.approx([0.2, 0.4, 0.6, 0.8], abs=1e-4)
    assert variance == pytest.approx(4 * grid * (1 - grid), abs=1e-9)


def test_a_jam_of_very_many_vehicles_has_times() -> None:
    mean, _, variance = staircase(np.full(300, 1e-6))
    assert np.isfinite(mean).all() and np.isfinite(variance).all()
    assert (np.diff(mean) > 0).all()


@pytest.mark.parametrize("last", [0.05, 1.0])
def test_a_jam_whose_vehicles_came_early_in_a_long_span_has_times(last: float) -> None:
    """All but the last were due in a twentieth of the span: 700 vehicles, then a dead detector."""
    latest = np.append(np.linspace(0.0, 0.05, 699), last)
    mean, _, variance = staircase(latest)
    assert np.isfinite(mean).all() and np.isfinite(variance).all()
    assert (np.diff(mean) >= 0).all()
    assert (mean[:-1] <= 0.1).all() and mean[-1] <= last + 0.05


def test_early_latest_times_give_the_mean_of_drawn_arrivals() -> None:
    latest = np.array([0.12, 0.2, 0.25, 0.25, 0.9])
    drawn = np.sort(np.random.default_rng(2).random((4_000_000, 5)), axis=1)
    drawn = drawn[(drawn <= latest).all(1)]
    mean, _, _ = staircase(latest)
    assert mean == pytest.approx(drawn.mean(0), abs=0.005)


def test_a_jam_of_an_hour_fits_into_memory() -> None:
    """A matrix of chances for each moment took 7 GB."""
    tracemalloc.start()
    try:
        mean, _, _ = staircase(np.linspace(0.0, 1.0, 600))
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert (np.diff(mean) > 0).all()
    assert most < 100e6


def test_exit_detectors_say_when_the_vehicles_of_a_jam_came() -> None:
    advance = crossed([25, 40, 60, 62, 64, 85], [10, 1, 2, 2, 2, 10])
    stop = crossed([29.75, 58, 64, 67, 70, 89.75], [10, 2, 4, 5, 5, 10])
    entries = crossed([1, 16, 20, 22, 24, 61])
    found = course({"advance": advance, "stop": stop, "entry": entries})
    even = course({"advance": advance, "stop": stop})
    truth = np.array([20.0, 22.0, 24.0])
    errors = [np.abs(one.come_s[2:5] - truth).max() for one in (found, even)]
    assert errors[0] < 5.0 < errors[1]


def test_a_jam_that_never_ends_grows_at_the_rate_of_free_times() -> None:
    # A car every 5 s comes; from 100 s on the light serves one in 10 s, and the queue grows.
    generator = np.random.default_rng(0)
    errors: list[float] = []
    rates: list[float] = []
    for _ in range(40):
        starts = np.sort(generator.uniform(0.0, 600.0, generator.poisson(120)))
        first = starts < 100.0
        slow = 130.0 + 10.0 * np.arange(40)
        advance = crossed(
            [*(starts[first] + 25.0), *slow], [10.0] * int(first.sum()) + [2.0] * len(slow)
        )
        stop = crossed(
            [*(starts[first] + 29.75), *(slow + 35.0)], [10.0] * int(first.sum()) + [4.0] * 40
        )
        found = course({"advance": advance, "stop": stop})
        assert found.jams[-1].open
        (deviation,) = found.deviation(np.array([400.0]))
        true = min((starts < 400.0).sum() - (found.leave_s <= 400.0).sum(), LANE.storage_veh)
        errors.append((found.vehicles(np.array([400.0]))[0] - true) / deviation)
        rates.append(found.jams[-1].error * np.sqrt(first.sum()))
    assert np.abs(errors).mean() < 1.5
    assert np.mean(rates) == pytest.approx(1.0, rel=0.2)


def test_exit_detectors_count_the_queue_of_a_jam_that_never_ends() -> None:
    # A car every 5 s comes on the road, and from 100 s on one in 10 s leaves by this lane. Every
    # third one takes the free lane beside it.
    starts = 5.0 * np.arange(110)
    beside = np.arange(110) % 3 == 2
    slow = 130.0 + 10.0 * np.arange(44)
    first = starts[~beside & (starts < 100.0)]
    passages = {
        "advance": crossed([*(first + 25.0), *slow], [10.0] * len(first) + [2.0] * 44),
        "stop": crossed([*(first + 29.75), *(slow + 35.0)], [10.0] * len(first) + [4.0] * 44),
        "entry": crossed(list(starts + 1.0)),
        "advance beside": crossed(list(starts[beside] + 25.0)),
        "stop beside": crossed(list(starts[beside] + 29.75)),
        "entry beside": Passages.none(),
    }
    other = Lane("W_1", "W", 300.0, 10.0, ())
    detectors = [ADVANCE, STOP, ENTRY]
    detectors += [replace(d, id=f"{d.id} beside", lane="W_1") for d in detectors]
    period = Period("day", 0.0, 575.0, "fit", {}, passages)
    lanes = {"W_0": LANE, "W_1": other}
    (found,) = LaneEstimate([period], lanes, detectors).incoming("W_0")
    assert found.jams[-1].open
    for time in (200.0, 350.0, 500.0):
        came = int(((starts <= time) & ~beside).sum())
        true = came - int((found.leave_s <= time).sum())
        assert found.vehicles(np.array([time]))[0] == pytest.approx(true, abs=1), time
    # Without them the rate of free times is all there is, and the deviation says so.
    bare = [d for d in detectors if d.kind != "exit"]
    (guess,) = LaneEstimate([period], lanes, bare).incoming("W_0")
    times = np.array([500.0])
    assert found.deviation(times)[0] < 0.5 * guess.deviation(times)[0]


def test_a_lane_never_holds_more_than_fit_on_it() -> None:
    slow = 130.0 + 10.0 * np.arange(45)
    head = 25.0 + 2.0 * np.arange(40)
    advance = crossed([*head, *slow], [10.0] * 40 + [2.0] * 45)
    stop = crossed([*(head + 4.75), *(slow + 35.0)], [10.0] * 40 + [4.0] * 45)
    found = course({"advance": advance, "stop": stop})
    held = found.vehicles(np.arange(0.0, 600.0, 5.0))
    assert held.max() <= LANE.storage_veh
    assert held[-1] > 0.8 * LANE.storage_veh


def test_a_missed_vehicle_and_a_change_of_lanes_do_not_shift_the_others() -> None:
    starts = [10.0, 20, 50, 90, 130, 170]
    there = free(starts)
    missed = there["advance"].at(np.array([0, 1, 3, 4, 5]))
    found = course({"advance": missed, "stop": there["stop"]})
    assert found.unmatched == 1
    assert found.leave_s == pytest.approx(np.array(starts) + 30.0)
    kept = np.array([0, 1, 3, 4, 5])
    assert found.come_s[kept] == pytest.approx(np.array(starts)[kept])
    gone = there["stop"].at(np.array([0, 1, 2, 4, 5]))
    found = course({"advance": there["advance"], "stop": gone})
    assert found.unmatched == 1
    # The one that changed lanes behind the advance detector did so before the next one came by:
    # between 115.5 s, where it left the detector, and 155.25 s.
    assert found.vehicles(np.array([100.0, 134.0, 137.0])).tolist() == [1, 2, 1]
    assert found.deviation(np.array([125.0]))[0] == pytest.approx(0.5, abs=0.1)


def test_without_an_advance_detector_vehicles_are_known_when_they_leave() -> None:
    found = course({"stop": crossed([29.75, 80, 82.5, 85, 119.75], [10, 2, 4, 5, 10])})
    assert found.come_s[[0, 4]] == pytest.approx([0, 90])
    assert found.vehicles(np.array([79.0]))[0] >= 2  # it waits on the detector; others are guessed
    assert found.deviation(np.array([52.0]))[0] > 0.4
    assert found.deviation(np.array([75.0]))[0] == 0.0  # the lane takes 29.75 s without a queue


def test_a_vehicle_on_the_lane_at_the_end_has_not_left() -> None:
    there = free([10.0, 570.0])
    stop = there["stop"].at(np.array([0]))
    found = course({"advance": there["advance"], "stop": stop})
    assert found.leave_s.tolist() == [pytest.approx(40.0), np.inf]
    assert found.vehicles(np.array([590.0]))[0] == 1


def test_late_stamps_are_put_right() -> None:
    late = {name: crossed(list(p.on_s + 2.0)) for name, p in free([10, 20]).items()}
    period = Period("day", 0.0, 600.0, "fit", {}, late)
    config = DetectionConfig(latency_s=2.0)
    (found,) = LaneEstimate([period], {"W_0": LANE}, [ADVANCE, STOP], config).incoming("W_0")
    assert found.leave_s == pytest.approx([40, 50])


@pytest.mark.parametrize("latency_s", [np.nan, np.inf, 2000.0])
def test_a_latency_of_no_detector_is_refused(latency_s: float) -> None:
    with pytest.raises(OptionError, match=r"latency_s = .*: must be from -60 to 60 s"):
        DetectionConfig(latency_s=latency_s)


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        ({"latency_s": "1"}, "latency_s is '1'; allowed: a number"),
        ({"least_free": 0}, "least_free is 0; allowed: > 0"),
        ({"gap_s": np.nan}, "gap_s is nan; allowed: > 0, finite"),
        ({"start_mps": 0.0}, "start_mps is 0.0; allowed: > 0"),
        ({"speed_spread": -0.1}, "speed_spread is -0.1"),
        ({"longest_s": np.inf}, "longest_s is inf"),
        ({"late_s": -1.0}, "late_s is -1.0; allowed: >= 0"),
        ({"missed": 1.0}, "missed is 1.0; allowed: from 0 to below 1"),
    ],
)
def test_impossible_numbers_of_the_estimate_are_refused(numbers: dict[str, Any], told: str) -> None:
    with pytest.raises(OptionError, match=told):
        DetectionConfig(**numbers)
    DetectionConfig(late_s=0.0, missed=0.0)


def test_stamps_of_sumos_output_are_a_step_early() -> None:
    zones = [replace(one, clock="sumo") for one in (ADVANCE, STOP)]
    period = Period("day", 0.0, 600.0, "fit", {}, free([10, 20]))
    estimate = LaneEstimate([period], {"W_0": LANE}, zones, step_s=0.5)
    (found,) = estimate.incoming("W_0")
    assert found.leave_s == pytest.approx([40.5, 50.5])


def test_greens_of_a_lane_join_what_goes_on() -> None:
    signals = {"C": ((0.0, "Gr"), (10.0, "gG"), (20.0, "yr"), (23.0, "rG"), (40.0, "Gr"))}
    period = Period("day", 0.0, 60.0, "fit", signals, {})
    assert greens_of(period, "C", [0]) == [(0.0, 20.0), (40.0, 60.0)]
    assert greens_of(period, "C", [1]) == [(10.0, 20.0), (23.0, 40.0)]
    assert greens_of(period, "D", [0]) == []


def test_a_clock_counts_each_vehicle_of_a_stamp() -> None:
    """Vehicles of several lanes have one time where stamps are coarse."""
    clock = _Clock.of(Period("day", 0.0, 100.0, "fit", {}, {}), np.array([10.0, 10, 10, 20, 30]))
    assert clock.read(np.array([10.0, 20.0, 30.0])) == pytest.approx([3, 4, 5], abs=0.01)
    assert clock.when(np.array([4.0])) == pytest.approx([20.0], abs=0.01)
