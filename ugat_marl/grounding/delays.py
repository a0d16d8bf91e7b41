"""Estimates of how late greens begin on the street: by lost time, and by rewards.

**Lost time.** A model of the simulation knows what a green does that begins so many seconds late.
The street's changes are compared with it in the mean over all transitions of a phase, lane by lane:
single ones are mostly noise. Not by the sum of squared errors, which also counts the errors of the
model, and so prefers the delays it happens to know best. And not by a model trained to guess the
delay from a noisy transition: the best guess under noise is the middle of the range.

**Matched rewards.** Lost time is what a street's first intervals say. Slow vehicles lose more while
the green lasts. No delay of a beginning is that, but a longer one can make up for it: with the
delay found here the same policy has, over whole episodes, the same reward in both worlds. Rewards
do not say why: any other difference of the worlds is charged to the delay, too. And it has to be
the same policy, so that logs of another one do not do.

An hour of traffic is one sample, and some delay fits best even where no green is late. So greens
are moved only where chance does not explain the difference between the street's rewards and those
of the simulation with the lost time alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
import torch
from numpy.typing import NDArray
from scipy import optimize, special
from torch import Tensor

from ugat_marl.data import TransitionLog
from ugat_marl.grounding.forward import DelayedForward
from ugat_marl.grounding.networks import SMALLEST_SPREAD
from ugat_marl.grounding.reports import Floats
from ugat_marl.grounding.stacked import StackedTransitions

# --- lost time

STEP_S = 0.1
"""Resolution of the estimates."""
LEAST_ROWS = 5
"""Transitions of a phase below which their mean is not used."""
LEAST_S = 0.5
"""Delays below this are 0 when rounded to whole seconds."""
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
        """Intersections with a lost time, ``(agents,)`` bool.

        The others are those where 0 s fits as well and the best delay is 0 in whole seconds: that
        is chance, and would be made up for in every green of training.
        """
        return (self.low_s > 0.0) | (self.best_s >= LEAST_S)


@dataclass(frozen=True)
class ModelErrors:
    """Errors that a model of the simulation leaves, and the rows behind each delay.

    Attributes:
        spread: ``(agents, outputs)``, root mean square error, in units of its scale.
        rows: ``(agents, phases, delays)``, rows it was fitted to, by whole seconds.
    """

    spread: Tensor
    rows: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, model: DelayedForward, data: StackedTransitions) -> ModelErrors:
        """Measure a fitted model; the rows with weight are those it was fitted to."""
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
    model: DelayedForward, data: StackedTransitions, known: ModelErrors, phase_s: float
) -> LostTime:
    """Estimate the delays: by phase and lane, mean changes as the street has them.

    Args:
        model: Of the simulation.
        data: Of the street; rows with weight are those in which a green begins.
        known: What the model leaves open.
        phase_s: Expected distance of single phases from their intersection, in s.
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
    """Return means of ``(agents, n, outputs)`` over the `rows` of every phase, in float64."""
    agents, _, outputs = values.shape
    places = phase[..., None].expand(-1, -1, outputs)
    total = torch.zeros(agents, rows.shape[1], outputs).scatter_add_(1, places, values)
    return (total / rows.clamp(min=1.0)[..., None]).double()


def _between(rows: Tensor, seconds: float) -> Tensor:
    """Return the rows near a delay: those of the whole seconds beside it, by distance."""
    below = min(int(seconds), rows.shape[-1] - 2)
    share = seconds - below
    return rows[..., below] * (1.0 - share) + rows[..., below + 1] * share


# --- matched rewards

MATCHED_REWARD = "queue"
"""The reward that can be matched: it falls with every delay, and an episode's mean is one of many
moments. Differences of waiting times add up to what is left at the end."""
CHANCE = 0.05
"""Probability under the lost time alone below which rewards speak against it."""


@dataclass(frozen=True)
class EpisodeRewards:
    """Mean rewards per decision that one policy got in single episodes.

    Attributes:
        street: ``(episodes, agents)``.
        simulated: In the simulation with all greens late by 0, 1, 2, ... s,
            ``(delays, episodes, agents)``.
        before: What earlier policies got on the street, each ``(episodes, agents)``: they, too,
            tell how much the rewards of an episode vary.
    """

    street: Floats
    simulated: Floats
    before: Sequence[Floats] = ()


@dataclass(frozen=True)
class MatchedDelays:
    """Delays of greens by which rewards match.

    Attributes:
        delay_s: ``(agents,)``, with which the simulation pays what the street pays, in s.
        chance: How likely the street's rewards are under the lost time alone (`chance_of`).
        beyond_s: ``(agents,)``, what greens are to be later by than the lost time; 0 where chance
            explains the rewards.
    """

    delay_s: Floats
    chance: float
    beyond_s: Floats


def match_delays(rewards: EpisodeRewards, lost_s: Floats) -> MatchedDelays:
    """Find how much later than by their lost time greens have to be for rewards to match.

    Args:
        rewards: Of one policy, in both worlds.
        lost_s: ``(agents,)``, what greens lose when they begin, in s.
    """
    delay_s = matching_delays(rewards.street.mean(0), rewards.simulated.mean(1))
    chance = chance_of(rewards, lost_s)
    return MatchedDelays(delay_s, chance, (delay_s - lost_s) * (chance < CHANCE))


def episode_rewards(log: TransitionLog, agents: Sequence[str]) -> Floats:
    """Return mean rewards of these agents in each episode of a log, ``(episodes, agents)``."""
    means = log.frame.group_by("episode", "agent").agg(pl.col("reward").mean())
    table = means.pivot("agent", index="episode", values="reward").sort("episode")
    return table.select(agents).to_numpy().astype(np.float64)


def chance_of(rewards: EpisodeRewards, delay_s: Floats) -> float:
    """Return how likely the street's rewards are if its greens are late by these delays only.

    Two-sided, by Student's t, of the sum over the network: what an hour's traffic does to rewards
    it does to all intersections. Episodes are taken to vary in proportion to their mean.

    Args:
        rewards: Of one policy, in both worlds.
        delay_s: ``(agents,)``, delays in s.

    Returns:
        A p-value; 1 where no two episodes tell how much rewards vary.
    """
    delays, episodes, _ = rewards.simulated.shape
    late = np.arange(delays, dtype=np.float64)
    curves = zip(delay_s, rewards.simulated.mean(1).T, strict=True)
    expected = sum(float(np.interp(seconds, late, falling(curve))) for seconds, curve in curves)
    street = rewards.street.sum(1)
    alike = [street, *rewards.simulated.sum(2), *(group.sum(1) for group in rewards.before)]
    degrees = sum(len(group) - 1 for group in alike)
    if degrees < 1:
        return 1.0
    varies = math.sqrt(sum(_relative_squares(group) for group in alike) / degrees)
    error = varies * math.hypot(
        float(street.mean()) / math.sqrt(len(street)), expected / math.sqrt(episodes)
    )
    beyond = float(street.mean()) - expected
    if beyond == 0.0 or error == 0.0:
        return 1.0 if beyond == 0.0 else 0.0
    return 2.0 * float(special.stdtr(degrees, -abs(beyond / error)))


def _relative_squares(group: Floats) -> float:
    """Return the sum of squared distances from the mean, as shares of it; 0 if it is 0."""
    mean = float(group.mean())
    return float((((group - mean) / mean) ** 2).sum()) if mean else 0.0


def matching_delays(street: Floats, simulated: Floats) -> Floats:
    """Return the delay at which the simulation pays as much as the street.

    Rewards are taken to fall with the delay: where they rise by chance, neighbours are averaged
    (isotonic regression). Between whole seconds they lie on a line.

    Args:
        street: Mean rewards ``(agents,)``.
        simulated: The same with greens late by 0, 1, 2, ... s, ``(delays, agents)``.

    Returns:
        Delays in s, ``(agents,)``, of several that pay the same the shortest; 0 where the street
        pays more than the simulation at its best, that of its worst where it pays less.
    """
    pairs = zip(street, simulated.T, strict=True)
    return np.array([_matching(paid, falling(curve)) for paid, curve in pairs], dtype=np.float64)


def falling(values: Floats) -> Floats:
    """Return the sequence that never rises and is closest to `values` (least squares), ``(n,)``."""
    return optimize.isotonic_regression(values, increasing=False).x


def _matching(paid: float, curve: Floats) -> float:
    after = int(np.argmax(curve <= max(paid, curve[-1])))  # the shortest of those that pay the same
    if after == 0 or curve[after] > paid:
        return float(after)
    return after - (paid - curve[after]) / (curve[after - 1] - curve[after])
