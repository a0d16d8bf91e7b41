"""Wrappers: what a learner sees in closed form, what stays as it was, and SuperSuit's numbers."""

from __future__ import annotations

import copy
import itertools
import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import supersuit
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv
from pettingzoo.test import parallel_api_test

import ugat_marl
from ugat_marl.envs import (
    agent_indicator,
    appended_mask,
    intersection_names,
    legal_actions,
    masked_observation,
    pad_spaces,
)
from ugat_marl.envs.wrappers import frame_stack, shared_observation
from ugat_marl.errors import ActionError, EpisodeError, OptionError
from ugat_marl.policies import DQN
from ugat_marl.policies.learners.dqn import DQNConfig
from ugat_marl.scenarios import Scenario
from ugat_marl.testing import (
    ToyTraffic,
    check_determinism,
    check_environment,
    check_report,
    failed_checks,
)


def stacked(env: Any) -> Any:
    return frame_stack(env, 3)


def together(env: Any) -> Any:
    return agent_indicator(shared_observation(stacked(pad_spaces(env))))


SINGLE: dict[str, Callable[[Any], Any]] = {
    "pad_spaces": pad_spaces,
    "agent_indicator": agent_indicator,
    "shared_observation": shared_observation,
    "frame_stack": stacked,
}
ALL = {**SINGLE, "together": together}
VECTOR_RULES = {"observation_spaces_are_bounded", "observations_lie_in_their_spaces"}


class Steep(ParallelEnv):
    """Two unequal agents with odd bounds; they count steps, and see ten times their own name."""

    metadata: ClassVar = {"name": "steep", "render_modes": [], "is_parallelizable": True}

    def __init__(self, masks: bool = True, forgets: str = "") -> None:
        self.possible_agents = ["a_1", "b_2"]
        self.agents: list[str] = []
        self.told: list[Any] = []
        self.row = np.float32([1, 10])
        self.masks = masks
        self.forgets = forgets
        self.observation_spaces = {
            "a_1": Box(np.array([1, 0], np.float32), np.array([9, 40], np.float32)),
            "b_2": Box(np.array([-2, 0, 3], np.float32), np.array([7, 50, 60], np.float32)),
        }
        self.action_spaces = {"a_1": Discrete(2), "b_2": Discrete(4)}

    def observation_space(self, agent: str) -> Box:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete:
        return self.action_spaces[agent]

    def _see(self) -> tuple[dict[str, Any], dict[str, Any]]:
        n = len(self.told)
        # One array at every step, as of environments that fill a buffer.
        self.row[0] = 1 + n
        seen = {"a_1": self.row, "b_2": np.float32([n, 20, 30])}
        seen.pop(self.forgets, None)
        infos: dict[str, Any] = {agent: {"time": n} for agent in self.possible_agents}
        if self.masks:
            infos["a_1"]["action_mask"] = np.int8([0, 1])
            infos["b_2"]["action_mask"] = np.int8([1, 0, 0, 1])
        return seen, infos | {"__common__": {"time": n}}

    def reset(self, seed=None, options=None):
        self.agents, self.told = list(self.possible_agents), []
        return self._see()

    def step(self, actions):
        self.told.append(dict(actions))
        seen, infos = self._see()
        no, zero = dict.fromkeys(self.agents, False), dict.fromkeys(self.agents, 0.0)
        return seen, zero, no, no, infos


def is_list(vector: Any, expected: list[float]) -> bool:
    return vector.dtype == np.float32 and vector.tolist() == expected


# --- closed forms -------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [None, "mixed-v1", lambda: ugat_marl.env("single-v1")])
def test_only_environments_of_parallel_agents_are_wrapped(given: Any) -> None:
    given = given() if callable(given) else given
    with pytest.raises(OptionError, match=r"no environment of PettingZoo .* aec_to_parallel"):
        pad_spaces(given)


def test_padding_in_closed_form() -> None:
    env = pad_spaces(Steep())
    observations, infos = env.reset()
    assert is_list(observations["a_1"], [1, 10, 0]) and is_list(observations["b_2"], [0, 20, 30])
    assert infos["a_1"]["action_mask"].tolist() == [0, 1, 0, 0]
    assert infos["b_2"]["action_mask"].tolist() == [1, 0, 0, 1]
    assert infos["a_1"]["action_mask"].dtype == np.int8
    assert infos["__common__"] == {"time": 0} and infos["a_1"]["time"] == 0
    box = env.observation_space("a_1")
    assert box is env.observation_space("b_2")
    assert box.low.tolist() == [-2, 0, 0] and box.high.tolist() == [9, 50, 60]
    assert env.action_space("a_1") == env.action_space("b_2") == Discrete(4)
    after = env.step({"a_1": 1, "b_2": 3})
    assert is_list(after[0]["a_1"], [2, 10, 0])
    assert after[4]["a_1"]["action_mask"].tolist() == [0, 1, 0, 0]


@pytest.mark.parametrize("wrong", [{"a_1": 2}, {"a_1": 3}, {"a_1": -1}, {"a_1": None}, {"c": 0}])
def test_padding_refuses_actions_that_an_agent_does_not_have(wrong: dict[str, Any]) -> None:
    env = pad_spaces(Steep())
    env.reset()
    with pytest.raises(ActionError) as refused:
        env.step({"a_1": 0, "b_2": 0, **wrong})
    for said in ("from 2 on they are padding", "put legal_actions outside pad_spaces"):
        assert (said in str(refused.value)) == (wrong.get("a_1") in (2, 3))
    assert env.told == []  # the environment within heard nothing of it
    env.step({"a_1": 1, "b_2": 0})
    assert env.told == [{"a_1": 1, "b_2": 0}]


def test_padding_makes_masks_where_there_are_none() -> None:
    _, infos = pad_spaces(Steep(masks=False)).reset()
    assert infos["a_1"]["action_mask"].tolist() == [1, 1, 0, 0]
    assert infos["b_2"]["action_mask"].tolist() == [1, 1, 1, 1]


def test_a_padded_space_samples_actions_that_exist() -> None:
    space = pad_spaces(Steep()).action_space("a_1")
    space.seed(0)
    assert {int(space.sample()) for _ in range(50)} == {0, 1}
    assert space.sample(mask=np.int8([0, 0, 0, 1])) == 3  # who brings a mask knows better
    again = copy.deepcopy(space)
    assert {int(again.sample()) for _ in range(50)} == {0, 1}


def test_the_indicator_in_closed_form() -> None:
    env = agent_indicator(Steep())
    observations, _ = env.reset()
    assert is_list(observations["a_1"], [1, 10, 1, 0])
    assert is_list(observations["b_2"], [0, 20, 30, 0, 1])
    # upper bounds differ, where SuperSuit's indicator leaves its own bounds
    assert env.observation_space("a_1").high.tolist() == [9, 40, 1, 1]
    assert env.observation_space("b_2").low.tolist() == [-2, 0, 3, 0, 0]


def test_shared_observations_in_closed_form() -> None:
    env = shared_observation(Steep())
    observations, _ = env.reset()
    assert is_list(observations["a_1"], [1, 10, 1, 10, 0, 20, 30])
    assert is_list(observations["b_2"], [0, 20, 30, 1, 10, 0, 20, 30])
    assert env.observation_space("a_1").high.tolist() == [9, 40, 9, 40, 7, 50, 60]


def test_sharing_needs_everybody() -> None:
    with pytest.raises(EpisodeError, match="b_2"):
        shared_observation(Steep(forgets="b_2")).reset()


def test_frames_in_closed_form() -> None:
    env = frame_stack(Steep(), 3)
    for _ in range(2):  # the second episode knows nothing of the first
        observations, _ = env.reset()
        assert is_list(observations["a_1"], [0, 0, 0, 0, 1, 10])
        for expected in ([0, 0, 1, 10, 2, 10], [1, 10, 2, 10, 3, 10], [2, 10, 3, 10, 4, 10]):
            observations, *_ = env.step({"a_1": 0, "b_2": 0})
            assert is_list(observations["a_1"], expected)
    # a first frame is never zero, the missing ones before it are
    assert env.observation_space("a_1").low.tolist() == [0, 0, 0, 0, 1, 0]
    one, _ = frame_stack(Steep(), 1).reset()
    assert is_list(one["a_1"], [1, 10])
    with pytest.raises(OptionError, match="a whole number from 1"):
        frame_stack(Steep(), 0)
    with pytest.raises(OptionError, match="a whole number from 1"):
        frame_stack(Steep(), np.array([2]))  # type: ignore[arg-type]


def test_masked_observations_in_closed_form() -> None:
    env = masked_observation(pad_spaces(Steep()))
    observations, infos = env.reset()
    assert set(observations["a_1"]) == {"observations", "action_mask"}
    assert is_list(observations["a_1"]["observations"], [1, 10, 0])
    assert observations["a_1"]["action_mask"].tolist() == [0, 1, 0, 0]
    assert env.observation_space("a_1").contains(observations["a_1"])
    observations["a_1"]["action_mask"].fill(0)
    assert infos["a_1"]["action_mask"].tolist() == [0, 1, 0, 0]
    assert env.observation_spaces["a_1"] == env.observation_spaces["b_2"]
    free, _ = masked_observation(Steep(masks=False)).reset()
    assert free["b_2"]["action_mask"].tolist() == [1, 1, 1, 1]


def test_masked_observations_have_the_key_of_the_library() -> None:
    env = masked_observation(Steep(), key="observation")
    observations, _ = env.reset()
    assert set(observations["a_1"]) == {"observation", "action_mask"}
    assert env.observation_space("a_1").contains(observations["a_1"])
    with pytest.raises(OptionError, match="key = 'action_mask'"):
        masked_observation(Steep(), key="action_mask")


def test_forbidden_actions_become_permitted_ones() -> None:
    steep = Steep()
    env = legal_actions(pad_spaces(steep))
    _, infos = env.reset()
    assert infos["a_1"]["action_replaced"] == 0
    # a_1 may choose 1 of its two actions, and b_2 the actions 0 and 3
    for asked, executed in (
        ({"a_1": 1, "b_2": 3}, {"a_1": 1, "b_2": 3}),
        ({"a_1": 0, "b_2": 1}, {"a_1": 1, "b_2": 3}),
        ({"a_1": 3, "b_2": 2}, {"a_1": 1, "b_2": 0}),
    ):
        *_, infos = env.step(asked)
        assert steep.told[-1] == executed
        for agent in asked:
            assert infos[agent]["action_replaced"] == int(asked[agent] != executed[agent])
    with pytest.raises(ActionError):
        env.step({"a_1": 9, "b_2": 0})


def test_a_policy_sees_its_own_command_though_another_one_is_executed() -> None:
    env = legal_actions(
        ugat_marl.parallel_env("single-v1", "phase_order=cyclic", commands=1, duration_s=60)
    )
    env.reset(seed=1)
    observations, *_, infos = env.step({"signal_0": 5})
    assert infos["signal_0"]["action_replaced"] == 1
    assert observations["signal_0"][-9:-1].tolist() == [0, 0, 0, 0, 0, 1, 0, 0]
    observations, *_, infos = env.step({"signal_0": 1})  # nothing of before is remembered
    assert infos["signal_0"]["action_replaced"] == 0
    assert observations["signal_0"][-9:-1].tolist() == [0, 1, 0, 0, 0, 0, 0, 0]
    env.close()


def test_names_of_intersections_pass_delays_and_commands_on() -> None:
    plain = ugat_marl.parallel_env("grid2x2-v1", commands=1, duration_s=60)
    named = intersection_names(ugat_marl.parallel_env("grid2x2-v1", commands=1, duration_s=60))
    lights = plain.unwrapped.intersection_of
    seen: list[list[list[float]]] = [[], []]
    for rows, env, name in ((seen[0], plain, str), (seen[1], named, lights.__getitem__)):
        env.reset(seed=3)
        for step in range(4):
            env.delay_greens({name(agent): 3.0 for agent in lights})
            env.remember({name(agent): 2 for agent in lights})
            actions = {name(agent): step % 2 for agent in lights}
            observations, *_ = env.step(actions)
            rows += [observations[name(agent)].tolist() for agent in lights]
        env.close()
    assert seen[0] == seen[1]
    commands = ugat_marl.parallel_env("grid2x2-v1", duration_s=60)
    commands.reset(seed=3)
    for step in range(4):  # without delays traffic differs
        observations, *_ = commands.step(dict.fromkeys(lights, step % 2))
    commands.close()
    features = len(observations["signal_0"])
    assert observations["signal_0"].tolist() != seen[0][-len(lights)][:features]


@pytest.mark.parametrize("given", [None, [0]])
@pytest.mark.parametrize("what", ["remember", "delay_greens"])
def test_commands_and_delays_that_are_no_dictionary_are_refused(what: str, given: Any) -> None:
    env = intersection_names(ugat_marl.parallel_env("single-v1", commands=1, duration_s=60))
    env.reset(seed=1)
    with pytest.raises(ActionError, match="give a dictionary"):
        getattr(env, what)(given)
    env.close()


@pytest.mark.parametrize("what", ["remember", "delay_greens", "step"])
def test_lights_are_the_only_names(what: str) -> None:
    env = intersection_names(ugat_marl.parallel_env("single-v1", commands=1, duration_s=60))
    env.reset(seed=1)
    with pytest.raises(ActionError, match="for 'signal_0': the traffic lights are A1"):
        getattr(env, what)({"signal_0": 1})
    env.close()


class Masked(Steep):
    """Its first agent has a mask of one's choice."""

    def __init__(self, mask: list[int]) -> None:
        super().__init__()
        self.mask = np.int8(mask)

    def _see(self) -> tuple[dict[str, Any], dict[str, Any]]:
        seen, infos = super()._see()
        infos["a_1"]["action_mask"] = self.mask
        return seen, infos


def test_masks_that_no_agent_can_have_are_refused() -> None:
    env = legal_actions(Masked([0, 0]))
    env.reset(seed=0)
    with pytest.raises(ActionError, match="'a_1' allows no action"):
        env.step({"a_1": 0, "b_2": 0})
    with pytest.raises(ActionError, match="'a_1' has 1 entries; it has 2 actions"):
        pad_spaces(Masked([1])).reset(seed=0)


@pytest.mark.parametrize("wrap", [legal_actions, intersection_names])
@pytest.mark.parametrize("actions", [None, [0]])
def test_actions_that_are_no_dictionary_are_refused(wrap: Any, actions: Any) -> None:
    env = wrap(ugat_marl.parallel_env("single-v1", duration_s=60))
    env.reset(seed=1)
    with pytest.raises(ActionError, match="give a dictionary"):
        env.step(actions)
    env.close()


@pytest.mark.parametrize("wrapper", SINGLE)
def test_masked_observations_come_last(wrapper: str) -> None:
    with pytest.raises(OptionError, match="masked_observation last"):
        SINGLE[wrapper](masked_observation(Steep()))


def test_an_appended_mask_is_that_of_the_infos_behind_the_observation() -> None:
    env, plain = appended_mask(Steep()), Steep()
    seen, infos = env.reset(seed=0)
    own, _ = plain.reset(seed=0)
    for agent in env.possible_agents:
        mask = infos[agent]["action_mask"]
        np.testing.assert_array_equal(seen[agent], np.append(own[agent], mask))
        assert env.observation_space(agent).contains(seen[agent])
    unmasked = appended_mask(Steep(masks=False))
    seen, _ = unmasked.reset(seed=0)
    assert all(seen[a][-unmasked.action_space(a).n :].all() for a in unmasked.possible_agents)


def test_actions_must_be_counted_from_zero() -> None:
    env = Steep()
    env.action_spaces["a_1"] = Discrete(2, start=1)
    with pytest.raises(OptionError, match="Discrete"):
        pad_spaces(env)


# --- what stays ---------------------------------------------------------------------------------


def episode(env: Any, actions: Any = None) -> tuple[list[Any], list[Any], list[Any]]:
    """Observations, rewards and states of an episode in which everybody does the same."""
    observations, infos = env.reset(seed=3)
    seen, rewards, states = [copy.deepcopy(observations)], [], [env.state()]
    keys = {agent: set(info) for agent, info in infos.items()}
    while env.agents:
        observations, got, _, _, infos = env.step(dict.fromkeys(env.agents, len(rewards) % 2))
        seen.append(copy.deepcopy(observations))
        rewards.append(got)
        states.append(env.state())
        assert {agent: set(info) for agent, info in infos.items()} == keys
    return seen, rewards, states


@pytest.mark.parametrize("order", list(itertools.permutations(SINGLE)), ids="-".join)
def test_wrappers_stack_in_any_order(order: tuple[str, ...]) -> None:
    _, rewards, states = episode(ToyTraffic())
    env: Any = ToyTraffic()
    for name in order:
        env = SINGLE[name](env)
    masked = masked_observation(env)
    seen, same_rewards, same_states = episode(env)
    assert same_rewards == rewards
    np.testing.assert_array_equal(same_states, states)
    for moment in seen:
        for agent, vector in moment.items():
            assert env.observation_space(agent).contains(vector)
            assert vector.shape == masked.observation_space(agent)["observations"].shape
    assert env.state_space is env.base.state_space
    assert isinstance(env.base, ToyTraffic) and isinstance(masked.base, ToyTraffic)
    assert {env.action_space(agent).n for agent in env.possible_agents} == {3}
    assert env.step({}) == ({}, {}, {}, {}, {})  # after the end: SuperSuit's black_death asks


def test_unwrapped_shows_the_spaces_that_are_seen_and_all_else_within() -> None:
    env = agent_indicator(pad_spaces(ToyTraffic()))
    assert env.unwrapped.observation_spaces["tee_0"] is env.observation_space("tee_0")
    assert env.unwrapped.action_spaces["tee_0"].n == 3
    assert env.unwrapped.intersection_of == ToyTraffic().intersection_of
    episode(env)
    assert env.unwrapped.scores() == env.base.scores()


def test_a_learner_of_the_suite_learns_in_them() -> None:
    env = together(ToyTraffic())
    learner = DQN.of(env, DQNConfig(hidden=(4,), warmup_decisions=5, shared=True))
    policy = learner.learn(env, 2, seed=0)
    observations, infos = env.reset(seed=1)
    assert policy.act(observations, infos)["tee_0"] in (0, 1)


def test_options_of_the_environment_come_through() -> None:
    env = together(ugat_marl.parallel_env("single-v1", observation="queue"))
    assert env.env_options == {"observation": "queue", "neighbours": 0}
    assert DQN.of(env).policy().env_options == env.env_options


# --- SuperSuit ----------------------------------------------------------------------------------

COUNTERPARTS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "pad_spaces": (
        pad_spaces,
        lambda env: supersuit.pad_action_space_v0(supersuit.pad_observations_v0(env)),
    ),
    "agent_indicator": (
        lambda env: agent_indicator(pad_spaces(env)),
        lambda env: supersuit.agent_indicator_v0(supersuit.pad_observations_v0(env)),
    ),
    "frame_stack": (stacked, lambda env: supersuit.frame_stack_v1(env, 3)),
}


@pytest.mark.parametrize("name", COUNTERPARTS)
def test_supersuit_gives_the_same_numbers(name: str) -> None:
    ours, theirs = (make(ToyTraffic()) for make in COUNTERPARTS[name])
    for agent in ours.possible_agents:
        assert ours.observation_space(agent) == theirs.observation_space(agent)
    (seen, rewards, _), (their_seen, their_rewards, _) = episode(ours), episode(theirs)
    assert rewards == their_rewards
    for moment, other in zip(seen, their_seen, strict=True):
        for agent, vector in moment.items():
            np.testing.assert_array_equal(vector, other[agent])


def test_supersuit_wraps_them() -> None:
    env = supersuit.pettingzoo_env_to_vec_env_v1(together(ToyTraffic()))
    seen, _ = env.reset(seed=1)
    assert seen.shape == (3, 3 * 7 + 9 * 7 + 3)  # own frames, everybody's frames, one-hot


# --- conformance --------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _no_warnings() -> Iterator[None]:
    """PettingZoo warns where others would be confused."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        yield


def api(env: Any) -> None:
    parallel_api_test(env, num_cycles=30)
    env.close()


@pytest.mark.parametrize("wrapper", ALL)
def test_a_wrapped_toy_conforms(wrapper: str) -> None:
    def make() -> Any:
        return ALL[wrapper](ToyTraffic())

    results = check_environment(make) + check_determinism(make)
    assert not failed_checks(results), check_report(results).plain
    api(make())
    api(masked_observation(make()))


def test_masked_observations_conform_but_for_being_dictionaries() -> None:
    results = check_environment(lambda: masked_observation(together(ToyTraffic())))
    assert {result.name for result in failed_checks(results)} == VECTOR_RULES, check_report(
        results
    ).plain


@pytest.fixture(scope="module")
def scenarios() -> dict[str, Scenario]:
    """The scenarios, read once."""
    return {name: ugat_marl.load_scenario(name) for name in ("grid2x2-v1", "mixed-v1")}


@pytest.mark.parametrize("name", ["grid2x2-v1", "mixed-v1"])
def test_a_wrapped_road_network_conforms(name: str, scenarios: dict[str, Scenario]) -> None:
    def make() -> Any:
        return together(ugat_marl.parallel_env(scenarios[name], duration_s=60))

    results = check_environment(make)
    assert not failed_checks(results), check_report(results).plain
    env = make()
    sizes = {(env.observation_space(a).shape, env.action_space(a).n) for a in env.possible_agents}
    assert len(sizes) == 1
    api(env)
    api(masked_observation(make()))


# --- the page -----------------------------------------------------------------------------------


def test_the_page_names_every_wrapper_and_its_example_runs() -> None:
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "wrappers.md").read_text(
        encoding="utf-8"
    )
    named = set(re.findall(r"^\| `(\w+)\(env", page, flags=re.MULTILINE))
    others = {"appended_mask", "legal_actions", "masked_observation", "intersection_names"}
    assert named == {*SINGLE, *others}
    example = re.search(r"```python\n(.*?)```", page, flags=re.DOTALL)
    assert example is not None
    names: dict[str, Any] = {}
    exec(example[1], names)
    names["env"].close()


def test_an_action_that_a_light_lacks_is_told_with_its_name() -> None:
    named = intersection_names(pad_spaces(ugat_marl.parallel_env("mixed-v1", duration_s=20)))
    named.reset(seed=3)
    spaces_: dict[str, Any] = {light: named.action_space(light) for light in named.agents}
    light = next(light for light, space in spaces_.items() if space.own < space.n)
    with pytest.raises(ActionError, match=f"action of agent '{light}' is"):
        named.step({**dict.fromkeys(named.agents, 0), light: spaces_[light].own})
    named.close()


@pytest.mark.parametrize("equal", [True, False])
def test_names_of_lights_fail_the_checks_that_the_page_says(equal: bool) -> None:
    report = check_environment(lambda: intersection_names(ToyTraffic(equal=equal)))
    failed = {check.name for check in failed_checks(report)}
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "wrappers.md").read_text("utf-8")
    told = page.partition("Under `intersection_names` two fail, ")[2].partition(", because")[0]
    always, _, more = told.partition(", and, where agents have unequal spaces, ")
    assert failed == {*re.findall(r"`(\w+)`", always if equal else always + more)}


def test_agents_are_named_by_their_lights_and_nothing_else_changes() -> None:
    plain = ugat_marl.parallel_env("mixed-v1", duration_s=300)
    named = intersection_names(ugat_marl.parallel_env("mixed-v1", duration_s=300))
    light = plain.intersection_of
    assert named.possible_agents == [light[agent] for agent in plain.possible_agents]
    assert {*named.possible_agents} == {item.id for item in plain.network.intersections}
    seen, infos = plain.reset(seed=3)
    named_seen, named_infos = named.reset(seed=3)
    for step in range(4):
        for agent in plain.agents:
            assert np.array_equal(seen[agent], named_seen[light[agent]])
            assert named.observation_space(light[agent]).contains(named_seen[light[agent]])
            mask = infos[agent]["action_mask"]
            assert np.array_equal(mask, named_infos[light[agent]]["action_mask"])
        actions = {agent: step % plain.action_space(agent).n for agent in plain.agents}
        seen, rewards, _, _, infos = plain.step(actions)
        named_seen, named_rewards, _, ends, named_infos = named.step(
            {light[agent]: action for agent, action in actions.items()}
        )
        assert named_rewards == {light[agent]: value for agent, value in rewards.items()}
        assert {*ends} == {*light.values()}
    with pytest.raises(ActionError, match="'signala_0': the traffic lights are"):
        named.step({"signala_0": 0})
    first = named.possible_agents[0]
    with pytest.raises(ActionError, match=f"action of agent '{first}' is 99"):
        named.step({**dict.fromkeys(named.agents, 0), first: 99})
    with pytest.raises(ActionError, match=f"delay of agent '{first}' is -1"):
        named.delay_greens({first: -1.0})
    with pytest.raises(ActionError, match=f"no action for agent '{named.possible_agents[1]}'"):
        named.remember({first: 0})
    groups = {group: [light[a] for a in own] for group, own in plain.agent_groups.items()}
    assert named.agent_groups == groups
    assert {*named.layouts} == {*named.recorded_layouts} == {*light.values()}
    named.remember(dict.fromkeys(named.agents, 0))
    named.delay_greens(dict.fromkeys(named.agents, 1.0))
    plain.close()
    named.close()
    parallel_api_test(intersection_names(ugat_marl.parallel_env("single-v1", duration_s=100)), 12)
    with pytest.raises(OptionError, match="intersection_of"):
        intersection_names(Steep())
