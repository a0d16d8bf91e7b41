"""The benches' arithmetic against hand-made numbers, and each bench once at its smallest."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from studies.bench.env import EnvBench, find_scenario, require_same_work
from studies.bench.env_program import RecordingSimulator, random_actions
from studies.bench.field_log import FieldLogBench
from studies.bench.fitting import FittingBench
from studies.bench.fresh_process import in_fresh_process
from studies.bench.learning import LearningBench
from studies.bench.learning_program import Noise, Tape
from studies.bench.memory import MemoryBench, growth_of
from studies.bench.memory_program import family, look
from studies.bench.report import Report, Spread, Target
from studies.bench.sumo_rl import SumoRl
from studies.errors import MeasurementError
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.experiments import machine_facts

SCENARIO = "single-v1"


def test_a_spread_is_median_and_quartiles_whatever_the_order() -> None:
    spread = Spread.of([5.0, 1.0, 4.0, 2.0, 3.0])
    assert (spread.median, spread.low, spread.high) == (3.0, 2.0, 4.0)
    assert spread.values == (5.0, 1.0, 4.0, 2.0, 3.0)
    assert Spread.of([7.0]).low == Spread.of([7.0]).high == 7.0


def test_ratios_are_within_a_round() -> None:
    """A machine that is four times slower in one round changes no ratio."""
    ours, bare = [80.0, 20.0, 80.0], [100.0, 25.0, 100.0]
    assert Spread.of_ratios(ours, bare).values == pytest.approx((0.8, 0.8, 0.8))
    assert Spread.of(ours).median / Spread.of([100.0, 25.0, 25.0]).median != pytest.approx(0.8)
    with pytest.raises(ValueError, match="longer"):
        Spread.of_ratios([1.0], [1.0, 2.0])


@pytest.mark.parametrize(
    ("measured", "at_least", "met"),
    [(0.85, True, True), (0.849, True, False), (1.6, False, False), (1.5, False, True)],
)
def test_a_target_is_met_or_not(measured: float, at_least: bool, met: bool) -> None:
    limit = 0.85 if at_least else 1.5
    assert Target("t", measured, limit, at_least).met is met


@pytest.mark.parametrize(
    ("number", "text"),
    [(999.7, "1000"), (999.4, "999"), (0.00005, "0.00005"), (1234.6, "1235"), (0.12345, "0.123"),
     (7.0, "7"), (0.0, "0"), (math.nan, "-")],
)  # fmt: skip
def test_numbers_are_shown_without_exponent(number: float, text: str) -> None:
    assert str(Spread.of([number])) == f"{text} ({text}-{text})"


def test_what_was_not_measured_meets_no_target() -> None:
    assert not Target("t", math.nan, 0.85, at_least=True).met
    assert not Target("t", math.nan, 1.6, at_least=False).met


def test_growth() -> None:
    assert growth_of(200.0, 210.0) == pytest.approx(0.05)
    assert growth_of(0.0, 0.0) == 0.0
    assert growth_of(0.0, 1.0) == math.inf


def test_a_report_is_written_whole_with_the_machine(tmp_path: Path) -> None:
    rows = [{"what": "a [s]", "speed": Spread.of([1.0, 2.0]), "missing": math.nan}]
    report = Report("env", {"seed": 3, "out": tmp_path}, rows, [Target("t", 1.0, 2.0, True)])
    report.write(tmp_path / "deep" / "report.json")
    read = json.loads((tmp_path / "deep" / "report.json").read_text())
    assert read["settings"] == {"seed": 3, "out": str(tmp_path)}
    assert read["rows"][0]["speed"] == {"median": 1.5, "low": 1.25, "high": 1.75, "values": [1, 2]}
    assert read["rows"][0]["missing"] is None
    assert read["targets"][0]["met"] is False
    assert not report.met
    assert read["machine"]["cores"] >= 1
    assert read["machine"]["python"] == ".".join(map(str, sys.version_info[:3]))
    assert {"cpu", "versions", "date", "command"} <= set(read["machine"])
    console = Console(width=100, record=True)
    console.print(report.tables())
    printed = console.export_text()
    assert "MISSED" in printed
    assert "a [s]" in printed


def test_descendants_and_nobody_else_are_counted() -> None:
    table = [(10, 1, 5.0), (11, 10, 2.0), (12, 11, 1.0), (13, 1, 100.0), (1, 0, 50.0)]
    assert family(table, 10) == {10: 5.0, 11: 2.0, 12: 1.0}


def test_a_process_finds_itself() -> None:
    seen = look()
    assert seen["own memory [MiB]"] > 10
    assert seen["processes"] >= 1
    before = seen["open files"]
    with Path(__file__).open():
        assert look()["open files"] == before + 1


@pytest.mark.parametrize(
    ("program", "typed"),
    [
        ("/opt/lib/ugat_marl/__main__.py", "ugat-marl --seeds 2"),
        ("/opt/bin/ugat-marl", "ugat-marl --seeds 2"),
        ("/opt/tree/studies/bench/__main__.py", "python -m studies.bench --seeds 2"),
        ("baselines/results.py", "python baselines/results.py --seeds 2"),
        ("/opt/tree/baselines/results.py", "python results.py --seeds 2"),
    ],
)
def test_the_command_is_what_one_would_type(
    program: str, typed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", [program, "--seeds", "2"])
    assert machine_facts()["command"] == typed


def test_a_measured_program_that_fails_says_why(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text("print('so far'); raise SystemExit('no such road')")
    with pytest.raises(MeasurementError, match="status 1; it said: .*no such road"):
        in_fresh_process([program], {})
    program.write_text("pass")
    with pytest.raises(MeasurementError, match="status 0"):
        in_fresh_process([program], {})


def test_a_field_log_of_a_decision_a_day_is_measured(tmp_path: Path) -> None:
    report = FieldLogBench(days=5, lights=1, interval_s=86_400, folder=tmp_path).run()
    assert [row["days"] for row in report.rows] == [f"{k} to {k + 1}" for k in range(5)]


def test_other_work_is_not_compared() -> None:
    same = {"a": {"entered": 5, "arrived": 3}, "b": {"entered": 5, "arrived": 3}}
    require_same_work(same)
    with pytest.raises(MeasurementError, match="not the same work"):
        require_same_work({**same, "c": {"entered": 5, "arrived": 4}})
    require_same_work({**same, "c": {"entered": 5, "arrived": 4}}, tolerance=0.5)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: EnvBench(rounds=0), "rounds = 0"),
        (lambda: EnvBench(scenarios=()), "scenarios = 0"),
        (lambda: LearningBench(updates=0), "updates = 0"),
        (lambda: FittingBench(rounds=0), "rounds = 0"),
        (lambda: MemoryBench(resets=20), "more than settled"),
        (lambda: FieldLogBench(interval_s=86_401), "fewer than 5 decisions"),
        (lambda: FieldLogBench(days=4, interval_s=86_400), "fewer than 5 decisions"),
    ],
)
def test_impossible_options_are_refused(make: object, words: str) -> None:
    with pytest.raises(OptionError, match=words):
        make()  # type: ignore[operator]


def test_resco_networks_are_found_beside_sumo_rl(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("studies.bench.env.find_spec", lambda _: None)
    configuration = tmp_path / "grid4x4" / "grid4x4.sumocfg"
    configuration.parent.mkdir()
    configuration.touch()
    other = SumoRl(tmp_path / "python", tmp_path, {})
    assert find_scenario("resco:grid4x4", other) == (configuration, None)
    name, remark = find_scenario("resco:grid4x4", None)
    assert name == "grid4x4-v1"
    assert remark is not None
    assert "resco:grid4x4" in remark
    assert find_scenario("single-v1", None) == ("single-v1", None)


def test_recorded_switches_are_what_sumo_showed(tmp_path: Path) -> None:
    """The record, read second by second, is SUMO's own account of its signals."""
    env = parallel_env(SCENARIO, simulator="inprocess", duration_s=100)
    recorder = RecordingSimulator(tmp_path)
    env.simulate_with(recorder)
    env.reset(seed=1)
    (light,) = env.intersection_of.values()
    for action in random_actions(env, 5)[:-1]:
        env.step(action)
        shown = [state for _, states in recorder.switches for name, state in states]
        assert env._simulator.signals()[light] == shown[-1]
    env.close()
    times = [when for when, _ in recorder.switches]
    assert times == sorted(set(times))
    assert all(a != b for a, b in zip(shown, shown[1:], strict=False))
    asked = recorder.bare_request()
    assert asked["end_s"] - asked["begin_s"] == 90
    assert "--time-to-teleport" in asked["arguments"]
    assert not any("tripinfo" in part for part in asked["arguments"])


def test_a_tape_plays_the_same_episode_again() -> None:
    env = Noise([(3, 2), (4, 3)], decisions=4)
    tape = Tape(env)
    tape.reset(seed=7)
    while tape.agents:
        last = tape.step(dict.fromkeys(tape.agents, 1))
    tape.play()
    again = env._generator.random()
    env.reset(seed=7)
    for _ in range(4):
        repeated = env.step(dict.fromkeys(env.agents, 1))
    assert again == env._generator.random()
    np.testing.assert_array_equal(last[0]["agent_1"], repeated[0]["agent_1"])


@pytest.mark.slow
def test_bench_env(tmp_path: Path) -> None:
    out = tmp_path / "env.json"
    bench = EnvBench((SCENARIO,), rounds=2, duration_s=120, sumo_rl=False, out=out)
    report = bench.run()
    bare, inprocess, process = report.rows
    assert bare["ratio to libsumo"].median == 1.0
    assert bare["entered"] == inprocess["entered"] == process["entered"] > 0
    speeds = [row["simulated s / s"].values for row in report.rows]
    assert inprocess["ratio to libsumo"].values == pytest.approx(
        [a / b for a, b in zip(speeds[1], speeds[0], strict=True)]
    )
    assert [target.limit for target in report.targets] == [0.85, 0.75]
    assert report.targets[0].measured == inprocess["ratio to libsumo"].median
    assert json.loads(out.read_text())["settings"]["rounds"] == 2


@pytest.mark.slow
def test_bench_learning() -> None:
    report = LearningBench(
        SCENARIO, rounds=2, duration_s=200, warmup_decisions=40, updates=3, repetitions=3
    ).run()
    overhead, growth = report.targets
    training, plain = report.rows[1]["time"].values, report.rows[0]["time"].values
    ratios = [a / b for a, b in zip(training, plain, strict=True)]
    assert overhead.measured == pytest.approx(np.median(ratios))
    assert growth.measured > 0
    assert "20 decisions and 20 updates" in report.notes[0]


@pytest.mark.slow
def test_bench_fitting(tmp_path: Path) -> None:
    out = tmp_path / "fitting.json"
    report = FittingBench(SCENARIO, episodes=2, duration_s=200, rounds=2, epochs=2, out=out).run()
    rows = {row["what"]: row for row in report.rows}
    ratios, times = rows["CPU time of a fit / edl"], rows["CPU time of a fit [s]"]
    assert ratios["edl"].values == (1.0, 1.0)
    assert ratios["ensemble"].values == pytest.approx(
        [a / b for a, b in zip(times["ensemble"].values, times["edl"].values, strict=True)]
    )
    assert rows["mean u"]["none"].median == rows["mean u off the data"]["none"].median == 0.0
    assert 0 < rows["mean u in V4"]["dropout"].median <= 1
    assert "1 agents, 40 transitions" in report.notes[0]
    assert json.loads(out.read_text())["settings"]["domain"] == "V4"


@pytest.mark.slow
def test_bench_memory() -> None:
    report = MemoryBench(SCENARIO, resets=4, settled=2, steps=1).run()
    assert {row["simulator"] for row in report.rows} == {"process", "inprocess"}
    processes = [row["after 4"] for row in report.rows if row["what"] == "processes"]
    assert processes == [3, 1]
    assert all(target.met for target in report.targets if "MiB" not in target.name)
