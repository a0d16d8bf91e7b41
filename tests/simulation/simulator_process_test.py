"""Simulators in processes: many at once, reproducible, and gone without a trace however it ends."""

from __future__ import annotations

import gc
import hashlib
import importlib.util
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.interrupts import eventually
from ugat_marl import parallel_env
from ugat_marl.effects import load_scenario
from ugat_marl.errors import (
    EpisodeError,
    OptionError,
    SimulatorCrashed,
    SimulatorError,
    WorkerError,
)
from ugat_marl.scenarios import MEMORY_VARIABLE
from ugat_marl.simulation import (
    Channel,
    ChannelClosed,
    Host,
    LibsumoSimulator,
    Message,
    ProcessSimulator,
    Simulator,
    kept_warm,
    launch_of,
)
from ugat_marl.simulation.host import _WarmParent

Crossing = Callable[..., Path]

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that can fork")
needs_proc = pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc")


def pid_of(env: Any) -> int:
    return env._simulator._worker._pid


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def episode(env: Any, seed: int, actions_seed: int = 0) -> str:
    """A digest of everything an episode under random actions returns."""
    generator = np.random.default_rng(actions_seed)
    digest = hashlib.sha256()
    observations, _ = env.reset(seed=seed)
    while env.agents:
        for agent in env.agents:
            digest.update(observations[agent].tobytes())
        actions = {a: int(generator.integers(env.action_space(a).n)) for a in env.agents}
        observations, rewards, *_ = env.step(actions)
        digest.update(repr(sorted(rewards.items())).encode())
    digest.update(repr(env.scores()).encode())
    return digest.hexdigest()


# --- many at once


def test_many_live_at_once(crossing: Crossing, temporary: Path) -> None:
    directory = crossing()
    envs = [parallel_env(directory) for _ in range(8)]
    try:
        pids = set()
        for number, env in enumerate(envs):
            env.reset(seed=number)
            pids.add(pid_of(env))
        assert len(pids) == 8
        for _ in range(20):  # in lock-step
            for env in envs:
                env.step({"signal_0": 0})
        assert len({repr(env.scores()) for env in envs}) == 1  # nothing here is random
    finally:
        for env in envs:
            env.close()
    assert eventually(lambda: not any(map(alive, pids)), 1)
    assert list(temporary.iterdir()) == []


def test_threads_have_simulations_of_their_own(crossing: Crossing) -> None:
    directory = crossing()
    found: dict[int, list[str]] = {}

    def work(number: int) -> None:
        env = parallel_env(directory)
        found[number] = [episode(env, seed) for seed in (1, 2)]
        env.close()

    threads = [threading.Thread(target=work, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4
    assert len(set(map(tuple, found.values()))) == 1


def test_every_episode_has_a_process_of_its_own(crossing: Crossing) -> None:
    env = parallel_env(crossing())
    pids: list[int] = []
    for _ in range(3):
        env.reset(seed=0)
        env.step({"signal_0": 0})
        pids.append(pid_of(env))
    env.close()
    assert len(set(pids)) == 3
    assert eventually(lambda: not any(map(alive, pids)), 1)


@pytest.mark.slow
@needs_proc
def test_resets_leak_nothing(crossing: Crossing, temporary: Path) -> None:
    env = parallel_env(crossing())

    def held() -> tuple[int, int]:
        return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()

    counts = set()
    for number in range(12):
        env.reset(seed=number)
        env.step({"signal_0": 0})
        if number > 1:
            gc.collect()
            counts.add(held())
        assert len(list(temporary.iterdir())) == 1
    assert len(counts) == 1
    env.close()
    assert list(temporary.iterdir()) == []


@needs_proc
def test_a_killed_parent_of_workers_leaves_no_descriptor(crossing: Crossing) -> None:
    env = parallel_env(crossing())
    counts: list[int] = []
    for number in range(4):
        env.reset(seed=number)
        for parent in _WarmParent._current.values():
            parent._process.kill()
            parent._process.wait()
        gc.collect()
        counts.append(len(list(Path("/proc/self/fd").iterdir())))
    assert len({*counts[1:]}) == 1
    env.close()


def test_a_forgotten_environment_cleans_up(crossing: Crossing, temporary: Path) -> None:
    env = parallel_env(crossing())
    env.reset(seed=0)
    pid = pid_of(env)
    del env
    gc.collect()
    assert eventually(lambda: not alive(pid))
    assert list(temporary.iterdir()) == []


# --- the same trajectory, whatever runs it


def test_in_process_forked_and_spawned_are_the_same_to_the_bit() -> None:
    found = {}
    for simulator in ("inprocess", "process", "spawn"):
        env = parallel_env("grid2x2-v1", "V2", duration_s=300, simulator=simulator)
        found[simulator] = episode(env, seed=5)
        env.close()
    assert len(set(found.values())) == 1, found


RESCO = importlib.util.find_spec("sumo_rl") is not None
NETWORK = "resco:cologne1" if RESCO else "grid2x2-v1"


def test_a_seed_fixes_the_episode_whatever_ran_before(python: list[str]) -> None:
    """Where it is installed on cologne1, on which SUMO alternates if restarted in one process."""
    env = parallel_env(NETWORK, duration_s=600)
    other = parallel_env("single-v1", "V4", duration_s=300)
    first = episode(env, seed=11)
    assert episode(env, seed=12) != first
    episode(other, seed=11)
    other.reset(seed=1)  # alive meanwhile
    assert [episode(env, seed=11) for _ in range(3)] == [first] * 3
    env.close()
    other.close()
    script = (
        "from tests.simulation.simulator_process_test import NETWORK, episode, parallel_env\n"
        "env = parallel_env(NETWORK, duration_s=600, simulator='spawn')\n"
        "print(episode(env, seed=11)); env.close()\n"
    )
    again = subprocess.run([*python, "-c", script], stdout=subprocess.PIPE, text=True, check=True)
    assert again.stdout.split() == [first]


def test_without_a_seed_episodes_differ_and_follow_from_the_last_seed() -> None:
    def seeds() -> list[str]:
        env = parallel_env("single-v1", duration_s=100)
        found = [episode(env, 4)]
        for _ in range(2):
            env.reset()
            found.append(str(env._simulator._worker is not None) + repr(rewards(env)))
        env.close()
        return found

    def rewards(env: Any) -> list[float]:
        found = []
        while env.agents:
            found.append(env.step(dict.fromkeys(env.agents, 0))[1]["signal_0"])
        return found

    first = seeds()
    assert first == seeds()


# --- crashes


@pytest.mark.parametrize("simulator", ["process", "spawn"])
def test_a_crash_is_an_error_here_and_nowhere_else(
    simulator: str, crossing: Crossing, temporary: Path
) -> None:
    directory = crossing()
    env, other = (parallel_env(directory, simulator=simulator) for _ in range(2))
    env.reset(seed=0)
    other.reset(seed=0)
    env.step({"signal_0": 0})
    pid = pid_of(env)
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(SimulatorCrashed) as caught:
        env.step({"signal_0": 0})
    message = str(caught.value)
    assert f"simulator process {pid} died" in message
    assert "reset() starts this one afresh" in message
    assert "\n" not in message
    with pytest.raises(EpisodeError, match="call reset"):
        env.step({"signal_0": 0})
    other.step({"signal_0": 0})
    env.reset(seed=0)
    env.step({"signal_0": 0})
    env.close()
    other.close()
    assert list(temporary.iterdir()) == []


def test_last_words_are_part_of_the_error(
    crossing: Crossing, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PYTHONFAULTHANDLER", "1")  # it says so when memory is violated
    simulator = ProcessSimulator("spawn")
    simulator.start(launch_of(load_scenario(crossing()), 0, tmp_path, ()))
    assert simulator._worker is not None
    os.kill(simulator._worker._pid, signal.SIGSEGV)
    with pytest.raises(SimulatorCrashed, match="status -11 .*Fatal Python error: Segmentation"):
        simulator.advance(1, {})
    simulator.close()


def test_an_order_may_be_longer_than_a_command_line() -> None:
    """Linux takes 128 KiB as one argument; the service of all lanes of a city is more."""
    host = Host("ugat_marl.simulation.process:Simulations", "spawn")
    worker = host.start({"directory": None, "more": "x" * 200_000})
    worker.ask("signals")
    with pytest.raises(WorkerError):  # of the service, which has read the order
        worker.answer()


@pytest.mark.parametrize("simulator", ["process", "spawn"])
def test_sumo_s_words_come_through(simulator: str, crossing: Crossing, temporary: Path) -> None:
    lost = (
        '<vehicle id="a" depart="0" route="east"/>'
        '<vehicle id="lost" depart="500"><route edges="W_C C_N"/></vehicle>'
    )
    env = parallel_env(crossing(vehicles=lost), simulator=simulator, duration_s=1000)
    env.reset(seed=0)

    def play() -> None:
        while env.agents:
            env.step({"signal_0": 0})

    with pytest.raises(SimulatorError, match="SUMO failed after .* 'lost' has no valid route"):
        play()
    with pytest.raises(EpisodeError, match="call reset"):
        env.step({"signal_0": 0})
    env.close()
    assert list(temporary.iterdir()) == []


def test_a_killed_warm_parent_is_replaced(crossing: Crossing) -> None:
    env, other = parallel_env(crossing()), parallel_env(crossing())
    env.reset(seed=0)
    other.reset(seed=0)
    assert env._simulator._host._parent is other._simulator._host._parent
    env._simulator._host._parent._process.kill()
    env._simulator._host._parent._process.wait()
    env.step({"signal_0": 0})  # its worker lives on
    env.reset(seed=0)
    other.reset(seed=0)
    env.step({"signal_0": 0})
    assert env._simulator._host._parent is other._simulator._host._parent
    env.close()
    other.close()


def test_a_warm_parent_ends_with_its_last_host_or_with_the_block_that_keeps_it() -> None:
    def opened() -> Host:
        host = Host("types:SimpleNamespace")  # a service of this test alone
        host.warm()
        return host

    def parent_after_close() -> Any:
        host = opened()
        parent = host.warm()
        host.close()
        return parent

    assert not parent_after_close().alive
    with kept_warm():
        with kept_warm():
            kept = parent_after_close()
        assert kept.alive
        assert parent_after_close() is kept
    assert not kept.alive
    with kept_warm():
        kept = parent_after_close()
        host = opened()
        assert host.warm() is kept
    assert kept.alive
    host.close()
    assert not kept.alive


def test_asking_before_starting_or_after_closing(crossing: Crossing, tmp_path: Path) -> None:
    simulator = ProcessSimulator()
    with pytest.raises(SimulatorError, match="advance: no simulation is under way"):
        simulator.advance(1, {})
    simulator.start(launch_of(load_scenario(crossing()), 0, tmp_path, ()))
    simulator.close()
    simulator.close()
    with pytest.raises(SimulatorError, match="finish: no simulation is under way"):
        simulator.finish()


def test_start_methods() -> None:
    with pytest.raises(OptionError, match="start_method = 'thread'; allowed: 'forkserver', 'spaw"):
        ProcessSimulator("thread")  # type: ignore[arg-type]


def test_both_sides_measure_the_same(crossing: Crossing, tmp_path: Path) -> None:
    simulators: list[Simulator] = [LibsumoSimulator(), ProcessSimulator()]
    lanes = ("W_C_0", "C_E_0")
    found: list[list[Any]] = []
    for number, simulator in enumerate(simulators):
        own = tmp_path / str(number)
        own.mkdir()
        seen: list[Any] = [
            simulator.start(launch_of(load_scenario(crossing()), 1, own, lanes, waiting=True))
        ]
        seen.append(simulator.advance(30, {"C": [(10.0, "Gr"), (20.0, "rr")]}))
        seen += [simulator.vehicles(), simulator.signals(), simulator.finish()]
        simulator.close()
        found.append(seen)
    for here, there in zip(*found, strict=True):
        names = getattr(here, "__dataclass_fields__", None)
        if names is None:
            assert here == there
            continue
        for name in names:
            a, b = getattr(here, name), getattr(there, name)
            np.testing.assert_array_equal(a, b)
            assert np.asarray(a).dtype == np.asarray(b).dtype


# --- interruptions


def test_an_interruption_between_question_and_answer(crossing: Crossing, temporary: Path) -> None:
    """Ctrl-C while SUMO computes: the next answer must not be taken for this one's."""
    vehicles = '<flow id="f" type="car" route="east" begin="0" end="90000" period="2"/>'
    env = parallel_env(crossing(vehicles=vehicles), duration_s=100_000)
    env.reset(seed=0)
    pid = pid_of(env)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        with pytest.raises(KeyboardInterrupt):
            env._simulator.advance(50_000, {})
    finally:
        signal.signal(signal.SIGALRM, before)
    assert eventually(lambda: not alive(pid))
    env.reset(seed=0)
    env.step({"signal_0": 0})
    assert env.snapshot.time_s == 10
    env.close()
    assert list(temporary.iterdir()) == []


@dataclass
class Script:
    """A user's script in a process group of its own, and everything that descends from it."""

    process: subprocess.Popen[str]
    mark: str
    temporary: Path
    lines: list[str] = field(default_factory=list)

    def wait_for(self, line: str) -> None:
        assert self.process.stdout is not None
        while (got := self.process.stdout.readline()) and got.strip() != line:
            self.lines.append(got.strip())
        assert got, "the script ended early: " + self.process.communicate()[1]

    def relatives(self) -> list[int]:
        """Processes that carry the script's mark in their environment, zombies left out."""
        found: list[int] = []
        for folder in Path("/proc").iterdir():
            if folder.name.isdigit():
                try:
                    if self.mark.encode() in (folder / "environ").read_bytes():
                        found.append(int(folder.name))
                except OSError:
                    continue
        return found

    def leaves_nothing(self) -> bool:
        return eventually(lambda: not self.relatives() and not list(self.temporary.iterdir()))


@pytest.fixture
def run_script(
    python: list[str], tmp_path: Path, temporary: Path
) -> Iterator[Callable[[str], Script]]:
    started: list[Script] = []

    def run(text: str) -> Script:
        file = tmp_path / f"script{len(started)}.py"
        # A terminal's signals end a program, unless the tests themselves were begun with nohup.
        ends = "import signal\nsignal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
        file.write_text(ends + text)
        mark = uuid.uuid4().hex
        process = subprocess.Popen(
            [*python, str(file)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env={**os.environ, "MARK": mark, "PYTHONUNBUFFERED": "1"},
        )
        started.append(Script(process, mark, temporary))
        return started[-1]

    yield run
    for script in started:
        script.process.kill()
        script.process.communicate()


ENDLESS = """
from ugat_marl import parallel_env
envs = [parallel_env({path!r}, duration_s=10**6, simulator=s) for s in {simulators!r}]
for env in envs:
    env.reset(seed=1)
print("running")
while True:
    for env in envs:
        env.step(dict.fromkeys(env.agents, 0))
"""


@needs_proc
@pytest.mark.parametrize("how", ["SIGINT", "SIGTERM", "SIGKILL", "SIGHUP"])
def test_nothing_is_left_when_the_user_s_process_ends(
    how: str, crossing: Crossing, run_script: Callable[[str], Script]
) -> None:
    """The signal goes to the whole process group, as Ctrl-C in a terminal does."""
    simulators = ["process", "process", "spawn"]
    script = run_script(ENDLESS.format(path=str(crossing()), simulators=simulators))
    script.wait_for("running")
    # the script, the warm parent, three workers, the guard of the spawned one
    assert len(script.relatives()) == 1 + 1 + 3 + 1
    assert len(list(script.temporary.iterdir())) == 3
    os.killpg(script.process.pid, getattr(signal, how))
    _, said = script.process.communicate(timeout=20)
    assert script.leaves_nothing()
    assert "simulation.worker" not in said  # no traceback but the user's own


BUSY = """
from ugat_marl import parallel_env
print("running")
while True:
    env = parallel_env({path!r}, "V1")
    env.reset()
    env.step({{"signal_0": 0}})
    env.close()
"""


@needs_proc
@pytest.mark.parametrize("pause_s", [0.1, 0.5])
def test_nothing_is_left_of_a_start_that_was_killed(
    pause_s: float, crossing: Crossing, run_script: Callable[[str], Script]
) -> None:
    script = run_script(BUSY.format(path=str(crossing())))
    script.wait_for("running")
    time.sleep(pause_s)
    os.killpg(script.process.pid, signal.SIGKILL)
    script.process.communicate(timeout=20)
    assert script.leaves_nothing()


@needs_proc
def test_nothing_is_left_though_a_forked_child_survives(
    crossing: Crossing, run_script: Callable[[str], Script]
) -> None:
    """The child inherits the lines to the simulators, so that they do not close."""
    text = ENDLESS.format(path=str(crossing()), simulators=["process", "spawn"])
    fork = 'import os, time\nif os.fork() == 0:\n    time.sleep(60)\nprint("running")'
    script = run_script(text.replace('print("running")', fork))
    script.wait_for("running")
    # the script, its child, the warm parent, two workers, the guard of the spawned one
    assert len(script.relatives()) == 2 + 1 + 2 + 1
    script.process.kill()
    script.process.wait()
    assert eventually(lambda: len(script.relatives()) == 1 and not list(script.temporary.iterdir()))
    (child,) = script.relatives()
    os.kill(child, signal.SIGKILL)


@needs_proc
def test_a_script_needs_no_guard_and_need_not_close(
    crossing: Crossing, run_script: Callable[[str], Script]
) -> None:
    script = run_script(
        f"""
from ugat_marl import parallel_env
print("top level")
envs = [parallel_env({str(crossing())!r}, simulator=s) for s in ("process", "process", "spawn")]
for env in envs:
    env.reset(seed=1)
for env in envs:
    env.step(dict.fromkeys(env.agents, 0))
print("stepped")
"""
    )
    out, said = script.process.communicate(timeout=60)
    assert script.process.returncode == 0, said
    assert out.split("\n") == ["top level", "stepped", ""]  # the script ran once
    assert said == ""
    assert script.leaves_nothing()


@needs_proc
def test_close_leaves_nothing(crossing: Crossing, run_script: Callable[[str], Script]) -> None:
    script = run_script(
        f"""
import os
from pathlib import Path
from ugat_marl import parallel_env
def relatives():
    mark = os.environ["MARK"].encode()
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                if mark in (folder / "environ").read_bytes():
                    found.append(folder.name)
            except OSError:
                pass
    return len(found), len(os.listdir(os.environ["TMPDIR"]))
env = parallel_env({str(crossing())!r})
print(*relatives())
env.reset(seed=1)
print(*relatives())
while env.agents:
    env.step(dict.fromkeys(env.agents, 0))
print(*relatives())
env.close()
print(*relatives())
"""
    )
    out, said = script.process.communicate(timeout=60)
    # Nothing before reset; then warm parent, worker, folder; the warm parent between episodes.
    assert out.split("\n")[:4] == ["1 0", "3 1", "2 0", "1 0"], said
    assert script.leaves_nothing()


# --- forks


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_leaves_its_parent_s_simulation_alone(
    crossing: Crossing, temporary: Path
) -> None:
    directory = crossing()
    env = parallel_env(directory)
    expected = episode(env, seed=3)
    env.reset(seed=3)
    for _ in range(5):
        env.step({"signal_0": 0})
    half = env.snapshot
    context = multiprocessing.get_context("fork")
    mine, its = context.Pipe()

    def child() -> None:
        answers: dict[str, Any] = {}
        try:
            env.step({"signal_0": 0})
        except SimulatorError as error:
            answers["inherited"] = str(error)
        own = parallel_env(directory)
        answers["own"] = episode(own, seed=3)
        own.close()
        answers["reset"] = episode(env, seed=3)  # the inherited object begins anew
        env.close()
        its.send(answers)
        its.close()

    process = context.Process(target=child)
    process.start()
    assert mine.poll(60), "the child did not answer"
    answers = mine.recv()
    process.join(30)
    assert process.exitcode == 0
    assert "no simulation is under way in this process" in answers["inherited"]
    assert answers["own"] == answers["reset"] == expected
    # The parent's own simulation never noticed.
    env.step({"signal_0": 0})
    assert env.snapshot.time_s == half.time_s + 10
    env.close()
    assert list(temporary.iterdir()) == []


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_that_drops_the_environment_ends_nothing(crossing: Crossing) -> None:
    for simulator in ("process", "spawn", "inprocess"):
        holder = [parallel_env(crossing(), simulator=simulator)]
        holder[0].reset(seed=0)
        child = os.fork()
        if child == 0:
            holder.clear()
            gc.collect()
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        while holder[0].agents:
            holder[0].step({"signal_0": 0})
        assert holder[0].scores().departed > 0
        holder[0].close()


# --- the line between the two


def pair() -> tuple[Channel, Channel]:
    down, up = os.pipe(), os.pipe()
    here = Channel(os.fdopen(up[0], "rb"), writer := os.fdopen(down[1], "wb"), writer.close)
    there = Channel(os.fdopen(down[0], "rb"), writer := os.fdopen(up[1], "wb"), writer.close)
    return here, there


def test_messages_arrive_as_they_were_sent() -> None:
    here, there = pair()
    arrays = [np.arange(6.0).reshape(2, 3), np.empty(0), np.array([np.nan, np.inf, -0.0, 1e-300])]
    arrays.append(np.arange(12.0).reshape(3, 4).T)  # not contiguous
    here.send(Message({"text": "grün\n", "list": [1, None, {"a": 0.1}]}, arrays))
    got = there.receive()
    assert got.header == {"text": "grün\n", "list": [1, None, {"a": 0.1}]}
    for sent, received in zip(arrays, got.arrays, strict=True):
        assert received.shape == sent.shape
        assert received.tobytes() == np.ascontiguousarray(sent).tobytes()


def test_a_line_that_breaks_is_closed() -> None:
    here, there = pair()
    there._writer.write(b"\x10\x00\x00\x00")
    there._writer.close()
    with pytest.raises(ChannelClosed):
        here.receive()


def test_hanging_up_waits_for_the_other_end_but_not_for_ever() -> None:
    here, there = pair()
    started = time.monotonic()
    assert here.hang_up(0.2) is False
    assert time.monotonic() - started > 0.1  # it waited, and came back
    here, there = pair()
    there._writer.close()
    assert here.hang_up(5) is True


def test_workers_import_what_their_user_imports() -> None:
    from ugat_marl.simulation.host import _environment

    environment = _environment({"OF_A_SERVICE": "1", "PATH": "/nowhere"})
    assert environment["OF_A_SERVICE"] == "1" and environment["PATH"] == os.environ["PATH"]
    assert environment["PYTHONPATH"].split(os.pathsep) == [p or str(Path.cwd()) for p in sys.path]
    assert environment["PYTHONSAFEPATH"] == "1"


def test_the_limit_of_memory_holds_though_another_environment_is_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Processes are forked from a parent that started before the variable was set."""
    monkeypatch.delenv(MEMORY_VARIABLE, raising=False)
    first, second = (parallel_env("single-v1", duration_s=20) for _ in range(2))
    first.reset(seed=1)
    monkeypatch.setenv(MEMORY_VARIABLE, "0.05")
    with pytest.raises(SimulatorError, match=r"more memory than a simulation may use \(0\.05 GB\)"):
        second.reset(seed=1)
    monkeypatch.delenv(MEMORY_VARIABLE)
    second.reset(seed=1)
    first.close()
    second.close()
