"""Travel times and queues between detectors, counted by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ugat_marl.diagnosis.features import DetectorLayout, Greens, IncomingLane, tally
from ugat_marl.diagnosis.journeys import Crossings, journey_sums, matched
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.scenarios import Detector, Passages, Period

DETECTORS = (
    Detector("far", "in_0", 100.0, 0.0, "advance"),
    Detector("line", "in_0", 128.0, 0.0, "stop"),
)
LANE = IncomingLane("in_0", "in", 0, (0,), 14.0, {"advance": "far", "stop": "line"})
LAYOUT = DetectorLayout(("A",), (LANE,), (), DETECTORS, {})
GREENS = Greens(
    np.array([30.0, 90.0]),
    np.array([50.0, 110.0]),
    np.array([53.0, 113.0]),
    np.array([90.0, 120.0]),
    np.array([True, True]),
)


def crossings(*times: float, free: tuple[float, ...] = ()) -> Crossings:
    return Crossings(np.array(times), np.isin(times, free))


def passages(times: list[float], speeds: list[float]) -> Passages:
    on = np.array(times)
    return Passages(on, on + 0.5, np.array(speeds), np.full(len(on), 5.0))


def test_first_come_first_served() -> None:
    pairs, waiting = matched([np.array([0.0, 4.0, 8.0])], [crossings(31.0, 33.0)], [2.0])
    assert pairs == [[(0.0, 31.0), (4.0, 33.0)]]
    assert list(waiting[0]) == [8.0]


def test_a_vehicle_may_change_lanes_between_the_detectors() -> None:
    came = [np.array([0.0]), np.array([1.0, 2.0])]
    pairs, _ = matched(came, [crossings(31.0, 33.0), crossings(32.0)], [2.0, 2.0])
    assert pairs == [[(0.0, 31.0), (2.0, 33.0)], [(1.0, 32.0)]]


def test_a_missed_vehicle_does_not_shift_the_vehicles_after_the_next_free_one() -> None:
    # The stop detector missed the vehicle of 10 s; everyone drives freely and needs 2 s.
    came = [np.array([10.0, 20.0, 40.0, 60.0])]
    shifted, _ = matched(came, [crossings(22.0, 42.0, 62.0)], [2.0], [10.0])
    assert shifted == [[(10.0, 22.0), (20.0, 42.0), (40.0, 62.0)]]
    pairs, _ = matched(came, [crossings(22.0, 42.0, 62.0, free=(22.0,))], [2.0], [10.0])
    assert pairs == [[(20.0, 22.0), (40.0, 42.0), (60.0, 62.0)]]


def test_a_free_vehicle_that_nobody_saw_come_has_no_travel_time() -> None:
    pairs, _ = matched([np.array([0.0, 90.0])], [crossings(60.0, free=(60.0,))], [2.0], [10.0])
    assert pairs == [[]]


def test_who_left_another_lane_unseen_does_not_hide_the_arrival_on_a_third_lane() -> None:
    """The vehicle of 58 s changes to the first lane; the stop detector missed that of 0 s."""
    came = [np.array([]), np.array([0.0]), np.array([58.0, 70.0])]
    crossed = [crossings(60.0, free=(60.0,)), crossings(), crossings(95.0)]
    pairs, waiting = matched(came, crossed, [2.0] * 3, [10.0] * 3)
    assert pairs == [[(58.0, 60.0)], [], [(70.0, 95.0)]]
    assert [list(queue) for queue in waiting] == [[], [0.0], []]


def test_the_free_ones_are_quick_apart_and_not_at_the_begin_of_green() -> None:
    stop = passages([31.0, 38.0, 40.0, 47.0], [14.0, 14.0, 14.0, 3.0])
    seen = Crossings.of(stop, np.array([30.0]), 0.0, 0.85 * 14.0, 5.0)
    assert seen.time_s.tolist() == [31.5, 38.5, 40.5, 47.5]
    assert seen.free.tolist() == [False, True, False, False]


@pytest.mark.parametrize(("zone_m", "limit_mps"), [(0.0, 13.9), (6.0, 8.3), (12.0, 13.9)])
def test_without_speeds_a_free_vehicle_is_known_on_a_zone_of_any_length(
    zone_m: float, limit_mps: float
) -> None:
    over = (5.0 + zone_m) / np.array([limit_mps, 0.25 * limit_mps])  # the second one crawls
    on = np.array([40.0, 60.0])
    stop = Passages(on, on + over, np.full(2, np.nan), np.full(2, np.nan))
    seen = Crossings.of(stop, np.array([30.0]), zone_m, 0.85 * limit_mps, 5.0)
    assert seen.free.tolist() == [True, False]


@pytest.mark.parametrize("setback_m", [28.0, 300.0, 600.0])
@pytest.mark.parametrize("pace", [0.87, 1.0, 1.2])
def test_free_rides_take_what_they_take_from_any_detector(setback_m: float, pace: float) -> None:
    line = replace(DETECTORS[1], position_m=100.0 + setback_m)
    layout = replace(LAYOUT, detectors=(DETECTORS[0], line))
    greens = Greens(*(np.array([x]) for x in (10.0, 900.0, 903.0, 1000.0)), np.array([True]))
    came = np.arange(50.0, 800.0, 13.0)
    ride = setback_m / (14.0 * pace)
    seen = {
        "far": passages(came.tolist(), [14.0 * pace] * len(came)),
        "line": passages((came + ride).tolist(), [14.0 * pace] * len(came)),
    }
    period = Period("day", 0.0, 1000.0, "fit", {}, seen)
    day = tally(layout, period, [greens], Thresholds())
    assert day.journeys is not None
    total, number = day.journeys[0, 0]
    assert number == len(came)
    assert total / number == pytest.approx(ride + 0.5)  # its rear leaves half a second later


def test_sums_of_one_lane() -> None:
    # Due at 12, 14 and 40 s; green begins at 30 and 50 s. Two wait for the first, none for the
    # second.
    pairs = [(10.0, 31.0), (12.0, 33.0), (38.0, 40.5)]
    sums = journey_sums(pairs, 2.0, np.array([30.0, 50.0]))
    assert sums.tolist() == [[21.0 + 21.0 + 2.5, 3.0], [2.0, 2.0]]
    assert journey_sums([], 2.0, np.array([30.0])).tolist() == [[0.0, 0.0], [0.0, 1.0]]


def test_the_tally_of_a_period_has_them_beside_the_features() -> None:
    seen = {
        "far": passages([10.0, 20.0, 70.0], [14.0, 14.0, 14.0]),
        "line": passages([31.0, 33.0, 91.0], [3.0, 5.0, 3.0]),
    }
    period = Period("day", 0.0, 120.0, "fit", {}, seen)
    day = tally(LAYOUT, period, [GREENS], Thresholds())
    assert day.journeys is not None
    times, queues = day.journeys[:, 0]
    assert times.tolist() == [pytest.approx(21.5 + 13.5 + 21.5), 3.0]
    assert queues.tolist() == [3.0, 2.0]
    both = day + day
    assert both.journeys is not None
    assert both.journeys[0, 0].tolist() == [pytest.approx(113.0), 6.0]
