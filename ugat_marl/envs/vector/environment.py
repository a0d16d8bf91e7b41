"""Many simulations, stepped together."""

from __future__ import annotations

import contextlib
import inspect
import operator
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Never, Unpack, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ugat_marl.data import Scores
from ugat_marl.effects import Domain, load_scenario
from ugat_marl.envs.agents import AgentSet
from ugat_marl.envs.options import EnvKeywords, with_env_keywords
from ugat_marl.envs.traffic_env import parallel_env
from ugat_marl.envs.types import AnyParallelEnv
from ugat_marl.envs.vector.arrays import Arrays
from ugat_marl.envs.vector.remote import Answer, Episode, RemoteEnv, Shared
from ugat_marl.envs.vector.spec import (
    DomainOf,
    Wrap,
    Wraps,
    checked_options,
    domain_chooser,
    imported,
    listed,
    spelling,
)
from ugat_marl.errors import ActionError, EpisodeError, OptionError, UgatMarlError, UnknownNameError
from ugat_marl.scenarios import Scenario
from ugat_marl.simulation import Worker

Autoreset = Literal["same-step", "next-step", "disabled"]
"""Gymnasium's modes for the end of an episode.

- ``"same-step"``: the step that ends an episode returns the first observation of the next one; the
  last one is in `VectorStep.ended`.
- ``"next-step"``: the following step begins the next episode and ignores its actions.
- ``"disabled"``: the user calls `VectorEnv.reset`.
"""


@dataclass(frozen=True)
class Ended:
    """An episode that has ended in a step.

    Attributes:
        environment: Number of the environment in the stepped vector.
        episode: Number, seed and domain of the episode.
        observations: Last observations, float32 ``(agents, width)``.
        masks: Last masks, int8 ``(agents, actions)``.
        scores: Measures of the episode; None if a wrapper hides them.
    """

    environment: int
    episode: Episode
    observations: NDArray[np.float32]
    masks: NDArray[np.int8]
    scores: Scores | None


@dataclass
class _Sent:
    """A step that was begun by `VectorEnv.send` and not handed back yet.

    Attributes:
        arrived: True if its result is complete.
        truncated: True if it ended an episode.
        ended: This episode.
        last: Its last rewards and phases, while the arrays hold those of the next episode.
    """

    arrived: bool = False
    truncated: bool = False
    ended: Ended | None = None
    last: tuple[NDArray[np.float64], NDArray[np.int64]] | None = None


@dataclass(frozen=True)
class VectorStep:
    """Result of a reset or step of environments; its arrays are copies.

    Agents are in the order of `VectorEnv.agents`. Observations are padded with zeros at the end;
    masks are 0 for phases that an agent does not have.

    Attributes:
        observations: float32 ``(environments, agents, width)``.
        masks: int8 ``(environments, agents, actions)``; 1 where a phase may be chosen.
        rewards: float64 ``(environments, agents)``; 0 after a reset.
        executed: int64 ``(environments, agents)``; the phases that were shown.
        truncated: bool ``(environments,)``; true where an episode has ended.
        ended: Ended episodes of this step.
        numbers: int64 ``(environments,)``; the number of each environment in the vector, in rising
            order. All of them, except after `VectorEnv.recv`.
    """

    observations: NDArray[np.float32]
    masks: NDArray[np.int8]
    rewards: NDArray[np.float64]
    executed: NDArray[np.int64]
    truncated: NDArray[np.bool_]
    ended: tuple[Ended, ...]
    numbers: NDArray[np.int64]

    @property
    def ended_here(self) -> tuple[Ended, ...]:
        """Ended episodes whose row is truncated; not those of an earlier step that failed."""
        over = set(self.numbers[self.truncated].tolist())
        return tuple(ended for ended in self.ended if ended.environment in over)


class VectorEnv:
    """Environments in their own processes, stepped together; see `vector_env`.

    Args:
        environments: The environments.
        arrays: Their shared memory.
        plain: An environment with the same spaces, which is never started.
        domains: Function that gives the domain of an episode.
        autoreset: Mode for the end of an episode.
        shared: Their memory and host, closed with them; None for a half of another vector.
        whole: Vector of which this is a half; it is kept alive.

    Attributes:
        n: Number of environments.
        agents: Names of the agents of each environment.
        agent_set: Names of the agents, and sizes of their spaces.
        observation_spaces: Agent to its observation space, without padding.
        action_spaces: Agent to its action space, without padding.
        autoreset: Mode for the end of an episode.
        plain: An environment with the same spaces, which is never started.
    """

    def __init__(
        self,
        environments: Sequence[RemoteEnv],
        arrays: Arrays,
        plain: AnyParallelEnv,
        domains: DomainOf,
        autoreset: Autoreset,
        shared: Shared | None,
        whole: VectorEnv | None = None,
    ) -> None:
        self.n = len(environments)
        self.agent_set = AgentSet.of(plain)
        self.agents = self.agent_set.names
        self.observation_spaces = {a: plain.observation_space(a) for a in self.agents}
        self.action_spaces = {a: plain.action_space(a) for a in self.agents}
        self.autoreset: Autoreset = autoreset
        self.plain = plain
        self._environments = list(environments)
        self._arrays: Arrays | None = arrays
        self._domains = domains
        self._whole = whole
        self._shared = shared
        self._counts = np.array(self.agent_set.action_counts)
        self._begun: list[int] = []
        self._owed: tuple[Ended, ...] = ()  # of steps behind which something failed
        self._stepped: list[int] = []
        self._sent: dict[int, _Sent] = {}

    @property
    def episodes(self) -> tuple[Episode | None, ...]:
        """Current episode of each environment; None before the first reset."""
        return tuple(env.episode for env in self._environments)

    def halves(self) -> tuple[VectorEnv, VectorEnv]:
        """Return two vectors of these environments, to step one while the results of one are used.

        Closing the whole closes both. Closing a half ends only its simulations.

        Raises:
            OptionError: There is one environment only.
        """
        if self.n < 2:
            raise OptionError("halves() needs at least two environments")
        middle, arrays = self.n // 2, self._memory
        parts = slice(0, middle), slice(middle, self.n)
        first, second = (
            VectorEnv(
                self._environments[part],
                arrays.part(part),
                self.plain,
                self._domains,
                self.autoreset,
                None,
                whole=self,
            )
            for part in parts
        )
        return first, second

    def reset(
        self, seed: int | Sequence[int] | None = None, where: ArrayLike | None = None
    ) -> VectorStep:
        """Begin episodes; unfinished ones are dropped.

        Args:
            seed: One seed for each environment, or one number k for seeds k, k + 1, .... A later
                reset without a seed begins the next episodes; their seeds follow from the last.
            where: Numbers of the environments to reset, or a mask of them; all if None.

        Returns:
            All environments. Those that were not reset show what they showed last, or zeros if a
            step of theirs is under way; no row has a reward.

        Raises:
            SimulatorError: SUMO failed; the message contains its output.
        """
        chosen = self._chosen(where)
        seeds = self._seeds(seed, chosen)
        for index in chosen:
            self._environments[index].close()
            self._sent.pop(index, None)
        gone = set(chosen)
        self._stepped = [index for index in self._stepped if index not in gone]
        self._begun = [index for index in self._begun if index not in gone]
        self._begin(chosen, seeds)
        batch = self._batch(np.zeros(self.n, dtype=np.bool_), ())
        # also those that the whole vector, or a part of it, has begun
        pending = [index for index, env in enumerate(self._environments) if env.pending]
        under_way = [*pending, *self._sent]
        for rows in (batch.observations, batch.masks, batch.executed):
            rows[under_way] = 0  # half written
        batch.rewards[:] = 0.0
        return batch

    def step(self, actions: ArrayLike) -> VectorStep:
        """Show the chosen phases for one decision interval, in all environments.

        Args:
            actions: Integers ``(environments, agents)``.

        Raises:
            ActionError: The shape is wrong, or an agent does not have the phase; nothing was
                simulated.
            EpisodeError: An environment has no running episode. In mode ``"next-step"`` its next
                one begins instead, also after one that failed.
            SimulatorError: SUMO failed. The other environments have made their step. Episodes that
                ended in it are handed over with the next step, also after a `reset`.
        """
        self.step_async(actions)
        return self.step_wait()

    def step_async(self, actions: ArrayLike) -> None:
        """Begin a step, which `step_wait` ends; the caller may work in between."""
        everyone = list(range(self.n))
        self._stepped, self._begun = self._ask(everyone, self._checked(actions, everyone))

    def step_wait(self) -> VectorStep:
        """Wait for the step that `step_async` began.

        Raises:
            EpisodeError: No step has begun, or a reset by other halves dropped a part of it.
        """
        _ = self._memory  # a closed one says so
        if not self._stepped and not self._begun:
            raise EpisodeError("step_wait() without step_async()")
        stepped, begun = self._stepped, self._begun
        self._stepped, self._begun = [], []
        asked = [*stepped, *begun]
        if dropped := self._dropped(asked):
            self._drop(asked)
            raise dropped
        answers, failed = self._arrived(asked)
        memory = self._memory
        over = [index for index in stepped if index in answers and answers[index].over]
        truncated = np.zeros(self.n, dtype=np.bool_)
        truncated[over] = True
        self._owed += tuple(self._ended(index, answers[index]) for index in over)
        if over and self.autoreset == "same-step":
            rewards, executed = memory.rewards[over], memory.executed[over]
            self._begin(over, dict.fromkeys(over))
            memory.rewards[over], memory.executed[over] = rewards, executed
        if failed:
            raise failed[0]
        ended, self._owed = self._owed, ()
        return self._batch(truncated, ended)

    def send(self, actions: ArrayLike, where: ArrayLike | None = None) -> None:
        """Begin a step of some environments; `recv` hands back those that are ready first.

        Args:
            actions: Integers ``(environments, agents)``, one row for each environment of `where`.
            where: Numbers of the environments, or a mask of them; all if None.

        Raises:
            ActionError: The shape is wrong, or an agent does not have the phase; nothing was
                simulated.
            EpisodeError: An environment has no running episode, or is in the middle of a step.
        """
        chosen = self._chosen(where)
        stepped, begun = self._ask(chosen, self._checked(actions, chosen))
        self._sent |= {index: _Sent() for index in [*stepped, *begun]}

    def recv(self, count: int = 1) -> VectorStep:
        """Wait until `count` environments are ready; return their steps.

        An environment whose episode ends in mode ``"same-step"`` is ready when its next one has
        begun; the others do not wait for it. If more environments are ready, those come first that
        were ready first. The order in which environments become ready depends on the machine.

        Args:
            count: Number of environments, at most as many as were sent and not received.

        Raises:
            EpisodeError: So many steps are not under way, or a reset or `close` by other halves
                dropped one of them; the others can still be received.
            SimulatorError: SUMO failed in one environment, which has no episode now. The steps of
                the others can still be received, with the episode that it had ended before.
        """
        _ = self._memory  # a closed one says so
        if not 1 <= count <= len(self._sent):
            raise EpisodeError(
                f"recv({count}): {len(self._sent)} environments are in the middle of a step; "
                "send() begins one"
            )
        under_way = [index for index, step in self._sent.items() if not step.arrived]
        if dropped := self._dropped(under_way):
            for index in under_way:
                if not self._environments[index].pending:
                    del self._sent[index]
            raise dropped
        texts: list[str] = []
        try:
            while len(ready := [i for i, step in self._sent.items() if step.arrived]) < count:
                waiting = [index for index in self._sent if index not in ready]
                workers = [self._environments[index].worker for index in waiting]
                for place in Worker.first_answered(workers):
                    texts += self._receive(waiting[place])
        finally:
            for text in dict.fromkeys(texts):
                warnings.warn(text, stacklevel=2)
        numbers = sorted(ready[:count])
        steps = [self._sent.pop(index) for index in numbers]
        truncated = np.array([step.truncated for step in steps])
        ended = (*self._owed, *(step.ended for step in steps if step.ended is not None))
        self._owed = ()
        return self._batch(truncated, ended, numbers)

    def close(self) -> None:
        """End all simulations and processes and remove their files; a second call does nothing."""
        for env in self._environments:
            env.close()
        self._stepped, self._begun, self._sent = [], [], {}
        shared, self._shared = self._shared, None
        if shared is not None:
            self._arrays = None
            shared.close()

    def __enter__(self) -> VectorEnv:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self) -> Never:
        """Refuse copies and pickles."""
        raise EpisodeError(
            "a vector_env cannot be copied, as its processes and its memory cannot; make another "
            "one"
        )

    def __del__(self) -> None:
        if getattr(self, "_shared", None) is not None:
            with contextlib.suppress(OSError):
                self.close()

    # --- parts --------------------------------------------------------------------------------

    @property
    def _memory(self) -> Arrays:
        if self._arrays is None:
            raise EpisodeError("this vector_env is closed; make another one")
        return self._arrays

    def _dropped(self, asked: Sequence[int]) -> EpisodeError | None:
        """Return the error of steps that a `vector_env` with other halves dropped, if there are."""
        for index in asked:
            if not self._environments[index].pending:
                return EpisodeError(
                    f"a reset or close() by other halves dropped the step of environment {index}; "
                    "call reset()"
                )
        return None

    def _ask(self, chosen: list[int], requested: NDArray[np.int64]) -> tuple[list[int], list[int]]:
        """Begin a step; return the environments that make it, and those that begin an episode."""
        _ = self._memory  # a closed one says so
        anew = self.autoreset == "next-step"
        idle: dict[int, bool] = {}
        for index in chosen:
            env = self._environments[index]
            idle[index] = env.over and not env.pending
            if not (anew and idle[index] and env.episode is not None):
                env.require_running(index)
            if index in self._sent:
                raise EpisodeError(f"the step of environment {index} waits; call recv() first")
        stepped = [index for index in chosen if not idle[index]]
        begun = [index for index in chosen if idle[index]]
        for index, actions in zip(chosen, requested, strict=True):
            if not idle[index]:
                self._environments[index].act(actions.copy())
        self._begin_each(dict.fromkeys(begun), stepped)
        return stepped, begun

    def _receive(self, index: int) -> Sequence[str]:
        """Take the answer of an environment whose step was sent; return its warnings."""
        step = self._sent.pop(index)
        try:
            answer = self._environments[index].answer_or_replace()
            if answer is not None:  # else it died, and another process repeats its episode
                self._note(index, step, answer)
        except BaseException:  # of the next episode: the one that has ended is whole
            self._owed += () if step.ended is None else (step.ended,)
            raise
        self._sent[index] = step
        return () if answer is None else answer.warnings

    def _note(self, index: int, step: _Sent, answer: Answer) -> None:
        """Note an answer to a step that was sent; begin the next episode if this one is over."""
        memory = self._memory
        step.arrived = True
        if answer.over:
            step.truncated, step.ended = True, self._ended(index, answer)
        if answer.over and self.autoreset == "same-step":
            step.arrived = False
            step.last = memory.rewards[index].copy(), memory.executed[index].copy()
            self._environments[index].begin(None, self._domains)
        elif step.last is not None:
            memory.rewards[index], memory.executed[index] = step.last

    def _chosen(self, where: ArrayLike | None) -> list[int]:
        numbers = np.arange(self.n)
        if where is None:
            return numbers.tolist()
        try:
            asked = np.asarray(where)
            chosen = numbers[asked]
        except (IndexError, ValueError):  # numpy has no arrays of rows of unequal lengths
            asked = chosen = numbers[:0]
        if (
            chosen.ndim != 1
            or not chosen.size
            or len({*chosen.tolist()}) < chosen.size
            or (asked < 0).any()  # numpy would count from the end
        ):
            raise OptionError(
                f"where = {where!r}: must be different numbers below {self.n}, or a mask of "
                f"{self.n} truth values, at least one of them true"
            )
        return chosen.tolist()

    def _seeds(self, seed: int | Sequence[int] | None, chosen: list[int]) -> dict[int, int | None]:
        if seed is None:
            return dict.fromkeys(chosen)
        try:
            if isinstance(seed, int | np.integer):
                listed = [int(seed) + i for i in range(self.n)]
            else:
                listed = [operator.index(number) for number in seed]
        except TypeError:  # no sequence, or not of whole numbers
            listed = []
        if len(listed) != self.n or min(listed) < 0:
            raise OptionError(
                f"seed = {seed!r}: must be a number from 0 on, or {self.n} of them, one for each "
                "environment"
            )
        return {index: listed[index] for index in chosen}

    def _checked(self, actions: ArrayLike, chosen: list[int]) -> NDArray[np.int64]:
        try:
            phases = np.asarray(actions)
        except ValueError:  # rows of different lengths
            phases = np.empty(0)
        wanted = (len(chosen), len(self.agents))
        if phases.shape != wanted or not np.issubdtype(phases.dtype, np.integer):
            raise ActionError(
                f"actions are {phases.dtype} of shape {phases.shape}; allowed: integers of shape "
                f"{wanted}, one for each environment and agent"
            )
        wrong = (phases < 0) | (phases >= self._counts)
        if wrong.any():
            row, column = (int(places[0]) for places in np.nonzero(wrong))
            raise ActionError(
                f"action of agent {self.agents[column]!r} in environment {chosen[row]} is "
                f"{phases[row, column]}; allowed: the integers 0 to {self._counts[column] - 1}, "
                "its green phases; the others are padding, and 0 in the mask"
            )
        return phases.astype(np.int64)

    def _begin_each(self, seeds: Mapping[int, int | None], stepped: Sequence[int] = ()) -> None:
        """Begin an episode in some environments; if the user's `domains` fails, end all of these.

        Args:
            seeds: Environment to its seed; None for the next episode.
            stepped: Environments that were asked for a step in the same call.
        """
        asked = [*stepped]
        try:
            for index, seed in seeds.items():
                self._environments[index].begin(seed, self._domains)
                asked.append(index)
        except BaseException:
            for index in asked:  # nobody would wait for their answers
                self._environments[index].close()
            raise

    def _begin(self, chosen: list[int], seeds: dict[int, int | None]) -> None:
        self._begin_each({index: seeds[index] for index in chosen})
        _, failed = self._arrived(chosen)
        if failed:
            raise failed[0]

    def _arrived(self, chosen: list[int]) -> tuple[dict[int, Answer], list[UgatMarlError]]:
        """Wait for all answers; return them, and the errors of environments that failed."""
        answers: dict[int, Answer] = {}
        failed: list[UgatMarlError] = []
        for index in chosen:
            try:
                answers[index] = self._environments[index].answer()
            except UgatMarlError as error:
                failed.append(error)
            except BaseException:  # Ctrl-C: nobody waits for the others
                self._drop(chosen)
                raise
        for text in dict.fromkeys(_said(answers.values())):
            warnings.warn(text, stacklevel=4)
        return answers, failed

    def _drop(self, chosen: Sequence[int]) -> None:
        """End the episodes of the environments that have not answered."""
        for index in chosen:
            if self._environments[index].pending:
                self._environments[index].close()

    def _ended(self, index: int, answer: Answer) -> Ended:
        memory, episode = self._memory, self._environments[index].episode
        assert episode is not None
        seen, masks = memory.observations[index].copy(), memory.masks[index].copy()
        return Ended(index, episode, seen, masks, answer.scores)

    def _batch(
        self,
        truncated: NDArray[np.bool_],
        ended: tuple[Ended, ...],
        numbers: Sequence[int] | None = None,
    ) -> VectorStep:
        memory = self._memory
        rows = np.arange(self.n) if numbers is None else np.array(numbers, dtype=np.int64)
        return VectorStep(
            memory.observations[rows],
            memory.masks[rows],
            memory.rewards[rows],
            memory.executed[rows],
            truncated,
            ended,
            rows,
        )


def _said(answers: Iterable[Answer]) -> Iterator[str]:
    for answer in answers:
        yield from answer.warnings


def _wrapped(wrap: Wrap, env: AnyParallelEnv) -> Any:
    """Return what a wrapper makes of an environment.

    Raises:
        OptionError: It takes other arguments, or is no function.
    """
    wrapper = imported(spelling("wrap", wrap))
    try:
        inspect.signature(wrapper).bind(env)
    except TypeError as error:
        raise OptionError(
            f"wrap = {wrap!r}: cannot be called with an environment alone ({error}); write a "
            "function of your own that gives the other arguments"
        ) from None
    return wrapper(env)


@with_env_keywords
def vector_env(
    scenario: str | Path | Scenario,
    n: int,
    domains: Domain | Sequence[Domain] | DomainOf = "sim",
    *,
    autoreset: Autoreset = "same-step",
    wrap: Wraps = None,
    **options: Unpack[EnvKeywords],
) -> VectorEnv:
    """Make simulations in worker processes, stepped together, with arrays in shared memory.

    An environment depends only on its seed, its domain and its actions, and not on `n`. A process
    that dies is replaced; the new one repeats the actions of the episode.

    Args:
        scenario: Scenario, as for `ugat_marl.parallel_env`.
        n: Number of environments; each has one simulation in one process.
        domains: One domain for all; a list of `n`; or a function ``(environment, episode) ->
            domain`` that is called at each reset, and once before with (0, 0), such as one of
            `ugat_marl.envs.vector.spec.in_turn`.
        autoreset: Mode for the end of an episode, see `Autoreset`.
        wrap: Wrapper of each environment: an importable function, its ``"module:name"``, such as
            ``"ugat_marl.envs.wrappers:agent_indicator"``, or a list of them.
        **options: The keywords below, except ``simulator`` and ``render_mode``.

    Raises:
        UnknownNameError: A scenario, domain, option or mode does not exist.
        OptionError: A number is impossible, or a worker cannot import a function.
        ScenarioError: The scenario's files are missing or contradict each other.
    """
    count: Any = n
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise OptionError(f"n = {n!r}: must be a number of environments, at least 1")
    n = int(count)
    if autoreset not in get_args(Autoreset):
        raise UnknownNameError("value of option 'autoreset':", str(autoreset), get_args(Autoreset))
    given = checked_options(options)
    loaded = load_scenario(scenario, given.get("duration_s"))
    domain_of = domain_chooser(loaded, domains, n, given.get("duration_s"))
    plain: AnyParallelEnv = parallel_env(loaded, domain_of(0, 0), **given)
    for each in listed(wrap):
        plain = _wrapped(each, plain)
        if not hasattr(plain, "possible_agents"):
            raise OptionError(
                f"wrap = {each!r}: returned {type(plain).__name__} and not an environment"
            )
    shared = Shared(loaded, given, wrap, AgentSet.of(plain), n)
    environments = [RemoteEnv(shared, index, shared.arrays.part(index)) for index in range(n)]
    return VectorEnv(environments, shared.arrays, plain, domain_of, autoreset, shared)
