"""Measured signals as SUMO's programmes, second by second, and one drive under them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ugat_marl.diagnosis.features import DetectorLayout
from ugat_marl.diagnosis.replay import Day, Replay, _from, replay_document
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.effects import apply_effects, load_scenario, parse_domain
from ugat_marl.errors import MeasuredDataError, SimulatorError
from ugat_marl.scenarios import Network, Period, Scenario, SignalLog
from ugat_marl.simulation import standard_detectors

THRESHOLDS = Thresholds()


@pytest.fixture(scope="module")
def scenario(data: Path) -> Scenario:
    return load_scenario(data / "crossing")


def a_period(log: SignalLog, begin: float = 0.0, end: float = 100.0) -> Period:
    return Period("day1", begin, end, "fit", {"C": log}, {})


def phases(
    scenario: Scenario, period: Period, begin: float | None = None
) -> tuple[float, list[tuple[float, str]]]:
    """Offset and phases of the programme of C."""
    begin = period.begin_s if begin is None else begin
    root = replay_document(scenario, period, begin).parse()
    (logic,) = root.iter("tlLogic")
    assert (logic.get("id"), logic.get("type")) == ("C", "static")
    rows = [(float(p.get("duration", "")), p.get("state", "")) for p in logic.iter("phase")]
    return float(logic.get("offset", "")), rows


def shown(scenario: Scenario, period: Period, begin: float | None = None) -> list[str]:
    """The state in every second from `begin` to the end of the period."""
    start = period.begin_s if begin is None else begin
    seconds: list[str] = []
    for duration, state in phases(scenario, period, begin)[1]:
        seconds += [state] * round(min(duration, 5000))
    return seconds[: round(period.end_s - start)]


def test_a_log_becomes_a_programme(scenario: Scenario) -> None:
    log = ((0.0, "Gr"), (30.0, "yr"), (33.0, "rG"))
    offset, rows = phases(scenario, a_period(log))
    assert offset == 0.0
    assert rows[:2] == [(30.0, "Gr"), (3.0, "yr")]
    assert rows[2][1] == "rG"
    assert rows[2][0] >= 67.0, "the last state must last to the end"


def test_times_are_rounded_to_steps_and_not_durations(scenario: Scenario) -> None:
    # A change every 10.4 s: durations rounded would all be 10 s, and the tenth change 4 s early.
    log = tuple((10.4 * i, ("Gr", "rG")[i % 2]) for i in range(10))
    rows = phases(scenario, a_period(log))[1]
    assert [duration for duration, _ in rows[:-1]] == [10, 11, 10, 11, 10, 10, 11, 10, 11]
    assert sum(duration for duration, _ in rows[:-1]) == round(93.6)


def test_greens_of_simulated_days_are_those_that_the_simulation_shows(scenario: Scenario) -> None:
    network = Network.read(scenario)
    drive = Replay(scenario, network, standard_detectors(network), {}, THRESHOLDS)
    log = ((0.0, "Gr"), (30.4, "yr"), (33.4, "rG"), (60.6, "Gr"))
    seen = drive.shown(a_period(log)).signals["C"]
    assert seen == ((0.0, "Gr"), (30.0, "yr"), (33.0, "rG"), (61.0, "Gr"))
    ends = np.cumsum([duration for duration, _ in phases(scenario, a_period(log))[1]])
    assert list(ends[:3]) == [time for time, _ in seen[1:]]
    again = tuple((time + 0.4, state) for time, state in log[:1]) + log[1:]
    assert drive.shown(a_period(again)).signals["C"] == seen


@pytest.mark.parametrize(
    ("earliest_s", "begin_s"), [(400.0, 400.0), (399.99, 399.0), (390.5, 390.0), (0.0, 0.0)]
)
def test_a_simulation_begins_before_the_earliest_departure(
    scenario: Scenario, earliest_s: float, begin_s: float
) -> None:
    network = Network.read(scenario)
    drive = Replay(scenario, network, standard_detectors(network), {}, THRESHOLDS)
    period = a_period(((1000.0, "Gr"),), 1000.0, 1100.0)
    assert drive._begin_s(period) == 400.0
    assert drive._begin_s(period, earliest_s) == begin_s


def test_a_state_shorter_than_a_step_gives_way_to_the_next(scenario: Scenario) -> None:
    log = ((0.0, "Gr"), (30.0, "yr"), (30.3, "rr"), (40.0, "rG"))
    assert phases(scenario, a_period(log))[1][:2] == [(30.0, "Gr"), (10.0, "rr")]


def test_the_log_may_begin_before_the_period(scenario: Scenario) -> None:
    log = ((-17.0, "Gr"), (12.0, "rG"), (50.0, "Gr"))
    assert phases(scenario, a_period(log))[1][:2] == [(12.0, "Gr"), (38.0, "rG")]


def test_a_period_that_begins_late_has_its_offset(scenario: Scenario) -> None:
    log = ((25200.0, "Gr"), (25230.0, "rG"), (25260.0, "Gr"))
    offset, rows = phases(scenario, a_period(log, 25200.0, 25300.0))
    assert offset == 25200.0
    assert rows[:2] == [(30.0, "Gr"), (30.0, "rG")]


def test_before_the_period_its_own_beginning_is_shown(scenario: Scenario) -> None:
    log = tuple((1000.0 + 50.0 * i, ("Gr", "rG")[i % 2]) for i in range(20))
    period = a_period(log, 1000.0, 2000.0)
    offset, _ = phases(scenario, period, 400.0)
    assert offset == 400.0
    seconds = shown(scenario, period, 400.0)
    alone = shown(scenario, period)
    assert seconds[:600] == alone[:600]
    assert seconds[600:] == alone


def test_before_a_short_period_it_is_shown_as_often_as_needed(scenario: Scenario) -> None:
    """Else the lights would stand still for the rest of the warm-up."""
    log: SignalLog = ((1000.0, "Gr"), (1030.0, "rG"))
    again = _from(log, a_period(log, 1000.0, 1060.0), 850.0)
    early = [850.0 + 30.0 * k for k in range(5)]
    assert [time for time, _ in again] == [*early, 1000.0, 1030.0]
    assert [state for _, state in again] == ["Gr", "rG", "Gr", "rG", "Gr", "Gr", "rG"]


def test_a_lost_time_keeps_links_red_behind_every_start_of_green(scenario: Scenario) -> None:
    late = apply_effects(scenario, parse_domain("late_green=*,2"))
    log = ((0.0, "Gr"), (30.0, "rG"), (60.0, "Gr"))
    seconds = shown(late, a_period(log))
    assert seconds[29:33] == ["Gr", "rr", "rr", "rG"]
    assert seconds[59:63] == ["rG", "rr", "rr", "Gr"]
    assert shown(scenario, a_period(log))[29:33] == ["Gr", "rG", "rG", "rG"]


def test_a_traffic_light_without_signals_is_named(scenario: Scenario) -> None:
    with pytest.raises(MeasuredDataError, match=r"'day1'.*'C'"):
        replay_document(scenario, a_period(()), 0.0)


LOGS = st.lists(
    st.tuples(st.integers(-200, 1190), st.sampled_from(("Gr", "yr", "rr", "rG", "ry"))),
    min_size=1,
    unique_by=lambda row: row[0],
).map(lambda rows: tuple((tenth / 10, state) for tenth, state in sorted(rows)))


@given(LOGS, st.sampled_from((0.0, 40.0)))
def test_every_second_shows_what_the_log_says(log: SignalLog, early: float) -> None:
    scenario = load_scenario(Path(__file__).parents[1] / "fixtures" / "crossing")
    period = a_period(log, 0.0, 120.0)
    seconds = shown(scenario, period, -early)[round(early) :]
    assert len(seconds) == 120
    for second, state in enumerate(seconds):
        # The last change up to then, to the nearest step; the first state if there is none.
        known = [s for time, s in log if math.floor(max(time, 0.0) + 0.5) <= second]
        assert state == (known[-1] if known else seconds[0])


# --- in SUMO -------------------------------------------------------------------------------------


def replay(scenario: Scenario) -> Replay:
    network = Network.read(scenario)
    detectors = standard_detectors(network)
    return Replay(
        scenario, network, detectors, DetectorLayout.of(network, detectors).owner, THRESHOLDS
    )


def test_vehicles_obey_the_measured_signals(scenario: Scenario) -> None:
    log = ((0.0, "rG"), (120.0, "Gr"))
    seen = replay(scenario).simulate((), a_period(log, end=200.0), 1).period.passages
    assert (seen["exit:C_N_0"].on_s > 120).all()
    assert (seen["exit:C_E_0"].on_s < 135).all()
    assert len(seen["exit:C_N_0"]) > 3
    assert len(seen["exit:C_E_0"]) > 1


def test_the_same_day_is_the_same_day(scenario: Scenario) -> None:
    period = a_period(((0.0, "Gr"), (50.0, "rG"), (90.0, "Gr")), end=200.0)
    one, two, other = (replay(scenario).simulate((), period, seed) for seed in (1, 1, 2))
    assert one.travel_time_s == two.travel_time_s
    assert other.travel_time_s != one.travel_time_s
    for name, passages in one.period.passages.items():
        assert np.array_equal(passages.on_s, two.period.passages[name].on_s, equal_nan=True)


def test_effects_change_traffic_and_what_is_seen_of_it(scenario: Scenario) -> None:
    period = a_period(((0.0, "Gr"), (50.0, "rG"), (90.0, "Gr")), end=200.0)
    plain = replay(scenario).simulate((), period, 1)
    slow = replay(scenario).simulate(parse_domain("desired_speed=0.6"), period, 1)
    assert slow.travel_time_s > plain.travel_time_s + 10
    shifted = replay(scenario).simulate(parse_domain("signal_clock=C,3"), period, 1)
    assert shifted.travel_time_s == plain.travel_time_s
    name = "advance:S_C_0"
    assert shifted.period.passages[name].on_s[0] == pytest.approx(
        plain.period.passages[name].on_s[0] + 3.0
    )


class Watched(Replay):
    """Notes when vehicles park on each day it plays."""

    def __init__(self, scenario: Scenario) -> None:
        network = Network.read(scenario)
        detectors = standard_detectors(network)
        super().__init__(
            scenario, network, detectors, DetectorLayout.of(network, detectors).owner, THRESHOLDS
        )
        self.parked: list[list[float]] = []

    def _run(self, scenario: Scenario, *rest: Any) -> Day:
        vehicles = (x for item in scenario.routes for x in item.parse().iter("vehicle"))
        self.parked.append(
            [float(x.get("depart", "")) for x in vehicles if x.get("id", "").startswith("parking.")]
        )
        return super()._run(scenario, *rest)


def test_vehicles_park_at_other_times_on_other_days(scenario: Scenario) -> None:
    period = a_period(((0.0, "Gr"),), end=200.0)
    watched = Watched(scenario)
    seen = [
        watched.simulate(parse_domain("parking=S_C_0,90,20"), period, seed) for seed in (1, 1, 2)
    ]
    one, same, other = watched.parked
    assert len(one) == len(other) == 5
    assert one == same
    assert not set(one) & set(other)
    assert seen[0].travel_time_s == seen[1].travel_time_s
    watched.simulate((), period, 1)
    assert watched.parked[-1] == []


def test_what_sumo_says_of_an_impossible_programme_is_passed_on(scenario: Scenario) -> None:
    with pytest.raises(SimulatorError, match="period 'day1'"):
        replay(scenario).simulate((), a_period(((0.0, "G"),)), 1)
