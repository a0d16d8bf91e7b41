"""Checks of the actions of agents before a step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

from gymnasium.spaces import Discrete

from ugat_marl.errors import ActionError


def checked_phases(
    actions: Mapping[str, Any], agents: Sequence[str], spaces: Mapping[str, Discrete]
) -> list[int]:
    """Return the green phase requested by each agent, in their order.

    Raises:
        ActionError: An action is missing, is of an unknown agent, or is outside its space.
    """
    _refuse_unknown("actions", actions, agents)
    requested: list[int] = []
    for agent in agents:
        if agent not in actions:
            raise ActionError(f"no action for agent {agent!r}; every agent needs one")
        action = actions[agent]
        if not is_phase(action, spaces[agent]):
            last = spaces[agent].n - 1
            raise ActionError(
                f"action of agent {agent!r} is {action!r}; "
                f"allowed: the integers 0 to {last}, its green phases, as int or NumPy's scalar"
            )
        requested.append(int(action))
    return requested


def checked_delays(seconds: Mapping[str, float], agents: Sequence[str]) -> dict[str, float]:
    """Return the delays of the greens of some agents, in s.

    Raises:
        ActionError: A delay is of an unknown agent, not a number, negative or not finite.
    """
    _refuse_unknown("delays", seconds, agents)
    for agent, delay in seconds.items():
        if not isinstance(delay, Real) or not 0 <= delay < math.inf:
            raise ActionError(f"delay of agent {agent!r} is {delay!r} s; allowed: 0 or more")
    return {agent: float(delay) for agent, delay in seconds.items()}


def require_mapping(kind: str, given: Any, agents: Sequence[str]) -> None:
    """Refuse what is no dictionary.

    Args:
        kind: What is given, for the message.
        given: What is given.
        agents: The agents, which should be the keys.

    Raises:
        ActionError: It is no dictionary.
    """
    if not isinstance(given, Mapping):
        raise ActionError(
            f"{kind} are {str(given)[:80]!r} ({type(given).__name__}); give a dictionary with the "
            f"agents as its keys: {[*agents]}"
        )


def _refuse_unknown(kind: str, given: Any, agents: Sequence[str]) -> None:
    require_mapping(kind, given, agents)
    if unknown := sorted(set(given) - set(agents), key=str):
        raise ActionError(f"{kind} for unknown agents {unknown}; agents: {[*agents]}")


def is_phase(action: Any, space: Discrete) -> bool:
    """Return True if `space` contains `action`; fast for a plain int, the usual case."""
    return (type(action) is int and 0 <= action < space.n) or space.contains(action)
