"""Work that is done while SUMO simulates: once in a step, at the right time, without a trace."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pettingzoo.test.example_envs import generated_agents_parallel_v0

from ugat_marl import parallel_env
from ugat_marl.envs import (
    AnyParallelEnv,
    TrafficEnv,
    frame_stack,
    pad_spaces,
    step_meanwhile,
)
from ugat_marl.errors import ActionError, SimulatorError
from ugat_marl.policies.learners.dqn import DQN
from ugat_marl.policies.learners.dqn_config import DQNConfig
from ugat_marl.simulation.host import Worker

SIMULATORS = [
    pytest.param(
        "process",
        marks=pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that can fork"),
    ),
    "spawn",
    "inprocess",
]


def made(simulator: str = "spawn") -> TrafficEnv:
    return parallel_env("single-v1", duration_s=60, simulator=simulator)


def first(env: Any) -> dict[str, int]:
    return dict.fromkeys(env.agents, 0)


def played(env: TrafficEnv, seed: int) -> list[float]:
    """Return all that an episode shows, as one list."""
    env.reset(seed=seed)
    seen: list[float] = []
    while env.agents:
        observations, rewards, *_ = env.step(first(env))
        seen += [*np.concatenate([*observations.values()]), *rewards.values()]
    return seen


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_work_is_done_once_and_changes_no_episode(simulator: str) -> None:
    times: list[float] = []
    env = made(simulator)
    wanted = played(env, 3)
    env.reset(seed=3)
    seen: list[float] = []
    while env.agents:
        work = step_meanwhile(env, first(env), lambda: times.append(env.snapshot.time_s))
        seen += [*np.concatenate([*work[0].values()]), *work[1].values()]
    assert seen == wanted
    assert times == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0], "each work knows the state before its step"
    env.close()


@pytest.mark.parametrize("wrapped", [lambda env: env, lambda env: pad_spaces(frame_stack(env, 2))])
def test_the_process_is_asked_before_the_work_and_read_after(
    wrapped: Callable[[TrafficEnv], AnyParallelEnv], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only then does SUMO simulate during the work."""
    env = wrapped(made())
    env.reset(seed=1)
    order: list[str] = []
    for name in ("ask", "answer"):
        real = getattr(Worker, name)

        def noted(self: Worker, *args: Any, _real: Any = real, _name: str = name, **more: Any):
            order.append(_name)
            return _real(self, *args, **more)

        monkeypatch.setattr(Worker, name, noted)
    step_meanwhile(env, first(env), lambda: order.append("work"))
    assert order == ["ask", "work", "answer"]
    env.close()


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_work_that_fails_ends_the_episode_and_no_later_one_reads_its_answer(simulator: str) -> None:
    env = made(simulator)
    wanted = played(env, 5)
    env.reset(seed=4)
    with pytest.raises(ZeroDivisionError):
        step_meanwhile(env, first(env), lambda: 1 / 0)
    assert not env.agents
    assert played(env, 5) == wanted
    env.close()


@pytest.mark.parametrize("simulator", ["process", "spawn"])
def test_work_that_asks_the_simulation_is_told_that_it_cannot(simulator: str) -> None:
    env = parallel_env("single-v1", duration_s=60, simulator=simulator, render_mode="rgb_array")
    env.reset(seed=1)
    with pytest.raises(SimulatorError, match="in the middle of a step; work that is done mean"):
        step_meanwhile(env, first(env), env.render)
    env.reset(seed=1)
    env.step(first(env))
    env.close()


def test_work_of_a_refused_step_is_not_done_in_the_next() -> None:
    env = made()
    done: list[int] = []
    env.reset(seed=2)
    with pytest.raises(ActionError):
        step_meanwhile(env, {}, lambda: done.append(1))
    env.step(first(env))
    assert not done
    env.close()


def test_work_is_done_below_wrappers_and_in_environments_of_others() -> None:
    done: list[int] = []
    for env in (frame_stack(made(), 2), generated_agents_parallel_v0.parallel_env()):
        env.reset(seed=1)
        for number in range(3):
            done.clear()
            step_meanwhile(env, dict.fromkeys(env.agents, 0), lambda: done.append(1))
            assert len(done) == 1, f"{env} at step {number}"
        env.close()


def test_a_learner_updates_while_sumo_simulates(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many updates as before, the last one after the last step, none between two steps."""
    env = made()
    learner = DQN.of(env, DQNConfig(warmup_decisions=2, batch_size=4))
    order: list[str] = []
    real_ask, real_update = Worker.ask, DQN.update

    def ask(self: Worker, request: str, *args: Any, **more: Any) -> None:
        order.append(request)
        real_ask(self, request, *args, **more)

    def update(self: DQN, generator: Any) -> tuple[float, float]:
        order.append("update")
        return real_update(self, generator)

    monkeypatch.setattr(Worker, "ask", ask)
    monkeypatch.setattr(DQN, "update", update)
    learner.learn(env, 1, seed=0)
    assert order == [
        *["start", "advance", "advance"],
        *["advance", "update"] * 4,
        *["finish", "update"],
    ]
    assert learner.updates == 5
    env.close()
