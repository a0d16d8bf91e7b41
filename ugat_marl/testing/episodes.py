"""Whole episodes as values that checks inspect and compare bit for bit."""

from __future__ import annotations

import copy
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.envs import Actions, AnyParallelEnv
from ugat_marl.seeding import numpy_generator
from ugat_marl.testing.results import ConformanceError, Listening, NotChecked

MakeEnv = Callable[[], AnyParallelEnv]
"""Function that returns a new environment of the kind to check, not yet reset."""

Choose = Callable[[int, AnyParallelEnv, Mapping[str, Any]], Actions]
"""Function of step, environment and infos that returns the actions of all agents."""

PARTS = ("observations", "rewards", "terminations", "truncations", "infos")
"""Names of the values that `step` returns, in their order."""


@dataclass(frozen=True)
class StepReturn:
    """Values that `reset` or one `step` returned.

    Attributes:
        parts: Name of each returned value (of `PARTS`) to a copy made at that time.
        given: Name to the returned object itself. The environment may have changed it since.
        agents: `env.agents` after the call.
        actions: Actions of the step; None for `reset`.
    """

    parts: Mapping[str, Any]
    given: Mapping[str, Any]
    agents: tuple[str, ...]
    actions: Actions | None

    @property
    def observations(self) -> Mapping[str, Any]:
        """Agent to observation."""
        return self.parts["observations"]

    @property
    def infos(self) -> Mapping[str, Any]:
        """Agent to info."""
        return self.parts["infos"]


@dataclass(frozen=True)
class Episode:
    """All moments of an episode, `reset` first, and the scores at its end.

    Attributes:
        moments: Moment of `reset`, then one per step.
        scores: Scores that the environment gave; None if it has none.
    """

    moments: tuple[StepReturn, ...]
    scores: Any = None

    @property
    def actions(self) -> list[Actions]:
        """The actions of all steps."""
        return [moment.actions for moment in self.moments if moment.actions is not None]

    def agrees(self, other: Episode) -> bool:
        """Return True if all moments that both have are equal."""
        pairs = zip(self.moments, other.moments, strict=False)
        return not any(different(a.parts, b.parts) for a, b in pairs)


class EnvironmentCase:
    """Environment that is checked. Work that several checks need is done once.

    Args:
        make_env: Function that returns a new environment.
        seed: Seed of the episodes.
        max_steps: Number of steps after which an episode counts as endless.
    """

    def __init__(self, make_env: MakeEnv, seed: int = 1, max_steps: int = 10_000) -> None:
        self._make_env = make_env
        self.seed = seed
        self.max_steps = max_steps
        self._made: list[AnyParallelEnv] = []
        self._kept: list[AnyParallelEnv] = []
        self._fresh: AnyParallelEnv | None = None
        self._episode: Episode | None = None
        self._failed = False

    def make(self) -> AnyParallelEnv:
        """Return a new environment; `tidy` closes it."""
        env = self._make_env()
        self._made.append(env)
        return env

    @property
    def fresh(self) -> AnyParallelEnv:
        """An environment that is never reset."""
        if self._fresh is None:
            self._fresh = self._keep()
        return self._fresh

    @property
    def episode(self) -> Episode:
        """A whole episode of `seed` under random actions, in an environment of its own."""
        if self._failed:
            raise NotChecked("not checked, because no whole episode could be run")
        if self._episode is None:
            self._failed = True
            # After its episode this environment keeps no simulation, only the process that forks
            # new ones, so it need not be closed before the next check.
            self._episode = self.play(self._keep(), self.seed)
            self._failed = False
        return self._episode

    @functools.cached_property
    def is_repeatable(self) -> bool:
        """True if the episode is the same when it is played again."""
        episode = self.episode
        return episode.agrees(self.play(self.make(), self.seed))

    def need_episode(self) -> None:
        """Skip a check if no whole episode can be run.

        Raises:
            NotChecked: No whole episode can be run.
        """
        _ = self.episode

    def play(
        self,
        env: AnyParallelEnv,
        seed: int | None,
        choose: Choose | None = None,
        watch: Callable[[], None] | None = None,
    ) -> Episode:
        """Run an episode to its end; see `play`."""
        return play(env, seed, choose or random_actions(self.seed), self.max_steps, watch)

    def tidy(self) -> None:
        """Close the environments of `make`. Errors are ignored, since a check covers `close`."""
        while self._made:
            with Listening():
                self._made.pop().close()

    def close(self) -> None:
        """Close all environments."""
        self._made += self._kept
        self._kept.clear()
        self.tidy()

    def _keep(self) -> AnyParallelEnv:
        env = self._make_env()
        self._kept.append(env)
        return env


def play(
    env: AnyParallelEnv,
    seed: int | None,
    choose: Choose,
    max_steps: int,
    watch: Callable[[], None] | None = None,
) -> Episode:
    """Run an episode to its end.

    Args:
        env: The environment.
        seed: Seed for `reset`; None to call `reset` without a seed.
        choose: Function that chooses the actions.
        max_steps: Number of steps after which the episode counts as endless.
        watch: Function called after `reset` and after every step.

    Raises:
        ConformanceError: The episode does not end, or has no agents after `reset`.
    """
    played: list[StepReturn] = []
    for moment in moments(env, seed, choose, max_steps):
        played.append(moment)
        if watch:
            watch()
    scores = getattr(env.unwrapped, "scores", None)
    return Episode(tuple(played), scores() if callable(scores) else None)


def moments(
    env: AnyParallelEnv, seed: int | None, choose: Choose, max_steps: int
) -> Iterator[StepReturn]:
    """Yield the moment of `reset`, then one per step to the end of the episode; see `play`."""
    last = begin(env, seed)
    if not env.agents:
        raise ConformanceError("env.agents is empty after reset(); set it to possible_agents there")
    yield last
    for step in itertools.count():
        if not env.agents or (step and _all_over(last)):
            return
        if step >= max_steps:
            raise ConformanceError(
                f"the episode has not ended after {max_steps} steps; truncate all agents and "
                "empty env.agents at its end"
            )
        last = proceed(env, choose(step, env, last.infos))
        yield last


def begin(env: AnyParallelEnv, seed: int | None) -> StepReturn:
    """Reset the environment and return the moment."""
    given = env.reset() if seed is None else env.reset(seed=seed)
    return _moment(env, ("observations", "infos"), given, None)


def proceed(env: AnyParallelEnv, actions: Actions) -> StepReturn:
    """Step the environment and return the moment."""
    return _moment(env, PARTS, env.step(dict(actions)), dict(actions))


def _moment(
    env: AnyParallelEnv, names: tuple[str, ...], given: Any, actions: Actions | None
) -> StepReturn:
    call = "reset" if actions is None else "step"
    if not isinstance(given, tuple) or len(given) != len(names):
        raise ConformanceError(f"{call}() must return the tuple ({', '.join(names)})")
    for name, part in zip(names, given, strict=True):
        if not isinstance(part, dict):
            raise ConformanceError(
                f"{call}() returned {name} as {type(part).__name__}; return a dict by agent"
            )
    parts = dict(zip(names, given, strict=True))
    return StepReturn(copy.deepcopy(parts), parts, tuple(env.agents), actions)


def _all_over(moment: StepReturn) -> bool:
    """Return True if all agents are done, even if the environment still lists them."""
    ended, cut = moment.parts["terminations"], moment.parts["truncations"]
    return all(ended.get(agent) or cut.get(agent) for agent in moment.agents)


def random_actions(seed: int) -> Choose:
    """Return a function that draws allowed actions; its random stream restarts at step 0."""
    generator = numpy_generator(seed, "conformance", "actions")

    def choose(step: int, env: AnyParallelEnv, infos: Mapping[str, Any]) -> Actions:
        nonlocal generator
        if step == 0:
            generator = numpy_generator(seed, "conformance", "actions")
        return {agent: _random_action(env, agent, infos, generator) for agent in env.agents}

    return choose


def _random_action(
    env: AnyParallelEnv, agent: str, infos: Mapping[str, Any], generator: np.random.Generator
) -> int:
    space: Any = env.action_space(agent)
    if not hasattr(space, "n"):
        raise ConformanceError(
            f"the action space of {agent} is {space}; an action is a green phase: "
            "use gymnasium.spaces.Discrete"
        )
    allowed = allowed_actions(infos.get(agent), int(space.n))
    return int(getattr(space, "start", 0)) + int(generator.choice(allowed))


def allowed_actions(info: Any, count: int) -> NDArray[np.int64]:
    """Return the actions that a mask allows; all actions if there is no valid mask."""
    mask = np.asarray(info.get("action_mask")) if isinstance(info, Mapping) else np.empty(0)
    if mask.shape == (count,) and mask.dtype.kind in "biu" and mask.any():
        return np.flatnonzero(mask)
    return np.arange(count)


def replaying(episode: Episode, *, reverse: bool = False) -> Choose:
    """Return a function that repeats the actions of `episode`.

    With `reverse`, the dicts list the agents in the opposite order.
    """

    def choose(step: int, env: AnyParallelEnv, infos: Mapping[str, Any]) -> Actions:
        if step >= len(episode.actions):
            raise ConformanceError(
                f"the episode went on after {step} steps, where it had ended when recorded"
            )
        items = list(episode.actions[step].items())
        return dict(items[::-1] if reverse else items)

    return choose


def require_same(expected: Episode, repeated: Episode, condition: str, cure: str) -> None:
    """Raise a `ConformanceError` that names the first difference of two episodes.

    Scores are not compared; use `different` for them.
    """
    for step, (a, b) in enumerate(zip(expected.moments, repeated.moments, strict=False)):
        if where := different(a.parts, b.parts):
            raise ConformanceError(f"{condition}: after step {step}, {where}; {cure}")
    if len(expected.moments) != len(repeated.moments):
        lengths = f"{len(expected.moments) - 1} and {len(repeated.moments) - 1} steps"
        raise ConformanceError(f"{condition}: the episodes have {lengths}; {cure}")


def different(a: Any, b: Any, path: str = "") -> str:
    """Return where two nested values first differ; "" if they are equal. NaN equals NaN."""
    if is_dataclass(a) and is_dataclass(b):
        a, b = asdict(a), asdict(b)  # pyright: ignore[reportArgumentType]
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        if set(a) != set(b):
            return f"{path or 'the keys'} {sorted(map(str, a))} became {sorted(map(str, b))}"
        differences = (
            different(a[key], b[key], f"{path}[{key!r}]" if path else str(key)) for key in a
        )
        return next((where for where in differences if where), "")
    first, second = np.asarray(a), np.asarray(b)
    if first.shape != second.shape or first.dtype != second.dtype:
        return f"{path} changed from {first.dtype}{first.shape} to {second.dtype}{second.shape}"
    numeric = first.dtype.kind in "fc"
    if np.array_equal(first, second, equal_nan=numeric):
        return ""
    if not first.ndim:
        return f"{path} was {a!r} and became {b!r}"
    unlike = (first != second) & ~((first != first) & (second != second))  # nan equals nan
    index = tuple(int(i) for i in np.argwhere(unlike)[0])
    return f"{path}[{', '.join(map(str, index))}] was {first[index]} and became {second[index]}"
