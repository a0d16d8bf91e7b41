"""PettingZoo's own tests and SuperSuit's wrappers, on equal and unequal intersections."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import supersuit
from pettingzoo.test import (
    api_test,
    max_cycles_test,
    parallel_api_test,
    parallel_seed_test,
    render_test,
    seed_test,
)
from pettingzoo.test.state_test import state_test

import ugat_marl
from ugat_marl.envs import TrafficEnv
from ugat_marl.scenarios import Scenario

NAMES = ("single-v1", "grid2x2-v1", "mixed-v1")
STEPS = 8


@pytest.fixture(scope="module")
def scenarios() -> dict[str, Scenario]:
    """The scenarios, read once."""
    return {name: ugat_marl.load_scenario(name) for name in NAMES}


@pytest.fixture(params=NAMES)
def make(request: pytest.FixtureRequest, scenarios: dict[str, Scenario]) -> Iterator[Any]:
    """Makes environments of a few steps, and closes them after the test."""
    made: list[Any] = []

    def parallel(steps: int = STEPS, **options: Any) -> TrafficEnv:
        made.append(
            ugat_marl.parallel_env(scenarios[request.param], duration_s=10 * steps, **options)
        )
        return made[-1]

    def aec(steps: int = STEPS, **options: Any) -> Any:
        made.append(ugat_marl.env(scenarios[request.param], duration_s=10 * steps, **options))
        return made[-1]

    yield SimpleNamespace(parallel=parallel, aec=aec, name=request.param)
    for env in made:
        env.close()


@pytest.fixture(autouse=True)
def _no_warnings() -> Iterator[None]:
    """A warning is a failure; those that are no fault of the suite are named here."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for harmless in (
            "Agents have different observation space sizes",  # so they are: mixed-v1
            "Observations are different shapes",  # the same
            "agent_indicator wrapper is degenerate",  # type_only where all are of one type
        ):
            warnings.filterwarnings("ignore", harmless)
        # libsumo and other libraries warn about themselves, when they are first imported
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        yield


# --- PettingZoo ---------------------------------------------------------------------------------


def test_parallel_api(make: Any) -> None:
    parallel_api_test(make.parallel(), num_cycles=2 * STEPS)


def test_aec_api(make: Any) -> None:
    api_test(make.aec(), num_cycles=4 * STEPS, verbose_progress=False)


def test_parallel_seed(make: Any) -> None:
    """It compares one step only; `ugat_marl.testing` compares whole episodes."""
    parallel_seed_test(make.parallel, num_cycles=STEPS)


def test_aec_seed(make: Any) -> None:
    seed_test(make.aec, num_cycles=STEPS)


def test_max_cycles(make: Any) -> None:
    """Where PettingZoo counts cycles, a scenario has a duration."""
    module = SimpleNamespace(
        parallel_env=lambda max_cycles: make.parallel(max_cycles),
        env=lambda max_cycles: make.aec(max_cycles),
    )
    max_cycles_test(module)


def test_state(make: Any) -> None:
    state_test(make.aec(), make.parallel(), num_cycles=STEPS)


def test_render(make: Any) -> None:
    """Without "human", which needs a display (see env_test)."""

    def make_env(render_mode: str) -> Any:
        env = make.aec(render_mode=render_mode)
        env.metadata = {**env.metadata, "render_modes": ["rgb_array"]}
        return env

    render_test(make_env)


# --- SuperSuit ----------------------------------------------------------------------------------


def padded(env: Any) -> Any:
    return supersuit.pad_action_space_v0(supersuit.pad_observations_v0(env))


def with_indicator(env: Any) -> Any:
    return supersuit.agent_indicator_v0(padded(env))


def with_type_indicator(env: Any) -> Any:
    return supersuit.agent_indicator_v0(padded(env), type_only=True)


WRAPPERS: dict[str, Callable[[Any], Any]] = {
    "pad_observations": supersuit.pad_observations_v0,
    "pad_action_space": supersuit.pad_action_space_v0,
    "agent_indicator": with_indicator,
    "agent_indicator(type_only)": with_type_indicator,
    "frame_stack": lambda env: supersuit.frame_stack_v1(env, 3),
    "dtype": lambda env: supersuit.dtype_v0(env, np.float64),
    "normalize_obs": supersuit.normalize_obs_v0,
    "flatten": supersuit.flatten_v0,
    "delay_observations": lambda env: supersuit.delay_observations_v0(env, 2),
    "max_observation": lambda env: supersuit.max_observation_v0(env, 2),
    "sticky_actions": lambda env: supersuit.sticky_actions_v0(env, 0.3),
    "nan_noop": lambda env: supersuit.nan_noop_v0(env, 0),
    "clip_reward": lambda env: supersuit.clip_reward_v0(env, -1, 1),
}


def episode_of(env: Any) -> tuple[list[dict[str, Any]], list[dict[str, float]]]:
    """Observations and rewards of an episode of the same action, in their spaces throughout."""
    seen, _ = env.reset(seed=3)
    observations, rewards = [copy.deepcopy(seen)], []
    while env.agents:
        seen, given, *_ = env.step(dict.fromkeys(env.agents, 1))
        observations.append(copy.deepcopy(seen))  # frame_stack returns one array again and again
        rewards.append(given)
    for moment in observations:
        for agent, vector in moment.items():
            assert env.observation_space(agent).contains(vector), agent
    return observations, rewards


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_supersuit_wraps_it(make: Any, wrapper: str) -> None:
    observations, rewards = episode_of(WRAPPERS[wrapper](make.parallel()))
    assert len(rewards) == STEPS and all(set(moment) == set(rewards[0]) for moment in observations)


def test_wrappers_do_what_they_say(make: Any) -> None:
    plain, rewards = episode_of(make.parallel())
    stacked, _ = episode_of(supersuit.frame_stack_v1(make.parallel(), 2))
    padding, _ = episode_of(supersuit.pad_observations_v0(make.parallel()))
    marked, _ = episode_of(with_indicator(make.parallel()))
    _, clipped = episode_of(supersuit.clip_reward_v0(make.parallel(), -1, 1))
    names = list(plain[0])
    widest = max(vector.size for vector in plain[0].values())
    for step, moment in enumerate(plain):
        for place, (agent, vector) in enumerate(moment.items()):
            np.testing.assert_array_equal(padding[step][agent][: vector.size], vector)
            assert padding[step][agent].size == widest
            # 1 where the indicator is the agent's own
            np.testing.assert_array_equal(marked[step][agent][widest:], np.eye(len(names))[place])
            np.testing.assert_array_equal(stacked[step][agent][-vector.size :], vector)
    for given, cut in zip(rewards, clipped, strict=True):
        assert cut == {agent: max(-1, min(1, reward)) for agent, reward in given.items()}


def test_padding_maps_impossible_actions_to_zero_in_silence() -> None:
    """SuperSuit's fault: an agent of two phases that chooses the eighth gets the first."""
    env = supersuit.pad_action_space_v0(ugat_marl.parallel_env("mixed-v1", duration_s=20))
    env.reset(seed=1)
    assert {env.action_space(agent).n for agent in env.agents} == {8}
    infos = env.step(dict.fromkeys(env.agents, 7))[4]
    phases = {agent: env.unwrapped.action_space(agent).n for agent in env.possible_agents}
    for agent, count in phases.items():
        assert infos[agent]["executed_action"] == (7 if count == 8 else 0)
    env.close()


def test_agent_indicator_leaves_its_own_bounds_where_upper_bounds_differ() -> None:
    """SuperSuit's fault, which the suite's own spaces do not provoke: all end at 1."""
    from gymnasium.spaces import Box
    from supersuit.utils.agent_indicator import change_obs_space, change_observation

    space = Box(0, np.array([1, 9], np.float32), dtype=np.float32)
    marked = change_observation(np.zeros(2, np.float32), space, (0, 1))
    assert not change_obs_space(space, 1).contains(marked)
    for name in NAMES:
        for own in ugat_marl.parallel_env(name, neighbours=1).observation_spaces.values():
            assert set(own.high.tolist()) == {1.0}


def test_black_death_takes_one_step_too_many(make: Any) -> None:
    """SuperSuit's fault: it ends when agents are terminated *and* truncated, which they never are.

    The step after the end asks the environment what nobody's actions do, and it answers.
    """
    env = supersuit.black_death_v3(make.parallel())
    seen, _ = env.reset(seed=1)
    steps = 0
    while env.agents:
        seen, rewards, _, truncations, _ = env.step(dict.fromkeys(env.agents, 0))
        steps += 1
    assert steps == STEPS + 1
    assert all(truncations.values()) and set(rewards.values()) == {0.0}
    assert not any(vector.any() for vector in seen.values())


def test_frame_skip_repeats_actions(make: Any) -> None:
    env = supersuit.frame_skip_v0(make.parallel(), 2)
    env.reset(seed=1)
    steps = 0
    while env.agents:
        env.step(dict.fromkeys(env.agents, 0))
        steps += 1
    assert steps == STEPS // 2


def test_two_vector_environments_in_one_process(make: Any) -> None:
    """With libsumo in the process this would hang; every environment has a process of its own."""
    one = supersuit.pettingzoo_env_to_vec_env_v1(padded(make.parallel()))
    two = supersuit.concat_vec_envs_v1(one, 2, num_cpus=0, base_class="gymnasium")
    agents = one.num_envs
    assert two.num_envs == 2 * agents
    seen, infos = two.reset(seed=5)
    assert seen.shape == (2 * agents, *one.observation_space.shape) and len(infos) == 2 * agents
    alone, _ = one.reset(seed=5)
    np.testing.assert_array_equal(seen[:agents], alone)
    differ = False
    for step in range(STEPS + 2):
        actions = np.ones(two.num_envs, dtype=np.int64)
        seen, rewards, terminations, truncations, infos = two.step(actions)
        assert not terminations.any()
        assert truncations.all() == truncations.any() == (step == STEPS - 1)
        assert all("action_mask" in info for info in infos)
        if step < STEPS - 1:  # the first of the two is what one alone with its seed is
            alone, expected, *_ = one.step(actions[:agents])
            np.testing.assert_array_equal(seen[:agents], alone)
            np.testing.assert_array_equal(rewards[:agents], expected)
        if step == STEPS - 1:  # it has begun anew by itself, and kept the last observation
            assert all("terminal_observation" in info for info in infos)
        differ |= not np.array_equal(seen[:agents], seen[agents:])
    assert differ  # seeds 5 and 6
    one.close()
    two.close()


def test_vector_environments_in_processes_of_their_own(scenarios: dict[str, Scenario]) -> None:
    """The environment is copied to two processes, each of which starts SUMO in a third."""
    env = ugat_marl.parallel_env(scenarios["grid2x2-v1"], duration_s=10 * STEPS)
    one = supersuit.pettingzoo_env_to_vec_env_v1(env)
    two = supersuit.concat_vec_envs_v1(one, 2, num_cpus=2, base_class="gymnasium")
    seen, _ = two.reset(seed=5)
    alone, _ = one.reset(seed=5)
    actions = np.ones(two.num_envs, dtype=np.int64)
    for _ in range(STEPS - 1):
        np.testing.assert_array_equal(seen[:4], alone)
        two.step_async(actions)
        seen, *_ = two.step_wait()
        alone, *_ = one.step(actions[:4])
    assert not hasattr(two, "seed")  # SuperSuit's fault: PPO(seed=...) of SB3 fails
    one.close()
    two.close()
