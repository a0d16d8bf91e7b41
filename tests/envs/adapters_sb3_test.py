"""Parallel environments as Stable-Baselines3's: what it is told, what its actions do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ugat_marl.envs import agent_indicator, pad_spaces
from ugat_marl.errors import ActionError, EpisodeError, OptionError
from ugat_marl.testing import ToyTraffic

pytest.importorskip("stable_baselines3")
from ugat_marl.envs.adapters.sb3 import AgentsVecEnv


class Noted(ToyTraffic):
    """Remembers what it was asked for."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.seeds: list[int | None] = []
        self.asked: list[dict[str, int]] = []
        self.closed = 0

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.seeds.append(seed)
        return super().reset(seed, options)

    def step(self, actions: Any) -> Any:
        self.asked.append(dict(actions))
        return super().step(actions)

    def close(self) -> None:
        self.closed += 1


def many(number: int = 2, **given: Any) -> tuple[list[Noted], AgentsVecEnv]:
    inner = [Noted(**given) for _ in range(number)]
    return inner, AgentsVecEnv([agent_indicator(pad_spaces(env)) for env in inner])


def test_rows_are_the_agents_of_each_environment_in_turn() -> None:
    inner, env = many()
    assert env.num_envs == 6
    env.seed(7)
    seen = env.reset()
    assert seen.shape == (6, 7 + 3) and seen.dtype == np.float32
    assert [one.seeds for one in inner] == [[7], [8]]
    assert np.array_equal(seen[:3, 7:], np.eye(3)) and np.array_equal(seen[3:, 7:], np.eye(3))
    twin = agent_indicator(pad_spaces(ToyTraffic()))
    expected, _ = twin.reset(seed=8)
    assert np.array_equal(seen[3:], list(expected.values()))
    actions = [0, 1, 2, 1, 0, 0]
    seen, rewards, over, infos = env.step(np.array(actions))
    assert inner[0].asked == [dict(zip(twin.possible_agents, actions[:3], strict=True))]
    expected, paid, *_ = twin.step(dict(zip(twin.possible_agents, actions[3:], strict=True)))
    assert np.array_equal(seen[3:], list(expected.values()))
    assert rewards[3:].tolist() == list(paid.values())
    assert not over.any() and len(infos) == 6


def test_an_end_is_a_truncation_with_what_was_seen_there() -> None:
    _, env = many(1, steps=3)
    env.seed(1)
    env.reset()
    twin = agent_indicator(pad_spaces(ToyTraffic(steps=3)))
    twin.reset(seed=1)
    for number in range(3):
        seen, _, over, infos = env.step(np.zeros(3, dtype=int))
        last, *_ = twin.step(dict.fromkeys(twin.possible_agents, 0))
        assert over.all() == (number == 2)
    fresh, begun = twin.reset()
    np.testing.assert_equal(env.reset_infos, [begun[agent] for agent in twin.possible_agents])
    for row, agent in enumerate(twin.possible_agents):
        assert infos[row]["TimeLimit.truncated"] is True
        assert np.array_equal(infos[row]["terminal_observation"], last[agent])
        assert np.array_equal(seen[row], fresh[agent])
        assert not np.array_equal(seen[row], last[agent])


class Terminating(ToyTraffic):
    """Its episodes end because the task is over."""

    def step(self, actions: Any) -> Any:
        seen, rewards, terminations, truncations, infos = super().step(actions)
        return seen, rewards, truncations, terminations, infos


def test_an_end_of_the_task_is_no_truncation() -> None:
    env = AgentsVecEnv([agent_indicator(pad_spaces(Terminating(steps=1)))])
    env.reset()
    *_, over, infos = env.step(np.zeros(3, dtype=int))
    assert over.all() and not any(info["TimeLimit.truncated"] for info in infos)


def test_one_environment_may_end_before_another() -> None:
    env = AgentsVecEnv([pad_spaces(ToyTraffic(steps=2)), pad_spaces(ToyTraffic(steps=3))])
    env.seed(1)
    env.reset()
    ends = [env.step(np.zeros(6, dtype=int))[2].tolist() for _ in range(4)]
    assert ends[0] == [False] * 6 and ends[1] == [True] * 3 + [False] * 3
    assert ends[2] == [False] * 3 + [True] * 3 and ends[3] == [True] * 3 + [False] * 3


def test_masks_are_those_of_now() -> None:
    _, env = many()
    env.reset()
    wanted = [[True] * 3, [True, True, False], [True] * 3] * 2
    assert env.action_masks().tolist() == wanted
    assert np.stack(env.env_method("action_masks")).tolist() == wanted
    assert env.has_attr("action_masks")
    assert [mask().tolist() for mask in env.get_attr("action_masks", [1, 2])] == wanted[1:3]
    shown = AgentsVecEnv(env.envs, masks_in_observation=True)
    seen = shown.reset()
    assert seen[:, -3:].tolist() == wanted
    assert all(shown.observation_space.contains(row) for row in seen)
    with pytest.raises(ActionError, match="tee_0"):  # never another one in its place
        env.step(np.full(6, 2))


def test_attributes_methods_and_the_end() -> None:
    inner, env = many()
    assert env.get_attr("steps") == [12] * 6 and env.get_attr("steps", [0]) == [12]
    assert not any(env.env_is_wrapped(object))
    env.env_method("close", indices=[0, 1, 2])  # one call for the three agents of an environment
    assert [one.closed for one in inner] == [1, 0]
    env.close()
    assert [one.closed for one in inner] == [2, 1]


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(OptionError, match=r"wrappers\.pad_spaces"):
        AgentsVecEnv([ToyTraffic()])
    with pytest.raises(OptionError, match="no environment"):
        AgentsVecEnv([])

    class Leaving(ToyTraffic):
        def step(self, actions: Any) -> Any:
            found = super().step(actions)
            self.agents = self.agents[:1]
            return found

    env = AgentsVecEnv([pad_spaces(Leaving())])
    env.reset()
    with pytest.raises(EpisodeError, match="cross_1, tee_0 left"):
        env.step(np.zeros(3, dtype=int))


def test_stable_baselines3_trains_in_it() -> None:
    from stable_baselines3 import PPO

    env = AgentsVecEnv([agent_indicator(Equal()) for _ in range(2)])
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=3, device="cpu").learn(64)
    assert model.num_timesteps == 64 and model._n_updates > 0


class Equal(ToyTraffic):
    """The two equal intersections."""

    def __init__(self) -> None:
        super().__init__()
        for kept in (self.layouts, self.observation_spaces, self.action_spaces):
            del kept["tee_0"]
        self.possible_agents = list(self.layouts)
