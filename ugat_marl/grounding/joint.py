"""Grounding of neighbours at the same time: models see the phases that will really run.

Models that see their neighbours are told which phases run there, and those are only known once the
neighbours are grounded. With roads in both directions each agent is upstream of one that is
upstream of it, so that no order of the agents gives each the final phases of the others. The answer
is a fixed point: all agents are grounded for the phases the others ask for, again for those that
would then run, and so on until nothing changes. Neighbours change their answers in turn, or two of
them could alternate for ever. An agent that does not settle keeps its own action, so that the
search always ends.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl.grounding.gate import Gate

PASSES = 10
"""Times all agents are grounded before some that have not settled keep their own actions."""

Answer = Callable[[NDArray[np.int64]], tuple[NDArray[np.int64], NDArray[np.float32]]]
"""Grounded actions and their u, ``(agents,)`` each, if these phases run everywhere."""


@dataclass(frozen=True)
class Settled:
    """Answers that fit together: each was given for the phases that will run.

    Attributes:
        grounded: ``(agents,)`` int64.
        u: ``(agents,)`` float32.
        allowed: ``(agents,)`` bool, false where the grounded action is masked or never settled;
            None if there are no masks.
    """

    grounded: NDArray[np.int64]
    u: NDArray[np.float32]
    allowed: NDArray[np.bool_] | None


def turns(agents: Sequence[str], near: Mapping[str, Sequence[str]]) -> NDArray[np.bool_]:
    """Return groups of agents without neighbours among them, ``(turns, agents)`` bool."""
    pairs = {(a, b) for a in agents for b in near.get(a, ())}
    turn: dict[str, int] = {}
    for agent in agents:
        taken = {turn[b] for b in turn if (agent, b) in pairs or (b, agent) in pairs}
        turn[agent] = next(k for k in range(len(agents)) if k not in taken)
    return np.arange(max(turn.values()) + 1)[:, None] == np.array([turn[a] for a in agents])


def running(actions: NDArray[np.int64], permitted: NDArray[np.bool_] | None) -> NDArray[np.int64]:
    """Return the phases that run if these are asked for: a light that may not change stays.

    Args:
        actions: ``(agents,)``.
        permitted: ``(agents, phases)`` action masks.
    """
    if permitted is None:
        return actions
    held = ~_allowed(actions, permitted) & (permitted.sum(1) == 1)
    return np.where(held, permitted.argmax(1), actions)


def alone(
    answer: Answer, actions: NDArray[np.int64], permitted: NDArray[np.bool_] | None
) -> Settled:
    """Ground all agents once, for models that see no neighbours."""
    grounded, u = answer(actions)
    return Settled(grounded, u, None if permitted is None else _allowed(grounded, permitted))


def together(
    answer: Answer,
    gate: Gate,
    in_turn: NDArray[np.bool_],
    actions: NDArray[np.int64],
    permitted: NDArray[np.bool_] | None,
) -> Settled:
    """Ground all agents until the phases they were told of are those that will run.

    Args:
        answer: Asks the models; called at least once.
        gate: Says which answers would be taken; its books are left alone.
        in_turn: ``(turns, agents)`` bool, as `turns` makes it.
        actions: ``(agents,)`` the policy's actions.
        permitted: ``(agents, phases)`` action masks.
    """
    own = running(actions, permitted)
    told, given_up, turn = own, np.zeros(len(actions), bool), 0
    while True:
        for count in range(1, PASSES + 1):
            grounded, u = answer(told)
            allowed = ~given_up
            if permitted is not None:
                allowed = allowed & _allowed(grounded, permitted)
            executed = np.where(gate.accepts(u, allowed), grounded, actions)
            will_run = running(executed, permitted)
            changes = will_run != told
            if not changes.any():
                return Settled(grounded, u, allowed)
            while not (in_turn[turn] & changes).any():
                turn = (turn + 1) % len(in_turn)
            movers = in_turn[turn] & changes
            turn = (turn + 1) % len(in_turn)
            if count == PASSES:  # an agent that gave up never moves again: these are new ones
                given_up = given_up | movers
                will_run = own
            told = np.where(movers, will_run, told)


def _allowed(actions: NDArray[np.int64], permitted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return permitted[np.arange(len(actions)), actions]
