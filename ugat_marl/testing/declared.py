"""Checks of what an environment says about itself before it is reset."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from ugat_marl.testing.episodes import EnvironmentCase
from ugat_marl.testing.results import ConformanceError, require

_AGENT = re.compile(r"[A-Za-z][A-Za-z0-9-]*(_[A-Za-z0-9-]+)*_[0-9]+")


def agents_are_named(case: EnvironmentCase) -> None:
    """Agents are known before `reset` and called ``<group>_<n>``."""
    agents: Any = getattr(case.fresh, "possible_agents", None)
    require(
        isinstance(agents, list) and agents,
        f"possible_agents is {agents!r} before reset(); make it a list of names in __init__",
    )
    require(len(set(agents)) == len(agents), f"possible_agents has a name twice: {agents}")
    for agent in agents:
        require(
            isinstance(agent, str) and _AGENT.fullmatch(agent),
            f"the agent {agent!r} is not called <group>_<n>, like 'signal_0'; TorchRL and AgileRL "
            "group agents by that, and break on dots",
        )


def groups_have_equal_spaces(case: EnvironmentCase) -> None:
    """Agents whose names share a prefix have equal spaces."""
    env = case.fresh
    first: dict[str, str] = {}
    for agent in env.possible_agents:
        other = first.setdefault(agent.rpartition("_")[0], agent)
        for kind in ("observation_space", "action_space"):
            a, b = getattr(env, kind)(other), getattr(env, kind)(agent)
            require(
                a == b,
                f"{other} and {agent} share a prefix, but their {kind}s differ: {a} and {b}; "
                "give unequal agents different prefixes",
            )


def groups_are_listed(case: EnvironmentCase) -> None:
    """`unwrapped.agent_groups` maps each prefix to its agents."""
    expected: dict[str, list[str]] = {}
    for agent in case.fresh.possible_agents:
        expected.setdefault(agent.rpartition("_")[0], []).append(agent)
    groups: Any = getattr(case.fresh.unwrapped, "agent_groups", None)
    found = {k: list(v) for k, v in groups.items()} if isinstance(groups, Mapping) else groups
    require(
        found == expected,
        f"unwrapped.agent_groups is {found!r}; make it {expected!r}",
    )


def agents_have_traffic_lights(case: EnvironmentCase) -> None:
    """`unwrapped.intersection_of` maps every agent to a traffic light of its own."""
    lights: Any = getattr(case.fresh.unwrapped, "intersection_of", None)
    agents = set(case.fresh.possible_agents)
    require(
        isinstance(lights, Mapping) and set(lights) == agents,
        "unwrapped.intersection_of must map every agent to SUMO's id of its traffic light; "
        f"it is {lights!r}",
    )
    require(
        len(set(lights.values())) == len(agents),
        f"two agents have the same traffic light in unwrapped.intersection_of: {lights!r}",
    )


def spaces_are_the_same_objects(case: EnvironmentCase) -> None:
    """Asking twice for a space gives one object, or seeding it would have no effect."""
    env = case.fresh
    for agent in env.possible_agents:
        for kind in ("observation_space", "action_space"):
            ask = getattr(env, kind)
            require(
                ask(agent) is ask(agent),
                f"{kind}({agent!r}) makes a new space at each call; make it once, in __init__",
            )


def spaces_are_listed(case: EnvironmentCase) -> None:
    """`unwrapped` has `observation_spaces` and `action_spaces` (skrl and EPyMARL read them)."""
    env = case.fresh
    for kind in ("observation_space", "action_space"):
        listed: Any = getattr(env.unwrapped, f"{kind}s", None)
        require(
            isinstance(listed, Mapping) and set(listed) == set(env.possible_agents),
            f"unwrapped.{kind}s must be a dict with the space of every agent; skrl and EPyMARL "
            "read it",
        )
        for agent in env.possible_agents:
            require(
                listed[agent] == getattr(env, kind)(agent),
                f"unwrapped.{kind}s[{agent!r}] is not what {kind}({agent!r}) returns",
            )


def observation_spaces_are_bounded(case: EnvironmentCase) -> None:
    """Observations are float32 vectors with finite bounds."""
    for agent in case.fresh.possible_agents:
        _require_bounded(case.fresh.observation_space(agent), f"the observation space of {agent}")


def _require_bounded(space: Any, what: str) -> None:
    require(
        isinstance(space, Box) and space.dtype == np.float32 and len(space.shape) == 1,
        f"{what} is {space}; make it a one-dimensional float32 Box",
    )
    for side, bound in (("low", space.low), ("high", space.high)):
        wrong = np.flatnonzero(~np.isfinite(bound))
        if wrong.size:
            raise ConformanceError(
                f"{what} has the bound {side}[{wrong[0]}] = {bound[wrong[0]]}; scale observations "
                "into finite bounds, best [0, 1]"
            )
    wrong = np.flatnonzero(space.low >= space.high)
    require(
        not wrong.size,
        f"{what} has low >= high at {wrong[:3].tolist()}; leave constants out of the observation",
    )


def action_spaces_count_from_zero(case: EnvironmentCase) -> None:
    """Actions are the whole numbers 0 to n - 1 with n > 1."""
    for agent in case.fresh.possible_agents:
        space: Any = case.fresh.action_space(agent)
        require(
            isinstance(space, Discrete) and space.start == 0 and space.n > 1,
            f"the action space of {agent} is {space}; use Discrete(n) with n > 1 green phases, "
            "and no agent where there is nothing to choose",
        )


def state_space_is_bounded(case: EnvironmentCase) -> None:
    """`state_space` exists before `reset`; float32, finite."""
    space = getattr(case.fresh, "state_space", None)
    require(space is not None, "state_space is missing; skrl and QMIX read it before reset()")
    _require_bounded(space, "state_space")


def metadata_is_complete(case: EnvironmentCase) -> None:
    """`metadata` and `render_mode` are as PettingZoo wants them."""
    env: Any = case.fresh
    metadata: Any = getattr(env, "metadata", None)
    require(isinstance(metadata, Mapping), f"metadata is {metadata!r}; make it a dict")
    name, modes = metadata.get("name"), metadata.get("render_modes")
    require(
        isinstance(name, str) and name,
        f"metadata['name'] is {name!r}; give the environment a name that ends in _v<N>",
    )
    require(
        isinstance(modes, list | tuple) and all(isinstance(mode, str) for mode in modes),
        f"metadata['render_modes'] is {modes!r}; make it a list of names, maybe empty",
    )
    require(
        metadata.get("is_parallelizable") is True,
        "metadata['is_parallelizable'] is not True; PettingZoo's conversions refuse such a "
        "parallel environment",
    )
    require(
        hasattr(env.unwrapped, "render_mode"),
        "the attribute render_mode is missing; set it in __init__, to None if nothing is drawn",
    )
    mode = env.unwrapped.render_mode
    require(
        mode is None or mode in modes,
        f"render_mode is {mode!r}, which metadata['render_modes'] {list(modes)} does not list",
    )


def attributes_do_not_mislead(case: EnvironmentCase) -> None:
    """There is no `num_envs` and no `device`."""
    for env in (case.fresh, case.fresh.unwrapped):
        for name in ("num_envs", "device"):
            require(
                not hasattr(env, name),
                f"the environment has the attribute {name!r}, from which skrl concludes that it "
                "is a vector environment of another library; rename it",
            )


DECLARED = (
    agents_are_named,
    agents_have_traffic_lights,
    groups_are_listed,
    groups_have_equal_spaces,
    spaces_are_the_same_objects,
    spaces_are_listed,
    observation_spaces_are_bounded,
    action_spaces_count_from_zero,
    state_space_is_bounded,
    metadata_is_complete,
    attributes_do_not_mislead,
)
