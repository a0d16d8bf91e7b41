"""Processes that are stopped: nothing waits for them without end, and numbers stay the same."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ugat_marl.envs import parallel_env, vector_env
from ugat_marl.errors import OptionError, ScenarioError, SimulatorCrashed
from ugat_marl.parallel import DEADLINE_VARIABLE
from ugat_marl.scenarios import finished, read_scenario
from ugat_marl.simulation import Host, ProcessSimulator, launch_of
from ugat_marl.simulation.channel import ChannelClosed
from ugat_marl.simulation.host import StartMethod

Crossing = Callable[..., Path]


@pytest.mark.parametrize("method", ["forkserver", "spawn"])
def test_a_stopped_simulation_counts_as_dead(
    method: StartMethod, crossing: Crossing, tmp_path: Path
) -> None:
    simulator = ProcessSimulator(method, deadline_s=4.0)
    launch = launch_of(read_scenario(crossing()), 0, tmp_path / "run", ())
    first = simulator.start(launch)
    worker = simulator._worker
    assert worker is not None
    os.kill(worker._pid, signal.SIGSTOP)
    begun = time.monotonic()
    with pytest.raises(SimulatorCrashed, match=r"did not answer 'advance' within 4 s and was"):
        simulator.advance(10.0, {})
    assert time.monotonic() - begun < 12.0
    until = time.monotonic() + 5
    while Path(f"/proc/{worker._pid}/environ").exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker._pid}/environ").exists()
    again = simulator.start(launch)
    np.testing.assert_array_equal(again.vehicles, first.vehicles)
    simulator.close()


def test_a_stopped_worker_of_a_vector_is_replaced_with_the_same_numbers(crossing: Crossing) -> None:
    def play(stopped_at: int | None) -> list[float]:
        env = vector_env(crossing(), 2, deadline_s=8.0)  # the warm parent starts within it as well
        rewards: list[float] = []
        env.reset(seed=3)
        for decision in range(6):
            if decision == stopped_at:
                worker = env._environments[1]._worker
                assert worker is not None
                os.kill(worker._pid, signal.SIGSTOP)
            transition = env.step(np.full((2, 1), decision % 2))
            rewards += transition.rewards.ravel().tolist()
        env.close()
        return rewards

    assert play(2) == play(None)


SLOW = """
import time

def reward(before, after):
    time.sleep(0.3)
    return float(after.halting.sum() - before.halting.sum())
"""


@pytest.mark.slow
def test_an_episode_longer_than_the_deadline_is_repeated(
    crossing: Crossing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The deadline is that of a decision, not of all that a fresh process repeats."""
    (tmp_path / "slow_reward_of_a_test.py").write_text(SLOW)
    monkeypatch.syspath_prepend(str(tmp_path))
    reward = importlib.import_module("slow_reward_of_a_test").reward
    env = vector_env(crossing(), 1, deadline_s=3.0, reward=reward)
    env.reset(seed=3)
    rewards: list[float] = []
    for decision in range(15):
        if decision == 14:
            os.kill(env._environments[0].worker._pid, signal.SIGKILL)
        rewards.append(float(env.step(np.zeros((1, 1), dtype=np.int64)).rewards[0, 0]))
    env.reset(seed=3)
    again = [float(env.step(np.zeros((1, 1), dtype=np.int64)).rewards[0, 0]) for _ in range(15)]
    env.close()
    assert rewards == again


@pytest.mark.parametrize("simulator", ["process", "spawn"])
def test_a_plain_environment_has_the_deadline_that_it_is_given(
    simulator: str, crossing: Crossing
) -> None:
    env = parallel_env(crossing(), simulator=simulator, deadline_s=6)
    first, _ = env.reset(seed=3)
    worker = env._simulator._worker  # pyright: ignore[reportAttributeAccessIssue, reportOptionalMemberAccess]
    os.kill(worker._pid, signal.SIGSTOP)
    with pytest.raises(SimulatorCrashed, match=r"did not answer 'advance' within 6 s"):
        env.step(dict.fromkeys(env.agents, 0))
    again, _ = env.reset(seed=3)
    for agent, row in first.items():
        np.testing.assert_array_equal(again[agent], row)
    env.close()


@pytest.mark.parametrize("deadline_s", [0, -1, 3e6, 1e12, float("nan"), float("inf"), True, "5"])
def test_impossible_deadlines_of_environments(deadline_s: Any, crossing: Crossing) -> None:
    for make in (parallel_env, lambda *given, **options: vector_env(*given, 2, **options)):
        with pytest.raises(OptionError, match="deadline_s = .*: give a number of seconds above 0"):
            make(crossing(), deadline_s=deadline_s)


def test_a_simulation_in_this_process_has_no_deadline(crossing: Crossing) -> None:
    with pytest.raises(OptionError, match="leave it out with simulator='inprocess'"):
        parallel_env(crossing(), simulator="inprocess", deadline_s=5.0)


LARGE = """
import numpy as np
from ugat_marl.simulation.channel import Message

class Large:
    def prepare(self, order): pass
    def open(self, order, descriptors):
        return lambda question: Message({}, [np.ones(question.header["count"])])
"""


@pytest.mark.parametrize("method", ["forkserver", "spawn"])
@pytest.mark.parametrize("amid", ["the question", "the answer"])
def test_a_worker_that_stops_in_the_middle_of_a_message_counts_as_dead(
    method: StartMethod, amid: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "large_service.py").write_text(LARGE)
    monkeypatch.syspath_prepend(tmp_path)
    host = Host("large_service:Large", method, deadline_s=3.0)
    worker = host.start({})
    worker.ask("once", count=2)
    np.testing.assert_array_equal(worker.answer().arrays[0], [1.0, 1.0])
    large = np.ones(2_000_000)  # 16 MB, far more than a connection holds
    if amid == "the answer":
        worker.ask("large", count=len(large))
        assert worker.has_answered(30.0)
    os.kill(worker._pid, signal.SIGSTOP)
    begun = time.monotonic()

    def go_on() -> None:
        if amid == "the question":
            worker.ask("large", [large], count=1)
        worker.answer()

    with pytest.raises(ChannelClosed):
        go_on()
    assert 2.5 < time.monotonic() - begun < 10.0
    assert "did not answer 'large' within 3 s and was killed" in worker.crash_message("large")
    host.close()


HELD = """
import ctypes
import pathlib
import sys
import time

class Held:
    def prepare(self, order): pass
    def told(self, order): pass
    def abandoned(self): pass
    def open(self, order, descriptors):
        return lambda question: ctypes.PyDLL(None).sleep(60)  # keeps the interpreter's lock

if __name__ == "__main__":
    from ugat_marl.simulation import Host

    host = Host("held_service:Held", sys.argv[2])
    worker = host.start({"directory": sys.argv[1]})
    worker.ask("anything")
    time.sleep(2)
    print(worker._pid, flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("method", ["forkserver", "spawn"])
def test_a_worker_inside_a_long_call_ends_with_the_process_of_the_user(
    method: StartMethod, tmp_path: Path
) -> None:
    program, folder = tmp_path / "held_service.py", tmp_path / "folder"
    program.write_text(HELD)
    folder.mkdir()
    paths = os.pathsep.join(map(str, (tmp_path, *sys.path)))
    user = subprocess.Popen(
        [sys.executable, program, folder, method],
        env={**os.environ, "PYTHONPATH": paths, "PYTHONSAFEPATH": ""},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert user.stdout is not None
    worker = int(user.stdout.readline())
    user.kill()
    user.wait()
    user.stdout.close()
    until = time.monotonic() + 20
    while (Path(f"/proc/{worker}/environ").exists() or folder.exists()) and (
        time.monotonic() < until
    ):
        time.sleep(0.1)
    assert not Path(f"/proc/{worker}/environ").exists()
    assert not folder.exists()


def test_the_guard_of_a_spawned_worker_ends_with_it(crossing: Crossing, tmp_path: Path) -> None:
    simulator = ProcessSimulator("spawn")
    simulator.start(launch_of(read_scenario(crossing()), 0, tmp_path / "run", ()))
    worker = simulator._worker
    assert worker is not None
    children = Path(f"/proc/{worker._pid}/task/{worker._pid}/children")
    (guard,) = children.read_text().split()
    simulator.close()
    assert not Path(f"/proc/{guard}").exists()


def test_a_program_that_does_not_end_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DEADLINE_VARIABLE, "0.5")
    with pytest.raises(ScenarioError, match=r"netconvert: did not end within 0.5 s and was killed"):
        finished("netconvert", [sys.executable, "-c", "import time; time.sleep(60)"])


@pytest.mark.parametrize("text", ["soon", "0", "-1", "nan", "inf", "1_000", "\u0665"])
def test_impossible_deadlines(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DEADLINE_VARIABLE, text)
    with pytest.raises(OptionError, match="give "):
        Host("any:Service")
