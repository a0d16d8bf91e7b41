"""Greens read off signal logs, and which lanes and detectors belong to which light."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ugat_marl.diagnosis.features import DetectorLayout, Greens, IncomingLane, tally
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.effects import load_scenario
from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import Detector, Network, Passages, Period, SignalLog
from ugat_marl.simulation import standard_detectors

THRESHOLDS = Thresholds()


def greens(
    log: SignalLog, links: tuple[int, ...] = (0,), begin: float = 0.0, end: float = 100.0
) -> Greens:
    lane = IncomingLane("in_0", "in", 0, links, 14.0, {"stop": "stop"})
    detectors = (Detector("stop", "in_0", 90.0, 0.0, "stop"),)
    layout = DetectorLayout(("C",), (lane,), (), detectors, {"stop": "C"})
    return layout.greens(Period("day1", begin, end, "fit", {"C": log}, {}))[0]


def rows(found: Greens) -> list[tuple[float, float, float, float]]:
    """Start, end, red, next of every green."""
    table = np.stack([found.start_s, found.end_s, found.red_s, found.next_s], axis=1)
    return [tuple(row) for row in table.tolist()]


def test_a_green_ends_with_yellow_and_red_begins_behind_it() -> None:
    log = ((0.0, "r"), (10.0, "G"), (40.0, "y"), (43.0, "r"), (60.0, "G"), (80.0, "y"), (83.0, "r"))
    found = greens(log)
    assert rows(found) == [(10, 40, 43, 60), (60, 80, 83, 100)]
    assert found.protected.all()


def test_without_yellow_red_begins_at_once() -> None:
    assert rows(greens(((0.0, "r"), (10.0, "G"), (40.0, "r")))) == [(10, 40, 40, 100)]


def test_red_and_yellow_before_green_is_still_red() -> None:
    log = ((0.0, "r"), (8.0, "u"), (10.0, "G"), (40.0, "y"), (43.0, "r"))
    assert rows(greens(log)) == [(10, 40, 43, 100)]


def test_both_kinds_of_yellow_are_yellow() -> None:
    log = ((0.0, "r"), (10.0, "G"), (40.0, "Y"), (42.0, "y"), (43.0, "r"))
    assert rows(greens(log)) == [(10, 40, 43, 100)]


def test_changes_of_other_links_do_not_cut_a_green() -> None:
    log = ((0.0, "rG"), (10.0, "Gr"), (15.0, "GG"), (20.0, "Gr"), (40.0, "yr"), (43.0, "rr"))
    assert rows(greens(log)) == [(10, 40, 43, 100)]


def test_a_lane_is_green_while_one_of_its_links_is() -> None:
    log = ((0.0, "rr"), (10.0, "Gr"), (20.0, "GG"), (30.0, "rG"), (40.0, "ry"), (43.0, "rr"))
    assert rows(greens(log, (0, 1))) == [(10, 40, 43, 100)]


def test_only_a_green_with_right_of_way_is_protected() -> None:
    log = ((0.0, "r"), (10.0, "g"), (20.0, "y"), (23.0, "r"), (30.0, "G"), (40.0, "y"), (43.0, "r"))
    assert greens(log).protected.tolist() == [False, True]
    # A second link that has right of way gives it to the lane.
    mixed = tuple((time, state + ("G" if state == "g" else "r")) for time, state in log)
    assert greens(mixed, (0, 1)).protected.tolist() == [True, True]


def test_greens_cut_by_the_period_are_left_out() -> None:
    # One runs already when the period begins, one still when it ends.
    log = ((-5.0, "G"), (20.0, "y"), (23.0, "r"), (40.0, "G"), (60.0, "y"), (63.0, "r"),
           (90.0, "G"))  # fmt: skip
    found = greens(log)
    assert found.start_s.tolist() == [40.0]
    assert (found.end_s.tolist(), found.red_s.tolist()) == ([60.0], [63.0])
    # At the very begin a green is whole; one that ends with the period is not.
    assert greens(((0.0, "G"), (20.0, "r"))).start_s.tolist() == [0.0]
    assert greens(((10.0, "G"), (100.0, "r"))).start_s.tolist() == []


def test_no_log_no_greens() -> None:
    assert rows(greens(())) == []
    assert greens(()).protected.dtype == np.bool_


def test_the_crossing_has_two_lanes_with_their_own_letters(data: Path) -> None:
    network = Network.read(load_scenario(data / "crossing"))
    layout = DetectorLayout.of(network, standard_detectors(network))
    assert layout.intersections == ("C",)
    assert {lane.id: (lane.edge, lane.links) for lane in layout.lanes} == {
        "S_C_0": ("S_C", (0,)),
        "W_C_0": ("W_C", (1,)),
    }
    assert layout.lanes[0].detectors == {"advance": "advance:S_C_0", "stop": "stop:S_C_0"}
    assert {lane for _, lane, _ in layout.exits} == {"C_N_0", "C_E_0"}
    assert set(layout.owner.values()) == {"C"}
    period = Period("day1", 0.0, 100.0, "fit", {"C": ((0.0, "Gr"), (40.0, "rG"), (50.0, "Gr"))}, {})
    south, west = layout.greens(period)
    assert (south.start_s.tolist(), west.start_s.tolist()) == ([0.0], [40.0])


def test_lanes_without_detectors_are_kept_and_empty(data: Path) -> None:
    network = Network.read(load_scenario(data / "crossing"))
    layout = DetectorLayout.of(network, [Detector("d", "S_C_0", 487.0, 0.0, "stop")])
    assert [dict(lane.detectors) for lane in layout.lanes] == [{"stop": "d"}, {}]
    assert layout.exits == ()
    assert layout.owner == {"d": "C"}


def test_detectors_at_no_traffic_light_are_refused(data: Path) -> None:
    network = Network.read(load_scenario(data / "crossing"))
    with pytest.raises(MeasuredDataError, match="no detector lies on a lane"):
        DetectorLayout.of(network, [Detector("d", "nowhere_0", 1.0, 0.0, "stop")])


# --- whatever is logged, nothing breaks ----------------------------------------------------------

STATES = st.text("GgyYurRsoO", min_size=2, max_size=2)
LOGS = st.lists(st.tuples(st.integers(-50, 700), STATES), max_size=25).map(
    lambda items: tuple(sorted((float(time), state) for time, state in items))
)
TIMES = st.floats(-10, 620, allow_nan=False)


@st.composite
def some_passages(draw: st.DrawFn) -> Passages:
    """Any passages, a few of them without begin or end, in order or not."""
    on = np.array(draw(st.lists(TIMES, max_size=15)))
    count = len(on)

    def column(values: st.SearchStrategy[float]) -> np.ndarray:
        return np.array(draw(st.lists(values, min_size=count, max_size=count)), dtype=np.float64)

    off = on + column(st.floats(0, 200))
    unknown = column(st.sampled_from([0.0, 0.0, 0.0, 1.0, 2.0]))
    on, off = np.where(unknown == 1, np.nan, on), np.where(unknown == 2, np.nan, off)
    speed = column(st.one_of(st.just(np.nan), st.floats(0, 40)))
    return Passages(on, off, speed, column(st.one_of(st.just(np.nan), st.floats(1, 30))))


@given(LOGS)
def test_greens_are_in_order_and_inside_the_period(log: SignalLog) -> None:
    found = greens(log, (0, 1), end=600.0)
    assert (found.start_s >= 0).all()
    assert (found.end_s < 600).all()
    assert (found.start_s <= found.end_s).all()
    assert (found.end_s <= found.red_s).all()
    assert (np.diff(found.start_s) >= 0).all()
    assert (found.start_s[1:] >= found.end_s[:-1]).all()
    assert (found.next_s >= found.end_s).all()


@given(LOGS, st.fixed_dictionaries({}, optional={k: some_passages() for k in ("a", "s", "x")}))
@example(((0.0, "GG"), (0.0, "YG"), (601.0, "GG")), {})  # a yellow beyond the period's end
def test_features_of_anything_are_finite(log: SignalLog, seen: dict[str, Passages]) -> None:
    lanes = (
        IncomingLane("in_0", "in", 0, (0,), 14.0, {"advance": "a", "stop": "s"}),
        IncomingLane("in_1", "in", 0, (1,), 14.0, {}),
    )
    detectors = (
        Detector("a", "in_0", 100.0, 2.0, "advance"),
        Detector("s", "in_0", 190.0, 8.0, "stop"),
    )
    layout = DetectorLayout(("C",), lanes, ((0, "out_0", "x"),), detectors, {})
    period = Period("day1", 0.0, 600.0, "fit", {"C": log}, seen)
    found = tally(layout, period, layout.greens(period), THRESHOLDS)
    assert np.isfinite(found.sums).all()
    assert np.isfinite(found.bins).all()
    assert np.isfinite(found.journeys).all()
    assert (found.sums[..., 1] >= 0).all()
    assert (found.bins >= -1e-9).all()
    assert (found.sums[:, 1] == 0).all(), "a lane without detectors tells nothing"
