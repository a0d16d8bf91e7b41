"""Estimates of the delay of greens on the street (the real domain): by lost time, and by rewards.

**Lost time.** A model of the simulation predicts the changes after a green with a given delay. The
mean changes on the street are compared with it, by phase and lane, because single transitions are
mostly noise. Two other estimates fail. The sum of squared errors also counts the errors of the
model, so it prefers delays that the model knows best. A model that guesses the delay from a noisy
transition answers with the middle of the range.

**Matched rewards.** Lost time describes only the start of a green; slow vehicles also lose time
later. A longer delay can make up for this loss. With the matched delay, a policy gets the same
reward over whole episodes in both worlds. Every other difference between the worlds enters this
delay, too. Both rewards must come from the same policy.

An hour of traffic is one sample, so some delay fits best even where no green is late. Greens are
therefore moved only if chance does not explain the difference between the rewards of the street and
those of the simulation with the lost time alone.
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
"""Resolution of the estimates, in s."""
LEAST_ROWS = 5
"""Smallest number of transitions of a phase from which its mean is used."""
LEAST_S = 0.5
"""Smallest delay, in s, that is taken for one: half of the step of whole seconds."""
LEVEL = 3.84
"""95 % quantile of chi-squared with one degree of freedom."""


@dataclass(frozen=True)
class LostTime:
    """Delays that fit measured transitions best, in s.

    Attributes:
        phase_s: ``(agents, phases)``, delays of single phases, pulled to their intersection's.
        best_s: ``(agents,)``, common delay of all phases of an intersection.
        low_s: ``(agents,)``, lower end of the 95 % interval of `best_s`; `high_s` is the upper.
        switches: ``(agents,)``, number of transitions used.
    """

    phase_s: Tensor
    best_s: NDArray[np.float64]
    low_s: NDArray[np.float64]
    high_s: NDArray[np.float64]
    switches: NDArray[np.int64]

    @property
    def shown(self) -> NDArray[np.bool_]:
        """Intersections with a lost time, ``(agents,)`` bool.

        At the others 0 s lies in the interval and the best delay rounds to 0 s. Such a delay may be
        chance, and would act on every green of the training.
        """
        return (self.low_s > 0.0) | (self.best_s >= LEAST_S)


@dataclass(frozen=True)
class ModelErrors:
    """Errors of a model of the simulation, and the number of rows of each delay.

    Attributes:
        spread: ``(agents, outputs)``, root mean square error, in units of the model's scale.
        rows: ``(agents, phases, delays)``, number of training rows, by delay in whole seconds.
    """

    spread: Tensor
    rows: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, model: DelayedForward, data: StackedTransitions) -> ModelErrors:
        """Measure a fitted model on its training rows, those with weight."""
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
    """Estimate the delays with which the model explains the mean changes on the street best.

    For a delay d, with the mean error m of every output over the rows of a phase, and its variance
    v = spread^2 (1 / rows on the street + 1 / rows of the simulation near d):

        misfit(d) = sum m^2 / v,    cost(d) = misfit(d) + sum log v

    Args:
        model: Fitted model of the simulation.
        data: Transitions of the street; rows with weight are those in which a green begins.
        known: Errors and row numbers of the model.
        phase_s: Expected distance of single phases from their intersection's delay, in s.
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
    # The misfit at the best delay is the model's own error; it makes the delays less certain.
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
    """Return the number of rows at a delay, interpolated between whole seconds."""
    below = min(int(seconds), rows.shape[-1] - 2)
    share = seconds - below
    return rows[..., below] * (1.0 - share) + rows[..., below + 1] * share


# --- matched rewards

MATCHED_REWARDS = ("total-queue", "queue")
"""Rewards that can be matched: they fall with every delay, and their mean covers the whole episode.
A sum of differences of waiting times contains only the waiting time at the end."""
CHANCE = 0.05
"""p-value of the lost time alone below which delays are moved to match rewards."""


@dataclass(frozen=True)
class EpisodeRewards:
    """Mean rewards per decision of one policy in single episodes.

    Attributes:
        street: Rewards in the real domain, ``(episodes, agents)``.
        simulated: Rewards in the simulation with all greens late by 0, 1, 2, ... s,
            ``(delays, episodes, agents)``.
        before: Rewards of earlier policies on the street, each ``(episodes, agents)``; used only to
            measure how much rewards vary between episodes.
    """

    street: Floats
    simulated: Floats
    before: Sequence[Floats] = ()


@dataclass(frozen=True)
class MatchedDelays:
    """Delays of greens by which rewards match.

    Attributes:
        delay_s: ``(agents,)``, delays in s with which rewards are equal in both worlds.
        chance: p-value of the street's rewards under the lost time alone (`chance_of`).
        beyond_s: ``(agents,)``, delay in s beyond the lost time; 0 if chance explains the rewards.
    """

    delay_s: Floats
    chance: float
    beyond_s: Floats


def match_delays(rewards: EpisodeRewards, lost_s: Floats) -> MatchedDelays:
    """Find the delay beyond the lost time with which rewards match.

    Args:
        rewards: Rewards of one policy in both worlds.
        lost_s: ``(agents,)``, lost time of greens, in s.
    """
    delay_s = matching_delays(rewards.street.mean(0), rewards.simulated.mean(1))
    chance = chance_of(rewards, lost_s)
    return MatchedDelays(delay_s, chance, (delay_s - lost_s) * (chance < CHANCE))


def episode_rewards(log: TransitionLog, agents: Sequence[str]) -> Floats:
    """Return mean rewards of these agents in each episode of a log, ``(episodes, agents)``.

    An agent without rows in an episode gets the mean of its other episodes.
    """
    means = log.frame.group_by("episode", "agent").agg(pl.col("reward").mean())
    table = means.pivot("agent", index="episode", values="reward").sort("episode")
    known = table.select(pl.col(agent).fill_null(pl.col(agent).mean()) for agent in agents)
    return known.to_numpy().astype(np.float64)


def chance_of(rewards: EpisodeRewards, delay_s: Floats) -> float:
    """Return the p-value of the street's rewards if its greens have these delays only.

    The test is a two-sided t-test of the sum over the network, because an hour's traffic affects
    all intersections together. The standard deviation of episodes is taken as proportional to their
    mean; `varies` is its share of the mean:

        t = (street - expected) / (varies * hypot(street / sqrt(n), expected / sqrt(m)))

    n and m are the numbers of episodes on the street and, per delay, in the simulation.

    Args:
        rewards: Rewards of one policy in both worlds.
        delay_s: ``(agents,)``, delays in s.

    Returns:
        A p-value; 1 if there are too few episodes to measure how much rewards vary.
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
    """Return sum(((x - mean) / mean)^2); 0 if the mean is 0."""
    mean = float(group.mean())
    return float((((group - mean) / mean) ** 2).sum()) if mean else 0.0


def matching_delays(street: Floats, simulated: Floats) -> Floats:
    """Return the delay at which the simulation gives the same reward as the street.

    Rewards should fall with the delay. Isotonic regression averages neighbours where they rise by
    chance. Rewards between whole seconds are interpolated linearly.

    Args:
        street: Mean rewards ``(agents,)``.
        simulated: Mean rewards with greens late by 0, 1, 2, ... s, ``(delays, agents)``.

    Returns:
        Delays in s, ``(agents,)``; the shortest if several fit. 0 if the street's reward is above
        all simulated ones; the delay of the smallest simulated reward if it is below all.
    """
    pairs = zip(street, simulated.T, strict=True)
    return np.array([_matching(paid, falling(curve)) for paid, curve in pairs], dtype=np.float64)


def falling(values: Floats) -> Floats:
    """Return the sequence that never rises and is closest to `values` (least squares), ``(n,)``."""
    return optimize.isotonic_regression(values, increasing=False).x


def _matching(paid: float, curve: Floats) -> float:
    after = int(np.argmax(curve <= max(paid, curve[-1])))  # the first, so the shortest delay
    if after == 0 or curve[after] > paid:
        return float(after)
    return after - (paid - curve[after]) / (curve[after - 1] - curve[after])
