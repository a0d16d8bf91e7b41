"""Features of detections that were written down and counted by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from ugat_marl.diagnosis import Tally
from ugat_marl.diagnosis.features import (
    ALL_FEATURES,
    BIN_FEATURES,
    FEATURES,
    INDEX,
    SPEED_FEATURES,
    DetectorLayout,
    IncomingLane,
    tally,
)
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.scenarios import Detector, DetectorKind, Passages, Period, SignalLog

THRESHOLDS = Thresholds()

NAN = float("nan")
LIMIT_MPS = 14.0
LOG: SignalLog = ((0.0, "r"), (10.0, "G"), (40.0, "y"), (43.0, "r"), (60.0, "G"), (90.0, "y"),
                  (93.0, "r"))  # fmt: skip
"""Two greens of 30 s: from 10 s and from 60 s."""


def a_layout(kinds: Sequence[DetectorKind] = ("advance", "stop"), lanes: int = 1) -> DetectorLayout:
    """Lanes of one approach side by side, all under the first letter of the light, and one exit."""
    inner = tuple(
        IncomingLane(
            f"in_{i}", "in", 0, (0,), LIMIT_MPS, {kind: f"{kind}:in_{i}" for kind in kinds}
        )
        for i in range(lanes)
    )
    detectors = [
        Detector(name, lane.id, 90.0, 0.0, kind)
        for lane in inner
        for kind, name in lane.detectors.items()
    ]
    exits = ((0, "out_0", "exit:out_0"),)
    detectors.append(Detector("exit:out_0", "out_0", 10.0, 0.0, "exit"))
    owner = {item.id: "C" for item in detectors}
    return DetectorLayout(("C",), inner, exits, tuple(detectors), owner)


def passages(
    on: Sequence[float],
    off: Sequence[float] | None = None,
    speed: Sequence[float] | float = NAN,
    length: Sequence[float] | float = NAN,
) -> Passages:
    """Passages from lists; half a second over the detector if `off` is not given."""
    count = len(on)
    ons = np.array(on, dtype=np.float64)
    return Passages(
        ons,
        ons + 0.5 if off is None else np.array(off, dtype=np.float64),
        np.broadcast_to(np.asarray(speed, dtype=np.float64), count).copy(),
        np.broadcast_to(np.asarray(length, dtype=np.float64), count).copy(),
    )


def a_period(
    seen: dict[str, Passages], log: SignalLog = LOG, begin: float = 0.0, end: float = 120.0
) -> Period:
    return Period("day1", begin, end, "fit", {"C": log}, seen)


def counted(
    seen: dict[str, Passages],
    layout: DetectorLayout | None = None,
    log: SignalLog = LOG,
    end: float = 120.0,
) -> Tally:
    layout = layout or a_layout()
    period = a_period(seen, log, end=end)
    return tally(layout, period, layout.greens(period), THRESHOLDS)


def of(found: Tally, name: str, place: int = 0) -> tuple[float, float]:
    """Sum and number of observations of a feature."""
    total, weight = found.sums[INDEX[name], place]
    return (round(float(total), 9), round(float(weight), 9))


# A queue of six that stood at the first green, and one vehicle that came much later. Their rears
# leave the stop detector at:
OFF = (12.0, 14.5, 16.5, 18.4, 20.0, 22.9, 30.0)
ON = (5.0, 13.5, 15.7, 17.7, 19.4, 22.2, 29.5)
SPEED = (3.0, 5.0, 7.0, 8.0, 9.0, 10.0, 14.0)
QUEUE = {"stop:in_0": passages(ON, OFF, SPEED, 5.0)}


def test_gaps_of_a_queue_are_those_counted_by_hand() -> None:
    found = counted(QUEUE)
    assert of(found, "lost") == (2.0, 1)  # 12 - 10
    assert of(found, "gap2") == (2.5, 1)
    assert of(found, "gap3") == (2.0, 1)
    assert of(found, "gap4-5") == (3.5, 2)  # 1.9 + 1.6
    assert of(found, "gap6-8") == (2.9, 1)
    assert of(found, "gap9+") == (0.0, 0)
    assert of(found, "gap_spread") == (1.4, 3)  # 0.1 + 0.4 + 0.9
    assert of(found, "gap_short") == (1, 3)  # 1.6
    assert of(found, "gap_long") == (1, 3)  # 2.9
    assert of(found, "gap_permitted") == (0.0, 0)


def test_a_gap_of_more_than_five_seconds_ends_the_queue() -> None:
    found = counted(QUEUE)
    assert of(found, "queued") == (1, 2)  # one of two greens found a queue
    assert of(found, "discharged") == (6, 2)  # the seventh came after a gap of 7.1 s


def test_speeds_and_times_by_position_in_the_queue() -> None:
    found = counted(QUEUE)
    assert of(found, "speed1") == (3.0, 1)
    assert of(found, "speed2") == (5.0, 1)
    assert of(found, "speed3") == (7.0, 1)
    assert of(found, "speed4-5") == (17.0, 2)
    assert of(found, "speed6-8") == (10.0, 1)
    assert of(found, "over1") == (2.0, 1)  # from the start of green
    assert of(found, "over2-3") == (1.0 + 0.8, 2)
    assert of(found, "over4+") == (2.0, 3)  # 0.7 + 0.6 + 0.7


def test_lost_time_has_a_trend_over_the_period() -> None:
    # 2 s lost in the green at 10 s, 3 s in that at 60 s; the middle of the period is 60 s.
    found = counted({"stop:in_0": passages((5.0, 55.0), (12.0, 63.0))})
    assert of(found, "lost") == (5.0, 2)
    assert of(found, "lost_trend") == (round(2.0 * (10 - 60) / 60, 9), 2)


def test_a_vehicle_that_came_after_the_start_of_green_was_no_queue() -> None:
    found = counted({"stop:in_0": passages((10.5, 13.0), (12.0, 14.5))})
    assert of(found, "lost") == (0.0, 0)
    assert of(found, "gap2") == (0.0, 0)
    assert of(found, "discharged") == (0, 2)


def test_a_first_vehicle_that_never_started_tells_nothing_of_the_rest() -> None:
    # It leaves 13 s after the start of green: broken down, or looking at a telephone.
    found = counted({"stop:in_0": passages((5.0, 24.0), (23.0, 25.0))})
    assert of(found, "lost") == (0.0, 0)
    assert of(found, "discharged") == (0, 2)


def test_permitted_greens_are_counted_apart() -> None:
    found = counted(QUEUE, log=tuple((time, state.replace("G", "g")) for time, state in LOG))
    assert of(found, "gap_permitted") == (2.5 + 2.0 + 1.9 + 1.6 + 2.9, 5)
    for name in ("lost", "gap2", "gap4-5", "speed1", "over1"):
        assert of(found, name) == (0.0, 0), name
    assert of(found, "discharged") == (6, 2)


def test_crossings_in_yellow_and_in_red() -> None:
    # Yellow from 40 and 90 s, red from 43 and 93 s.
    off = (9.0, 20.0, 41.0, 44.0, 47.0, 52.0, 92.0)
    found = counted({"stop:in_0": passages([t - 0.5 for t in off], off)})
    assert of(found, "yellow_crossings") == (2, 2)  # 41, 92
    assert of(found, "late_crossings") == (1, 2)  # 44: at most 2 s of red
    assert of(found, "red_crossings") == (1, 2)  # 47: 4 s; 52 is not a clearance any more
    assert of(found, "last_crossing") == (1.0 + 4.0 + 2.0, 3)


def test_red_until_the_next_green_only() -> None:
    short = ((0.0, "G"), (10.0, "y"), (13.0, "r"), (15.0, "G"), (40.0, "y"), (43.0, "r"))
    found = counted({"stop:in_0": passages((15.5,), (16.0,))}, log=short)
    assert of(found, "red_crossings") == (0, 2)


def test_counts_are_per_minute_and_per_bin() -> None:
    seen = {
        "advance:in_0": passages((1.0, 100.0, 299.0, 301.0)),
        "stop:in_0": passages((10.0, 599.0)),
        "exit:out_0": passages((20.0,)),
    }
    found = counted(seen, end=600.0)
    assert of(found, "count_advance") == (4, 10)
    assert of(found, "count_stop") == (2, 10)
    assert of(found, "count_exit", 1) == (1, 10)
    assert found.bins.shape == (len(BIN_FEATURES), 2, 2)
    assert found.bins[0, 0].tolist() == [3, 1]
    assert found.bins[1, 0].tolist() == [1, 1]
    assert found.bins[2, 1].tolist() == [1, 0]


def test_vehicles_are_conserved_or_not() -> None:
    seen = {
        "advance:in_0": passages(np.arange(10.0).tolist()),
        "advance:in_1": passages(np.arange(6.0).tolist()),
        "stop:in_0": passages(np.arange(8.0).tolist()),
        "stop:in_1": passages(np.arange(8.0).tolist()),
        "exit:out_0": passages(np.arange(12.0).tolist()),
    }
    found = counted(seen, a_layout(lanes=2))
    # Vehicles may change lanes between the detectors: the approach counts, at its first lane.
    assert of(found, "kept_to_stop") == (16, 16)
    assert of(found, "kept_to_exit") == (12, 16)
    assert of(found, "kept_to_stop", 1) == (0, 0)


def test_occupancy_by_signal() -> None:
    # On from 20 to 30 s in green, from 45 to 50 s in red, and on 70 to 74 s twice at a time.
    seen = {"advance:in_0": passages((20.0, 45.0, 70.0, 70.0), (30.0, 50.0, 72.0, 74.0))}
    found = counted(seen)
    assert of(found, "occupied_in_green") == (14.0, 60.0)
    assert of(found, "occupied_in_red") == (5.0, 17.0 + 27.0)
    assert found.bins[3, 0].tolist() == [19.0]


def test_occupied_seconds_fall_into_their_bins() -> None:
    seen = {"advance:in_0": passages((290.0,), (320.0,))}
    assert counted(seen, end=600.0).bins[3, 0].tolist() == [10.0, 20.0]


def test_a_queue_over_the_advance_detector_when_green_begins() -> None:
    seen = {"advance:in_0": passages((5.0, 59.5), (12.0, 62.0))}
    assert of(counted(seen), "queue_over") == (1, 2)  # at 60 s only half a second before green


def test_a_passage_may_have_begun_before_the_period_and_end_after_it() -> None:
    seen = {"advance:in_0": passages((NAN, 110.0), (4.0, NAN))}
    found = counted(seen)
    assert found.bins[3, 0].tolist() == [4.0 + 10.0]
    assert of(found, "count_advance") == (2, 2)
    # Off only after minutes without an on: a leaving nobody saw the coming of.
    late = counted({"advance:in_0": passages((NAN,), (100.0,))})
    assert late.bins[3, 0].tolist() == [0.0]


def test_a_vehicle_on_the_stop_detector_since_before_the_period_was_queued() -> None:
    found = counted({"stop:in_0": passages((NAN, 13.0, 30.0), (12.0, 14.0, NAN))})
    assert of(found, "lost") == (2.0, 1)
    assert of(found, "gap2") == (2.0, 1)
    assert of(found, "count_stop") == (3, 2)


def test_moving_platoons_at_the_advance_detector() -> None:
    on = (20.0, 21.5, 23.5, 33.5, 35.0)
    seen = {"advance:in_0": passages(on, speed=(12.0, 12.0, 12.0, 12.0, 5.0))}
    found = counted(seen)
    assert of(found, "platoon_gap") == (
        1.5 + 2.0,
        2,
    )  # 10 s is not a platoon, 5 m/s is not a motion
    assert of(found, "platoon_short") == (1, 2)
    assert of(found, "platoon_middle") == (2, 2)
    assert of(found, "platoon_time") == (1.0, 2)


def test_free_vehicles_and_those_that_see_red() -> None:
    # In green: 20 s (10 s after its start), 21 s (in a platoon), 70 s. In red: 50 s.
    seen = {"advance:in_0": passages((20.0, 21.0, 50.0, 70.0), speed=(15.0, 15.0, 4.0, 13.0))}
    found = counted(seen)
    assert of(found, "free_speed") == (28.0, 2)
    assert of(found, "free_speed_spread") == (2.0, 2)
    assert of(found, "free_fast") == (1, 2)  # 15 > 1.05 * 14
    assert of(found, "free_time") == (1.0, 2)
    assert of(found, "red_speed") == (4.0, 1)
    assert of(found, "red_slow") == (1, 1)
    assert of(found, "red_time") == (0.5, 1)


def test_lengths_are_measured_or_follow_from_speed_and_time() -> None:
    seen = {"stop:in_0": passages((20.0, 30.0, 50.0), (20.5, 31.0, 60.0), (10.0, 12.0, 0.0))}
    found = counted(seen)
    assert of(found, "vehicle_length") == (5.0 + 12.0, 2)  # the slow one tells nothing
    assert of(found, "long_vehicles") == (1, 2)
    known = counted({"stop:in_0": passages((20.0,), (20.5,), 10.0, 7.1)})
    assert of(known, "vehicle_length") == (7.1, 1)


def test_a_length_is_that_of_the_vehicle_not_of_the_zone() -> None:
    layout = a_layout()
    zones = tuple(replace(item, length_m=6.0) for item in layout.detectors)
    seen = {"stop:in_0": passages((20.0,), (21.05,), 10.0)}
    found = counted(seen, replace(layout, detectors=zones))
    assert of(found, "vehicle_length") == (pytest.approx(4.5), 1)
    assert of(found, "long_vehicles") == (0, 1)


def test_a_lane_without_a_stop_detector_tells_of_arrivals_only() -> None:
    seen = {"advance:in_0": passages((20.0, 30.0), speed=12.0, length=5.0)}
    found = counted(seen, a_layout(("advance",)))
    assert of(found, "count_advance") == (2, 2)
    assert of(found, "vehicle_length") == (10.0, 2)
    for name in ("count_stop", "queued", "lost", "yellow_crossings", "kept_to_stop"):
        assert of(found, name) == (0, 0), name


def test_a_detector_that_saw_nothing_counted_nothing() -> None:
    found = counted({})
    for name, place in (("count_advance", 0), ("count_stop", 0), ("count_exit", 1)):
        assert of(found, name, place) == (0, 2)
    assert of(found, "occupied_in_red") == (0, 44)
    assert of(found, "lost") == (0, 0)


def test_without_speeds_only_the_features_of_speed_are_empty() -> None:
    with_speeds = counted(QUEUE)
    without = counted({"stop:in_0": passages(ON, OFF)})
    for name, _, _ in FEATURES:
        if name in SPEED_FEATURES:
            assert of(without, name) == (0, 0), name
        else:
            assert of(without, name) == of(with_speeds, name), name


def test_periods_add_up() -> None:
    one, two = counted(QUEUE), counted({"stop:in_0": passages((5.0,), (13.0,))})
    both = one + two
    assert both.days == 2
    assert of(both, "lost") == (5.0, 2)
    assert of(both, "count_stop") == (8, 4)
    assert (both.bins == one.bins + two.bins).all()


def test_the_order_of_the_passages_does_not_matter_for_discharge() -> None:
    shuffled = QUEUE["stop:in_0"].at(np.array([3, 0, 6, 1, 5, 2, 4]))
    assert np.allclose(
        counted(QUEUE).sums[INDEX["lost"] : INDEX["platoon_gap"]],
        counted({"stop:in_0": shuffled}).sums[INDEX["lost"] : INDEX["platoon_gap"]],
    )


def test_every_feature_has_a_name_of_its_own() -> None:
    assert len(INDEX) == len(ALL_FEATURES)
    assert set(INDEX) >= SPEED_FEATURES


@pytest.mark.parametrize("log", [(), ((0.0, "r"),), ((0.0, "G"),)])
def test_a_light_that_never_changes_leaves_counts(log: SignalLog) -> None:
    found = counted(QUEUE, log=log)
    assert of(found, "count_stop") == (7, 2)
    assert of(found, "discharged") == (0, 0)
