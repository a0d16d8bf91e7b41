"""The grounded environment: own actions stored, grounded ones executed, masks respected."""

from __future__ import annotations

import pickle
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv
from pettingzoo.test import parallel_api_test

import ugat_marl
from ugat_marl.data import AgentLayout
from ugat_marl.envs.commands import memory_size
from ugat_marl.errors import ActionError, OptionError
from ugat_marl.grounding import GateConfig, GroundedEnv, InputsConfig, PhaseTransform
from ugat_marl.grounding.transform import GroundedActions

LAYOUTS = {"a_0": AgentLayout(3, 4), "b_0": AgentLayout(2, 2, 1)}
KEYS = {"grounded_action", "uncertainty", "accepted"}


class Crossing(ParallelEnv):
    """Two unequal intersections that remember what they were told; six steps long."""

    metadata: ClassVar = {"name": "crossing", "render_modes": ["ansi"], "is_parallelizable": True}

    def __init__(self, masks: dict[str, list[int]] | None = None) -> None:
        self.possible_agents = list(LAYOUTS)
        self.agents: list[str] = []
        self.render_mode = "ansi"
        self.domain = "sim"
        self.state_space = Box(0, 1, (8,), np.float32)
        self.observation_spaces = {a: Box(0, 1, (v.size,), np.float32) for a, v in LAYOUTS.items()}
        self.action_spaces = {a: Discrete(v.phases) for a, v in LAYOUTS.items()}
        self.masks = masks or {}
        self.told: list[dict[str, int]] = []

    def observation_space(self, agent: str) -> Box:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete:
        return self.action_spaces[agent]

    def _outcome(self) -> tuple[dict[str, Any], dict[str, Any]]:
        observations = {a: self.rng.random(v.size, np.float32) for a, v in LAYOUTS.items()}
        last = self.told[-1] if self.told else {}
        infos = {
            a: {
                "action_mask": np.array(self.masks.get(a, [1] * v.phases), np.int8),
                "executed_action": last.get(a, 0),
            }
            for a, v in LAYOUTS.items()
        }
        return observations, infos | {"__common__": {"time": len(self.told)}}

    def reset(self, seed=None, options=None):
        self.rng = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self.told = []
        return self._outcome()

    def step(self, actions):
        if not self.agents:
            return {}, {}, {}, {}, {}
        self.told.append(dict(actions))
        observations, infos = self._outcome()
        over = len(self.told) == 6
        everyone = list(self.agents)
        self.agents = [] if over else everyone
        return (
            observations,
            dict.fromkeys(everyone, -1.0),
            dict.fromkeys(everyone, False),
            dict.fromkeys(everyone, over),
            infos,
        )

    def state(self):
        return np.zeros(8, np.float32)

    def render(self):
        return "picture"

    def close(self):
        self.closed = True


def transform(mode: str = "infinite", **options: Any) -> PhaseTransform:
    made = PhaseTransform(LAYOUTS, 0, gate=GateConfig(mode=mode, **options))
    made.forward.fitted.fill_(True)
    made.inverse.fitted.fill_(True)
    return made


def test_a_policy_sees_the_commands_it_gave_and_not_the_grounded_ones() -> None:
    class Other(PhaseTransform):
        """Always answers phase 3."""

        def __call__(self, observations, actions, permitted=None, earlier=()):
            threes = np.full(len(actions), 3)
            zeros = np.zeros(len(actions), np.float32)
            return GroundedActions(threes, threes, zeros, np.ones(len(actions), bool), zeros)

    inner = ugat_marl.parallel_env("single-v1", commands=2, duration_s=100.0)
    try:
        env = GroundedEnv(inner, Other(inner.recorded_layouts, 0))
        env.reset(seed=0)
        (agent,) = env.agents
        phases = inner.action_space(agent).n
        for command in (0, 1, 2):
            observations, _, _, _, infos = env.step({agent: command})
            memory = observations[agent][-memory_size(phases, 2) :]
            assert memory[:phases].argmax() == command
            assert infos[agent]["grounded_action"] == 3
    finally:
        inner.close()


def test_models_see_the_phases_that_ran_and_those_that_were_asked_for() -> None:
    class Slow(Crossing):
        """Its lights show phase 1, whatever they are told."""

        def _outcome(self):
            observations, infos = super()._outcome()
            for agent in LAYOUTS:
                infos[agent]["executed_action"] = 1
            return observations, infos

    class Seen(PhaseTransform):
        """Keeps the earlier decisions it is given."""

        def __call__(self, observations, actions, permitted=None, earlier=()):
            self.earlier = list(earlier)
            return super().__call__(observations, actions, permitted, earlier)

    made = Seen(LAYOUTS, 0, inputs=InputsConfig(history=2))
    made.forward.fitted.fill_(True)
    made.inverse.fitted.fill_(True)
    env = GroundedEnv(Slow(), made)
    env.reset(seed=1)
    for own in ({"a_0": 3, "b_0": 0}, {"a_0": 2, "b_0": 0}):
        env.step(own)
    (moment,) = made.earlier
    assert moment.executed.tolist() == [[1], [1]]
    assert moment.asked.tolist() == [[3], [0]]


def test_the_grounded_action_is_executed_and_told_in_the_infos() -> None:
    env = GroundedEnv(Crossing(), transform())
    env.reset(seed=1)
    own = {"a_0": 3, "b_0": 1}
    changed = 0
    for _ in range(5):
        _, _, _, _, infos = env.step(own)
        told = env.unwrapped.told[-1]
        assert own == {"a_0": 3, "b_0": 1}  # the learner's dictionary is its own
        for agent in LAYOUTS:
            assert infos[agent]["grounded_action"] == told[agent] == infos[agent]["executed_action"]
            assert infos[agent]["accepted"] == 1
            assert 0 < infos[agent]["uncertainty"] <= 1
        changed += told != own
    assert changed  # untrained models do not return the policy's action every time


def test_a_refused_action_is_the_policys_own_and_the_answer_is_still_told() -> None:
    env = GroundedEnv(Crossing(), transform("static", static_alpha=1e-6))
    env.reset(seed=1)
    _, _, _, _, infos = env.step({"a_0": 2, "b_0": 0})
    assert env.unwrapped.told == [{"a_0": 2, "b_0": 0}]
    assert [infos[a]["accepted"] for a in LAYOUTS] == [0, 0]
    outcome = transform()(
        env.transform.stack.observations(Crossing().reset(seed=1)[0]), np.array([2, 0])
    )
    assert [infos[a]["grounded_action"] for a in LAYOUTS] == outcome.grounded.tolist()


def test_infos_have_the_same_numeric_keys_at_reset_as_at_step() -> None:
    env = GroundedEnv(Crossing(), transform())
    _, at_reset = env.reset(seed=1)
    _, _, _, _, at_step = env.step({"a_0": 0, "b_0": 0})
    for agent in LAYOUTS:
        assert set(at_reset[agent]) == set(at_step[agent]) >= KEYS | {"action_mask"}
        for key in KEYS:
            assert type(at_reset[agent][key]) is type(at_step[agent][key])
            assert isinstance(at_reset[agent][key], int | float)
    assert at_reset["__common__"] == {"time": 0} and at_step["__common__"] == {"time": 1}
    assert not KEYS & set(at_step["__common__"])


def test_a_masked_grounded_action_is_not_executed() -> None:
    for own in range(4):
        mask = [int(phase == own) for phase in range(4)]
        env = GroundedEnv(Crossing({"a_0": mask}), transform())
        env.reset(seed=1)
        for _ in range(5):
            _, _, _, _, infos = env.step({"a_0": own, "b_0": 0})
            assert env.unwrapped.told[-1]["a_0"] == own
            assert infos["a_0"]["accepted"] == (infos["a_0"]["grounded_action"] == own)


def test_a_learner_may_scale_what_it_was_given_in_place() -> None:
    told: list[list[dict[str, int]]] = []
    for scale in (False, True):
        env = GroundedEnv(Crossing(), transform())
        seen, infos = env.reset(seed=1)
        while env.agents:
            if scale:
                for agent in LAYOUTS:
                    seen[agent] *= 100
                    infos[agent]["action_mask"].fill(0)
            seen, _, _, _, infos = env.step({"a_0": 3, "b_0": 1})
        told.append(env.unwrapped.told)
    assert told[0] == told[1]


def test_an_episode_is_an_epoch_of_the_gate() -> None:
    env = GroundedEnv(Crossing(), transform("dynamic", window_epochs=1))
    seen: list[float] = []
    for episode in range(2):
        env.reset(seed=episode)
        seen.clear()
        while env.agents:
            _, _, _, _, infos = env.step({"a_0": 0, "b_0": 0})
            seen.append(infos["a_0"]["uncertainty"])
    env.transform.gate.update()
    assert env.transform.gate.alpha[0] == pytest.approx(np.mean(seen))  # the last episode only
    assert len(seen) == 6


@pytest.mark.filterwarnings("ignore:Agent was given info but was dead")  # it means __common__
def test_it_is_a_parallel_environment() -> None:
    parallel_api_test(GroundedEnv(Crossing(), transform()), num_cycles=20)


def test_the_wrapped_environments_attributes_stay_usable() -> None:
    inner = Crossing()
    env = GroundedEnv(inner, transform())
    assert env.unwrapped is inner and env.render_mode == "ansi" and env.render() == "picture"
    assert env.possible_agents == list(LAYOUTS) and env.domain == "sim"
    assert env.observation_space("a_0") is inner.observation_space("a_0")
    assert env.action_space("b_0") is inner.action_space("b_0")
    assert env.state_space.shape == env.state().shape
    assert env.metadata["name"] == "crossing"
    env.close()
    assert inner.closed
    with pytest.raises(AttributeError):
        _ = env.no_such_thing


def test_it_can_be_sent_to_another_process_before_reset() -> None:
    env = pickle.loads(pickle.dumps(GroundedEnv(Crossing(), transform())))  # noqa: S301
    env.reset(seed=1)
    assert env.step({"a_0": 0, "b_0": 0})[4]["a_0"]["accepted"] == 1


def test_after_the_last_step_the_environment_answers_itself() -> None:
    env = GroundedEnv(Crossing(), transform())
    env.reset(seed=0)
    while env.agents:
        env.step({"a_0": 0, "b_0": 0})
    assert env.step({}) == ({}, {}, {}, {}, {})


@pytest.mark.parametrize("wrong", [4, -1, 1.5, "north", None, [1, 2], float("nan")])
def test_impossible_actions_are_refused_before_anything_moves(wrong: object) -> None:
    env = GroundedEnv(Crossing(), transform())
    env.reset(seed=0)
    with pytest.raises(ActionError, match=r"action of a_0 .* 0 to 3"):
        env.step({"a_0": wrong, "b_0": 0})
    with pytest.raises(ActionError, match="no action for b_0"):
        env.step({"a_0": 0})
    assert env.unwrapped.told == []
    env.step({"a_0": np.int64(1), "b_0": np.array(1)})  # what learners hand over


def test_a_grounding_for_something_else_is_refused() -> None:
    other = PhaseTransform({"a_0": AgentLayout(3, 4)}, 0)
    with pytest.raises(OptionError, match="1 agents .*has 2"):
        GroundedEnv(Crossing(), other)
    wider = PhaseTransform({"a_0": AgentLayout(3, 4), "b_0": AgentLayout(2, 2, 5)}, 0)
    with pytest.raises(OptionError, match=r"\(9,\) and 2 phases from b_0.*\(5,\)"):
        GroundedEnv(Crossing(), wider)
