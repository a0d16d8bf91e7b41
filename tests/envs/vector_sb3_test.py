"""Simulations in processes as Stable-Baselines3's VecEnv: the same as the one over plain ones."""

from __future__ import annotations

import contextlib
import os
from typing import Any

import numpy as np
import pytest

from ugat_marl import parallel_env, vector_env
from ugat_marl.envs import agent_indicator, pad_spaces
from ugat_marl.errors import ActionError, OptionError

pytest.importorskip("stable_baselines3")
from ugat_marl.envs.adapters.sb3 import AgentsVecEnv
from ugat_marl.envs.adapters.sb3_vector import SimulationsVecEnv

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that can fork")
WRAPS = ["ugat_marl.envs.wrappers:pad_spaces", "ugat_marl.envs.wrappers:agent_indicator"]


def played(env: Any, steps: int) -> list[Any]:
    env.seed(3)
    seen: list[Any] = [env.reset(), env.action_masks()]
    for step in range(steps):
        draws = np.random.default_rng(step).random(env.action_masks().shape)
        observations, rewards, over, infos = env.step((draws * env.action_masks()).argmax(axis=1))
        # Where an episode is over, the next ones have seeds of their own.
        seen += [rewards, over, env.action_masks() * ~over[:, None], observations * ~over[:, None]]
        for key in ("action_mask", "executed_action", "terminal_observation"):
            if over.all() and key == "action_mask":
                continue
            seen += [np.array(info.get(key, 0)) for info in infos]
        seen.append(np.array([info.get("TimeLimit.truncated", False) for info in infos]))
    return seen


@pytest.mark.parametrize("masks_in_observation", [False, True])
def test_it_is_the_one_over_plain_environments(masks_in_observation: bool) -> None:
    plain = [agent_indicator(pad_spaces(parallel_env("mixed-v1", duration_s=50))) for _ in range(2)]
    one = AgentsVecEnv(plain, masks_in_observation=masks_in_observation)
    two = SimulationsVecEnv(
        vector_env("mixed-v1", 2, wrap=WRAPS, duration_s=50),
        masks_in_observation=masks_in_observation,
    )
    assert (one.num_envs, one.observation_space) == (two.num_envs, two.observation_space)
    for here, there in zip(played(one, 5), played(two, 5), strict=True):
        np.testing.assert_array_equal(here, there)
    assert two.env_method("action_masks")[0].shape == two.get_attr("action_masks")[0]().shape
    one.close()
    two.close()
    two.close()


def test_what_would_only_reach_this_process_is_refused() -> None:
    env = SimulationsVecEnv(vector_env("grid2x2-v1", 1, wrap=WRAPS, duration_s=50))
    env.reset()
    for call in (
        lambda: env.env_method("state"),
        lambda: env.set_attr("reward", None),
        lambda: env.set_options({"domain": "V4"}),
    ):
        with pytest.raises(OptionError):
            call()
    assert not env.has_attr("agents")
    assert env.get_attr("render_mode", 0) == [None]
    env.set_options()
    env.close()


def test_it_learns() -> None:
    masked = pytest.importorskip("sb3_contrib").MaskablePPO
    env = SimulationsVecEnv(vector_env("grid2x2-v1", 2, wrap=WRAPS, duration_s=100))
    model = masked("MlpPolicy", env, n_steps=16, batch_size=64, n_epochs=1, seed=1, device="cpu")
    model.learn(300)
    assert model.num_timesteps >= 300
    env.close()


def test_a_learner_without_masks_needs_legal_actions() -> None:
    from stable_baselines3 import PPO

    def learn(wrap: list[str]) -> int:
        env = SimulationsVecEnv(vector_env("mixed-v1", 1, wrap=wrap, duration_s=100))
        with contextlib.closing(env):
            model = PPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, seed=1)
            return model.learn(100).num_timesteps

    pad, indicator = WRAPS
    with pytest.raises(ActionError, match="put legal_actions outside pad_spaces"):
        learn(WRAPS)
    assert learn([pad, "ugat_marl.envs.wrappers:legal_actions", indicator]) >= 100


def test_only_the_convention_of_the_library_is_taken() -> None:
    env = vector_env("grid2x2-v1", 1, autoreset="disabled")
    with pytest.raises(OptionError, match="needs 'same-step'"):
        SimulationsVecEnv(env)
    with pytest.raises(OptionError, match=r"wrappers\.pad_spaces"):
        SimulationsVecEnv(vector_env("mixed-v1", 1))
