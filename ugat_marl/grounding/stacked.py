"""Observations and transitions of unequal intersections as padded tensors, one row each.

An observation is ``features | phase one-hot | context``. Its head is the part that f predicts and h
compares: the features, followed by the phase if a model includes it. All padding is on the right,
so an intersection's own numbers always start at column 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ugat_marl.data import AgentLayout, TransitionLog
from ugat_marl.errors import LogError, first_names
from ugat_marl.policies import size_mask


class Stack:
    """The agents of a network in their order, and the sizes of their padded tensors.

    Attributes:
        layouts: Agent to the division of its observation.
        agents: Agent names; index i of every tensor's first axis is ``agents[i]``.
        sizes: Observation length of each agent; `width` is the largest.
        phases: Number of phases of each agent; `actions` is the largest.
        valid_actions: ``(agents, actions)`` bool, the phases each agent has.
    """

    def __init__(self, layouts: Mapping[str, AgentLayout]) -> None:
        self.layouts = dict(layouts)
        self.agents = tuple(layouts)
        self.sizes = [layout.size for layout in layouts.values()]
        self.phases = [layout.phases for layout in layouts.values()]
        self.width = max(self.sizes)
        self.actions = max(self.phases)
        self.valid_actions = size_mask(self.phases)

    def heads(self, include_phase: bool) -> list[int]:
        """Return the length of each agent's head: features, plus phases if included."""
        return [layout.features + layout.phases * include_phase for layout in self.layouts.values()]

    def current_phase(self, observation: Tensor) -> Tensor:
        """Return the phase, ``(agents, batch)``, in ``(agents, batch, width)`` observations."""
        phases = torch.zeros(observation.shape[:2], dtype=torch.long)
        for i, layout in enumerate(self.layouts.values()):
            shown = observation[i, :, layout.features : layout.features + layout.phases]
            phases[i] = shown.argmax(-1)
        return phases

    def observations(self, observations: Mapping[str, NDArray[np.float32]]) -> Tensor:
        """Return one observation per agent as ``(agents, 1, width)`` float32."""
        rows = np.zeros((len(self.agents), 1, self.width), np.float32)
        for row, agent, size in zip(rows, self.agents, self.sizes, strict=True):
            row[0, :size] = observations[agent][:size]  # a memory of commands follows
        return torch.from_numpy(rows)

    def masks(self, masks: Mapping[str, NDArray[np.int8] | None]) -> NDArray[np.bool_]:
        """Return action masks as ``(agents, actions)`` bool; an agent without one may do all."""
        rows = self.valid_actions.numpy().copy()
        for row, agent, phases in zip(rows, self.agents, self.phases, strict=True):
            mask = masks.get(agent)
            if mask is not None:
                row[:phases] = np.asarray(mask, bool)
        return rows


@dataclass(frozen=True)
class StackedTransitions:
    """Transitions of all agents, padded; n is the longest agent's number of rows.

    Attributes:
        observation: ``(agents, n, width)`` float32.
        next_observation: ``(agents, n, width)`` float32.
        served_features: ``(agents, n, features)`` float32, as in `Transitions`; None if they were
            not measured everywhere.
        asked: ``(agents, n)`` int64, the action that the policy chose.
        executed: ``(agents, n)`` int64, the phase that was served.
        delay_s: ``(agents, n)`` float32, delay of its green, in s.
        episode: ``(agents, n)`` int64, counted from 0 without gaps; -1 in padding.
        step: ``(agents, n)`` int64, number of the decision in its episode.
        weight: ``(agents, n)`` float32, 1 for a row, 0 for padding.
    """

    observation: Tensor
    next_observation: Tensor
    served_features: Tensor | None
    asked: Tensor
    executed: Tensor
    delay_s: Tensor
    episode: Tensor
    step: Tensor
    weight: Tensor

    @property
    def outcome(self) -> Tensor:
        """Features that show the effect of a green: the served ones if measured, else the next.

        The next features hardly depend on the start of the green: after ten seconds often the same
        number of vehicles has passed, and others have arrived.
        """
        return self.next_observation if self.served_features is None else self.served_features


def alike(
    one: StackedTransitions, two: StackedTransitions
) -> tuple[StackedTransitions, StackedTransitions]:
    """Return both with the served features, or both without."""
    if one.served_features is None or two.served_features is None:
        return replace(one, served_features=None), replace(two, served_features=None)
    return one, two


def refuse_other_agents(log: TransitionLog, stack: Stack) -> None:
    """Refuse a log whose agents or observations differ from those of the stack."""
    if dict(log.provenance.layouts) != stack.layouts:
        raise LogError(
            f"the transition log of {log.provenance.scenario} "
            f"({log.provenance.observation} observation, agents {first_names(log.agents)}) does "
            f"not fit the models, made for agents {first_names(stack.agents)}; use the same "
            "scenario and the same observation options"
        )


def stack_log(log: TransitionLog, stack: Stack) -> StackedTransitions:
    """Return all transitions of a log as padded tensors.

    Raises:
        LogError: The log has other agents, or an agent has no rows.
    """
    refuse_other_agents(log, stack)
    rows = [log.transitions(agent) for agent in stack.agents]
    for agent, agent_rows in zip(stack.agents, rows, strict=True):
        if not len(agent_rows):
            raise LogError(f"the transition log has no row of {agent}; record whole episodes")
    number = np.unique(log.frame["episode"].to_numpy())
    count, n = len(rows), max(len(agent_rows) for agent_rows in rows)
    observation = torch.zeros(count, n, stack.width)
    following = torch.zeros(count, n, stack.width)
    asked, executed, step = (torch.zeros(count, n, dtype=torch.long) for _ in range(3))
    episode = torch.full((count, n), -1)
    weight, delay_s = torch.zeros(count, n), torch.zeros(count, n)
    for i, agent_rows in enumerate(rows):
        k, size = len(agent_rows), stack.sizes[i]
        observation[i, :k, :size] = torch.from_numpy(agent_rows.observation)
        following[i, :k, :size] = torch.from_numpy(agent_rows.next_observation)
        asked[i, :k] = torch.from_numpy(agent_rows.action)
        executed[i, :k] = torch.from_numpy(agent_rows.executed)
        delay_s[i, :k] = torch.from_numpy(agent_rows.delay_s)
        episode[i, :k] = torch.from_numpy(np.searchsorted(number, agent_rows.episode))
        step[i, :k] = torch.from_numpy(agent_rows.step)
        weight[i, :k] = 1.0
    served: Tensor | None = None
    if all(agent_rows.served_features.shape[1] for agent_rows in rows):
        most = max(layout.features for layout in stack.layouts.values())
        served = torch.zeros(count, n, most)
        for i, agent_rows in enumerate(rows):
            part = torch.from_numpy(agent_rows.served_features)
            served[i, : len(agent_rows), : part.shape[1]] = part
    return StackedTransitions(
        observation, following, served, asked, executed, delay_s, episode, step, weight
    )
