"""Checks of a policy against the promises of `ugat_marl.policies.protocols.Policy`."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ugat_marl.policies import Policy
from ugat_marl.seeding import numpy_generator
from ugat_marl.testing.episodes import (
    EnvironmentCase,
    MakeEnv,
    StepReturn,
    allowed_actions,
    different,
)
from ugat_marl.testing.results import (
    CheckResult,
    ConformanceError,
    Listening,
    NotChecked,
    require,
    run_checks,
)

Answers = list[Mapping[str, Any]]


class PolicyCase(EnvironmentCase):
    """Policy that is checked, with an episode of random actions as its questions.

    Args:
        policy: The policy.
        make_env: Function that returns a new environment with the policy's `env_options`.
        seed: Seed of the episode and of `policy.reset`.
    """

    def __init__(self, policy: Policy, make_env: MakeEnv, seed: int = 1) -> None:
        super().__init__(make_env, seed)
        self.policy = policy
        self._first: Answers | None = None
        self._again: Answers | None = None
        self._speechless = False

    @property
    def questions(self) -> Sequence[StepReturn]:
        """Moments of the episode at which a policy acts: all but the last."""
        return self.episode.moments[:-1]

    @property
    def answers(self) -> Answers:
        """The policy's answers to all questions after `reset(seed)`."""
        if self._speechless:
            raise NotChecked("not checked, because act() failed")
        if self._first is None:
            self.need_episode()  # a failure here is not the policy's fault
            self._speechless = True
            self._first = self.ask(self.policy)
            self._speechless = False
        return self._first

    @property
    def second_answers(self) -> Answers:
        """The policy's answers to the same questions after a second `reset(seed)`."""
        if self._again is None:
            _ = self.answers
            self._again = self.ask(self.policy)
        return self._again

    def need_repeatable(self) -> None:
        """Skip a check if the policy does not repeat its answers.

        Raises:
            NotChecked: The policy does not repeat its answers.
        """
        if self.answers != self.second_answers:
            raise NotChecked("not checked, because the policy does not repeat its answers")

    def ask(self, policy: Policy, order: Callable[[Any], Any] = dict) -> Answers:
        """Return a policy's answers to all questions; `order` sorts the dicts that it gets."""
        policy.reset(self.seed)
        answers: Answers = []
        for moment in self.questions:
            observations, infos = copy.deepcopy((moment.observations, moment.infos))
            answer: Any = policy.act(order(observations), order(infos))
            if not isinstance(answer, Mapping):
                raise ConformanceError(
                    f"act() returned {type(answer).__name__}; return a dict by agent"
                )
            answers.append(dict(answer))
        return answers

    def actions(self, agent: str) -> int:
        """Return the number of actions of an agent."""
        return int(getattr(self.fresh.action_space(agent), "n", 0))


def it_is_a_policy(case: PolicyCase) -> None:
    """The policy has `env_options`, `reset(seed)` and `act(observations, infos)`."""
    for name in ("reset", "act"):
        require(
            callable(getattr(case.policy, name, None)),
            f"the policy has no method {name}(); see ugat_marl.policies.protocols.Policy",
        )
    options: Any = getattr(case.policy, "env_options", None)
    require(
        isinstance(options, Mapping),
        f"env_options is {options!r}; make it a dict, empty if the policy needs no options",
    )


def it_answers(case: PolicyCase) -> None:
    """`act` works at every step of an episode and returns a dict."""
    require(case.answers, "the episode has no step in which a policy could act")


def it_acts_for_every_agent(case: PolicyCase) -> None:
    """`act` returns an action for each agent, and for no other name."""
    agents = set(case.fresh.possible_agents)
    for step, answer in enumerate(case.answers):
        missing, unknown = sorted(agents - set(answer)), sorted(set(answer) - agents)
        require(
            not missing and not unknown,
            f"in step {step}, act() left out {missing} and invented {unknown}; answer for exactly "
            "the agents of the environment",
        )


def its_actions_are_phases(case: PolicyCase) -> None:
    """Every action is a whole number from 0 to n - 1 for an agent with n actions."""
    for step, answer in enumerate(case.answers):
        for agent, action in answer.items():
            count = case.actions(agent) if agent in case.fresh.possible_agents else 0
            require(
                not count or _is_phase(action, count),
                f"in step {step}, the action of {agent} is {action!r}; return an int from 0 to "
                f"{count - 1}",
            )


def _is_phase(action: Any, count: int) -> bool:
    whole = isinstance(action, int | np.integer) and not isinstance(action, bool)
    return whole and bool(0 <= action < count)


def it_respects_masks(case: PolicyCase) -> None:
    """The policy never chooses an action that the mask forbids, for any observation."""
    _ = case.answers
    options: Any = getattr(case.policy, "env_options", None) or {}
    if options.get("signals") == "programme":
        return  # the environment ignores its actions
    generator = numpy_generator(case.seed, "conformance", "masks")
    case.policy.reset(case.seed)
    for step, moment in enumerate(case.questions):
        observations, infos = copy.deepcopy((moment.observations, dict(moment.infos)))
        allowed: dict[str, int] = {}
        for agent in case.fresh.possible_agents:
            count = case.actions(agent)
            allowed[agent] = int(generator.choice(allowed_actions(infos.get(agent), count)))
            mask = (np.arange(count) == allowed[agent]).astype(np.int8)
            infos[agent] = {**infos.get(agent, {}), "action_mask": mask}
        answer = case.policy.act(observations, infos)
        for agent, only in allowed.items():
            action = answer.get(agent)
            require(
                not _is_phase(action, case.actions(agent)) or action == only,
                f"in step {step}, {agent} takes action {action}, though its mask allows only "
                f"{only}; read infos[agent]['action_mask']",
            )


def a_seed_repeats_its_answers(case: PolicyCase) -> None:
    """After `reset(seed)` the policy answers the same questions in the same way."""
    for step, (a, b) in enumerate(zip(case.answers, case.second_answers, strict=True)):
        require(
            a == b,
            f"asked twice, the policy answers step {step} differently: {a} and {b}; let "
            "reset(seed) forget the past and seed every random choice",
        )


def order_does_not_matter(case: PolicyCase) -> None:
    """Answers do not depend on the order of agents in the dicts."""
    case.need_repeatable()

    def reverse(given: Mapping[str, Any]) -> dict[str, Any]:
        return dict(reversed(list(given.items())))

    for step, (a, b) in enumerate(zip(case.answers, case.ask(case.policy, reverse), strict=True)):
        require(
            a == b,
            f"step {step} is answered by {a}, but by {b} when the agents come in another order; "
            "go through agents by name",
        )


def what_it_is_given_stays_as_it_is(case: PolicyCase) -> None:
    """`act` changes neither observations nor infos, since a learner may store them."""
    _ = case.answers
    case.policy.reset(case.seed)
    for step, moment in enumerate(case.questions):
        given = copy.deepcopy({"observations": moment.observations, "infos": moment.infos})
        case.policy.act(given["observations"], given["infos"])
        where = different({"observations": moment.observations, "infos": moment.infos}, given)
        require(
            not where,
            f"in step {step}, act() changed what it was given: {where}; work on copies",
        )


def saving_keeps_its_answers(case: PolicyCase) -> None:
    """A loaded policy answers like the saved one, if the policy has `save` and `load`."""
    policy: Any = case.policy
    if not (callable(getattr(policy, "save", None)) and callable(getattr(policy, "load", None))):
        return
    case.need_repeatable()
    with TemporaryDirectory(prefix="ugat_marl-check-") as folder:
        path = Path(folder) / "policy.pt"
        policy.save(path)
        require(
            any(path.parent.iterdir()),
            "save(path) wrote no file; write one even if there is nothing to keep, or leave out "
            "save() and load()",
        )
        loaded = _loaded(policy, path)
        for step, (a, b) in enumerate(zip(case.answers, case.ask(loaded), strict=True)):
            require(
                a == b,
                f"saved and loaded, the policy answers step {step} with {b}, not {a}; save all "
                "that decides its answers",
            )
    # The copy that `load` fills has the answers already: only a missing file shows that it reads.
    with TemporaryDirectory(prefix="ugat_marl-check-") as folder, Listening() as heard:
        _loaded(policy, Path(folder) / "policy.pt")
    require(
        heard.error is not None,
        "load(path) of a file that is not there raises nothing; read what save(path) wrote",
    )


def _loaded(policy: Any, path: Path) -> Any:
    """Return a policy of a file; `load` returns it, or fills the policy it belongs to."""
    filled = copy.deepcopy(policy)
    made = filled.load(path)
    if callable(getattr(made, "act", None)):
        return made
    load = inspect.getattr_static(policy, "load", None)  # None where __getattr__ makes it
    require(
        not isinstance(load, classmethod | staticmethod),
        f"load(path) returned {type(made).__name__}; return the policy that it read",
    )
    return filled


POLICY_CHECKS = (
    it_is_a_policy,
    it_answers,
    it_acts_for_every_agent,
    its_actions_are_phases,
    it_respects_masks,
    a_seed_repeats_its_answers,
    order_does_not_matter,
    what_it_is_given_stays_as_it_is,
    saving_keeps_its_answers,
)
"""All checks of a policy; each takes a `PolicyCase`."""


def check_policy(policy: Policy, make_env: MakeEnv, seed: int = 1) -> list[CheckResult]:
    """Check a policy.

    Args:
        policy: The policy.
        make_env: Function that returns a new environment with the policy's `env_options`. The
            checks play one episode.
        seed: Seed of that episode and of `policy.reset`.
    """
    case = PolicyCase(policy, make_env, seed)
    try:
        return run_checks(POLICY_CHECKS, case)
    finally:
        case.close()
