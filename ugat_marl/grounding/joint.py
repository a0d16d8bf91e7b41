"""Grounding neighbours at the same time: everyone's models see the phases that will really run.

Models that see their neighbours are told which phases run there, and those are only known once the
neighbours are grounded. With roads in both directions everyone is upstream of somebody who is
upstream of them, so that no order of the agents gives each the final phases of the others. The
answer is a fixed point: all agents are grounded for the phases the others ask for, again for those
that would then run, and so on until nothing changes. An agent that goes on changing its mind is
left with its own action, so that an end always comes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl.grounding.gate import Gate

PASSES = 6
"""Times all agents are grounded before those that have not settled keep their own actions."""

Answer = Callable[[NDArray[np.int64]], tuple[NDArray[np.int64], NDArray[np.float32]]]
"""Grounded actions and their u, ``(agents,)`` each, if these phases run everywhere."""


@dataclass(frozen=True)
class Settled:
    """Answers that hold together: each was given for the phases that will run.

    Attributes:
        grounded: ``(agents,)`` int64.
        u: ``(agents,)`` float32.
        allowed: ``(agents,)`` bool, false where the grounded action is masked or never settled;
            None if there are no masks.
    """

    grounded: NDArray[np.int64]
    u: NDArray[np.float32]
    allowed: NDArray[np.bool_] | None


def running(actions: NDArray[np.int64], permitted: NDArray[np.bool_] | None) -> NDArray[np.int64]:
    """The phases that run if these are asked for: a light that may not change yet does not.

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
    """One pass, for models that see no neighbours."""
    grounded, u = answer(actions)
    return Settled(grounded, u, None if permitted is None else _allowed(grounded, permitted))


def together(
    answer: Answer, gate: Gate, actions: NDArray[np.int64], permitted: NDArray[np.bool_] | None
) -> Settled:
    """Grounds all agents until the phases they were told of are those that will run.

    Args:
        answer: Asks the models; called at least once.
        gate: Says which answers would be taken; its books are left alone.
        actions: ``(agents,)`` the policy's actions.
        permitted: ``(agents, phases)`` action masks.
    """
    will_run = running(actions, permitted)
    given_up = np.zeros(len(actions), bool)
    while True:
        told = will_run
        for _ in range(PASSES):
            told = will_run
            grounded, u = answer(told)
            allowed = ~given_up
            if permitted is not None:
                allowed = allowed & _allowed(grounded, permitted)
            executed = np.where(gate.accepts(u, allowed), grounded, actions)
            will_run = running(executed, permitted)
            if np.array_equal(will_run, told):
                return Settled(grounded, u, allowed)
        # Whoever has given up runs its own action from then on, so these are always new ones.
        given_up |= will_run != told


def _allowed(actions: NDArray[np.int64], permitted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return permitted[np.arange(len(actions)), actions]
