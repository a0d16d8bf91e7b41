"""Algorithm 1 between two worlds written by hand, of which the street obeys one decision late.

f must know the street: its history tells which command is under way. h must know the simulation,
where a command acts at once. The logs must keep what was asked for apart from what ran.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ugat_marl.data import AgentLayout, Provenance, Run, TransitionLog, TransitionRecorder
from ugat_marl.envs import parallel_env
from ugat_marl.grounding import (
    FitConfig,
    InputsConfig,
    InverseConfig,
    RunState,
    SimulatedWorld,
    Ugat,
    UgatConfig,
    stack_log,
)
from ugat_marl.grounding.forward import ForwardConfig
from ugat_marl.grounding.view import Moment
from ugat_marl.policies import observer_of, roll_out
from ugat_marl.progress import Silent

LANES = PHASES = 3
LAYOUTS = {"a_0": AgentLayout(LANES, PHASES)}
STARTS = 0.5


class ByHand:
    """Lane k empties by 0.2 while phase k runs; commands act `late` decisions later."""

    roll_outs_under_delays = 0

    def __init__(self, late: int) -> None:
        self._late = late

    def collect(self, policy: Any, iteration: int, seed: int) -> TransitionLog:
        generator = np.random.default_rng((seed, iteration, self._late))
        domain = "street" if self._late else "sim"
        recorder = TransitionRecorder(Provenance("by hand", "", domain, (), 10.0, "count", LAYOUTS))
        for episode in range(4):
            asked = generator.integers(PHASES, size=150)
            running, counts = 0, np.full(LANES, STARTS)
            for step, command in enumerate(asked):
                executed = int(asked[step - self._late]) if step >= self._late else running
                change = np.where(np.arange(LANES) == executed, -0.2, 0.1)
                then = np.clip(counts + change, 0.0, 1.0)
                recorder.record(
                    episode,
                    step,
                    {"a_0": np.array([*counts, *np.eye(PHASES)[running]])},
                    {"a_0": int(command)},
                    {"a_0": executed},
                    {"a_0": 0.0},
                    {"a_0": np.array([*then, *np.eye(PHASES)[executed]])},
                )
                running, counts = executed, then
        return recorder.log()

    def replay(self) -> None:
        """Return None: the policy acts."""

    def stop(self) -> None:
        """Do nothing."""


class Idle:
    """A learner that learns nothing."""

    episodes = 0

    def learn(self, env: Any, episodes: int, *_: Any) -> None:
        self.episodes += episodes

    def policy(self) -> Idle:
        return self

    def save(self, path: Path) -> None:
        path.write_bytes(b"")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> RunState[Any]:
    config = UgatConfig(
        grounding="phase",
        pretrain_episodes=0,
        iterations=1,
        grounded_episodes=1,
        inputs=InputsConfig(history=3),
        forward=ForwardConfig(hidden=(48,)),
        inverse=InverseConfig(hidden=(48,), embedding=16),
        fit=FitConfig(epochs=60),
    )
    state = RunState(Idle(), config.transform(LAYOUTS, 0))  # type: ignore[arg-type]
    run = Run(tmp_path_factory.mktemp("run"), {}, Silent())
    env: Any = _Spaces()
    try:
        Ugat(env=env, sim=ByHand(0), real=ByHand(1), config=config, seed=0, run=run).train(state)  # type: ignore[arg-type]
    finally:
        run.close()
    return state


class _Spaces:
    """Spaces of the agent, as the grounded environment asks for them."""

    possible_agents = ("a_0",)
    unwrapped = None
    metadata: Mapping[str, Any] = {}

    def observation_space(self, _: str) -> Any:
        return np.zeros(LANES + PHASES)

    def action_space(self, _: str) -> Any:
        return type("Space", (), {"n": PHASES})()


def test_f_knows_the_street_and_h_the_simulation(trained: RunState[Any]) -> None:
    transform = trained.transform
    now = torch.tensor([[[STARTS] * LANES + [1.0, 0.0, 0.0]]])
    for under_way in range(PHASES):
        for asked in range(PHASES):
            moment = Moment(now, torch.tensor([[0]]), torch.tensor([[under_way]]))
            grounded = transform(now, np.array([asked]), None, [moment, moment])
            # On the street the phase under way will run, so the simulation has to show it now.
            assert grounded.grounded.tolist() == [under_way]


def test_logs_keep_what_was_asked_for_apart_from_what_ran(trained: RunState[Any]) -> None:
    street, sim = (
        stack_log(log, trained.transform.stack) for log in (trained.real[0], trained.simulated[0])
    )
    assert torch.equal(sim.asked, sim.executed)
    assert not torch.equal(street.asked, street.executed)


def test_a_roll_out_records_the_policy_s_own_action() -> None:
    env = parallel_env("single-v1", "execution_delay=20", duration_s=100)

    class Scripted:
        env_options: Mapping[str, Any] = {}

        def reset(self, seed: int) -> None:
            self.asked = iter([1, 2, 3, 4, 5, 6, 7, 1, 2, 3])

        def act(self, observations: Any, infos: Any) -> dict[str, int]:
            return {"signal_0": next(self.asked)}

    try:
        log = roll_out(env, Scripted(), 0, record=observer_of(env)).log
    finally:
        env.close()
    assert log is not None
    rows = log.transitions("signal_0")
    assert rows.action.tolist() == [1, 2, 3, 4, 5, 6, 7, 1, 2, 3]
    assert rows.executed.tolist() == [0, 0, 1, 2, 3, 4, 5, 6, 7, 1]


def test_every_iteration_has_its_own_traffic() -> None:
    def make(**options: Any) -> Any:
        return parallel_env("single-v1", duration_s=30, **options)

    class Keep:
        env_options: Mapping[str, Any] = {}

        def reset(self, seed: int) -> None:
            del seed

        def act(self, observations: Any, infos: Any) -> dict[str, int]:
            return dict.fromkeys(observations, 0)

    world = SimulatedWorld(make, "real", episodes=2, epsilon=0.0)
    seeds = [world.collect(Keep(), iteration, 5).provenance.seeds for iteration in (0, 1)]
    assert len({*seeds[0], *seeds[1]}) == 4
