"""Views: the inputs of models beside an agent's own state, from earlier and from neighbours.

A view widens the observations of a `Stack` to the right, so an agent's own numbers still begin at
column 0: ``own | earlier ones, each with the phase that ran and the one that was asked for |
neighbours, each with the phase that runs``. A command that was asked for and did not run is late or
lost; without it, no model of the street could know what is under way. Logs and running episodes use
the same function. At the start of an episode, its first observation, without phases, replaces the
missing earlier ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ugat_marl.envs import AnyParallelEnv, as_traffic_env
from ugat_marl.errors import LogError, OptionError, first_names, require_kinds, require_ranges
from ugat_marl.grounding.stacked import Stack, StackedTransitions
from ugat_marl.scenarios import within_hops

Neighbours = Mapping[str, Sequence[str]]
"""Agent to the agents one road away."""

UNKNOWN = -1
"""Phase of a decision before the first one of an episode."""


@dataclass(frozen=True)
class InputsConfig:
    """Inputs of f and h beside the intersection's own state and action.

    Attributes:
        history: Number of the last observations f sees, the current one included, with the phases
            that ran between them and those that were asked for.
        hops: Distance in roads up to which f and h see the features and phases of other
            intersections, with the phases that run in the step: the joint-local grounding of
            JL-GAT (Turnau et al. 2025).
    """

    history: int = 1
    hops: int = 0

    def __post_init__(self) -> None:
        require_kinds(self, "inputs")
        require_ranges(self, "inputs", at_least={"history": 1})
        if self.hops < 0:
            raise OptionError(f"inputs hops is {self.hops}; allowed: 0 or a number of roads")

    def near(self, agents: Sequence[str], neighbours: Neighbours | None) -> Neighbours:
        """Return the neighbours that each agent's models see, nearest first; none without hops.

        Raises:
            OptionError: There are hops, but neighbours are missing or do not fit the agents.
        """
        if not self.hops:
            return {}
        if neighbours is None:
            raise OptionError(
                f"inputs hops is {self.hops}, but nobody says who is near whom; give neighbours, "
                "such as ugat_marl.grounding.view.neighbours_of(env), or leave hops at 0"
            )
        foreign = {*neighbours, *(n for near in neighbours.values() for n in near)} ^ {*agents}
        if foreign:
            raise OptionError(
                f"neighbours and agents differ in {sorted(foreign)[:4]}; name the neighbours of "
                f"every agent: {first_names(agents)}"
            )
        return within_hops(neighbours, self.hops)


def neighbours_of(env: AnyParallelEnv) -> dict[str, tuple[str, ...]]:
    """Return the agents one road away from each agent of an environment, wrapped or not."""
    base = as_traffic_env(env)
    agent = {light: name for name, light in base.intersection_of.items()}
    return {
        agent[intersection.id]: tuple(agent[other] for other in intersection.neighbours)
        for intersection in base.network.intersections
    }


@dataclass(frozen=True)
class Moment:
    """Decisions of all agents, in any number of episodes.

    Attributes:
        observation: ``(agents, n, width)`` float32, padded observations.
        executed: ``(agents, n)`` int64, the phases that ran next; -1 if unknown.
        asked: ``(agents, n)`` int64, the phases that the policy asked for; -1 if unknown.
    """

    observation: Tensor
    executed: Tensor
    asked: Tensor


class View:
    """Extension of observations by earlier ones and by those of neighbours.

    Args:
        stack: The agents.
        history: Number of observations of an agent itself, the current one included.
        near: Agent to the neighbours it sees; agents that are left out see none.

    Attributes:
        sizes: Length of each agent's widened observation; `width` is the largest.
        lights: ``(agents, 1, width)`` bool, true for columns of phases (one-hot).
        joint: True if some agent sees a neighbour.
    """

    def __init__(self, stack: Stack, history: int = 1, near: Neighbours | None = None) -> None:
        self.stack = stack
        self.history = history
        self.near = {agent: tuple((near or {}).get(agent, ())) for agent in stack.agents}
        self.joint = any(self.near.values())
        places = [self._places(agent) for agent in stack.agents]
        self.sizes = [len(agent_places) for agent_places in places]
        self.width = max(self.sizes)
        # Padding reads the last column of all, which is zero.
        nothing = len(stack.agents) * history * self._block
        self._columns = torch.full((len(places), self.width), nothing)
        self.lights = torch.zeros(len(places), 1, self.width, dtype=torch.bool)
        for i, own in enumerate(places):
            self._columns[i, : len(own)] = torch.tensor([column for column, _ in own])
            self.lights[i, 0, : len(own)] = torch.tensor([light for _, light in own])

    def seen(self, now: Tensor, running: Tensor, earlier: Sequence[Moment] = ()) -> Tensor:
        """Return widened observations ``(agents, n, width)``.

        Args:
            now: ``(agents, n, stack.width)`` current observations.
            running: ``(agents, n)`` int64, the phases that run next; only neighbours see them.
            earlier: Earlier decisions of the episode, latest first.
        """
        if self.history == 1 and not self.joint:
            return now
        moments = [Moment(now, running, running), *earlier][: self.history]
        while len(moments) < self.history:
            unknown = torch.full_like(running, UNKNOWN)
            moments.append(Moment(moments[-1].observation, unknown, unknown))
        parts = [
            part
            for m in moments
            for part in (m.observation, self._shown(m.executed), self._shown(m.asked))
        ]
        rows = torch.cat(parts, -1).transpose(0, 1).flatten(1)
        rows = nn.functional.pad(rows, (0, 1))[:, self._columns.flatten()]
        return rows.view(-1, *self._columns.shape).transpose(0, 1).contiguous()

    def of(self, data: StackedTransitions) -> Tensor:
        """Return widened observations of all rows of a log, ``(agents, n, width)``.

        Raises:
            LogError: Neighbours are seen, but the agents were not recorded at the same times.
        """
        if self.history == 1 and not self.joint:
            return data.observation
        if self.joint:
            _refuse_unequal_times(data, self.stack)
        row = torch.arange(data.step.shape[1]).expand_as(data.step)
        goes_on = (data.episode[:, 1:] == data.episode[:, :-1]) & (data.step.diff(dim=1) == 1)
        begins = nn.functional.pad(~goes_on, (1, 0), value=True)
        first = torch.where(begins, row, 0).cummax(1).values
        earlier: list[Moment] = []
        for lag in range(1, self.history):
            before = (row - lag).maximum(first)
            places = before[..., None].expand_as(data.observation)
            executed, asked = (
                torch.where(row - lag >= first, phases.gather(1, before), UNKNOWN)
                for phases in (data.executed, data.asked)
            )
            earlier.append(Moment(data.observation.gather(1, places), executed, asked))
        return self.seen(data.observation, data.executed, earlier)

    @property
    def _block(self) -> int:
        """Width of one agent's numbers of one moment."""
        return self.stack.width + 2 * self.stack.actions

    def _shown(self, phase: Tensor) -> Tensor:
        """Return phases ``(agents, n)`` as one-hot; zeros for an unknown phase."""
        shown = nn.functional.one_hot(phase.clamp(min=0), self.stack.actions)
        return shown * (phase != UNKNOWN)[..., None].float()

    def _places(self, agent: str) -> list[tuple[int, bool]]:
        """Return, for each input, its column in a row of all moments, and True for a phase."""
        stack = self.stack

        def moment(name: str, lag: int, end: int, phases: int) -> list[tuple[int, bool]]:
            """Return the columns of a moment, with the executed phase (1) and the asked one (2)."""
            layout = stack.layouts[name]
            start = (stack.agents.index(name) * self.history + lag) * self._block
            lit = range(layout.features, layout.features + layout.phases)
            observed = [(start + k, k in lit) for k in range(end)]
            for kind in range(phases):
                first = start + stack.width + kind * stack.actions
                observed += [(first + k, True) for k in range(layout.phases)]
            return observed

        size = stack.layouts[agent].size
        columns = moment(agent, 0, size, phases=0)
        for lag in range(1, self.history):
            columns += moment(agent, lag, size, phases=2)
        for name in self.near[agent]:
            layout = stack.layouts[name]
            columns += moment(name, 0, layout.features + layout.phases, phases=1)
        return columns


def _refuse_unequal_times(data: StackedTransitions, stack: Stack) -> None:
    for times in (data.episode, data.step):
        for agent, agent_times in zip(stack.agents, times, strict=True):
            if not torch.equal(agent_times, times[0]):
                raise LogError(
                    f"the log has rows of {agent} at other times than of {stack.agents[0]}; models "
                    "that see their neighbours need all agents at every decision: record whole "
                    "episodes, or leave hops at 0"
                )
