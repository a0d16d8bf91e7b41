"""Statistics of lanes by hand: what leaves in greens of each age."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.grounding.summaries import NAMES, LaneRows, LaneView, Summary

GREEN = np.array([[True, False]])
HOLDS, PASSED_S = np.full(1, 40.0), np.full(1, 30.0)
VIEW = LaneView(("road_0",), (GREEN,), (HOLDS,), (0,), HOLDS, PASSED_S, ((),))
SERVED = (1.0, 2.0, 4.0, 4.0)
"""Vehicles that leave in the first, second, ... decision of a green."""


def log_of(interval_s: float, skipped: int = -1) -> TransitionLog:
    """Return a log of greens of four decisions after reds of two; one decision may be missing."""
    layouts = {"a_0": AgentLayout(1, 2)}
    recorder = TransitionRecorder(
        Provenance("by hand", "", "street", (), interval_s, "count", layouts)
    )
    count, before = 20.0, 1
    for t in range(60):
        age = t % 6
        phase = 0 if age < 4 else 1
        then = count - SERVED[age] if phase == 0 else count + 5.5
        seen = [
            {"a_0": np.array([vehicles / 40.0, *np.eye(2)[shown]])}
            for vehicles, shown in ((count, before), (then, phase))
        ]
        if t != skipped:
            did = {"a_0": phase}
            recorder.record(0, t, seen[0], did, did, {"a_0": 0.0}, seen[1])
        count, before = then, phase
    return recorder.log()


def fall(log: TransitionLog, age: str) -> tuple[float, float]:
    """Return the mean fall of long queues in greens of an age, and its number of decisions."""
    summary, column = VIEW.summary(log), NAMES.index(f"fall, green {age}, 9 or more")
    return float(summary.values[0, column]), float(summary.rows[0, column])


@pytest.mark.parametrize(
    ("interval_s", "goes_on", "is_long"),
    [(10.0, (2.0, 10.0), (4.0, 20.0)), (5.0, (3.0, 20.0), (4.0, 10.0))],
)
def test_greens_are_told_apart_by_their_age(
    interval_s: float, goes_on: tuple[float, float], is_long: tuple[float, float]
) -> None:
    """A green of 15 s is long: of those of 10 s the third decision, of those of 5 s the fourth."""
    log = log_of(interval_s)
    assert fall(log, "begins") == pytest.approx((1.0, 10.0))
    assert fall(log, "goes on") == pytest.approx(goes_on)
    assert fall(log, "is long") == pytest.approx(is_long)


@pytest.mark.parametrize(
    ("skipped", "goes_on", "is_long"),
    [(1, (22.0 / 10, 10.0), (4.0, 19.0)), (2, (24.0 / 11, 11.0), (4.0, 18.0))],
)
def test_a_missing_decision_makes_no_green_older(
    skipped: int, goes_on: tuple[float, float], is_long: tuple[float, float]
) -> None:
    """Without a decision nobody knows that a green went on: the next one takes its place."""
    log = log_of(10.0, skipped)
    assert fall(log, "goes on") == pytest.approx(goes_on)
    assert fall(log, "is long") == pytest.approx(is_long)


def rows_of(counts: list[float], served: list[float], view: LaneView = VIEW) -> LaneRows:
    """Return the decisions of a lane in green, whose counts follow each other."""
    layouts = {"a_0": AgentLayout(1, 2)}
    recorder = TransitionRecorder(Provenance("by hand", "", "street", (), 10.0, "count", layouts))
    seen = [{"a_0": np.array([count / 40.0, 1.0, 0.0])} for count in counts]
    for t, left in enumerate(served):
        stays = {"a_0": np.array([(counts[t] - left) / 40.0])}
        ran = {"a_0": 0}
        recorder.record(0, t, seen[t], ran, ran, {"a_0": 0.0}, seen[t + 1], served=stays)
    (rows,) = view.rows(recorder.log())
    return rows


def test_vehicles_that_left_are_counted_without_those_that_came() -> None:
    rows = rows_of([20.0, 19.0, 22.0], served=[3.0, 2.0])
    assert rows.left == pytest.approx([3.0, 2.0])
    assert (rows.before - rows.after).tolist() == [1.0, -3.0]


def test_a_lane_is_full_if_it_is_so_before_or_after_a_decision() -> None:
    """It holds 40 vehicles, and is full from 36 on."""
    assert rows_of([35.0, 36.0, 30.0, 30.0], served=[0.0] * 3).full.tolist() == [True, True, False]


def test_a_short_lane_is_never_full() -> None:
    """A single vehicle fills most of it, and is no jam."""
    counts, served = [0.0, 1.0, 3.0, 2.0], [0.0] * 3
    for holds, expected in ((2.9, [False] * 3), (3.0, [False, True, True])):
        rows = rows_of(counts, served, replace(VIEW, holds=np.array([holds])))
        assert rows.full.tolist() == expected


def test_a_lane_without_a_decision_has_no_statistics() -> None:
    log = log_of(10.0)
    summary = VIEW.summary(TransitionLog(log.provenance, log.frame.clear()))
    assert np.isnan(summary.values).all() and not summary.rows.any()


def test_the_network_s_mean_counts_decisions_and_not_lanes() -> None:
    values, rows = np.full((3, len(NAMES)), 4.0), np.full((3, len(NAMES)), 10.0)
    values[1], rows[1] = 1.0, 20.0
    values[2] = np.nan
    assert Summary(values, rows).network == pytest.approx(2.0)
