"""How much green is lost on the street: the delay with which a model of the simulation fits best.

A model of the simulation knows what a green does that begins so many seconds late. The street's
changes are compared with it in the mean over all transitions of a phase, lane by lane: single ones
are mostly noise. Not by the sum of squared errors, which also counts the errors of the model, and
so prefers the delays it happens to know best. And not by a model trained to guess the delay from a
noisy transition: whoever guesses well under noise guesses the middle of the range.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ugat_marl.grounding.delays import DelayedForward
from ugat_marl.grounding.scaling import SMALLEST_SPREAD
from ugat_marl.grounding.stacked import StackedTransitions

STEP_S = 0.1
"""Resolution of the estimates."""
LEAST_ROWS = 5
"""Fewer transitions have no mean to speak of."""
LEAST_S = 0.5
"""What is less is 0 in whole seconds."""
LEVEL = 3.84
"""95 % quantile of chi-squared with one degree of freedom."""


@dataclass(frozen=True)
class LostTime:
    """Delays that fit measured transitions best, in s.

    Attributes:
        phase_s: ``(agents, phases)``, those of single phases, drawn to their intersection's.
        best_s: ``(agents,)``, one for all phases of an intersection.
        low_s: ``(agents,)`` lower end of its 95 % interval; ``high_s`` the upper.
        switches: ``(agents,)``, the number of transitions behind them.
    """

    phase_s: Tensor
    best_s: NDArray[np.float64]
    low_s: NDArray[np.float64]
    high_s: NDArray[np.float64]
    switches: NDArray[np.int64]

    @property
    def shown(self) -> NDArray[np.bool_]:
        """Whether there is any, ``(agents,)``.

        There is none where 0 s would do as well and the best delay is 0 in whole seconds: what is
        left is chance, and it would be made up for in every green of training.
        """
        return (self.low_s > 0.0) | (self.best_s >= LEAST_S)


@dataclass(frozen=True)
class Means:
    """What a model of the simulation leaves open, and how well it knows each delay.

    Attributes:
        spread: ``(agents, outputs)``, root mean square error, in units of its scale.
        rows: ``(agents, phases, delays)``, rows it was fitted to, by whole seconds.
    """

    spread: Tensor
    rows: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, model: DelayedForward, data: StackedTransitions) -> Means:
        """Of a fitted model; the rows with weight are those it was fitted to."""
        change = model.change(data.observation, data.outcome) / model.scale
        seen = model.view.of(data)
        error = model(seen, data.executed, model.extra(data.delay_s)) - change
        count = data.weight.sum(1, keepdim=True).clamp(min=1.0)
        mean = (data.weight[..., None] * error**2).sum(1) / count
        classes = model.most_s + 1
        cell = data.executed * classes + data.delay_s.round().long().clamp(max=model.most_s)
        rows = torch.zeros(len(mean), model.stack.actions * classes)
        rows = rows.scatter_add_(1, cell, data.weight).view(len(mean), -1, classes)
        return cls(mean.sqrt().clamp(min=SMALLEST_SPREAD), rows)


@torch.no_grad()
def lost_time(
    model: DelayedForward, data: StackedTransitions, known: Means, phase_s: float
) -> LostTime:
    """Estimates the delays: by phase and lane, mean changes as the street has them.

    Args:
        model: Of the simulation.
        data: Of the street; rows with weight are those in which a green begins.
        known: What the model leaves open.
        phase_s: How far single phases are expected to lie from their intersection, in s.
    """
    stack, seen = model.stack, model.view.of(data)
    grid = torch.linspace(0.0, model.most_s, round(model.most_s / STEP_S) + 1)
    change = model.change(data.observation, data.outcome) / model.scale
    rows = torch.zeros(len(stack.agents), stack.actions).scatter_add_(1, data.executed, data.weight)
    enough = known.rows.sum(-1) >= LEAST_ROWS * known.rows.shape[-1]
    use = (enough & (rows >= LEAST_ROWS))[..., None] * model.valid_outputs
    cost = torch.zeros(len(stack.agents), stack.actions, len(grid), dtype=torch.float64)
    misfit = torch.zeros_like(cost)
    for place, seconds in enumerate(grid.tolist()):
        extra = model.extra(torch.full_like(data.delay_s, seconds))
        error = change - model(seen, data.executed, extra)
        mean = _by_phase(error * data.weight[..., None], data.executed, rows)
        simulated = _between(known.rows, seconds)
        chance = 1.0 / rows.clamp(min=1.0) + 1.0 / simulated.clamp(min=1.0)
        chance = (chance[..., None] * known.spread[:, None] ** 2).double()
        misfit[:, :, place] = (use * mean**2 / chance).sum(-1)
        cost[:, :, place] = misfit[:, :, place] + (use * chance.log()).sum(-1)
    # What no delay explains is the model's own error; it makes the delays less certain.
    excess = (misfit.sum(1).amin(-1) / use.sum((1, 2)).clamp(min=1.0)).clamp(min=1.0)[:, None]
    total = cost.sum(1)
    likely = (total - total.amin(-1, keepdim=True)) / excess
    best = grid[total.argmin(-1)]
    inside = (likely <= LEVEL).numpy()
    low = [float(grid[row.argmax()]) for row in inside]
    high = [float(grid[len(grid) - 1 - row[::-1].argmax()]) for row in inside]
    prior = ((grid - best[:, None]) / phase_s) ** 2
    return LostTime(
        phase_s=grid[(cost / excess[..., None] + prior[:, None, :]).argmin(-1)].float(),
        best_s=best.double().numpy(),
        low_s=np.array(low),
        high_s=np.array(high),
        switches=data.weight.sum(1).long().numpy(),
    )


def _by_phase(values: Tensor, phase: Tensor, rows: Tensor) -> Tensor:
    """Means of ``(agents, n, outputs)`` over the `rows` of every phase: float64, one per phase."""
    agents, _, outputs = values.shape
    places = phase[..., None].expand(-1, -1, outputs)
    total = torch.zeros(agents, rows.shape[1], outputs).scatter_add_(1, places, values)
    return (total / rows.clamp(min=1.0)[..., None]).double()


def _between(rows: Tensor, seconds: float) -> Tensor:
    """Rows near a delay: those of the whole seconds beside it, by distance."""
    below = min(int(seconds), rows.shape[-1] - 2)
    share = seconds - below
    return rows[..., below] * (1.0 - share) + rows[..., below + 1] * share
