"""The act-step-observe loop and what it records."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ugat_marl.effects import load_scenario
from ugat_marl.envs import TrafficEnv, parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.policies import EpsilonGreedy, RollOutStopped, make_rule, observer_of, roll_out


class Always:
    """Phase 0, always."""

    env_options: Mapping[str, Any] = {}

    def __init__(self) -> None:
        self.resets: list[int] = []

    def reset(self, seed: int) -> None:
        self.resets.append(seed)

    def act(self, observations: Mapping[str, Any], infos: Mapping[str, Any]) -> dict[str, int]:
        return dict.fromkeys(observations, 0)


@pytest.fixture
def env() -> Iterator[TrafficEnv]:
    env = parallel_env("grid2x2-v1", "sim", duration_s=200)
    yield env
    env.close()


def test_one_episode_is_played_and_recorded(env: TrafficEnv) -> None:
    policy = Always()
    played = roll_out(env, policy, 7, record=observer_of(env))
    assert policy.resets == [7]
    assert played.steps == 20
    assert played.log is not None
    assert len(played.log) == 20 * 4
    assert played.log.provenance.seeds == (7,)
    assert played.log.provenance.scenario_hash == env.scenario.hash
    for agent in env.possible_agents:
        rows = played.log.transitions(agent)
        assert np.array_equal(rows.observation[1:], rows.next_observation[:-1])
        assert (rows.action == 0).all()
    assert played.mean_reward == pytest.approx(env.scores().reward)


def test_a_recorded_episode_leaves_no_measurement_for_the_next_one(env: TrafficEnv) -> None:
    roll_out(env, Always(), 1, record=observer_of(env, "waiting"))
    assert len(env.snapshot.waiting_s) > 0
    roll_out(env, Always(), 1)
    assert len(env.snapshot.waiting_s) == 0


def test_what_is_recorded_can_differ_from_what_the_policy_sees() -> None:
    rule = make_rule("largest-queue:20", parallel_env("grid2x2-v1", duration_s=100))
    env = parallel_env("grid2x2-v1", duration_s=100, **rule.env_options)
    plain = parallel_env("grid2x2-v1", duration_s=100)
    try:
        log = roll_out(env, rule, 3, record=observer_of(env, "count")).log
        assert log is not None
        assert log.provenance.observation == "count"
        assert dict(log.provenance.layouts) == dict(plain.layouts)
        actions = [log.transitions(agent).action for agent in env.possible_agents]
        observations, _ = plain.reset(seed=3)
        for step in range(10):
            for agent in plain.possible_agents:
                assert np.array_equal(observations[agent], log.transitions(agent).observation[step])
            chosen = {a: int(own[step]) for a, own in zip(plain.agents, actions, strict=True)}
            observations, *_ = plain.step(chosen)
    finally:
        env.close()
        plain.close()


def test_exploration_has_its_rate_and_keeps_to_the_mask() -> None:
    policy = EpsilonGreedy(Always(), 0.5)
    policy.reset(1)
    agents = [f"signal_{i}" for i in range(4)]
    observations = {agent: np.zeros(1, np.float32) for agent in agents}
    infos = {agent: {"action_mask": np.array([1, 0, 1, 1], np.int8)} for agent in agents}
    chosen = [policy.act(observations, infos)[a] for _ in range(2000) for a in agents]
    counts = np.bincount(chosen, minlength=4) / len(chosen)
    assert counts[1] == 0
    assert counts[2] == pytest.approx(0.5 / 3, abs=0.02)
    assert counts[0] == pytest.approx(0.5 + 0.5 / 3, abs=0.02)
    policy.reset(1)
    again = [policy.act(observations, infos)[a] for _ in range(2000) for a in agents]
    assert again == chosen


def test_a_log_names_agents_as_the_environment_that_will_read_it() -> None:
    """On unequal intersections names depend on who is seen; a log follows its own observer."""
    rule = make_rule("largest-queue:20", parallel_env("mixed-v1", duration_s=50))
    env = parallel_env("mixed-v1", duration_s=50, **rule.env_options)
    reader = parallel_env("mixed-v1", duration_s=50, neighbours=1)
    try:
        log = roll_out(env, rule, 3, record=observer_of(env, "count", 1)).log
        assert log is not None
        assert dict(log.provenance.layouts) == dict(reader.layouts)
        assert log.agents == tuple(reader.possible_agents)
        assert env.possible_agents == parallel_env("mixed-v1").possible_agents
    finally:
        env.close()


def test_greens_that_no_action_means_are_not_recorded() -> None:
    scenario = load_scenario("single-v1")
    for phases in ("conflict-free", "programme"):
        env = parallel_env(
            scenario.with_control(phases=phases), signals="programme", duration_s=110
        )
        try:
            rule = make_rule("programme", env)
            if phases == "conflict-free":
                with pytest.raises(
                    OptionError, match=r"none of its phases.*phases = \"programme\""
                ):
                    roll_out(env, rule, 3, record=observer_of(env))
                continue
            log = roll_out(env, rule, 3, record=observer_of(env)).log
            assert log is not None
            assert set(log.transitions("signal_0").executed.tolist()) == {0, 1, 2, 3}
        finally:
            env.close()


def test_a_programme_was_asked_for_what_it_ran() -> None:
    """Else a log of the lights as they are would say that nearly all commands are lost."""
    env = parallel_env("grid2x2-v1", "sim", signals="programme", duration_s=400)
    try:
        exploring = EpsilonGreedy(make_rule("programme", env), 0.3)  # the default of `rollout`
        log = roll_out(env, exploring, 3, record=observer_of(env)).log
        assert log is not None
        for agent in log.agents:
            rows = log.transitions(agent)
            assert set(rows.executed.tolist()) > {0}
            assert np.array_equal(rows.action, rows.executed)
    finally:
        env.close()


def test_a_stopped_episode_leaves_no_measurement_for_the_next_one(env: TrafficEnv) -> None:
    def stop(step: int) -> None:
        raise RollOutStopped

    with pytest.raises(RollOutStopped):
        roll_out(env, Always(), 1, record=observer_of(env, "waiting"), on_step=stop)
    roll_out(env, Always(), 1)
    assert len(env.snapshot.waiting_s) == 0


def test_a_policy_does_not_read_another_observation_that_is_long_enough() -> None:
    env = parallel_env("grid2x2-v1", "sim", duration_s=100, observation="count", neighbours=3)
    with pytest.raises(OptionError, match=r"reads .* 'movements', .* shows 'count'; make it with"):
        roll_out(env, make_rule("largest-queue:20", env), 1)
    env.close()


def test_an_environment_of_others_is_not_recorded(env: TrafficEnv) -> None:
    other: Any = SimpleNamespace(unwrapped=object())
    with pytest.raises(OptionError, match="object cannot be recorded"):
        roll_out(other, Always(), 1, record=observer_of(env))
