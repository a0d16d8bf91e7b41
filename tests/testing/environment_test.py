"""Each check of environments catches an environment that breaks just its rule."""

from __future__ import annotations

import subprocess
import sys
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from pettingzoo.test import parallel_api_test

import ugat_marl
from ugat_marl.effects import scenario_in_domain
from ugat_marl.errors import ActionError
from ugat_marl.grounding import GroundedEnv, PhaseTransform
from ugat_marl.testing import (
    ENVIRONMENT_CHECKS,
    ConformanceError,
    EnvironmentCase,
    ToyTraffic,
    check_environment,
    check_report,
    failed_checks,
)

BROKEN: list[tuple[str, type[ToyTraffic]]] = []


def breaks(check: str) -> Any:
    """Marks an environment as one that exactly `check` must catch."""

    def mark(subject: type[ToyTraffic]) -> type[ToyTraffic]:
        BROKEN.append((check, subject))
        return subject

    return mark


class Telling(ToyTraffic):
    """An environment whose infos are edited by `tell`."""

    def tell(self, infos: dict[str, Any]) -> None: ...

    def _infos(self) -> dict[str, dict[str, Any]]:
        infos = super()._infos()
        self.tell(infos)
        return infos


class Giving(ToyTraffic):
    """An environment whose step results are edited by `give`."""

    def give(self, results: list[Any]) -> None: ...

    def step(self, actions):
        results = list(super().step(actions))
        self.give(results)
        return tuple(results)


# --- an episode ---------------------------------------------------------------------------------


@breaks("an_episode_runs")
class ResetForgetsAgents(ToyTraffic):
    def reset(self, seed=None, options=None):
        result = super().reset(seed)
        self.agents = []
        return result


# --- life ---------------------------------------------------------------------------------------


@breaks("nothing_starts_before_reset")
class StartsAProcess(ToyTraffic):
    def __init__(self):
        super().__init__()
        self.process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)

    def close(self):
        super().close()
        process, self.process = self.process, None
        if process is not None:
            process.communicate()

    def __getstate__(self):
        return {**self.__dict__, "process": None}


@breaks("environments_can_be_sent")
class HoldsALambda(ToyTraffic):
    def __init__(self):
        super().__init__()
        self.reward = lambda queue: -queue.sum()


@breaks("environments_can_be_sent")
class ForgetsWhenSent(ToyTraffic):
    def __setstate__(self, state):
        self.__dict__.update(state)
        self.possible_agents = []


@breaks("reset_takes_seed_and_options")
class KnowsItsOptions(ToyTraffic):
    def reset(self, seed=None, options=None):
        if options:
            raise TypeError("no options, please")
        return super().reset(seed)


@breaks("reset_and_close_repeat")
class ClosesOnce(ToyTraffic):
    closed = False

    def close(self):
        if self.closed:
            raise RuntimeError("already closed")
        self.closed = True


@breaks("reset_and_close_repeat")
class ResetsOnlyAtTheEnd(ToyTraffic):
    def reset(self, seed=None, options=None):
        if self.agents and self._step > 0:
            raise RuntimeError("the episode is not over")
        return super().reset(seed)


@breaks("close_ends_processes")
class LeavesAProcess(ToyTraffic):
    def reset(self, seed=None, options=None):
        # It ends by itself when this process does, since its standard input closes.
        self.process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
        LEFT.append(self.process)
        return super().reset(seed)


LEFT: list[subprocess.Popen[bytes]] = []


# --- what is declared ---------------------------------------------------------------------------


@breaks("agents_are_named")
class NamedWithADot(ToyTraffic):
    def __init__(self):
        super().__init__()
        self.rename({"cross_0": "a.b_0", "cross_1": "a.b_1"}, "a.b")

    def rename(self, names, group):
        for part in ("layouts", "intersection_of", "observation_spaces", "action_spaces"):
            own = getattr(self, part)
            setattr(self, part, {names.get(a, a): value for a, value in own.items()})
        self.possible_agents = [names.get(a, a) for a in self.possible_agents]
        self.agent_groups = {group: list(names.values()), "tee": ["tee_0"]}


@breaks("agents_are_named")
class NamedWithoutANumber(NamedWithADot):
    def __init__(self):
        ToyTraffic.__init__(self)
        self.rename({"cross_0": "x_north", "cross_1": "x_south"}, "x")


@breaks("agents_have_traffic_lights")
class WithoutTrafficLights(ToyTraffic):
    def __init__(self):
        super().__init__()
        del self.intersection_of


@breaks("agents_have_traffic_lights")
class SharesATrafficLight(ToyTraffic):
    def __init__(self):
        super().__init__()
        self.intersection_of["cross_1"] = "A"


@breaks("groups_are_listed")
class ListsNoGroups(ToyTraffic):
    def __init__(self):
        super().__init__()
        self.agent_groups = {"all": self.possible_agents}


@breaks("groups_have_equal_spaces")
class UnequalGroup(NamedWithADot):
    def __init__(self):
        ToyTraffic.__init__(self)
        self.rename({"tee_0": "cross_2"}, "cross")
        self.agent_groups = {"cross": self.possible_agents}


@breaks("spaces_are_the_same_objects")
class MakesSpacesAnew(ToyTraffic):
    def action_space(self, agent):
        return Discrete(self.layouts[agent].phases)


@breaks("spaces_are_listed")
class ListsNoSpaces(ToyTraffic):
    def __init__(self):
        super().__init__()
        self.hidden, self.observation_spaces = self.observation_spaces, {}

    def observation_space(self, agent):
        return self.hidden[agent]


@breaks("observation_spaces_are_bounded")
class UnboundedObservations(ToyTraffic):
    def __init__(self):
        super().__init__()
        for agent, layout in self.layouts.items():
            self.observation_spaces[agent] = Box(0, np.inf, (layout.size,), np.float32)


@breaks("observation_spaces_are_bounded")
class DoubleObservations(ToyTraffic):
    def __init__(self):
        super().__init__()
        for agent, layout in self.layouts.items():
            self.observation_spaces[agent] = Box(0, 1, (layout.size,), np.float64)

    def _observe(self):
        return {agent: vector.astype(np.float64) for agent, vector in super()._observe().items()}


@breaks("action_spaces_count_from_zero")
class CountsFromOne(ToyTraffic):
    def __init__(self):
        super().__init__()
        self.action_spaces = {a: Discrete(v.phases, start=1) for a, v in self.layouts.items()}

    def step(self, actions):
        self.action_spaces = {a: Discrete(v.phases) for a, v in self.layouts.items()}
        try:
            return super().step({agent: action - 1 for agent, action in actions.items()})
        finally:
            self.action_spaces = {a: Discrete(v.phases, start=1) for a, v in self.layouts.items()}


@breaks("state_space_is_bounded")
class UnboundedState(ToyTraffic):
    def __init__(self):
        super().__init__()
        self.state_space = Box(0, np.inf, self.state_space.shape, np.float32)


@breaks("metadata_is_complete")
class Nameless(ToyTraffic):
    metadata: ClassVar = {"render_modes": ["rgb_array"], "is_parallelizable": True}


@breaks("metadata_is_complete")
class NotParallelizable(ToyTraffic):
    metadata: ClassVar = {**ToyTraffic.metadata, "is_parallelizable": False}


@breaks("metadata_is_complete")
class DrawsUnlisted(ToyTraffic):
    metadata: ClassVar = {**ToyTraffic.metadata, "render_modes": []}


@breaks("attributes_do_not_mislead")
class PretendsToBeMany(ToyTraffic):
    num_envs = 1


@breaks("attributes_do_not_mislead")
class HasADevice(ToyTraffic):
    device = "cpu"


# --- what an episode gives ----------------------------------------------------------------------


@breaks("agents_stay_the_same")
class RemovesPossibleAgents(ToyTraffic):
    def reset(self, seed=None, options=None):
        result = super().reset(seed)
        self.possible_agents = sorted(self.possible_agents)
        self.agents = ["cross_0", "tee_0", "cross_1"]
        return result


@breaks("observations_lie_in_their_spaces")
class CountsBeyondCapacity(ToyTraffic):
    def _observe(self):
        return {agent: vector + np.float32(0.5) for agent, vector in super()._observe().items()}


@breaks("observations_lie_in_their_spaces")
class LastObservationIsEmpty(ToyTraffic):
    def _observe(self):
        vectors = super()._observe()
        return {a: v[:0] for a, v in vectors.items()} if self._step == self.steps else vectors


@breaks("state_lies_in_its_space")
class StateEndsWithTheEpisode(ToyTraffic):
    def state(self):
        if not self.agents:
            raise RuntimeError("the episode is over")
        return super().state()


@breaks("state_lies_in_its_space")
class StateShrinks(ToyTraffic):
    def state(self):
        return super().state()[: 3 if not self.agents else None]


@breaks("infos_keep_their_keys")
class TellsMoreLater(Telling):
    def tell(self, infos):
        if self._step:
            infos["tee_0"]["waited"] = 1.0


@breaks("infos_keep_their_keys")
class TellsInChangingShapes(Telling):
    def tell(self, infos):
        infos["tee_0"]["queue"] = np.zeros(self._step % 2 + 1)


@breaks("infos_keep_their_keys")
class TellsOfAllLater(Telling):
    def tell(self, infos):
        if self._step >= 3:
            infos["__common__"] = {"waited": 1.0}


@breaks("infos_hold_numbers")
class TellsInWords(Telling):
    def tell(self, infos):
        infos["tee_0"]["light"] = "B"


@breaks("infos_hold_numbers")
class TellsNothing(Telling):
    def tell(self, infos):
        infos["tee_0"]["next"] = None


@breaks("infos_hold_numbers")
class TellsToNobody(Telling):
    def tell(self, infos):
        infos["common"] = {"time": self._step}


@breaks("masks_allow_something")
class MasksAreBooleans(Telling):
    def tell(self, infos):
        infos["tee_0"]["action_mask"] = np.ones(2, bool)


@breaks("masks_allow_something")
class MasksForbidEverything(Telling):
    def tell(self, infos):
        infos["tee_0"]["action_mask"].fill(self._step != 3)


@breaks("masks_allow_something")
class MasksNothing(Telling):
    def tell(self, infos):
        del infos["tee_0"]["action_mask"]


@breaks("executed_actions_are_told")
class ExecutedTheImpossible(Telling):
    def tell(self, infos):
        infos["tee_0"]["executed_action"] = 2


@breaks("executed_actions_are_told")
class KeepsTheExecutedSecret(Telling):
    def tell(self, infos):
        del infos["tee_0"]["executed_action"]


@breaks("everybody_acts_to_the_end")
class DiesEarly(ToyTraffic):
    def step(self, actions):
        here = self.agents
        if len(here) == 2:  # the dead one keeps its phase, so that no other check stumbles
            self.agents, actions = self.possible_agents, {**actions, "cross_1": 0}
        results = super().step(actions)
        if self.agents and self._step >= 3:
            self.agents = ["cross_0", "tee_0"]
            results[3]["cross_1"] = True
        for part in results:
            if "cross_1" not in here:
                del part["cross_1"]
        return results


@breaks("everybody_acts_to_the_end")
class Terminates(Giving):
    def give(self, results):
        if not self.agents:
            results[2], results[3] = results[3], results[2]


@breaks("everybody_acts_to_the_end")
class StaysAfterTheEnd(Giving):
    def give(self, results):
        self.agents = self.possible_agents


@breaks("values_are_plain")
class RewardsOfNumpy(Giving):
    def give(self, results):
        results[1] = {agent: np.float64(reward) for agent, reward in results[1].items()}


@breaks("values_are_plain")
class FlagsOfNumpy(Giving):
    def give(self, results):
        results[3] = {agent: np.bool_(flag) for agent, flag in results[3].items()}


@breaks("values_are_plain")
class RewardIsNotANumber(Giving):
    def give(self, results):
        if self._step == 5:
            results[1]["tee_0"] = float("nan")


@breaks("results_are_fresh")
class ReusesItsArrays(ToyTraffic):
    def _observe(self):
        if self._step == 0:
            self.kept = {a: np.empty(v.size, np.float32) for a, v in self.layouts.items()}
        for agent, vector in self._vectors().items():
            self.kept[agent][:] = vector
        return dict(self.kept)


@breaks("results_are_fresh")
class ReusesItsDict(Giving):
    kept: ClassVar[dict[str, float]] = {}

    def give(self, results):
        self.kept.update(results[1])
        results[1] = self.kept


@breaks("what_was_given_may_be_changed")
class KeepsWhatItGives(ToyTraffic):
    def _observe(self):
        self.given = super()._observe()
        return self.given

    def state(self):
        if self._step == 0:  # wrong from the first step on
            return super().state()
        return np.concatenate(
            [self.given.get(a, np.zeros(v.size)) for a, v in self.layouts.items()]
        ).astype(np.float32)


@breaks("what_was_given_may_be_changed")
class GivesOneMask(Telling):
    def tell(self, infos):
        if self._step == 0:
            self.kept = {agent: info["action_mask"] for agent, info in infos.items()}
        for agent, info in infos.items():
            info["action_mask"] = self.kept[agent]


@breaks("what_was_given_may_be_changed")
class RewardsWhatWasGiven(ToyTraffic):
    def _observe(self):
        self.given = super()._observe()
        return self.given.copy()

    def step(self, actions):
        before = {agent: float(vector.sum()) for agent, vector in self.given.items()}
        observations, _, *others = super().step(actions)
        return observations, before, *others


@breaks("pictures_are_pictures")
class DrawsFloats(ToyTraffic):
    def render(self):
        return super().render() / 255.0


@breaks("wrong_actions_are_refused")
class WrapsAround(ToyTraffic):
    def step(self, actions):
        return super().step({a: int(v) % self.action_spaces[a].n for a, v in actions.items()})


@breaks("wrong_actions_are_refused")
class StumblesOverWrongActions(ToyTraffic):
    def step(self, actions):
        try:
            return super().step(actions)
        except ActionError:
            self.agents = []
            raise


@breaks("wrong_actions_are_refused")
class MovesBeforeItRefuses(ToyTraffic):
    def step(self, actions):
        try:
            return super().step(actions)
        except ActionError:
            self._serve("cross_0", 0)
            raise


@pytest.mark.parametrize(
    ("check", "subject"),
    BROKEN,
    ids=[f"{check}-{subject.__name__}" for check, subject in BROKEN],
)
def test_a_broken_environment_is_caught_by_its_check(check: str, subject: type[ToyTraffic]) -> None:
    results = check_environment(subject)
    caught = {result.name: result.message for result in results if result.passed is False}
    try:
        assert set(caught) == {check}, caught
        assert len(caught[check]) > 40  # what is wrong, and the way out
    finally:
        while LEFT:
            LEFT.pop().communicate()


def test_every_check_has_a_broken_environment() -> None:
    assert {name for name, _ in BROKEN} == {check.__name__ for check in ENVIRONMENT_CHECKS}


def test_the_toy_environment_passes() -> None:
    assert not failed_checks(check_environment(ToyTraffic))
    parallel_api_test(ToyTraffic(), num_cycles=30)


def test_the_toy_environment_loses_no_vehicle() -> None:
    env = ToyTraffic(steps=30)
    episode = EnvironmentCase(lambda: env, seed=4).episode
    queued = -sum(episode.moments[-1].parts["rewards"].values())
    scores = env.scores()
    assert scores.due == scores.departed + scores.backlog > 200
    assert scores.departed == scores.throughput + queued
    empty = EnvironmentCase(lambda: ToyTraffic(arrivals=0)).episode
    assert not any(sum(moment.parts["rewards"].values()) for moment in empty.moments[1:])


@pytest.mark.parametrize("scenario", ["single-v1", "grid2x2-v1", "mixed-v1"])
def test_the_suites_environments_pass(scenario: str) -> None:
    assert not failed_checks(
        check_environment(lambda: ugat_marl.parallel_env(scenario, duration_s=150))
    )


@pytest.mark.parametrize(
    "options",
    [
        {"observation": "pressure", "reward": "pressure", "neighbours": 1},
        {"observation": "waiting", "reward": "waiting", "render_mode": "rgb_array"},
        {"observation": "movements", "signals": "programme"},
        {"domain": "V4", "observation": "density"},
        {"simulator": "inprocess", "observation": "queue"},
    ],
    ids=lambda options: "-".join(map(str, options.values())),
)
def test_the_options_of_the_suites_environments_pass(options: dict[str, Any]) -> None:
    scenario = scenario_in_domain(ugat_marl.load_scenario("mixed-v1"), options.pop("domain", "sim"))
    assert not failed_checks(
        check_environment(lambda: ugat_marl.parallel_env(scenario, duration_s=60, **options))
    )


def grounded() -> GroundedEnv:
    env = ugat_marl.parallel_env("mixed-v1", duration_s=100)
    transform = PhaseTransform(env.layouts, 0)
    transform.forward.fitted.fill_(True)
    transform.inverse.fitted.fill_(True)
    return GroundedEnv(env, transform)


def test_a_grounded_environment_passes() -> None:
    assert not failed_checks(check_environment(grounded))


def test_one_check_can_be_made_alone() -> None:
    check = {check.__name__: check for check in ENVIRONMENT_CHECKS}["masks_allow_something"]
    case = EnvironmentCase(dict(BROKEN)["masks_allow_something"])
    with pytest.raises(ConformanceError, match="action_mask"):
        check(case)
    with pytest.raises(AssertionError):  # so that pytest shows it as a failure
        check(case)
    case.close()


def test_what_cannot_be_checked_is_neither_passed_nor_failed() -> None:
    class Breaks(ToyTraffic):
        def step(self, actions):
            raise ZeroDivisionError("oh")

    results = {result.name: result for result in check_environment(Breaks)}
    assert results["an_episode_runs"].passed is False
    assert "ZeroDivisionError: oh" in results["an_episode_runs"].message
    assert results["masks_allow_something"].passed is None
    assert results["agents_are_named"].passed is True


def test_an_episode_without_end_is_given_up() -> None:
    case = EnvironmentCase(lambda: ToyTraffic(steps=10**9), max_steps=50)
    with pytest.raises(ConformanceError, match="not ended after 50 steps"):
        _ = case.episode


def test_the_report_names_what_failed() -> None:
    results = check_environment(dict(BROKEN)["values_are_plain"])
    text = check_report(results).plain
    assert "FAILED  values are plain\n          after step" in text
    assert text.endswith(f"{len(results) - 1} of {len(results)} checks passed")
    assert not any("\n" in result.message for result in results)
