"""Each check of policies catches a policy that breaks just its rule."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

import ugat_marl
from ugat_marl.policies import DQN, RULE_NAMES, make_rule
from ugat_marl.testing import POLICY_CHECKS, ToyTraffic, check_policy, failed_checks

BROKEN: list[tuple[str, type[Good]]] = []


class Good:
    """Weighs lanes by seeded numbers and takes the best allowed phase; longer held, better."""

    def __init__(self) -> None:
        self.env_options: Mapping[str, Any] = {}
        self.weights = np.random.default_rng(3).normal(size=(8, 8))

    def reset(self, seed: int) -> None:
        self.generator = np.random.default_rng(seed)
        self.held: dict[str, int] = {}

    def act(self, observations, infos):
        noise = {agent: self.generator.normal() for agent in sorted(observations)}
        return {
            agent: self.best(agent, observations[agent], infos, noise) for agent in observations
        }

    def best(self, agent, observation, infos, noise) -> int:
        mask = infos[agent]["action_mask"]
        scores = self.weights[: mask.size, : observation.size] @ observation + noise[agent]
        scores[self.held.get(agent, 0)] += 0.1
        self.held[agent] = int(np.where(mask > 0, scores, -np.inf).argmax())
        return self.held[agent]

    def save(self, path) -> None:
        np.save(path.with_suffix(".npy"), self.weights)
        path.touch()

    def load(self, path) -> None:
        self.weights = np.load(path.with_suffix(".npy"))


def breaks(check: str) -> Any:
    """Marks a policy as one that exactly `check` must catch."""

    def mark(subject: type[Good]) -> type[Good]:
        BROKEN.append((check, subject))
        return subject

    return mark


@breaks("it_is_a_policy")
class WithoutOptions(Good):
    def __init__(self):
        super().__init__()
        self.env_options = None


@breaks("it_answers")
class GivesUp(Good):
    def act(self, observations, infos):
        raise FloatingPointError("too much traffic")


@breaks("it_answers")
class AnswersInAList(Good):
    def act(self, observations, infos):
        return list(super().act(observations, infos).values())


@breaks("it_acts_for_every_agent")
class ForgetsAnAgent(Good):
    def act(self, observations, infos):
        actions = super().act(observations, infos)
        del actions["tee_0"]
        return actions


@breaks("it_acts_for_every_agent")
class InventsAnAgent(Good):
    def act(self, observations, infos):
        return {**super().act(observations, infos), "tee_1": 0}


@breaks("its_actions_are_phases")
class GoesBeyondTheLast(Good):
    def act(self, observations, infos):
        beyond = {a: i["action_mask"].size for a, i in infos.items() if i["action_mask"].all()}
        return {**super().act(observations, infos), **beyond}


@breaks("its_actions_are_phases")
class AnswersInFloats(Good):
    def act(self, observations, infos):
        return {agent: float(action) for agent, action in super().act(observations, infos).items()}


@breaks("it_respects_masks")
class IgnoresMasks(Good):
    def act(self, observations, infos):
        free = {a: {"action_mask": np.ones_like(i["action_mask"])} for a, i in infos.items()}
        return super().act(observations, free)


@breaks("a_seed_repeats_its_answers")
class IgnoresItsSeed(Good):
    def reset(self, seed):
        super().reset(seed)
        self.generator = np.random.default_rng()

    def best(self, agent, observation, infos, noise):
        return int(self.generator.choice(np.flatnonzero(infos[agent]["action_mask"])))


@breaks("a_seed_repeats_its_answers")
class RemembersLastTime(Good):
    def reset(self, seed):
        held = getattr(self, "held", {})
        super().reset(seed)
        self.held = held

    def best(self, agent, observation, infos, noise):
        self.held[agent] = self.held.get(agent, 0) + 1
        allowed = np.flatnonzero(infos[agent]["action_mask"])
        return int(allowed[self.held[agent] // 5 % allowed.size])


@breaks("order_does_not_matter")
class ServesTheFirst(Good):
    def act(self, observations, infos):
        drawn = {agent: self.generator.random() for agent in observations}
        return {
            agent: int(allowed[int(drawn[agent] * allowed.size)])
            for agent in observations
            for allowed in [np.flatnonzero(infos[agent]["action_mask"])]
        }


@breaks("what_it_is_given_stays_as_it_is")
class ScalesInPlace(Good):
    def best(self, agent, observation, infos, noise):
        observation *= 2
        return super().best(agent, observation, infos, noise)


@breaks("saving_keeps_its_answers")
class SavesZeros(Good):
    def save(self, path):
        np.save(path.with_suffix(".npy"), np.zeros((8, 8)))
        path.touch()


@breaks("saving_keeps_its_answers")
class CannotLoad(Good):
    def load(self, path):
        raise OSError("not a policy")


@breaks("saving_keeps_its_answers")
class SavesNothing(Good):
    def save(self, path):
        self.place = path

    def load(self, path):
        if path != self.place:
            raise FileNotFoundError(path)


@breaks("saving_keeps_its_answers")
class LoadsNothing(Good):
    def load(self, path):
        pass


@breaks("saving_keeps_its_answers")
class MakesItselfAnew(Good):
    @classmethod
    def load(cls, path):
        return cls()


@breaks("saving_keeps_its_answers")
class IsMadeAnew(Good):
    @staticmethod
    def load(path):
        return IsMadeAnew()


@breaks("saving_keeps_its_answers")
class ReturnsNoPolicy(Good):
    @classmethod
    def load(cls, path):
        np.load(path.with_suffix(".npy"))


@pytest.mark.parametrize(
    ("check", "subject"),
    BROKEN,
    ids=[f"{check}-{subject.__name__}" for check, subject in BROKEN],
)
def test_a_broken_policy_is_caught_by_its_check(check: str, subject: type[Good]) -> None:
    caught = {
        result.name: result.message
        for result in check_policy(subject(), ToyTraffic)
        if result.passed is False
    }
    assert set(caught) == {check}, caught


def test_every_check_has_a_broken_policy() -> None:
    assert {name for name, _ in BROKEN} == {check.__name__ for check in POLICY_CHECKS}


def test_a_good_policy_passes() -> None:
    assert not failed_checks(check_policy(Good(), ToyTraffic))


def test_what_a_failing_policy_does_not_show_is_not_checked() -> None:
    results = {result.name: result.passed for result in check_policy(GivesUp(), ToyTraffic)}
    assert results["it_is_a_policy"] is True
    assert results["it_respects_masks"] is None and results["order_does_not_matter"] is None


@pytest.mark.parametrize("name", RULE_NAMES)
def test_the_controllers_pass(name: str) -> None:
    scenario = ugat_marl.load_scenario("mixed-v1")
    options: dict[str, Any] = {"duration_s": 300}
    env = ugat_marl.parallel_env(scenario, **options)
    options |= make_rule(name, env).env_options
    policy = make_rule(name, ugat_marl.parallel_env(scenario, **options))
    assert not failed_checks(
        check_policy(policy, lambda: ugat_marl.parallel_env(scenario, **options))
    )


def test_a_learned_policy_passes() -> None:
    assert not failed_checks(check_policy(DQN.of(ToyTraffic(), seed=2).policy(), ToyTraffic))
