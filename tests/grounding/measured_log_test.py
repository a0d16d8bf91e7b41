"""Measured data as a transition log, against the log of the simulation that was measured."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import polars as pl
import pytest

from ugat_marl.__main__ import main
from ugat_marl.data import MeasuredData, TransitionLog, write_measured
from ugat_marl.effects import load_scenario
from ugat_marl.envs import parallel_env
from ugat_marl.errors import MeasuredDataError, OptionError, UnknownNameError
from ugat_marl.experiments import policy_factory, record
from ugat_marl.grounding import (
    LaneView,
    MeasuredSource,
    RecordedWorld,
    StreetConfig,
    TimedConfig,
    UgatConfig,
    log_of_measured,
)
from ugat_marl.grounding.measured_log import phases_shown
from ugat_marl.grounding.street import Simulation, StreetWorld
from ugat_marl.grounding.summaries import NAMES, OF_COUNTS
from ugat_marl.grounding.ugat import Ugat
from ugat_marl.grounding.worlds import RecordedCommands
from ugat_marl.policies import observer_of, roll_out
from ugat_marl.scenarios import Network, Scenario
from ugat_marl.scenarios.junctions import Upstream
from ugat_marl.seeding import derive_seed

POLICY = "fixed-time:20"


@pytest.fixture(scope="module")
def crossing(data: Path) -> Scenario:
    return load_scenario(data / "crossing")


@pytest.fixture(scope="module")
def measured(crossing: Scenario) -> MeasuredData:
    return record(
        crossing, "sim", policy_factory(POLICY), periods=1, workers=1, same_demand=True,
        lanes=True, trajectories=True,
    )  # fmt: skip


@pytest.fixture(scope="module")
def truth(crossing: Scenario) -> TransitionLog:
    """What the simulation itself saw in the recorded episode."""
    make = policy_factory(POLICY)
    policy = make(parallel_env(crossing))
    env = parallel_env(crossing, crossings=True, reward="queue", **policy.env_options)
    with contextlib.closing(env):
        seed = derive_seed(0, "record", 0, "simulation")
        log = roll_out(env, policy, seed, record=observer_of(env, "count")).log
    assert log is not None
    return log


def imported(
    measured: MeasuredData, scenario: Scenario, observation: str = "count", **more: Any
) -> TransitionLog:
    options: dict[str, Any] = {"source": "detections", **more}
    network = Network.read(scenario)
    return log_of_measured(measured, scenario, network, "street", observation, **options).log


def test_the_log_is_that_of_the_simulation(
    crossing: Scenario, measured: MeasuredData, truth: TransitionLog
) -> None:
    log = imported(measured, crossing)
    (agent,) = log.agents
    found, true = log.transitions(agent), truth.transitions(agent)
    rows = len(found)
    assert 10 <= rows < len(true)  # the last cars were not seen by a detector
    assert found.executed.tolist() == true.executed[:rows].tolist()
    assert found.action.tolist() == true.executed[:rows].tolist()
    assert found.observation[:, 2:].tolist() == true.observation[:rows, 2:].tolist()
    counts, others = 40 * found.observation[:, :2], 40 * true.observation[:rows, :2]
    assert others.max() >= 3
    assert np.abs(counts - others).mean() < 0.3
    left, gone = (40 * r.observation[:, :2] - 40 * r.served_features for r in (found, true))
    assert np.abs(left - gone[:rows]).mean() < 0.06 < gone.mean()
    assert np.abs(found.reward - true.reward[:rows]).mean() < 0.5
    assert log.provenance.source == "measured" and log.provenance.domain == "street"
    assert set(log.provenance.deviation) == {"S_C_0", "W_C_0"}


@pytest.mark.parametrize("kind", ["lanes", "trajectories"])
def test_a_table_of_lanes_or_trajectories_takes_the_place_of_the_estimate(
    crossing: Scenario, measured: MeasuredData, truth: TransitionLog, kind: str
) -> None:
    given = replace(
        measured, **{"lanes": None, "trajectories": None, kind: getattr(measured, kind)}
    )
    log = imported(given, crossing, source="best")
    found, true = log.transitions(log.agents[0]), truth.transitions(truth.agents[0])
    assert len(found) == len(true)
    assert found.observation[1:].tolist() == true.observation[1:].tolist()
    assert found.reward.tolist() == true.reward.tolist()
    assert not log.provenance.deviation


@pytest.mark.parametrize("source", ["best", "detections"])
def test_held_out_periods_are_left_out(
    crossing: Scenario, measured: MeasuredData, source: MeasuredSource
) -> None:
    assert measured.lanes is not None
    (day,) = measured.periods
    again = measured.lanes.with_columns(period_id=pl.lit("day2"))
    both = replace(
        measured,
        periods=(day, replace(day, id="day2", split="heldout")),
        lanes=pl.concat([measured.lanes, again.filter(pl.col("lane_id") != "S_C_0")]),
        trajectories=None,
    )
    network = Network.read(crossing)
    alone = log_of_measured(measured, crossing, network, "street", "count", source)
    fit = log_of_measured(both, crossing, network, "street", "count", source)
    assert fit.log.frame.equals(alone.log.frame)
    assert fit.log.provenance == alone.log.provenance
    assert fit.findings[0].startswith("1 held-out period ('day2'): left out")
    assert fit.findings[1:] == alone.findings
    every = log_of_measured(both, crossing, network, "street", "count", source, periods="all")
    assert every.log.episodes == 2 and not any("left out, to" in x for x in every.findings)
    with pytest.raises(UnknownNameError, match="heldout"):
        imported(measured, crossing, periods="heldout")


def test_lanes_that_a_table_lacks_are_said_to_be_estimated(
    crossing: Scenario, measured: MeasuredData
) -> None:
    assert measured.lanes is not None
    network = Network.read(crossing)
    some = measured.lanes.filter(pl.col("lane_id") != "S_C_0")
    given = replace(measured, lanes=some, trajectories=None)
    made = log_of_measured(given, crossing, network, "street", "count", "best")
    alone = imported(measured, crossing)
    assert made.log.provenance.deviation == {"S_C_0": alone.provenance.deviation["S_C_0"]}
    assert "(median of 1 lanes)" in made.findings[0]
    found, guessed = (x.transitions(x.agents[0]).observation for x in (made.log, alone))
    whole = imported(replace(measured, trajectories=None), crossing, source="best")
    true = whole.transitions(whole.agents[0]).observation
    assert len(found) == len(guessed) < len(true)  # the end of the estimate is left out
    config = StreetConfig()
    assert "eyes" not in config.of_log(made.log).parts
    assert "eyes" in config.of_log(whole).parts


def test_only_estimated_periods_make_up_the_deviation_of_a_lane(
    crossing: Scenario, measured: MeasuredData
) -> None:
    """Of two equal days, one has the lane in its table."""
    lanes, network = measured.lanes, Network.read(crossing)
    assert lanes is not None
    (day,) = measured.periods
    other = replace(day, id="another day")
    some = lanes.filter(pl.col("lane_id") != "S_C_0").with_columns(period_id=pl.lit(other.id))
    given = replace(
        measured, periods=(day, other), lanes=pl.concat([lanes, some]), trajectories=None
    )
    made = log_of_measured(given, crossing, network, "street", "count", "best")
    alone = imported(measured, crossing).provenance.deviation["S_C_0"]
    assert made.log.provenance.deviation == {"S_C_0": pytest.approx(alone)}


def test_an_unknown_source_is_refused(crossing: Scenario, measured: MeasuredData) -> None:
    with pytest.raises(UnknownNameError, match="'detection'.*detections"):
        imported(measured, crossing, source=cast(Any, "detection"))


def test_lanes_that_count_with_those_upstream_are_estimated(
    crossing: Scenario, measured: MeasuredData
) -> None:
    """A table holds the vehicles of the lane alone, and agents would see too few."""
    network = Network.read(crossing)
    short = replace(network.lanes["S_C_0"], behind=Upstream({"W_C_0": 1.0}))
    joined = replace(network, lanes={**network.lanes, "S_C_0": short})
    made = log_of_measured(measured, crossing, joined, "street", "count", "best")
    assert set(made.log.provenance.deviation) == {"S_C_0"}
    assert "estimated from detections on 1 lane ('S_C_0')" in made.findings[-1]


def test_a_hole_in_a_table_of_lanes_is_refused(crossing: Scenario, measured: MeasuredData) -> None:
    assert measured.lanes is not None
    hole = measured.lanes.filter(~pl.col("time_s").is_between(60.0, 120.0))
    given = replace(measured, lanes=hole, trajectories=None)
    with pytest.raises(MeasuredDataError, match="lanes: nothing of lane .* at 70 s.*--vehicles"):
        log_of_measured(given, crossing, Network.read(crossing), "street", "count", "best")


def test_trajectories_between_whole_seconds_give_the_same_log(
    crossing: Scenario, measured: MeasuredData
) -> None:
    assert measured.trajectories is not None

    def observed(trajectories: pl.DataFrame) -> list[list[float]]:
        given = replace(measured, lanes=None, trajectories=trajectories)
        log = imported(given, crossing, source="best")
        return log.transitions(log.agents[0]).observation.tolist()

    early = measured.trajectories.with_columns(pl.col("time_s") - 0.4)
    assert observed(early) == observed(measured.trajectories)


def test_gaps_of_trajectories_are_said_or_refused(
    crossing: Scenario, measured: MeasuredData
) -> None:
    assert measured.trajectories is not None
    network = Network.read(crossing)
    options: dict[str, Any] = {"observation": "count", "source": "best"}

    def findings(trajectories: pl.DataFrame) -> str:
        given = replace(measured, lanes=None, trajectories=trajectories)
        return "\n".join(log_of_measured(given, crossing, network, "street", **options).findings)

    busy = set(measured.trajectories["time_s"].to_list())
    assert busy >= set(np.arange(10.0, 100.0).tolist())
    assert "anywhere" not in findings(measured.trajectories)
    hole = measured.trajectories.filter(~pl.col("time_s").is_between(20.0, 69.0))
    assert "anywhere for up to 48 s (period 'day1', from 22 s on)" in findings(hole)
    with pytest.raises(MeasuredDataError, match=r"positions every 5 s.*--vehicles detections"):
        findings(measured.trajectories.filter(pl.col("time_s") % 5 == 0))


def test_a_learner_and_a_fit_take_the_log(crossing: Scenario, measured: MeasuredData) -> None:
    log = imported(measured, crossing, "movements")
    env = parallel_env(crossing, observation="movements")
    world = RecordedWorld(log, env)
    taken = world.collect(RecordedCommands(log), 0, 0)
    assert taken is not None and taken.frame.equals(log.frame)
    summary = LaneView.of(Network.read(crossing), "movements").summary(log)
    assert np.isfinite(summary.values[:, NAMES.index("mean")]).all()


def test_rewards_of_a_log_are_not_matched(crossing: Scenario, measured: MeasuredData) -> None:
    """They are those of whoever set the lights, and those of the simulation the learner's."""
    env = parallel_env(crossing, observation="count")
    world, nothing = RecordedWorld(imported(measured, crossing), env), cast(Any, None)
    config = UgatConfig("timed", timed=TimedConfig(match=True))
    ugat = Ugat(env=env, sim=nothing, real=world, config=config, seed=0, run=nothing)
    with pytest.raises(OptionError, match="the street's log is of another policy"):
        ugat.train(nothing)


def test_a_replay_repeats_the_commands_of_the_street(
    crossing: Scenario, measured: MeasuredData
) -> None:
    log = imported(measured, crossing)
    replay = RecordedWorld(log, parallel_env(crossing, observation="count")).replay()
    assert replay is not None
    with contextlib.closing(parallel_env(crossing, **replay.env_options)) as env:
        again = roll_out(env, replay, 3, record=observer_of(env)).log
    assert again is not None
    wanted = log.transitions(log.agents[0]).executed
    found = again.transitions(again.agents[0]).executed
    assert found[: len(wanted)].tolist() == wanted.tolist()
    assert set(found[len(wanted) :]) == {wanted[-1]}


def test_worlds_repeat_a_log_at_its_own_time_of_day(
    crossing: Scenario, measured: MeasuredData
) -> None:
    """A period that begins with the third decision; the worlds' log has its time, and no other."""
    (whole, *_) = measured.periods
    period = replace(whole, begin_s=whole.begin_s + 20.0)
    later = replace(measured, periods=(period,), lanes=None, trajectories=None)
    log = imported(later, crossing)
    assert int(log.frame["step"].to_numpy().min()) == 2
    env = parallel_env(crossing, observation="count")
    world = RecordedWorld(log, env)
    taken = world.collect(RecordedCommands(log), 0, 0)
    assert taken is not None and int(taken.frame["step"].to_numpy().min()) == 0
    replay = world.replay()
    assert replay is not None
    simulation = Simulation(crossing, {"observation": "count"}, 0.0, workers=1)
    (again,) = simulation.logs([StreetWorld()], replay, [3], 100.0, lambda: None)
    wanted = log.transitions(log.agents[0]).executed[:10]
    assert again.transitions(again.agents[0]).executed.tolist() == wanted.tolist()
    whole_log = roll_out(env, replay, 3, record=observer_of(env)).log
    assert whole_log is not None
    seen = [one.transitions(log.agents[0]).observation for one in (again, whole_log)]
    assert np.array_equal(seen[0], seen[1][2:12])


def test_a_log_whose_steps_count_from_midnight_is_the_same_log(
    crossing: Scenario, measured: MeasuredData
) -> None:
    log = imported(measured, crossing)
    anywhere = replace(log.provenance, from_begin=False)
    late = TransitionLog(anywhere, log.frame.with_columns(step=pl.col("step") + 2520))
    world = RecordedWorld(late, parallel_env(crossing, observation="count"))
    taken = world.collect(RecordedCommands(log), 0, 0)
    assert taken is not None and taken.frame.equals(log.frame)


def test_of_a_lane_with_a_guessed_queue_only_the_service_is_used(
    crossing: Scenario, measured: MeasuredData
) -> None:
    view = LaneView.of(Network.read(crossing), "count")
    log = imported(measured, crossing)
    plain = TransitionLog(replace(log.provenance, deviation={}), log.frame)
    unsure = TransitionLog(replace(log.provenance, deviation={"S_C_0": 5.0}), log.frame)
    whole, part = view.summary(plain), view.summary(unsure)
    lane = view.lanes.index("S_C_0")
    assert np.isnan(part.values[lane, OF_COUNTS]).all()
    other = 1 - lane
    assert np.array_equal(part.values[other], whole.values[other], equal_nan=True)
    assert np.array_equal(
        part.values[lane, ~OF_COUNTS], whole.values[lane, ~OF_COUNTS], equal_nan=True
    )
    assert part.network[NAMES.index("mean")] == whole.values[other, NAMES.index("mean")]
    # A simulated world is compared by the same numbers.
    known = ~np.isnan(part.values)
    assert np.array_equal(whole.where(known).network, part.network, equal_nan=True)


def test_estimated_vehicles_are_no_readings_of_detectors(
    crossing: Scenario, measured: MeasuredData, truth: TransitionLog
) -> None:
    assert StreetConfig().of_log(truth) == StreetConfig()
    assert StreetConfig().of_log(imported(measured, crossing)).parts == (
        "channel", "service", "effects"
    )  # fmt: skip


def test_clearances_lead_to_the_next_phase(crossing: Scenario) -> None:
    light = Network.read(crossing).intersections[0]
    assert light.phases == ("Gr", "rG")
    shown = ((0.0, "Gr"), (20.0, "yr"), (23.0, "rr"), (25.0, "rG"), (45.0, "ry"))
    phases, strange = phases_shown(shown, light, 50.0, 5.0)
    assert phases.tolist() == [0, 1, 1, 1, 1]
    assert strange == 0.0


def test_links_that_stay_green_in_a_clearance_are_no_phase() -> None:
    links = [SimpleNamespace(index=i) for i in range(3)]
    light: Any = SimpleNamespace(id="J", links=links, phases=("GGr", "GrG", "Grr"))
    shown = ((0.0, "GGr"), (30.0, "Gyr"), (33.0, "Grr"), (35.0, "GrG"), (60.0, "Gry"))
    phases, strange = phases_shown((*shown, (63.0, "Grr")), light, 80.0, 5.0)
    assert phases.tolist() == [0, 1, 1, 1, 2, 2]
    assert strange == 0.0


@pytest.mark.parametrize("end_s", [100.0, 66.0])
def test_greens_shorter_than_the_scenarios_shortest_are_greens(end_s: float) -> None:
    """So are those that the end of the log cuts."""
    links = [SimpleNamespace(index=i) for i in range(3)]
    light: Any = SimpleNamespace(id="J", links=links, phases=("Grr", "rGr", "rrG"))
    shown = [(0.0, "Grr"), (20.0, "yrr"), (23.0, "rrr"), (24.0, "rGr"), (28.0, "ryr")]
    shown += [(31.0, "rrr"), (32.0, "rrG"), (60.0, "rry"), (63.0, "rrr"), (64.0, "Grr")]
    phases, _ = phases_shown(tuple(shown), light, end_s, 5.0)
    assert phases.tolist() == [0, 1, 1, 1, 2, 2, 2, 0, 0, 0]


def test_greens_of_no_phase_are_the_most_similar_one_and_said(crossing: Scenario) -> None:
    light = Network.read(crossing).intersections[0]
    phases, strange = phases_shown(((0.0, "Gr"), (20.0, "GG"), (30.0, "rG")), light, 40.0, 5.0)
    assert phases.tolist() == [0, 0, 1]
    assert strange == pytest.approx(0.25)
    with pytest.raises(MeasuredDataError, match="'C' never shows a phase of the scenario"):
        phases_shown(((0.0, "rr"),), light, 40.0, 5.0)


def test_what_the_data_cannot_tell_is_an_error(crossing: Scenario, measured: MeasuredData) -> None:
    period = measured.periods[0]

    def without(kind: str) -> MeasuredData:
        kept = tuple(d for d in measured.detectors if d.kind != kind)
        return replace(measured, detectors=kept)

    def changed(**more: Any) -> MeasuredData:
        return replace(measured, periods=(replace(period, **more),))

    with pytest.raises(OptionError, match="waiting"):
        imported(measured, crossing, "waiting")
    for data, observation, words in (
        (changed(passages={}), "count", "counts only: when single vehicles leave"),
        (without("stop"), "count", r"no stop detector on 2 lanes \('S_C_0', 'W_C_0'\)"),
        (without("exit"), "movements", "no exit detector on 2 lanes .* --observation count"),
        (changed(signals={}), "count", "nothing of traffic light 'C' in period 'day1'"),
        (changed(end_s=20.0), "count", "fewer than two decisions of 10 s"),
    ):
        with pytest.raises(MeasuredDataError, match=words):
            imported(data, crossing, observation)
    assert len(imported(without("exit"), crossing, "count")) > 0


def test_without_advance_detectors_it_says_so(crossing: Scenario, measured: MeasuredData) -> None:
    kept = tuple(d for d in measured.detectors if d.kind != "advance")
    network = Network.read(crossing)
    found = log_of_measured(
        replace(measured, detectors=kept), crossing, network, "street", "count", "detections"
    )
    assert any("no advance detector" in line for line in found.findings)
    assert any("taken for the commands" in line for line in found.findings)


def test_the_command_writes_a_log_that_can_be_read(
    tmp_path: Path, data: Path, measured: MeasuredData, capsys: pytest.CaptureFixture[str]
) -> None:
    write_measured(replace(measured, lanes=None, trajectories=None), tmp_path / "main-street")
    periods = tmp_path / "main-street" / "periods.csv"
    periods.write_text(periods.read_text().rstrip("\n"))
    out = tmp_path / "street.parquet"
    call = ["import-log", str(data / "crossing"), str(tmp_path / "main-street")]
    assert main([*call, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "vehicles on a lane are estimated" in said and "transitions of 1 periods" in said
    assert "the last line has no end" in said, "findings of the reader"
    assert "Finding(" not in said
    log = TransitionLog.read(out)
    assert log.provenance.domain == "main-street"
    assert log.provenance.observation == "movements"
    table = tmp_path / "main-street" / "signals.parquet"
    content = table.read_bytes()
    assert main([*call, "--out", str(table)]) == 2
    assert "is no transition log" in capsys.readouterr().err
    assert table.read_bytes() == content
    assert main([*call, "--out", str(out), "--observation", "waiting"]) == 2
    assert "which detectors do not see" in capsys.readouterr().err
