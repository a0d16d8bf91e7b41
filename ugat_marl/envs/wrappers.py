"""Wrappers for learners that need equal spaces or larger observations.

They take any `ParallelEnv` whose agents observe one-dimensional boxes, act in `Discrete(n)` and
live to the end of the episode. They can be stacked in any order, but `masked_observation` comes
last, `legal_actions` outside of `pad_spaces`, and `intersection_names` outside of all others.
Rewards, ends and `state()` stay those of the wrapped environment. So do infos, but `pad_spaces`
lengthens or adds ``action_mask``, and `legal_actions` adds ``action_replaced``.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import AECEnv
from pettingzoo.utils import BaseParallelWrapper

from ugat_marl.envs.actions import checked_phases, is_phase, require_mapping
from ugat_marl.envs.agents import discrete_actions, vector_box
from ugat_marl.envs.observations import joint_space
from ugat_marl.envs.options import is_count
from ugat_marl.envs.types import AnyParallelEnv, ResetResult, StepResult
from ugat_marl.errors import ActionError, EpisodeError, OptionError, UgatMarlError

Vectors = Mapping[str, NDArray[np.float32]]
Infos = dict[str, dict[str, Any]]


def pad_spaces(env: AnyParallelEnv) -> Wrapper:
    """Give all agents equal spaces: zeros behind short observations, further actions.

    All agents share one `Box` of the length of the longest observation, and act in a `Discrete` of
    the size of the largest. ``infos[agent]["action_mask"]`` is 0 for actions that an agent does not
    have; it is added if the environment gives no mask. `sample()` of an action space draws among
    the agent's own actions.

    Raises:
        ActionError: `step` got an action that the agent does not have; nothing was simulated.
    """
    return _Pad(env)


def agent_indicator(env: AnyParallelEnv) -> Wrapper:
    """Append to each observation a one-hot of its agent, in the order of `possible_agents`.

    The bounds of the one-hot are 0 and 1, for observations with any bounds.
    """
    return _AgentIndicator(env)


def shared_observation(env: AnyParallelEnv) -> Wrapper:
    """Append the observations of all agents, its own included, to each observation.

    The appended part is the same for all agents, in the order of `possible_agents`. It contains the
    observations of the wrapped environment. `state()` does not change.
    """
    return _SharedObservation(env)


def frame_stack(env: AnyParallelEnv, k: int) -> Wrapper:
    """Join the last `k` observations of each agent, the newest last; zeros before the first.

    Raises:
        OptionError: `k` is not at least 1.
    """
    return _FrameStack(env, k)


def masked_observation(env: AnyParallelEnv, key: str = "observations") -> Wrapper:
    """Give observations as ``{key: vector, "action_mask": int8 (actions,)}``.

    The mask is a copy of that of the infos, or all ones without one.

    Args:
        env: The environment.
        key: Name of the vector: "observations", as RLlib needs it, or "observation", the form of
            PettingZoo's classic environments, which tianshou and others read.

    Raises:
        OptionError: The key is that of the mask.
    """
    if key == "action_mask":
        raise OptionError(
            f"key = {key!r}: the mask has this name; take another, such as observation"
        )
    return _MaskedObservation(env, key)


def legal_actions(env: AnyParallelEnv) -> Wrapper:
    """Execute a permitted action in place of one that the mask forbids, padding included.

    It is for libraries that ignore masks. Forbidden action a becomes number ``a % n`` of the n
    permitted ones, and the info's ``action_replaced`` is 1. The library learns from the action that
    it chose, so masks serve better where a library knows them. Put it outside `pad_spaces`.
    """
    return _LegalActions(env)


def intersection_names(env: AnyParallelEnv) -> Wrapper:
    """Name each agent by SUMO's id of its traffic light, such as ``A1`` for ``signal_0``.

    It goes outside of all other wrappers but `masked_observation`. Policies and logs of the suite
    know agents by their own names.

    Raises:
        OptionError: The environment does not say which agent has which light.
    """
    return _IntersectionNames(env)


def appended_mask(env: AnyParallelEnv) -> Wrapper:
    """Append to each observation the agent's action mask, for learners without another way.

    The learner must not choose actions whose mask is 0. The mask is all ones if the infos have
    none.
    """
    return _AppendedMask(env)


class Wrapper(BaseParallelWrapper[str, Any, Any]):
    """Base of the wrappers, with its own spaces; everything else is the wrapped environment's.

    Attributes:
        observation_spaces: Agent to its space, the same object as `observation_space` returns.
        action_spaces: Agent to its space, the same object as `action_space` returns.
    """

    observation_spaces: dict[str, Any]
    action_spaces: dict[str, Any]

    def __init__(self, env: AnyParallelEnv) -> None:
        given: Any = env
        if isinstance(given, AECEnv) or not hasattr(given, "possible_agents"):
            raise OptionError(
                f"{type(env).__name__} is no environment of PettingZoo in which all agents act at "
                "once; wrap one of ugat_marl.parallel_env, or convert it with pettingzoo's "
                "aec_to_parallel"
            )
        super().__init__(env)
        agents = env.possible_agents
        self.observation_spaces = {agent: vector_box(env, agent) for agent in agents}
        self.action_spaces = {agent: env.action_space(agent) for agent in agents}

    @property
    def unwrapped(self) -> Wrapper:
        """The wrapper itself, because skrl and EPyMARL read the spaces of `unwrapped`.

        It has every public attribute of the wrapped environments; `base` is the innermost one.
        """
        return self

    @property
    def base(self) -> Any:
        """The environment inside all wrappers."""
        env: Any = self
        while isinstance(env, Wrapper):
            env = env.env.unwrapped
        return env

    def observation_space(self, agent: str) -> Any:
        """The space of an agent's observations, the same object at each call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """The space of an agent's actions, the same object at each call."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """Start an episode of the wrapped environment."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self._begin()
        told = self._told(infos)
        return self._seen(observations, told), told

    def step(self, actions: dict[str, Any]) -> StepResult:
        """Step the wrapped environment and convert its observations and infos.

        Raises:
            ActionError: The wrapped environment or `pad_spaces` refuses an action.
        """
        self._check(actions)
        executed = self._translated(actions)
        observations, rewards, terminations, truncations, infos = self.env.step(executed)
        told = self._told(infos)
        return self._seen(observations, told), rewards, terminations, truncations, told

    def _begin(self) -> None:
        """Forget the previous episode."""

    def _check(self, actions: Mapping[str, Any]) -> None:
        """Refuse actions before anything happens."""

    def _translated(self, actions: dict[str, Any]) -> dict[str, Any]:
        """Return the actions for the wrapped environment."""
        return actions

    def _told(self, infos: Infos) -> Infos:
        """Return the infos for the learner."""
        return infos

    def _seen(self, observations: Vectors, infos: Infos) -> dict[str, Any]:
        """Return the observations for the learner; the environment's arrays stay as they are."""
        raise NotImplementedError


class PaddedDiscrete(spaces.Discrete):
    """`Discrete(n)` whose first `own` actions exist; `sample()` draws among these.

    It equals any other `Discrete(n)` and contains all its actions, so agents can share a network.

    Args:
        n: Number of actions, with the padding.
        own: Number of actions that exist.
    """

    def __init__(self, n: int, own: int) -> None:
        super().__init__(n)
        self.own = own

    def sample(self, mask: Any = None, probability: Any = None) -> np.int64:
        """Draw an action by `mask` or `probability`, or by default among those that exist."""
        if probability is not None:
            return super().sample(mask, probability=probability)
        if mask is None:
            mask = (np.arange(int(self.n)) < self.own).astype(np.int8)
        return super().sample(mask)


class _Pad(Wrapper):
    def __init__(self, env: AnyParallelEnv) -> None:
        super().__init__(env)
        self._own = {agent: discrete_actions(env, agent) for agent in self.action_spaces}
        self._most = max(int(space.n) for space in self._own.values())
        padded = {size: PaddedDiscrete(self._most, size) for size in map(_size, self._own.values())}
        self.action_spaces = {agent: padded[_size(size)] for agent, size in self._own.items()}
        common = common_box(list(self.observation_spaces.values()))
        self._width = common.shape[0]
        self.observation_spaces = dict.fromkeys(self.observation_spaces, common)

    def _check(self, actions: Mapping[str, Any]) -> None:
        if self.env.agents:  # after the end the environment itself reports the error
            try:
                checked_phases(actions, self.env.agents, self._own)
            except ActionError as error:
                raise ActionError(f"{error}{self._of_padding(actions)}") from None

    def _of_padding(self, actions: Any) -> str:
        """Return what to add to a refusal if one of the actions is padding."""
        padded = self.action_spaces
        for agent, action in actions.items() if isinstance(actions, Mapping) else ():
            if agent in padded and is_phase(action, padded[agent]):
                own = int(self._own[agent].n)
                if int(action) >= own:
                    return (
                        f"; from {own} on they are padding, and 0 in the action_mask of its info; "
                        "put legal_actions outside pad_spaces for a learner without masks"
                    )
        return ""

    def _told(self, infos: Infos) -> Infos:
        told = dict(infos)
        for agent, space in self._own.items():
            if agent in infos:
                mask = np.zeros(self._most, dtype=np.int8)
                given = infos[agent].get("action_mask")
                if given is not None and len(given) != space.n:
                    raise ActionError(
                        f"action_mask of agent {agent!r} has {len(given)} entries; it has "
                        f"{space.n} actions"
                    )
                mask[: space.n] = 1 if given is None else given
                told[agent] = {**infos[agent], "action_mask": mask}
        return told

    def _seen(self, observations: Vectors, infos: Infos) -> dict[str, Any]:
        return {agent: _longer(vector, self._width) for agent, vector in observations.items()}


class _AgentIndicator(Wrapper):
    def __init__(self, env: AnyParallelEnv) -> None:
        super().__init__(env)
        agents = list(self.observation_spaces)
        one_hot = spaces.Box(0.0, 1.0, (len(agents),), np.float32)
        extended = _each(self.observation_spaces, lambda box: joint_space([box, one_hot]))
        self.observation_spaces = extended
        self._row = {agent: row for row, agent in enumerate(agents)}

    def _seen(self, observations: Vectors, infos: Infos) -> dict[str, Any]:
        seen: dict[str, Any] = {}
        for agent, vector in observations.items():
            seen[agent] = _longer(vector, vector.size + len(self._row))
            seen[agent][vector.size + self._row[agent]] = 1
        return seen


class _SharedObservation(Wrapper):
    def __init__(self, env: AnyParallelEnv) -> None:
        super().__init__(env)
        every = list(self.observation_spaces.values())
        extended = _each(self.observation_spaces, lambda box: joint_space([box, *every]))
        self.observation_spaces = extended

    def _seen(self, observations: Vectors, infos: Infos) -> dict[str, Any]:
        if not observations:  # after the end
            return {}
        if missing := [agent for agent in self.observation_spaces if agent not in observations]:
            raise EpisodeError(
                f"the environment gave no observation of {missing}; shared_observation needs those "
                "of all agents to the end"
            )
        every = np.concatenate([observations[agent] for agent in self.observation_spaces])
        return {agent: np.concatenate((vector, every)) for agent, vector in observations.items()}


class _FrameStack(Wrapper):
    """Attribute `frames`: number of observations that one shows."""

    def __init__(self, env: AnyParallelEnv, k: int) -> None:
        super().__init__(env)
        given: Any = k
        if not is_count(given) or k < 1:
            raise OptionError(f"frame_stack of {k!r} observations: must be a whole number from 1")
        self.frames = int(k)
        self._frames: dict[str, deque[NDArray[np.float32]]] = {}
        self.observation_spaces = _each(self.observation_spaces, self._stacked_box)

    def _stacked_box(self, box: spaces.Box) -> spaces.Box:
        """Return the box of k frames; all but the newest may also be zeros."""
        zeros = spaces.Box(np.minimum(box.low, 0), np.maximum(box.high, 0), dtype=_dtype(box))
        return joint_space([*[zeros] * (self.frames - 1), box])

    def _begin(self) -> None:
        self._frames.clear()

    def _seen(self, observations: Vectors, infos: Infos) -> dict[str, Any]:
        for agent, vector in observations.items():
            if agent not in self._frames:
                self._frames[agent] = deque([np.zeros_like(vector)] * self.frames, self.frames)
            self._frames[agent].append(vector.copy())  # an environment may use one array again
        return {agent: np.concatenate(self._frames[agent]) for agent in observations}


class _Masking(Wrapper):
    """Base of wrappers that show masks in observations."""

    def __init__(self, env: AnyParallelEnv) -> None:
        super().__init__(env)
        self._sizes = {agent: _size(discrete_actions(env, agent)) for agent in self.action_spaces}

    def _mask(self, agent: str, infos: Infos) -> NDArray[np.int8]:
        given = infos.get(agent, {}).get("action_mask")
        return np.ones(self._sizes[agent], np.int8) if given is None else np.array(given, np.int8)


class _AppendedMask(_Masking):
    def __init__(self, env: AnyParallelEnv) -> None:
        super().__init__(env)
        masks = {size: spaces.Box(0.0, 1.0, (size,)) for size in self._sizes.values()}
        made: dict[tuple[int, int], spaces.Box] = {}  # agents that shared a box still do
        for agent, box in self.observation_spaces.items():
            key = id(box), self._sizes[agent]
            made[key] = made.get(key) or joint_space([box, masks[key[1]]])
            self.observation_spaces[agent] = made[key]

    def _seen(self, observations: Vectors, infos: Infos) -> dict[str, Any]:
        return {
            agent: np.concatenate((vector, self._mask(agent, infos)), dtype=vector.dtype)
            for agent, vector in observations.items()
        }


class _LegalActions(_Masking):
    def __init__(self, env: AnyParallelEnv) -> None:
        super().__init__(env)
        self._masks: dict[str, NDArray[np.int8]] = {}
        self._replaced: set[str] = set()

    def _begin(self) -> None:
        self._replaced = set()

    def _translated(self, actions: dict[str, Any]) -> dict[str, Any]:
        require_mapping("actions", actions, self.env.agents)
        self._replaced = set()
        executed = dict(actions)
        for agent, action in actions.items():
            mask = self._masks.get(agent)
            if mask is None or not is_phase(action, self.action_spaces[agent]):
                continue  # refused by the environment itself
            if int(action) >= len(mask) or mask[int(action)]:
                continue
            permitted = np.flatnonzero(mask)
            if not permitted.size:
                raise ActionError(f"action_mask of agent {agent!r} allows no action")
            executed[agent] = int(permitted[int(action) % len(permitted)])
            self._replaced.add(agent)
        if self._replaced and (remember := getattr(self.env, "remember", None)):
            remember({agent: self._asked(agent, actions, executed) for agent in executed})
        return executed

    def _asked(self, agent: str, actions: Mapping[str, Any], executed: Mapping[str, Any]) -> Any:
        """Return the command to remember: that of the policy, if the agent has such a phase."""
        space = self.action_spaces.get(agent)
        asked = actions[agent]
        if isinstance(space, PaddedDiscrete) and is_phase(asked, space) and asked >= space.own:
            return executed[agent]
        return asked

    def _told(self, infos: Infos) -> Infos:
        self._masks = {agent: self._mask(agent, infos) for agent in self.env.agents}
        told = dict(infos)
        for agent in self._sizes:
            if agent in infos:
                told[agent] = {**infos[agent], "action_replaced": int(agent in self._replaced)}
        return told

    def _seen(self, observations: Vectors, infos: Infos) -> dict[str, Any]:
        return dict(observations)


class _IntersectionNames(Wrapper):
    """Agents under the ids of their lights; spaces, vectors and numbers stay the same."""

    def __init__(self, env: AnyParallelEnv) -> None:
        super().__init__(env)
        lights: Mapping[str, str] | None = getattr(env.unwrapped, "intersection_of", None)
        if lights is None:
            raise OptionError(
                f"{type(env.unwrapped).__name__} has no intersection_of, which maps agents to "
                "traffic lights; wrap an environment of ugat_marl"
            )
        self._light = dict(lights)
        self._agent = {light: agent for agent, light in lights.items()}
        self.observation_spaces = self._renamed(self.observation_spaces)
        self.action_spaces = self._renamed(self.action_spaces)

    @property
    def possible_agents(self) -> list[str]:
        """All traffic lights, in the order of the agents."""
        return [self._light[agent] for agent in self.env.possible_agents]

    @property
    def agents(self) -> list[str]:
        """The traffic lights of the running episode."""
        return [self._light[agent] for agent in self.env.agents]

    @property
    def _base(self) -> Any:
        return self.env.unwrapped

    @property
    def agent_groups(self) -> dict[str, list[str]]:
        """Group to its traffic lights."""
        groups: Mapping[str, list[str]] = self._base.agent_groups
        return {group: [self._light[agent] for agent in own] for group, own in groups.items()}

    @property
    def intersection_of(self) -> dict[str, str]:
        """Every name to itself."""
        return {light: light for light in self.possible_agents}

    @property
    def layouts(self) -> dict[str, Any]:
        """Traffic light to the parts of its observation."""
        return self._renamed(self._base.layouts)

    @property
    def recorded_layouts(self) -> dict[str, Any]:
        """The same without the memory of commands."""
        return self._renamed(self._base.recorded_layouts)

    def remember(self, commands: Mapping[str, int]) -> None:
        """Let observations show these commands, see `TrafficEnv.remember`."""
        require_mapping("commands", commands, self.agents)
        own = self._of_agents("command", commands)
        with self._errors_name_lights():
            self._base.remember(own)

    def delay_greens(self, seconds: Mapping[str, float]) -> None:
        """Delay greens of the next step, see `TrafficEnv.delay_greens`."""
        require_mapping("delays", seconds, self.agents)
        own = self._of_agents("delay", seconds)
        with self._errors_name_lights():
            self._base.delay_greens(own)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """Start an episode of the wrapped environment."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._renamed(observations), self._renamed(infos)

    def step(self, actions: dict[str, Any]) -> StepResult:
        """Step the wrapped environment.

        Raises:
            ActionError: A name is that of no traffic light, or the environment refuses an action.
        """
        require_mapping("actions", actions, self.agents)
        own = self._of_agents("action", actions)
        with self._errors_name_lights():
            result = self.env.step(own)
        observations, rewards, terminations, truncations, infos = map(self._renamed, result)
        return observations, rewards, terminations, truncations, infos

    def _of_agents(self, kind: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return values of traffic lights as values of their agents.

        Raises:
            ActionError: A name is that of no traffic light.
        """
        if unknown := [name for name in values if name not in self._agent]:
            raise ActionError(
                f"{kind} for {unknown[0]!r}: the traffic lights are {', '.join(self._agent)}"
            )
        return {self._agent[light]: value for light, value in values.items()}

    def _renamed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        return {self._light[agent]: value for agent, value in values.items()}

    @contextmanager
    def _errors_name_lights(self) -> Iterator[None]:
        """Replace the agents in an error by their lights, the only names that the user knows."""
        try:
            yield
        except UgatMarlError as error:
            lights = {repr(agent): repr(light) for agent, light in self._light.items()}
            told = re.sub("|".join(map(re.escape, lights)), lambda m: lights[m[0]], str(error))
            error.args = (told,)
            raise


class _MaskedObservation(_Masking):
    def __init__(self, env: AnyParallelEnv, key: str) -> None:
        super().__init__(env)
        self._key = key
        sizes = self._sizes
        masks = {size: spaces.Box(0, 1, (size,), np.int8) for size in sizes.values()}
        self.observation_spaces = {
            agent: spaces.Dict({key: box, "action_mask": masks[sizes[agent]]})
            for agent, box in self.observation_spaces.items()
        }

    def _seen(self, observations: Vectors, infos: Infos) -> dict[str, Any]:
        return {
            agent: {self._key: vector, "action_mask": self._mask(agent, infos)}
            for agent, vector in observations.items()
        }


def _longer(vector: NDArray[Any], width: int) -> NDArray[Any]:
    """Return a copy with zeros behind it; `numpy.pad` takes several times as long."""
    longer = np.zeros(width, dtype=vector.dtype)
    longer[: vector.size] = vector
    return longer


def _size(space: spaces.Discrete) -> int:
    return int(space.n)


def _dtype(box: spaces.Box) -> Any:
    assert box.dtype is not None
    return box.dtype.type


def _each(boxes: Mapping[str, spaces.Box], change: Any) -> dict[str, spaces.Box]:
    """Return each agent's changed box; agents that shared a box still share one."""
    changed = {id(box): change(box) for box in boxes.values()}
    return {agent: changed[id(box)] for agent, box in boxes.items()}


def common_box(boxes: list[spaces.Box]) -> spaces.Box:
    """Return a box that contains the vectors of all boxes, padded with zeros to one length."""
    width = max(box.shape[0] for box in boxes)
    low, high = (
        np.array([_longer(getattr(box, side), width) for box in boxes]) for side in ("low", "high")
    )
    return spaces.Box(low.min(axis=0), high.max(axis=0), dtype=_dtype(boxes[0]))
