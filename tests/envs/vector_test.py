"""Many simulations together: the same as alone, whatever dies, and nothing left behind."""

from __future__ import annotations

import copy
import gc
import hashlib
import importlib
import os
import pickle
import signal
import subprocess
import sys
import time
import uuid
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from gymnasium import vector as gymnasium_vector
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from tests.interrupts import eventually
from ugat_marl import parallel_env, vector_env
from ugat_marl.effects import ControllerPart, StartupDelay, load_scenario, parse_domain
from ugat_marl.envs import AgentSet, VectorEnv, agent_indicator, pad_spaces
from ugat_marl.envs.vector.arrays import Arrays, Shape, shared_memory
from ugat_marl.envs.vector.gymnasium_env import GymnasiumVectorEnv
from ugat_marl.envs.vector.remote import SERVICE
from ugat_marl.envs.vector.spec import Spec, in_turn
from ugat_marl.envs.vector.worker import Episodes
from ugat_marl.errors import (
    ActionError,
    EpisodeError,
    OptionError,
    ScenarioError,
    SimulatorCrashed,
    SimulatorError,
    UgatMarlError,
    UnknownNameError,
    WorkerError,
)
from ugat_marl.grounding import CommandChannel, FittedService
from ugat_marl.grounding.eyes import DeadLanes
from ugat_marl.scenarios import Network
from ugat_marl.simulation import Host

Crossing = Callable[..., Path]

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that can fork")
needs_proc = pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc")
LENGTH_S = 100
DECISIONS = 10


@pytest.fixture(scope="module", autouse=True)
def warm() -> Iterator[None]:
    """Keeps the parent between tests, so that each does not wait for SUMO to load."""
    host = Host(SERVICE)
    host.warm()
    yield
    host.close()


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """Writes a module that workers can import; returns its name."""

    def make(text: str) -> str:
        name = f"own_{uuid.uuid4().hex}"
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.syspath_prepend(str(tmp_path))
        return name

    return make


def chosen(masks: np.ndarray, seed: int, decision: int) -> np.ndarray:
    """Random permitted actions that depend on nothing but the numbers given."""
    draws = np.random.default_rng([seed, decision]).random(masks.shape)
    return (draws * masks).argmax(axis=-1)


def alone(env: Any, seed: int) -> str:
    """A digest of a plain environment's episode, in the arrays of a vector."""
    agents = AgentSet.of(env)
    digest = hashlib.sha256()
    observations, infos = env.reset(seed=seed)
    decision = 0
    while True:
        masks = agents.masks(infos).astype(np.int8)
        digest.update(agents.stack(observations).tobytes() + masks.tobytes())
        if not env.agents:
            break
        actions = agents.actions(chosen(masks, seed, decision))
        observations, rewards, _, _, infos = env.step(actions)
        digest.update(np.array([rewards[name] for name in agents.names]).tobytes())
        executed = [infos[name]["executed_action"] for name in agents.names]
        digest.update(np.array(executed, dtype=np.int64).tobytes())
        decision += 1
    digest.update(repr(env.unwrapped.scores()).encode())
    return digest.hexdigest()


def together(
    env: VectorEnv,
    seed: int,
    episodes: int = 1,
    at: Callable[[int], None] = lambda step: None,
) -> list[list[str]]:
    """Digests of the episodes of each environment; `at` is called before each step."""
    batch = env.reset(seed)
    digests = [hashlib.sha256() for _ in range(env.n)]
    found: list[list[str]] = [[] for _ in range(env.n)]
    decisions = [0] * env.n
    for row, digest in enumerate(digests):
        digest.update(batch.observations[row].tobytes() + batch.masks[row].tobytes())
    step = 0
    while any(len(own) < episodes for own in found):
        seeds = [episode.seed for episode in env.episodes if episode is not None]
        actions = np.array(
            [chosen(batch.masks[row], seeds[row], decisions[row]) for row in range(env.n)]
        )
        at(step)
        batch = env.step(actions)
        ended = {one.environment: one for one in batch.ended}
        for row in range(env.n):
            digests[row].update(batch.rewards[row].tobytes() + batch.executed[row].tobytes())
            decisions[row] += 1
            if row in ended:
                last = ended[row]
                digests[row].update(last.observations.tobytes() + last.masks.tobytes())
                digests[row].update(repr(last.scores).encode())
                found[row].append(digests[row].hexdigest())
                digests[row], decisions[row] = hashlib.sha256(), 0
            digests[row].update(batch.observations[row].tobytes() + batch.masks[row].tobytes())
        step += 1
    return [own[:episodes] for own in found]


def pids(env: VectorEnv) -> list[int]:
    return [lane._worker._pid for lane in env._environments if lane._worker is not None]


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"


# --- the same as alone


@pytest.mark.parametrize("domain", ["sim", "V4"])
def test_one_is_a_plain_environment_to_the_bit(domain: str, temporary: Path) -> None:
    plain = parallel_env("mixed-v1", domain, duration_s=LENGTH_S)
    with vector_env("mixed-v1", 1, domain, duration_s=LENGTH_S) as env:
        ((found,),) = together(env, 3)
    assert found == alone(plain, 3)
    plain.close()
    assert list(temporary.iterdir()) == []


def test_a_fitted_street_is_the_same_as_alone() -> None:
    lanes = Network.read(load_scenario("single-v1")).lane_table().ids
    phases = np.ones((3, 8, 8), dtype=np.bool_)
    phases[1] = np.eye(8, dtype=np.bool_)  # a phase stays for a second decision
    parts: tuple[ControllerPart, ...] = (
        FittedService(lanes, np.tile([[2.0, 1.0]], (len(lanes), 1))),
        CommandChannel(
            ("signal_0",),
            np.array([0.3, 0.5, 0.2]),
            np.array([[0.3, 0.5, 0.2]]),
            np.array([[[0.3, 0.5, 0.2]]]),
            (phases,),
        ),
        DeadLanes(lanes[:2]),
        *parse_domain("counting_error=2"),
    )
    digests: list[str] = []
    for fitted in ((), *((part,) for part in parts), parts):
        with vector_env("single-v1", 1, duration_s=LENGTH_S, fitted=fitted) as env:
            ((found,),) = together(env, 3)
        plain = parallel_env("single-v1", duration_s=LENGTH_S, fitted=fitted)
        assert found == alone(plain, 3)
        plain.close()
        digests.append(found)
    assert len({*digests}) == len(digests)  # each of them changes something


def test_an_episode_depends_on_its_seed_and_domain_alone() -> None:
    domains = in_turn(["sim", "V4", [StartupDelay(0.1 + 0.2)]])
    options: dict[str, Any] = {"duration_s": LENGTH_S, "observation": "density"}
    found: dict[int, list[list[str]]] = {}
    for n in (1, 3):
        with vector_env("grid2x2-v1", n, domains, **options) as env:
            found[n] = together(env, 7, episodes=3)
            last = env.episodes
    assert found[1][0] == found[3][0]
    assert [one and one.domain for one in last] == ["sim", "V4", "startup_delay=0.3"]
    assert len({digest for own in found[3] for digest in own}) == 9
    # Every one can be played again: the third of the last environment was in V4.
    env = vector_env("grid2x2-v1", 3, domains, **options)
    env.reset(7)
    lane = env._environments[2]
    lane.begin(None, domains)
    lane.answer()
    lane.begin(None, domains)
    lane.answer()
    episode = lane.episode
    env.close()
    assert episode is not None
    assert episode.domain == "V4"
    plain = parallel_env("grid2x2-v1", "V4", **options)
    assert alone(plain, episode.seed) == found[3][2][2]
    plain.close()


def test_a_reset_of_some_leaves_the_step_of_the_others() -> None:
    nothing = np.zeros((2, 1), dtype=np.int64)
    with (
        vector_env("single-v1", 2, duration_s=LENGTH_S) as env,
        vector_env("single-v1", 2, duration_s=LENGTH_S) as other,
    ):
        env.reset(seed=1)
        other.reset(seed=1)
        env.step_async(nothing)
        anew = env.reset(where=[0])
        assert anew.observations[0].any() and not anew.observations[1].any()
        assert env.step_wait().rewards[1] == other.step(nothing).rewards[1]
        assert not env.reset(where=[0]).rewards.any()
        other.reset(where=[0])
        assert env.step(nothing).rewards[1] == other.step(nothing).rewards[1]


FIVE = "def reward(before, after):\n    return 5.0\n"


def test_a_reset_shows_no_reward_and_no_row_that_is_half_written(
    module: Callable[[str], str],
) -> None:
    """Whether the whole or a half of it has begun the step of the others."""
    reward = importlib.import_module(module(FIVE)).reward
    nothing = np.zeros((2, 1), dtype=np.int64)
    with vector_env("single-v1", 2, duration_s=LENGTH_S, reward=reward) as env:
        second = env.halves()[1]
        env.reset(seed=[1, 2])
        assert env.step(nothing).rewards.tolist() == [[5.0], [5.0]]
        second.step_async(nothing[:1])
        anew = env.reset(seed=[7, 8], where=[0])
        assert [one.seed for one in env.episodes if one is not None] == [7, 2]
        assert anew.observations[0].any() and not anew.observations[1].any()
        assert not anew.rewards.any()
        assert second.step_wait().rewards.tolist() == [[5.0]]
        env.step_async(nothing)
        anew = second.reset(seed=3)
        assert anew.observations.any() and not anew.rewards.any()


DRAWS = "import random\nimport numpy\n\ndef reward(before, after):\n"
DRAWS += "    return random.random() + 10 * numpy.random.random()\n"


def test_what_a_function_of_the_user_draws_follows_from_the_seed(
    module: Callable[[str], str],
) -> None:
    reward = importlib.import_module(module(DRAWS)).reward
    nothing = np.zeros((2, 1), dtype=np.int64)
    drawn = []
    for _ in range(2):
        with vector_env("single-v1", 2, duration_s=20, reward=reward) as env:
            env.reset(seed=1)
            drawn.append([env.step(nothing).rewards.tolist() for _ in range(4)])  # two episodes
    assert drawn[0] == drawn[1]
    assert len({whole for step in drawn[0] for (whole,) in step}) == 8


def test_a_reset_forgets_an_episode_that_was_to_begin() -> None:
    nothing = np.zeros((1, 1), dtype=np.int64)
    with vector_env("single-v1", 1, duration_s=20, autoreset="next-step") as env:
        env.reset(seed=1)
        for _ in range(2):
            env.step(nothing)
        env.step_async(nothing)  # begins the next episode
        env.reset(seed=5)
        with pytest.raises(EpisodeError, match="step_wait\\(\\) without step_async"):
            env.step_wait()
        assert env.step(nothing).rewards.shape == (1, 1)


FAILS_ONCE = """
import os, pathlib

def reward(before, after):
    if os.getpid() == int(pathlib.Path(__file__).with_name("victim").read_text()):
        raise ValueError("planted")
    return float(after.halting.sum() - before.halting.sum())
"""


def test_what_ends_beside_an_error_is_handed_over_with_the_next_step(
    module: Callable[[str], str], tmp_path: Path
) -> None:
    victim = tmp_path / "victim"
    victim.write_text("-1")
    reward = importlib.import_module(module(FAILS_ONCE)).reward
    nothing = np.zeros((2, 1), dtype=np.int64)
    with vector_env("single-v1", 2, duration_s=20, reward=reward) as env:
        env.reset(seed=1)
        env.step(nothing)
        victim.write_text(str(pids(env)[0]))
        with pytest.raises(WorkerError, match="planted"):
            env.step(nothing)
        victim.write_text("-1")
        env.reset(where=[0])
        (ended,) = env.step(nothing).ended
        assert ended.environment == 1 and ended.episode.number == 0 and ended.scores is not None
        assert len(env.step(nothing).ended) == 2


class UnknownOnce:
    """Domains of which that of environment 0, episode 1 is unknown at first."""

    def __init__(self) -> None:
        self.asked = 0

    def __call__(self, environment: int, episode: int) -> str:
        if (environment, episode) == (0, 1):
            self.asked += 1
            if self.asked == 1:
                return "nowhere"
        return "sim"


def test_an_episode_is_handed_over_though_the_next_one_cannot_begin() -> None:
    nothing = np.zeros((2, 1), dtype=np.int64)
    with vector_env("single-v1", 2, UnknownOnce(), duration_s=10) as env:
        env.reset(seed=1)
        with pytest.raises(UgatMarlError, match="nowhere"):
            env.step(nothing)
        env.reset(where=[0, 1])
        ended = env.step(nothing).ended
        assert [(e.environment, e.episode.number) for e in ended[:2]] == [(0, 0), (1, 0)]
        assert all(each.scores is not None for each in ended)


def test_an_episode_is_received_though_the_next_one_cannot_begin() -> None:
    with vector_env("single-v1", 2, UnknownOnce(), duration_s=10) as env:
        env.reset(seed=1)
        env.send(np.zeros((1, 1), dtype=np.int64), [0])
        with pytest.raises(UgatMarlError, match="nowhere"):
            env.recv()
        env.send(np.zeros((1, 1), dtype=np.int64), [1])
        ended = env.recv().ended
        assert [(e.environment, e.episode.number) for e in ended] == [(0, 0), (1, 0)]


def test_two_halves_are_the_whole() -> None:
    with vector_env("single-v1", 3, duration_s=LENGTH_S) as env:
        whole = together(env, 5)
        first, second = env.halves()
        assert (first.n, second.n) == (1, 2)
        assert together(first, 5) + together(second, 6) == whole
        # One goes on while the other is looked at.
        one, two = first.reset(1), second.reset(1)
        first.step_async(one.masks.argmax(axis=-1))
        second.step_async(two.masks.argmax(axis=-1))
        with pytest.raises(EpisodeError, match="environment 0 is in the middle of a step"):
            env.step(np.zeros((3, 1), dtype=np.int64))
        assert second.step_wait().rewards[0] == first.step_wait().rewards[0]
        with pytest.raises(EpisodeError, match="step_wait\\(\\) without step_async"):
            first.step_wait()


DECORATED = """
import functools

def base(before, after):
    return -1.0

def twice_of(function):
    @functools.wraps(function)
    def inner(*views):
        return 2 * function(*views)
    return inner

twice = twice_of(base)

class Weighted:
    def reward(self, before, after):
        return 3.0
"""


def test_a_reward_whose_name_leads_to_another_one_is_refused(module: Callable[[str], str]) -> None:
    own = importlib.import_module(module(DECORATED))
    for reward in (own.twice, own.Weighted().reward):
        with pytest.raises(OptionError, match="which is another function"):
            vector_env("single-v1", 1, reward=reward)
    with vector_env("single-v1", 1, duration_s=20, reward=own.base) as env:
        env.reset(seed=1)
        assert env.step([[0]]).rewards == -1.0


def test_wrappers_rewards_and_effects_reach_the_workers(module: Callable[[str], str]) -> None:
    own = module("def alike(before, after):\n    return float(after.vehicles.sum())\n")
    reward = __import__(own).alike
    wrap = ["ugat_marl.envs.wrappers:pad_spaces", agent_indicator]
    with vector_env(
        "mixed-v1", 1, [[StartupDelay(0.7)]], wrap=wrap, reward=reward, duration_s=LENGTH_S
    ) as env:
        ((found,),) = together(env, 2)
    inner = parallel_env("mixed-v1", [StartupDelay(0.7)], reward=reward, duration_s=LENGTH_S)
    plain = agent_indicator(pad_spaces(inner))
    assert found == alone(plain, 2)
    plain.close()


def test_what_was_warned_of_is_heard(crossing: Crossing) -> None:
    late = '<vehicle id="a" type="car" depart="150" route="east"/>'
    with vector_env(crossing(vehicles=late), 2, duration_s=200) as env:
        env.reset(1)
        env.step(np.zeros((2, 1), dtype=np.int64))
        with pytest.warns(UserWarning, match="no vehicle has entered the network"):
            env.step(np.zeros((2, 1), dtype=np.int64))


# --- deaths


@pytest.mark.parametrize("moment", ["between", "under way", "at the reset", "with the parent"])
def test_a_killed_simulation_is_taken_up_again(moment: str, temporary: Path) -> None:
    options: dict[str, Any] = {"duration_s": LENGTH_S}
    killed: list[int] = []
    with vector_env("grid2x2-v1", 2, **options) as env:
        unharmed = together(env, 4, episodes=2)

        def kill(step: int) -> None:
            if step in (3, 4, 13):
                victim = pids(env)[step % 2]
                os.kill(victim, signal.SIGSTOP if moment == "under way" else signal.SIGKILL)
                killed.append(victim)
                if moment == "under way":
                    subprocess.Popen(["/bin/sh", "-c", f"sleep 0.2; kill -9 {victim}"])
                if moment == "with the parent":
                    parent = env._shared.host._parent  # type: ignore[union-attr]
                    parent._process.kill()  # type: ignore[union-attr]
                    parent._process.wait()  # type: ignore[union-attr]

        if moment == "at the reset":
            begin = env._environments[1]._start

            def start() -> None:
                begin()
                if len(killed) < 2:
                    killed.append(env._environments[1]._worker._pid)  # type: ignore[union-attr]
                    os.kill(killed[-1], signal.SIGKILL)

            env._environments[1]._start = start  # type: ignore[method-assign]
            assert together(env, 4, episodes=2) == unharmed
        else:
            assert together(env, 4, episodes=2, at=kill) == unharmed
    assert len(killed) >= 2
    assert eventually(lambda: all(map(gone, killed)))
    assert list(temporary.iterdir()) == []


def test_one_that_dies_each_time_is_given_up(module: Callable[[str], str]) -> None:
    own = module(
        "import os\n"
        "def reward(before, after):\n"
        "    if after.time_s >= 30: os._exit(3)\n"
        "    return 0.0\n"
    )
    reward = __import__(own).reward
    with vector_env("single-v1", 2, reward=reward, duration_s=LENGTH_S) as env:
        batch = env.reset(1)
        for _ in range(2):
            batch = env.step(chosen(batch.masks, 0, 0))
        with pytest.raises(SimulatorCrashed, match="decision 3 of Episode.*replaced 3 times"):
            env.step(chosen(batch.masks, 0, 0))
        with pytest.raises(EpisodeError, match="no episode under way; call reset"):
            env.step(chosen(batch.masks, 0, 0))


def test_one_that_cannot_be_replaced_is_over() -> None:
    def none_left(*_: object) -> Any:
        raise SimulatorCrashed("no process can be started")

    with vector_env("single-v1", 2, duration_s=LENGTH_S) as env:
        batch = env.reset(1)
        dying = env._environments[1]
        assert dying._worker is not None
        os.kill(dying._worker._pid, signal.SIGKILL)  # type: ignore[arg-type]
        dying._shared.start = none_left  # type: ignore[method-assign]
        with pytest.raises(SimulatorCrashed, match="no process"):
            env.step(chosen(batch.masks, 0, 0))
        with pytest.raises(EpisodeError, match="no episode under way; call reset"):
            env.step(chosen(batch.masks, 0, 0))


@pytest.mark.parametrize(
    ("fault", "named"),
    [("return 1 / 0", "ZeroDivisionErr"), ("raise SystemExit(3)", "SystemExit: 3")],
)
def test_errors_of_the_users_own_functions_are_told_whole(
    fault: str, named: str, module: Callable[[str], str]
) -> None:
    own = module(f"def reward(before, after):\n    {fault}\n")
    reward = __import__(own).reward
    with vector_env("single-v1", 1, reward=reward, duration_s=LENGTH_S) as env:
        batch = env.reset(1)
        with pytest.raises(WorkerError, match=f"(?s)by the reward or the wrapper.*{named}"):
            env.step(chosen(batch.masks, 0, 0))
        batch = env.reset(2)  # it goes on


def test_sumo_s_words_come_through(crossing: Crossing) -> None:
    lost = (
        '<vehicle id="a" depart="0" route="east"/>'
        '<vehicle id="lost" depart="50"><route edges="W_C C_N"/></vehicle>'
    )
    with vector_env(crossing(vehicles=lost), 2, duration_s=200) as env:
        env.reset(1)

        def play() -> None:
            for _ in range(20):
                env.step(np.zeros((2, 1), dtype=np.int64))

        with pytest.raises(SimulatorError, match="SUMO failed after .* 'lost' has no valid route"):
            play()


def test_a_domain_with_other_phases_is_refused(crossing: Crossing) -> None:
    scenario = load_scenario(crossing())
    env = vector_env(scenario, 1, lambda environment, episode: ["sim", "V1"][episode])
    env.close()
    env = vector_env(scenario, 1)
    env._shared.agents = AgentSet.of(parallel_env("single-v1"))  # type: ignore[union-attr]
    with pytest.raises(ScenarioError, match="has other agents, observations or phases"):
        env.reset(1)
    env.close()


@needs_proc
def test_the_parent_has_loaded_sumo_for_all_episodes(crossing: Crossing) -> None:
    with vector_env(crossing(), 1, duration_s=LENGTH_S) as env:
        env.reset(1)
        (worker,) = pids(env)
        status = Path(f"/proc/{worker}/status").read_text()
        parent = status.partition("PPid:")[2].split()[0]
        assert "libsumo" in Path(f"/proc/{parent}/maps").read_text()


def test_the_parent_frees_the_environments_of_a_closed_vector(crossing: Crossing) -> None:
    directory = crossing()
    spec = Spec.of(load_scenario(directory), {"duration_s": LENGTH_S}, []).as_dict()
    service = Episodes()
    order = {
        "spec": {**spec, "scenario": str(directory)},
        "domain": "sim",
        "folder": "mine",
        "path": [],
    }
    for _ in range(2):
        service.prepare(order)
    made = weakref.ref(env := cast("Any", service._ready))
    env.wrapped_by_a_user_s_code = [env]
    service.prepare({**order, "folder": "another", "domain": "V1"})
    del env
    service.told({"forget": "mine"})
    assert made() is None
    gc.unfreeze()


# --- nothing is left


@pytest.mark.slow
@needs_proc
def test_opened_and_closed_ten_times(crossing: Crossing, temporary: Path) -> None:
    directory = crossing()

    def once(number: int) -> list[int]:
        env = vector_env(directory, 2, ["sim", "V1"], duration_s=LENGTH_S)
        env.reset(number)
        env.step(np.zeros((2, 1), dtype=np.int64))
        mine = pids(env)
        env.close()
        env.close()
        return mine

    def entries(folder: str) -> set[Path]:
        return set(Path(folder).iterdir()) if Path(folder).exists() else set()

    once(0)
    gc.collect()
    before, shared = len(entries("/proc/self/fd")), entries("/dev/shm")
    seen = [pid for number in range(10) for pid in once(number)]
    assert len(set(seen)) == 20
    assert eventually(lambda: all(map(gone, seen)))
    assert len(entries("/proc/self/fd")) <= before
    assert list(temporary.iterdir()) == []
    assert entries("/dev/shm") <= shared


SCRIPT = """
import numpy as np
from ugat_marl import vector_env
env = vector_env({path!r}, 3, duration_s=10**6)
env.reset(1)
print("running", flush=True)
while {forever}:
    env.step(np.zeros((3, 1), dtype=np.int64))
"""


@needs_proc
@pytest.mark.parametrize("how", ["SIGKILL", "SIGINT", "end"])
def test_nothing_is_left_when_the_user_s_process_ends(
    how: str, crossing: Crossing, temporary: Path, tmp_path: Path
) -> None:
    file = tmp_path / "script.py"
    file.write_text(SCRIPT.format(path=str(crossing()), forever=how != "end"))
    mark = uuid.uuid4().hex
    environment = {
        **os.environ,
        "MARK": mark,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    process = subprocess.Popen(
        [sys.executable, str(file)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=environment,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "running\n", process.communicate()[1]

    def relatives() -> list[int]:
        found: list[int] = []
        for folder in Path("/proc").iterdir():
            if folder.name.isdigit():
                try:
                    if mark.encode() in (folder / "environ").read_bytes():
                        found.append(int(folder.name))
                except OSError:
                    continue
        return found

    if how != "end":
        assert len(relatives()) == 1 + 1 + 3  # the script, the parent, three simulations
        time.sleep(0.3)
        os.killpg(process.pid, getattr(signal, how))
    _, said = process.communicate(timeout=30)
    assert eventually(lambda: not relatives() and not list(temporary.iterdir()), 10)
    assert "simulation.worker" not in said
    assert how != "end" or (said == "" and process.returncode == 0)


def test_an_unused_one_starts_and_leaves_nothing(crossing: Crossing, temporary: Path) -> None:
    env = vector_env(crossing(), 4)
    assert pids(env) == []
    assert list(temporary.iterdir()) == []
    env.close()
    with pytest.raises(EpisodeError, match="this vector_env is closed"):
        env.reset(1)


@pytest.mark.slow
def test_halves_outlive_the_name_of_the_whole(crossing: Crossing, temporary: Path) -> None:
    first, second = vector_env(crossing(), 2, duration_s=20).halves()
    gc.collect()
    with pytest.raises(EpisodeError, match=r"environment 0 has no episode.*where=\[0\]"):
        second.step([[0]])
    for half in (first, second):
        half.reset(1)
        half.step([[0]])
    first.close()
    second.step([[0]])
    with pytest.raises(ActionError, match=r"of shape \(0,\); allowed: integers of shape \(1, 1\)"):
        second.step([[0], [0, 1]])
    del first, second, half
    gc.collect()
    assert list(temporary.iterdir()) == []


# --- ends of episodes


@pytest.mark.parametrize("mode", ["same-step", "next-step", "disabled"])
def test_the_three_conventions_at_the_end_of_an_episode(mode: Any, crossing: Crossing) -> None:
    none = np.zeros((2, 1), dtype=np.int64)
    with vector_env(crossing(), 2, duration_s=20, autoreset=mode) as env:
        first = env.reset(1)
        env.step(none)
        last = env.step(none)
        assert last.truncated.all()
        assert [one.environment for one in last.ended] == [0, 1]
        assert last.ended[0].scores is not None
        if mode == "same-step":
            assert np.array_equal(last.observations, first.observations)
            assert not np.array_equal(last.ended[0].observations, first.observations[0])
            return
        assert np.array_equal(last.observations[0], last.ended[0].observations)
        if mode == "next-step":
            begun = env.step(none)
            assert not begun.truncated.any() and not begun.rewards.any()
            assert np.array_equal(begun.observations, first.observations)
            assert [one and one.number for one in env.episodes] == [1, 1]
            return
        with pytest.raises(EpisodeError, match="environment 0 has no episode under way"):
            env.step(none)
        env.reset(where=[1])
        assert [one and one.number for one in env.episodes] == [0, 1]
        env.reset(where=[True, False])
        env.step(none)


def test_gymnasium_s_vector_env() -> None:
    vector = vector_env("mixed-v1", 2, duration_s=20)
    env = GymnasiumVectorEnv(vector)
    agents = len(vector.agents)
    assert isinstance(env, gymnasium_vector.VectorEnv)
    assert env.num_envs == 2 * agents
    observations, infos = env.reset(seed=1)
    assert observations in env.observation_space
    for step in range(2):
        actions = chosen(infos["action_mask"], 1, step)
        assert actions in env.action_space
        observations, rewards, terminations, truncations, infos = env.step(actions)
        assert observations in env.observation_space
        assert rewards.shape == terminations.shape == truncations.shape == (env.num_envs,)
        assert not terminations.any()
    assert truncations.all()
    assert infos["_final_obs"].all()
    assert all(one in env.single_observation_space for one in infos["final_obs"])
    assert (infos["final_info"]["att_s"] > 0).all()
    assert env.metadata["autoreset_mode"] == gymnasium_vector.AutoresetMode.SAME_STEP
    with pytest.raises(OptionError, match="reset_mask must be"):
        env.reset(options={"reset_mask": np.arange(env.num_envs) == 0})
    with pytest.raises(ActionError, match="allowed: \\(.*,\\)"):
        env.step([0])
    env.close()
    env.close()
    assert pids(vector) == []


def test_gymnasium_s_final_values_are_those_of_the_vector() -> None:
    one, two = (vector_env("mixed-v1", 2, "execution_delay=10", duration_s=20) for _ in range(2))
    env, agents = GymnasiumVectorEnv(one), len(one.agents)
    _, infos = env.reset(seed=1)
    batch = two.reset(1)
    for step in range(2):
        _, _, _, truncations, infos = env.step(chosen(infos["action_mask"], 1, step))
        batch = two.step(chosen(batch.masks.reshape(2 * agents, -1), 1, step).reshape(2, agents))
        np.testing.assert_array_equal(infos["executed_action"], batch.executed.ravel())
    assert truncations.all() and len(batch.ended) == 2
    final = infos["final_info"]
    np.testing.assert_array_equal(final["executed_action"], batch.executed.ravel())
    for ended in batch.ended:
        rows = slice(ended.environment * agents, (ended.environment + 1) * agents)
        np.testing.assert_array_equal(np.stack(infos["final_obs"][rows]), ended.observations)
        np.testing.assert_array_equal(final["action_mask"][rows], ended.masks)
        assert ended.observations.any() and ended.masks.any()
    env.close()
    two.close()


def test_gymnasium_resets_those_of_a_mask() -> None:
    vector = vector_env("mixed-v1", 2, duration_s=20, autoreset="disabled")
    env, agents = GymnasiumVectorEnv(vector), len(vector.agents)
    before, _ = env.reset(seed=1)
    mask = np.repeat([False, True], agents)
    after, _ = env.reset(seed=[1, 9], options={"reset_mask": mask})
    assert [one.seed for one in vector.episodes if one is not None] == [1, 9]
    np.testing.assert_array_equal(after[~mask], before[~mask])
    env.close()


def test_gymnasium_s_own_wrappers_take_it() -> None:
    vector = GymnasiumVectorEnv(vector_env("grid2x2-v1", 1, duration_s=20))
    env = RecordEpisodeStatistics(vector)
    _, infos = env.reset(seed=1)
    paid = np.zeros(env.num_envs)
    for step in range(2):
        _, rewards, _, _, infos = env.step(chosen(infos["action_mask"], 1, step))
        paid += rewards
    np.testing.assert_allclose(infos["episode"]["r"], paid)
    assert infos["episode"]["l"].tolist() == [2] * env.num_envs
    env.close()


# --- wrong calls


def test_wrong_calls(crossing: Crossing) -> None:
    directory = crossing()
    for n in (0, -1, 1.5, True):
        with pytest.raises(OptionError, match="n = .*must be a number of environments"):
            vector_env(directory, n)  # type: ignore[arg-type]
    for options, error, words in (
        ({"autoreset": "later"}, UnknownNameError, "autoreset.*same-step"),
        ({"simulator": "process"}, OptionError, "simulator = 'process'.*use parallel_env"),
        ({"render_mode": "rgb_array"}, OptionError, "render_mode"),
        ({"observatoin": "count"}, UnknownNameError, "Did you mean 'observation'"),
        ({"domains": ["sim"]}, OptionError, "domains has 1 entries for 2 .*in_turn"),
        ({"domains": "V44"}, UnknownNameError, "Did you mean 'V4'"),
        ({"domain": "V4"}, OptionError, "vector_env takes domains"),
        ({"domains": ["sim", "V44"]}, UnknownNameError, "Did you mean 'V4'"),
        ({"domains": ["sim", StartupDelay(1.0)]}, OptionError, "mixes domains and single effects"),
        ({"wrap": lambda env: env}, OptionError, "wrap = .*move it to a module"),
        ({"wrap": "ugat_marl.envs.wrappers:padd"}, OptionError, "cannot be imported .*module:name"),
        ({"wrap": "ugat_marl.envs.wrappers:frame_stack"}, OptionError, "environment alone .*'k'"),
        ({"wrap": "ugat_marl.envs:wrappers"}, OptionError, "environment alone .*not a callable"),
        ({"reward": lambda a, b: 0.0}, OptionError, "reward = .*move it to a module"),
    ):
        with pytest.raises(error, match=words):
            vector_env(directory, 2, **options)
    with pytest.raises(OptionError, match="at least one domain"):
        in_turn([])
    with pytest.raises(OptionError, match=r"in_turn\(None\): give a list of domains"):
        in_turn(None)  # type: ignore[arg-type]
    effects = [StartupDelay(1.0)]
    for one in ("V1", effects):  # a list of effects is one domain
        assert [in_turn(one)(environment, 1) for environment in range(3)] == [one] * 3
    numbers: dict[str, Any] = {"neighbours": np.int64(0), "duration_s": np.float32(20)}
    with vector_env(directory, 1, **numbers) as env:
        assert env.reset(1).observations.shape[0] == 1
    with vector_env(directory, 2, duration_s=20) as env:
        with pytest.raises(EpisodeError, match="no episode under way; call reset"):
            env.step([[0], [0]])
        for seed in (-1, [1], [1, 2, 3], [1, -2], 1.5, [1.5, 2.5], "ab"):
            with pytest.raises(OptionError, match="seed = .*from 0 on, or 2 of them"):
                env.reset(seed)
        for where in ([2], [-1], [0, 0], [], [False, False], 1, [[0, 1], [1]]):
            with pytest.raises(OptionError, match="where = .*different numbers below 2"):
                env.reset(1, where)
        env.reset(1)
        for actions in ([0, 0], [[0.0], [0.0]], [[0], [0], [0]]):
            with pytest.raises(ActionError, match="integers of shape \\(2, 1\\)"):
                env.step(actions)
        with pytest.raises(
            ActionError, match="'signal_0' in environment 1 is 2; allowed: .* 0 to 1"
        ):
            env.step([[0], [2]])
        with pytest.raises(OptionError, match="at least two"):
            env.halves()[0].halves()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            env.step([[0], [1]])  # nothing has happened in between


def test_the_arrays_do_not_overlap() -> None:
    shape = Shape(2, 3, 5, 4)
    descriptor = shared_memory(shape)
    one, two = Arrays.over(descriptor, shape), Arrays.over(descriptor, shape)
    os.close(descriptor)
    for number, name in enumerate(one.__dataclass_fields__, 1):
        getattr(one, name)[:] = number
    for number, name in enumerate(one.__dataclass_fields__, 1):
        assert (getattr(two, name) == number).all()
    two.part(1).observations[0] = 9
    assert one.observations[1, 0, 0] == 9
    assert one.observations[0].max() == 1


# --- the first that are ready


def one_by_one(
    env: VectorEnv,
    seed: int,
    episodes: int = 1,
    count: int = 1,
    at: Callable[[int], None] = lambda step: None,
) -> list[list[str]]:
    """The same digests as `together`, with the first `count` environments that are ready."""
    digests = [hashlib.sha256() for _ in range(env.n)]
    found: list[list[str]] = [[] for _ in range(env.n)]
    decisions, batch, step = [0] * env.n, env.reset(seed), 0
    while True:
        for row, number in enumerate(batch.numbers.tolist()):
            digests[number].update(batch.observations[row].tobytes() + batch.masks[row].tobytes())
        at(step)
        step += 1
        seeds = [episode.seed for episode in env.episodes if episode is not None]
        numbers = batch.numbers.tolist()
        env.send(
            np.array(
                [
                    chosen(batch.masks[row], seeds[number], decisions[number])
                    for row, number in enumerate(numbers)
                ]
            ),
            where=numbers,
        )
        batch = env.recv(count)
        assert len(batch.numbers) == count
        ended = {one.environment: one for one in batch.ended}
        for row, number in enumerate(batch.numbers.tolist()):
            digest = digests[number]
            digest.update(batch.rewards[row].tobytes() + batch.executed[row].tobytes())
            decisions[number] += 1
            assert batch.truncated[row] == (number in ended)
            if number in ended:
                last = ended[number]
                digest.update(last.observations.tobytes() + last.masks.tobytes())
                digest.update(repr(last.scores).encode())
                found[number].append(digest.hexdigest())
                digests[number], decisions[number] = hashlib.sha256(), 0
        if all(len(own) >= episodes for own in found):
            return [own[:episodes] for own in found]


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_the_order_in_which_environments_are_ready_changes_no_episode(count: int) -> None:
    with vector_env("grid2x2-v1", 3, ["sim", "V4", "V1"], duration_s=LENGTH_S) as env:
        assert one_by_one(env, 4, episodes=2, count=count) == together(env, 4, episodes=2)


@pytest.mark.slow
def test_a_killed_simulation_is_taken_up_again_while_others_are_received() -> None:
    killed: list[int] = []
    with vector_env("grid2x2-v1", 2, duration_s=LENGTH_S) as env:
        unharmed = together(env, 4, episodes=2)

        def kill(step: int) -> None:
            if step in (3, 4, 13):
                killed.append(pids(env)[step % 2])
                os.kill(killed[-1], signal.SIGKILL)

        assert one_by_one(env, 4, episodes=2, at=kill) == unharmed
    assert len(killed) == 3
    assert eventually(lambda: all(map(gone, killed)))


def test_a_slow_environment_holds_up_no_other_one() -> None:
    with vector_env("single-v1", 3, duration_s=10_000) as env:
        first = env.reset(1)
        os.kill(pids(env)[1], signal.SIGSTOP)  # before it is asked, or it may have answered
        try:
            env.send(first.masks.argmax(axis=-1))
            first = env.recv(2)
            assert first.numbers.tolist() == [0, 2]
            env.send(first.masks.argmax(axis=-1), where=[0, 2])
            assert sorted([*env.recv().numbers, *env.recv().numbers]) == [0, 2]
        finally:
            os.kill(pids(env)[1], signal.SIGCONT)
        assert env.recv().numbers.tolist() == [1]


@pytest.mark.slow
def test_one_that_never_answers_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UGAT_MARL_DEADLINE_S", "12")  # a replacement has to start within it
    with vector_env("single-v1", 2, duration_s=LENGTH_S) as env:
        expected = env.step(env.reset(1).masks.argmax(axis=-1))
        actions = env.reset(1).masks.argmax(axis=-1)
        stopped = pids(env)[0]
        os.kill(stopped, signal.SIGSTOP)  # before it is asked: afterwards it may have answered
        env.send(actions)
        batch = env.recv(2)
        assert gone(stopped)
        assert batch.numbers.tolist() == [0, 1]
        assert batch.observations.tobytes() == expected.observations.tobytes()


@pytest.mark.parametrize("mode", ["next-step", "disabled"])
def test_ends_of_episodes_as_in_a_step(mode: Any, crossing: Crossing) -> None:
    with vector_env(crossing(), 2, duration_s=20, autoreset=mode) as env:
        actions = np.zeros((1, 1), dtype=int)
        env.reset(3)
        for _ in range(2):
            env.send(actions, where=[1])
            batch = env.recv()
        assert batch.truncated.tolist() == [True] and batch.ended[0].environment == 1
        if mode == "disabled":
            with pytest.raises(EpisodeError, match="environment 1 has no episode under way"):
                env.send(actions, where=[1])
        else:
            env.send(actions, where=[1])
            batch = env.recv()
            assert not batch.truncated.any() and not batch.rewards.any() and not batch.ended
            assert [one.number for one in env.episodes if one is not None] == [0, 1]


def test_wrong_calls_of_send_and_recv(crossing: Crossing) -> None:
    with vector_env(crossing(), 2, duration_s=20) as env:
        actions = np.zeros((2, 1), dtype=int)
        env.reset(3)
        with pytest.raises(EpisodeError, match=r"recv\(1\): 0 environments are in the middle"):
            env.recv()
        with pytest.raises(ActionError, match=r"shape \(1, 1\)"):
            env.send(actions, where=[1])
        with pytest.raises(ActionError, match="in environment 1 is 9"):
            env.send(actions[:1] + 9, where=[1])
        env.send(actions[:1], where=[1])
        with pytest.raises(EpisodeError, match=r"recv\(2\): 1 environments"):
            env.recv(2)
        with pytest.raises(EpisodeError, match="environment 1 is in the middle of a step"):
            env.step(actions)
        env.send(actions[:1], where=[0])
        env.recv()
        left = next(iter(env._sent))
        env.reset(where=[left])
        with pytest.raises(EpisodeError, match=r"recv\(1\): 0 environments"):
            env.recv()
        env.step(actions)


def test_domains_that_are_none_are_an_error_of_the_suite() -> None:
    given: Any = None
    with pytest.raises(OptionError, match="domain None"):
        vector_env("single-v1", 2, given, duration_s=60)


@pytest.mark.parametrize("autoreset", ["same-step", "next-step"])
def test_a_function_of_domains_that_fails_leaves_environments_that_can_begin_again(
    autoreset: Any,
) -> None:
    def domains(environment: int, episode: int) -> str:
        if episode and environment == 1 and fails:
            raise LookupError("no more domains")
        return "sim"

    fails = True
    number: Any = np.int64(3)
    envs = vector_env("single-v1", number, domains, duration_s=20, autoreset=autoreset)
    zeros = np.zeros((3, 1), dtype=np.int64)
    envs.reset(seed=5)
    envs.step(zeros)
    if autoreset == "next-step":
        envs.step(zeros)
    with pytest.raises(LookupError):
        envs.step(zeros)
    fails = False
    if autoreset == "same-step":
        with pytest.raises(EpisodeError, match="no episode under way; call reset"):
            envs.step(zeros)
        envs.reset(seed=5)
    envs.step(zeros)
    envs.close()


def test_a_forked_child_leaves_the_simulations_of_its_parent_alone(temporary: Path) -> None:
    with vector_env("single-v1", 1, duration_s=60) as env:
        batch = env.reset(seed=3)
        actions = chosen(batch.masks, 0, 0)
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                for act in (lambda: env.step(actions), lambda: env.reset(seed=3)):
                    with pytest.raises(EpisodeError) as refused:
                        act()
                    os.write(writer, str(refused.value).encode())
            finally:
                os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        assert os.read(reader, 1000).count(b"belongs to another process") == 2
        rewards = [env.step(actions).rewards.tolist() for _ in range(6)]
        env.reset(seed=3)
        assert [env.step(actions).rewards.tolist() for _ in range(6)] == rewards
    assert list(temporary.iterdir()) == []


def test_a_step_that_a_reset_of_other_halves_dropped_is_not_waited_for() -> None:
    with vector_env("single-v1", 2, duration_s=60) as env:
        first, _ = env.halves()
        actions = chosen(env.reset(seed=3).masks, 0, 0)
        first.step_async(actions[:1])
        env.reset(seed=3)
        with pytest.raises(EpisodeError, match="dropped the step of environment 0"):
            first.step_wait()
        env.step_async(actions)
        first.reset(seed=3)
        with pytest.raises(EpisodeError, match="dropped the step of environment 0"):
            env.step_wait()
        env.reset(seed=3)
        env.step(actions)


@pytest.mark.timeout(60)
@pytest.mark.parametrize("end", ["reset", "close"])
def test_a_step_that_other_halves_dropped_is_not_received(end: str) -> None:
    with vector_env("single-v1", 2, duration_s=60) as env:
        first, _ = env.halves()
        actions = chosen(env.reset(seed=3).masks, 0, 0)
        env.send(actions)
        getattr(first, end)()
        with pytest.raises(EpisodeError, match="dropped the step of environment 0"):
            env.recv(2)
        assert env.recv(1).numbers.tolist() == [1]
        env.reset(seed=3)
        if end == "reset":
            first.send(actions[:1])
        getattr(env, end)()
        with pytest.raises(EpisodeError, match="0 environments|dropped the step of environment 0"):
            first.recv(1)


def test_an_edited_reward_is_the_edited_one_while_another_vector_is_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    module = tmp_path / "edited_reward.py"

    def paid(amount: float) -> Any:
        module.write_text(f"def reward(before, after):\n    return {amount}\n")
        importlib.invalidate_caches()
        loaded = sys.modules.get("edited_reward")
        own = importlib.reload(loaded) if loaded else importlib.import_module("edited_reward")
        return vector_env("single-v1", 1, duration_s=20, reward=own.reward)

    def rewards(env: Any) -> list[float]:
        found: list[float] = []
        for _ in range(3):
            env.reset(1)
            found.append(float(env.step([[0]]).rewards[0, 0]))
        return found

    with paid(1.0) as before:
        assert rewards(before) == [1.0] * 3
        with paid(222.0) as after:
            assert rewards(after) == [222.0] * 3
            assert rewards(before) == [1.0] * 3
    sys.modules.pop("edited_reward", None)


def test_a_step_that_is_interrupted_is_over_in_all_environments(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with vector_env("single-v1", 3, duration_s=60) as env:
        actions = chosen(env.reset(seed=3).masks, 0, 0)
        monkeypatch.setattr(env._environments[1].worker, "answer", interrupted)
        with pytest.raises(KeyboardInterrupt):
            env.step(actions)
        with pytest.raises(EpisodeError, match="environment 1 has no episode"):
            env.step(actions)
        env.reset(where=[1, 2])
        env.step(actions)


def interrupted() -> None:
    raise KeyboardInterrupt


def test_wrappers_that_are_none_are_refused(module: Callable[[str], str]) -> None:
    own = module("def forgets(env):\n    pass\n")
    for wrap, text in ((5, "a wrapper or a list"), (f"{own}:forgets", "returned NoneType")):
        with pytest.raises(OptionError, match=text):
            vector_env("single-v1", 1, wrap=cast(Any, wrap))


def test_a_stopped_process_ends_with_its_user(python: Sequence[str], temporary: Path) -> None:
    program = (
        "import os, signal, sys\n"
        "from ugat_marl import vector_env\n"
        "env = vector_env('single-v1', 1, duration_s=60)\n"
        "env.reset(seed=1)\n"
        "pid = env._environments[0].worker._pid\n"
        "os.kill(pid, signal.SIGSTOP)\n"
        "print(pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    run = subprocess.run([*python, "-c", program], stdout=subprocess.PIPE, timeout=60)
    assert eventually(lambda: gone(int(run.stdout)), 20)
    assert eventually(lambda: not list(temporary.iterdir()), 20)


def test_what_is_under_way_at_the_end_is_forgotten_and_nothing_is_copied() -> None:
    with vector_env("single-v1", 1, duration_s=50) as env:
        batch = env.reset(seed=1)
        for copied in (copy.copy, copy.deepcopy, pickle.dumps):
            with pytest.raises(EpisodeError, match="cannot be copied"):
                copied(env)
        env.step_async(batch.masks.argmax(axis=-1))
    with pytest.raises(EpisodeError, match="this vector_env is closed"):
        env.step_wait()
    with pytest.raises(EpisodeError, match="this vector_env is closed"):
        env.send(batch.masks.argmax(axis=-1))
    with pytest.raises(EpisodeError, match="this vector_env is closed"):
        env.recv()


def test_effects_of_a_file_may_last_as_long_as_the_episode(tmp_path: Path) -> None:
    """The scenario's own length is 600 s."""
    directory = load_scenario("single-v1").with_duration(600).write(tmp_path / "town")
    table = '[[effects]]\nname = "dropout"\ndetector = "stop:northA_A1_0"\n'
    with (directory / "scenario.toml").open("a") as file:
        file.write(table + "begin_s = 700\nend_s = 900\n")
    with vector_env(directory, 1, duration_s=1200) as env:
        env.reset(1)
