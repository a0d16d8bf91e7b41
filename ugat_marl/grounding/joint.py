"""Grounding of neighbours at the same time, for models that see the phases of neighbours.

Such models need the phases that run at the neighbours. These are only known once the neighbours are
grounded. Roads lead in both directions, so no order of the agents solves this. Grounding searches a
fixed point instead. It grounds all agents for the phases that the policy asks for, then for the
phases that would run, and so on until nothing changes. Neighbours change their answers in turn;
otherwise two of them could alternate for ever. An agent that does not settle keeps its own action,
so the search always ends.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl.grounding.channel import obeyed
from ugat_marl.grounding.gate import Gate

PASSES = 10
"""Number of passes after which agents that still change keep their own actions."""

Answer = Callable[[NDArray[np.int64]], tuple[NDArray[np.int64], NDArray[np.float32]]]
"""Function from the phases that run, ``(agents,)``, to grounded actions and their u."""


@dataclass(frozen=True)
class Settled:
    """Answers that agree: each was given for the phases that will run.

    Attributes:
        grounded: ``(agents,)`` int64 grounded actions.
        u: ``(agents,)`` float32 uncertainties.
        allowed: ``(agents,)`` bool, false where the grounded action is masked or never settled;
            None if there are no masks.
    """

    grounded: NDArray[np.int64]
    u: NDArray[np.float32]
    allowed: NDArray[np.bool_] | None


def turns(agents: Sequence[str], near: Mapping[str, Sequence[str]]) -> NDArray[np.bool_]:
    """Return groups of agents, ``(turns, agents)`` bool; a group contains no two neighbours."""
    pairs = {(a, b) for a in agents for b in near.get(a, ())}
    turn: dict[str, int] = {}
    for agent in agents:
        taken = {turn[b] for b in turn if (agent, b) in pairs or (b, agent) in pairs}
        turn[agent] = next(k for k in range(len(agents)) if k not in taken)
    return np.arange(max(turn.values()) + 1)[:, None] == np.array([turn[a] for a in agents])


def running(
    actions: NDArray[np.int64], current: NDArray[np.int64], permitted: NDArray[np.bool_] | None
) -> NDArray[np.int64]:
    """Return the phases that run if these are asked for; without masks each is obeyed.

    Args:
        actions: ``(agents,)`` phases asked for.
        current: ``(agents,)`` phases that run now.
        permitted: ``(agents, phases)`` action masks.
    """
    return actions if permitted is None else obeyed(actions, current, permitted)


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
    current: NDArray[np.int64],
    permitted: NDArray[np.bool_] | None,
) -> Settled:
    """Ground all agents until the assumed phases are those that will run.

    Args:
        answer: Function that asks the models; called at least once.
        gate: Gate that decides which answers would be taken; nothing is logged.
        in_turn: ``(turns, agents)`` bool, groups of `turns`.
        actions: ``(agents,)`` the policy's actions.
        current: ``(agents,)`` phases that run now.
        permitted: ``(agents, phases)`` action masks.
    """
    policy_phases = running(actions, current, permitted)
    told, given_up, turn = policy_phases, np.zeros(len(actions), bool), 0
    while True:
        for count in range(1, PASSES + 1):
            grounded, u = answer(told)
            allowed = ~given_up
            if permitted is not None:
                allowed = allowed & _allowed(grounded, permitted)
            executed = np.where(gate.accepts(u, allowed), grounded, actions)
            will_run = running(executed, current, permitted)
            changes = will_run != told
            if not changes.any():
                return Settled(grounded, u, allowed)
            while not (in_turn[turn] & changes).any():
                turn = (turn + 1) % len(in_turn)
            movers = in_turn[turn] & changes
            turn = (turn + 1) % len(in_turn)
            if count == PASSES:  # agents given up never move again, so the search ends
                given_up = given_up | movers
                will_run = policy_phases
            told = np.where(movers, will_run, told)


def _allowed(actions: NDArray[np.int64], permitted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return permitted[np.arange(len(actions)), actions]
