"""Work in parts: on threads, processes and Ray, with the same results, whatever dies."""

from __future__ import annotations

import contextlib
import copy
import os
import pickle
import shutil
import signal
import subprocess
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import ugat_marl
from ugat_marl.cli.arguments import workers_of
from ugat_marl.data import TransitionLog
from ugat_marl.diagnosis.engine import Budget, Engine
from ugat_marl.diagnosis.features import DetectorLayout
from ugat_marl.diagnosis.replay import Replay
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.diagnosis.unmeasured import Unmeasured
from ugat_marl.effects import StartupDelay, load_scenario
from ugat_marl.envs import TrafficEnv
from ugat_marl.errors import JobError, OptionError, ScenarioError, SimulatorCrashed
from ugat_marl.experiments import evaluation_of, policy_factory, rule_factory
from ugat_marl.files import files_sent_whole
from ugat_marl.grounding import RollOutSettings, roll_outs
from ugat_marl.parallel import (
    DEADLINE_VARIABLE,
    RETRIES,
    Heartbeat,
    LocalProcesses,
    RayExecutor,
    Stop,
    as_done,
    executor_of,
    parts_at_a_time,
    retry_on_crash,
    usable_cores,
)
from ugat_marl.policies import Policy
from ugat_marl.scenarios import Network, Period
from ugat_marl.simulation import standard_detectors

THRESHOLDS = Thresholds()

LENGTH_S = 100.0


def halved(number: int, stop: Stop) -> float:
    if number < 0:
        raise ValueError(f"{number} is negative")
    return number / 2


def test_parts_are_numbered_in_whatever_order_they_are_done() -> None:
    found = dict(as_done(3, halved, [(n, Stop()) for n in range(20)], Stop()))
    assert found == {n: n / 2 for n in range(20)}


def test_the_first_failure_stops_what_was_not_begun() -> None:
    begun: list[int] = []
    stop = Stop()

    def work(number: int) -> None:
        begun.append(number)
        if number == 1:
            raise ValueError("one")
        stop.wait(10)

    with pytest.raises(ValueError, match="one"):
        list(as_done(2, work, [(n,) for n in range(50)], stop))
    assert stop.is_set()
    assert len(begun) < 10


def test_an_executor_that_was_given_stays_open() -> None:
    with ThreadPoolExecutor(2) as pool:
        assert parts_at_a_time(pool) == 2
        list(as_done(pool, halved, [(1, Stop())], Stop()))
        assert pool.submit(int, "3").result() == 3
    with executor_of(3) as own:
        assert isinstance(own, ThreadPoolExecutor)
    with pytest.raises(RuntimeError, match="shutdown"):
        own.submit(int, "3")
    assert parts_at_a_time(None) == usable_cores()
    assert parts_at_a_time(5) == 5
    with pytest.raises(OptionError, match="workers = 0: must be a whole number from 1 on"):
        parts_at_a_time(0)


def test_a_stop_is_heard_where_it_was_made() -> None:
    stop = Stop()
    stop.set()
    elsewhere = copy.copy(stop)  # by the way that pickles go
    assert isinstance(elsewhere, threading.Event)
    assert not elsewhere.is_set()


def results(workers: Any, policies: Any = None) -> Any:
    policies = policies or {rule: rule_factory(rule) for rule in ("largest-queue:20", "random")}
    scenario = load_scenario("single-v1")
    return evaluation_of(
        scenario, policies, ["sim", "V4"], [5, 6], duration_s=LENGTH_S, workers=workers
    ).results


STOPS = """
import os, pathlib, signal
mark = pathlib.Path({mark!r})
if not mark.exists():
    mark.touch()
    os.kill(os.getpid(), signal.SIGSTOP)
"""
DIES = """
import os, pathlib
folder = pathlib.Path({folder!r})
marks = len(list(folder.iterdir()))
(folder / str(marks)).touch()
if marks < {times}:
    os.kill(os.getpid(), 9)
"""


def test_processes_that_die_are_replaced(tmp_path: Path) -> None:
    twice, always = (DIES.format(folder=str(tmp_path), times=times) for times in (2, 100))
    with LocalProcesses(1) as processes:
        list(as_done(processes, exec, [(twice,)], Stop()))
        assert len(list(tmp_path.iterdir())) == 3
        with pytest.raises(BrokenProcessPool):
            processes.submit(exec, always).result()
        assert len(list(tmp_path.iterdir())) == 4 + RETRIES
        with pytest.raises(ValueError, match="^invalid literal for int"):
            processes.submit(int, "one").result()
        assert processes.submit(int, "1").result() == 1
    with pytest.raises(RuntimeError, match="shutdown"):
        processes.submit(int, "1")


UNPACKED_NOWHERE = """
class Own(Exception):
    def __init__(self, one, two):
        super().__init__(one)
import pathlib
file = pathlib.Path({file!r})
file.write_text(file.read_text() + "." if file.exists() else ".")
raise Own("the reason", 2)
"""


def test_an_error_that_cannot_be_sent_is_told_and_nothing_is_repeated(tmp_path: Path) -> None:
    file = tmp_path / "calls"
    with LocalProcesses(1) as processes:
        with pytest.raises(JobError, match="Own: the reason"):
            processes.submit(exec, UNPACKED_NOWHERE.format(file=str(file)), {}).result()
        assert processes.submit(int, "1").result() == 1
    assert file.read_text() == "."


class NoNumber:
    """Becomes ``int("x")`` where it is unpickled."""

    def __reduce__(self) -> Any:
        return int, ("x",)


def test_a_part_or_result_that_cannot_be_sent_is_told_and_nothing_is_repeated(
    tmp_path: Path,
) -> None:
    file = tmp_path / "calls"
    odd = "type('Odd', (), {'__reduce__': lambda self: (int, ('x',))})()"
    with LocalProcesses(1) as processes:
        with pytest.raises(JobError, match="^the result of a part cannot be sent .*ValueError"):
            processes.submit(eval, f"(open({str(file)!r}, 'a').write('.'), {odd})[1]").result()
        with pytest.raises(JobError, match="^a part cannot be sent between processes .*ValueError"):
            processes.submit(str, NoNumber()).result()
        assert processes.submit(int, "1").result() == 1
    assert file.read_text() == "."


def test_a_policy_of_a_file_is_loaded_by_each_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "mine.py").write_text(
        "def first(observations): return dict.fromkeys(observations, 0)"
    )
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(tmp_path)
    policies = {"mine": policy_factory("sub/mine.py:first")}
    with LocalProcesses(1) as processes:
        assert results(processes, policies) == results(1, policies)


@pytest.mark.slow
def test_a_stopped_process_is_killed_and_its_part_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(DEADLINE_VARIABLE, "15")  # an interpreter starts within it
    with LocalProcesses(1) as processes:
        processes.submit(exec, STOPS.format(mark=str(tmp_path / "mark"))).result(120)
        assert (tmp_path / "mark").exists()


def test_a_pause_of_the_starter_is_no_silence_of_a_process(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = types.SimpleNamespace(monotonic=lambda: now_s)
    monkeypatch.setattr("ugat_marl.parallel.time", clock)
    monkeypatch.setenv(DEADLINE_VARIABLE, "60")
    now_s, signs = 0.0, 0
    heartbeat = Heartbeat(lambda: signs)
    now_s = 3600.0  # all processes were stopped, and this one is the first to run on
    assert not heartbeat.is_lost()
    lost: list[bool] = []
    for _ in range(59):
        now_s += 1.0
        lost.append(heartbeat.is_lost())
    assert lost == [False] * 58 + [True]
    signs += 1
    assert not heartbeat.is_lost()


def test_processes_give_what_threads_give() -> None:
    with LocalProcesses(2) as processes:
        assert results(processes) == results(2)


def test_roll_outs_are_in_the_order_of_their_seeds_whoever_plays_them() -> None:
    scenario = load_scenario("single-v1")
    rule = rule_factory("largest-queue:20")
    each = RollOutSettings(scenario, "V4", {"duration_s": LENGTH_S}, rule, 0.3, "count")
    alone = [each.play(seed, Stop())[0] for seed in (3, 1, 2)]
    log, scores = roll_outs(each, (3, 1, 2), workers=2)
    assert log.frame.equals(TransitionLog.concatenate(alone).frame)
    assert log.provenance.domain == "V4"
    assert log.provenance.seeds == (3, 1, 2)
    assert len({score.att_s for score in scores}) == 3


def engine_of(data: Path, workers: Any) -> Engine:
    scenario = load_scenario(data / "crossing")
    network = Network.read(scenario)
    detectors = standard_detectors(network)
    layout = DetectorLayout.of(network, detectors)
    shown = ((0.0, "Gr"), (30.0, "rG"), (60.0, "Gr"), (90.0, "rG"))
    periods = [Period("day1", 0.0, 120.0, "fit", {"C": shown}, {})]
    replay = Replay(scenario, network, detectors, layout.owner, THRESHOLDS)
    return Engine(
        scenario, layout, replay, periods, 3, THRESHOLDS,
        budget=Budget(), unmeasured=Unmeasured(), workers=workers,
    )  # fmt: skip


def test_days_of_a_diagnosis_are_the_same_in_processes(data: Path) -> None:
    found: list[Any] = []
    with LocalProcesses(1) as processes:
        for workers in (2, processes):
            engine = engine_of(data, workers)
            days = engine.replicates([StartupDelay(1.0)], [0, 1])
            found.append([(day.tally.sums.tolist(), day.travel_time_s) for day in days])
    assert found[0] == found[1]
    assert found[0][0] != found[0][1]


# --- simulators that die


def test_a_day_of_a_diagnosis_whose_simulator_dies_is_simulated_again(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (expected,) = engine_of(data, 1).replicates([], [0])
    run, ends = subprocess.run, [-9, -9, 0, *[-9] * 100]

    def killed(command: Any, **given: Any) -> Any:
        simulates = any(Path(word).stem == "sumo" for word in command)  # perhaps confined
        end = ends.pop(0) if simulates else 0
        return subprocess.CompletedProcess(command, end, "", "") if end else run(command, **given)

    monkeypatch.setattr("ugat_marl.scenarios.sumo_tools.subprocess.run", killed)
    (found,) = engine_of(data, 1).replicates([], [0])
    assert (found.tally.sums == expected.tally.sums).all()
    assert len(ends) == 100
    with pytest.raises(SimulatorCrashed, match="exit code -9"):
        engine_of(data, 1).replicates([], [0])
    assert len(ends) == 99 - RETRIES


@dataclass(frozen=True)
class Killed:
    """A rule whose simulator is killed at the third decision, the first times it is played."""

    folder: Path
    times: int
    rule: str = "largest-queue:20"

    def __call__(self, env: TrafficEnv) -> Policy:
        return KillingPolicy(rule_factory(self.rule)(env), self)


class KillingPolicy:
    def __init__(self, policy: Policy, how: Killed) -> None:
        self.env_options = policy.env_options
        self._policy = policy
        self._how = how
        self._decision = 0

    def reset(self, seed: int) -> None:
        self._policy.reset(seed)
        self._decision = 0

    def act(self, observations: Any, infos: Any) -> Any:
        self._decision += 1
        marks = len(list(self._how.folder.iterdir()))
        if self._decision == 3 and marks < self._how.times:
            (self._how.folder / str(marks)).touch()
            victims = list(simulators())
            assert victims
            for child in victims:
                os.kill(child, signal.SIGKILL)
        return self._policy.act(observations, infos)


def simulators() -> Iterator[int]:
    """The workers below this process."""
    tables = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):
                parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
                tables[int(folder.name)] = int(parent)
    warm = [pid for pid, parent in tables.items() if parent == os.getpid()]
    for pid, parent in tables.items():
        if parent in warm and b"ugat_marl.simulation" in Path(f"/proc/{pid}/cmdline").read_bytes():
            yield pid


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_an_episode_whose_simulator_dies_is_played_again(tmp_path: Path) -> None:
    folder = tmp_path / "marks"
    folder.mkdir()
    expected = results(1, {"rule": rule_factory("largest-queue:20")})
    assert results(1, {"rule": Killed(folder, 2)}) == expected
    assert len(list(folder.iterdir())) == 2
    with pytest.raises(SimulatorCrashed, match="died"):
        results(1, {"rule": Killed(folder, 100)})
    assert len(list(folder.iterdir())) == 3 + RETRIES


def test_other_errors_are_not_tried_again() -> None:
    tried: list[int] = []

    def play() -> None:
        tried.append(1)
        raise OptionError("no")

    with pytest.raises(OptionError, match="no"):
        retry_on_crash(play)
    assert tried == [1]


# --- Ray


def test_a_missing_ray_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(OptionError, match=r"pip install 'ray"):
        RayExecutor()


def test_ray_and_workers_exclude_each_other() -> None:
    with (
        pytest.raises(OptionError, match="--jobs is for this machine"),
        workers_of(2, "auto", "--jobs"),
    ):
        pass
    with workers_of(2, None) as workers:
        assert workers == 2


def test_a_scenario_for_another_machine_is_sent_with_its_files(
    crossing: Callable[..., Path],
) -> None:
    directory = crossing()
    scenario = load_scenario(directory)
    path_alone = copy.deepcopy(scenario)  # by the same function as a pickle
    with files_sent_whole():
        whole = copy.deepcopy(scenario)
    shutil.rmtree(directory)
    with pytest.raises(ScenarioError, match="no such file"):
        path_alone.network.read()
    env = ugat_marl.parallel_env(whole, duration_s=20)
    env.reset(seed=1)
    env.step(dict.fromkeys(env.agents, 0))
    env.close()


def test_ray_sends_files_whole(monkeypatch: pytest.MonkeyPatch, data: Path) -> None:
    """With a stand-in for Ray, which pickles as Ray does: in the call."""
    scenario, sent = load_scenario(data / "crossing"), []

    class Task:
        def remote(self, *parts: Any) -> Any:
            sent.append(pickle.dumps(parts[2]))
            return types.SimpleNamespace(future=Future)

    executor = RayExecutor.__new__(RayExecutor)
    executor._is_open, executor._task, executor._signs = True, Task(), None
    executor._running, executor._lock = {}, threading.Lock()
    executor.submit(len, scenario)
    assert scenario.network.read() in sent[0]
    assert scenario.network.read() not in pickle.dumps((scenario,))


@pytest.fixture(scope="module")
def ray() -> Iterator[Executor]:
    pytest.importorskip("ray")
    with RayExecutor() as executor:
        yield executor
    time.sleep(2)
    assert not sys.modules["ray"].is_initialized()  # nor was another one started since


def test_ray_gives_what_threads_give(ray: Executor) -> None:
    assert results(ray) == results(2)


def test_ray_s_errors_are_the_parts_own(ray: Executor) -> None:
    with pytest.raises(ValueError, match="^invalid literal for int"):
        list(as_done(ray, int, [("one",)], Stop()))


def test_ray_replaces_a_worker_that_dies(ray: Executor, tmp_path: Path) -> None:
    list(as_done(ray, exec, [(DIES.format(folder=str(tmp_path), times=2),)], Stop()))
    assert len(list(tmp_path.iterdir())) == 3


def test_ray_replaces_a_worker_that_is_stopped(
    ray: Executor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(DEADLINE_VARIABLE, "4")
    part = ray.submit(exec, STOPS.format(mark=str(tmp_path / "mark")))
    long = ray.submit(time.sleep, 12.0)  # longer than the deadline, and alive
    part.result(120)
    assert (tmp_path / "mark").exists()
    long.result(120)


def test_what_is_watched_is_played_here(ray: Executor) -> None:
    with pytest.raises(OptionError, match="needs workers in this process"):
        evaluation_of(
            load_scenario("single-v1"), {"r": rule_factory("random")}, ["sim"], [1],
            workers=ray, watch=lambda name, env: lambda step: None,
        )  # fmt: skip
