"""Sets of effects, with their strengths, that would make the measured difference.

Every hypothesis is simulated at a few strengths. Each change of the statistics is a direction. Sets
of up to three directions are fitted to the measured difference by least squares, without further
simulations. So effects that hide each other are proposed together.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.hypotheses import Hypothesis, Members, keys_of
from ugat_marl.diagnosis.records import Proposed
from ugat_marl.diagnosis.statistics import Distance, Reference, Whitener, softened, without_noise
from ugat_marl.diagnosis.thresholds import Thresholds

Array = NDArray[np.float64]

_cost = operator.attrgetter("expected")


@dataclass(frozen=True, eq=False)
class Direction:
    """Change of the statistics under a hypothesis at one strength.

    Attributes:
        hypothesis: The hypothesis.
        level: Values of its free fields.
        difference: Change of the statistics, by block, ``(members, features)``.
        variance: Variance of that change, by block.
        origin: Values from which strengths are measured: nominal values, or those of the model so
            far; None if there are none.
    """

    hypothesis: Hypothesis
    level: tuple[float, ...]
    difference: dict[str, Array]
    variance: dict[str, Array]
    origin: tuple[float, ...] | None

    def at(self, strength: float) -> tuple[float, ...]:
        """Return the values of the free fields at a multiple of the simulated strength."""
        if self.origin is None:
            return self.level
        values = [n + strength * (x - n) for n, x in zip(self.origin, self.level, strict=True)]
        return self.hypothesis.clipped(values)


def between(directions: Sequence[Direction], shares: Sequence[float]) -> list[Direction]:
    """Return the directions, and those at some shares of the way between strengths.

    The change by an effect is not proportional to its strength, but between two simulated strengths
    it is nearly linear.
    """
    all_directions = list(directions)
    for first, second in itertools.pairwise(directions):
        near = first.hypothesis == second.hypothesis and first.origin is not None
        if not near or not first.level or _side(first) != _side(second):
            continue
        for share in shares:
            level = tuple(
                (1 - share) * a + share * b for a, b in zip(first.level, second.level, strict=True)
            )
            mixed = {
                name: (1 - share) * first.difference[name] + share * second.difference[name]
                for name in first.difference
            }
            noise = {
                name: (1 - share) ** 2 * first.variance[name] + share**2 * second.variance[name]
                for name in first.variance
            }
            all_directions.append(Direction(first.hypothesis, level, mixed, noise, first.origin))
    return all_directions


def _side(direction: Direction) -> bool:
    assert direction.origin is not None
    return direction.level > direction.origin


def propose(
    directions: Sequence[Direction], whitener: Whitener, thresholds: Thresholds
) -> list[Proposed]:
    """Find sets of effects, in order of the cost that they would leave.

    For directions A (one per row, whitened) and the measured difference m, the strengths x minimise
    ``|m - A' x|^2``, and cost = this minimum + price * number of effects.

    Args:
        directions: Changes of the statistics under hypotheses.
        whitener: The measured difference and its noise.
        thresholds: Numbers of the method.

    Returns:
        Each set of hypotheses once, at its best strengths, least cost first.
    """
    if not directions:
        return []
    basis = [whitener(without_noise(x.difference, x.variance, thresholds)) for x in directions]
    gram, match = _products(basis, whitener.measured)
    best: dict[tuple[object, ...], Proposed] = {}
    kept = list(range(len(directions)))
    for size in range(1, len(thresholds.candidates) + 1):
        if size == 3 and len(kept) > thresholds.most_in_triples:  # all triples would take too long
            kept = _useful(best, directions, thresholds.most_in_triples)
        for chosen in itertools.combinations(kept, size):
            keys = tuple(sorted(str(directions[index].hypothesis.key) for index in chosen))
            models = sum(directions[index].hypothesis.name == "driver_model" for index in chosen)
            if len(set(keys)) < size or models > 1:
                continue
            signs = tuple(directions[index].hypothesis.both for index in chosen)
            strengths = _least_squares(gram, match, chosen, signs, thresholds)
            if strengths is None:
                continue
            left = whitener.gap - _taken_off(gram, match, chosen, strengths)
            cost = left + thresholds.price * size
            if keys not in best or cost < best[keys].expected:
                members = tuple(
                    (directions[index].hypothesis, directions[index].at(float(strength)))
                    for index, strength in zip(chosen, strengths, strict=True)
                )
                if not any(hypothesis.is_nothing(values) for hypothesis, values in members):
                    best[keys] = Proposed(members, cost)
    return sorted(best.values(), key=_cost)


def _least_squares(
    gram: Array,
    match: Array,
    chosen: tuple[int, ...],
    both: tuple[bool, ...],
    thresholds: Thresholds,
) -> Array | None:
    """Return strengths along the directions, clipped; None if one of the directions does not help.

    Args:
        gram: Scalar products of all directions, ``(directions, directions)``.
        match: Scalar products of the directions with the measured difference, ``(directions,)``.
        chosen: Indices of the directions to use.
        both: True for directions that may have a negative strength.
        thresholds: Numbers of the method.
    """
    strengths = _solved(gram, match, chosen, thresholds)
    if strengths is None:
        return None
    # a negative strength helps only if the effect has an opposite
    size = np.where(both, np.abs(strengths), strengths)
    if (size < thresholds.least_strength).any():
        return None
    return np.clip(strengths, -thresholds.farthest, thresholds.farthest)


def _solved(
    gram: Array, match: Array, chosen: Sequence[int], thresholds: Thresholds
) -> Array | None:
    """Return the best strengths along directions, of any size; None if there are none."""
    part = gram[np.ix_(chosen, chosen)]
    ridge = thresholds.strength_ridge * np.trace(part) * np.eye(len(chosen))
    try:
        return np.linalg.solve(part + ridge, match[list(chosen)])
    except np.linalg.LinAlgError:
        return None


def _taken_off(gram: Array, match: Array, chosen: Sequence[int], strengths: Array) -> float:
    """Return by how much directions at some strengths shorten the squared difference."""
    part = gram[np.ix_(chosen, chosen)]
    return float(strengths @ (2 * match[list(chosen)] - part @ strengths))


def exchanges(
    members: Members, directions: Sequence[Direction], whitener: Whitener, thresholds: Thresholds
) -> list[Proposed]:
    """Find effects that may stand in the place of one of the model's, in order of the cost left.

    Effects that imitate each other are not told apart while much else is unknown. Later the
    imitation is there, and the right effect adds hardly anything to it. So one effect is taken out
    and another one put in, and the values of the others move along.

    Args:
        members: Members of the model.
        directions: Changes of the statistics on top of the model. Those of a member at values that
            change nothing take it out, the others move it.
        whitener: What the model leaves, and its noise.
        thresholds: Numbers of the method.

    Returns:
        Changes of the model, the best of each effect that goes: nominal values of the one that
        goes, values of the one that comes and of those that stay. Pairs that would leave clearly
        more than the model does are left out. A prediction is less exact the more it moves.
    """
    basis = [whitener(without_noise(x.difference, x.variance, thresholds)) for x in directions]
    gram, match = _products(basis, whitener.measured)
    present = keys_of(members)
    absent = [k for k, one in enumerate(directions) if one.hypothesis.key not in present]
    out, moves = _of_members(members, directions)
    exchanged: list[Proposed] = []
    for key, gone in out.items():
        best: dict[object, Proposed] = {}
        stay = [move for other, move in moves.items() if other != key]
        without, left = match - gram[gone], whitener.gap - 2 * match[gone] + gram[gone, gone]
        goes = (directions[gone].hypothesis, directions[gone].level)
        for come in absent:
            chosen = [come, *stay]
            strengths = _solved(gram, without, chosen, thresholds)
            if strengths is None:
                continue
            comes = directions[come].hypothesis
            if (abs(strengths[0]) if comes.both else strengths[0]) < thresholds.least_strength:
                continue
            strengths = np.clip(strengths, -thresholds.farthest, thresholds.farthest)
            cost = left - _taken_off(gram, without, chosen, strengths)
            if comes.key not in best or cost < best[comes.key].expected:
                moved = zip(chosen, strengths.tolist(), strict=True)
                values = ((directions[k].hypothesis, directions[k].at(x)) for k, x in moved)
                best[comes.key] = Proposed((goes, *values), cost)
        most = thresholds.near_share * whitener.gap + thresholds.near_cost
        most += thresholds.imitation_share * float(gram[gone, gone])
        near = [proposal for proposal in best.values() if proposal.expected <= most]
        exchanged += sorted(near, key=_cost)[: thresholds.exchanged]
    return sorted(exchanged, key=_cost)


def _products(basis: Sequence[Array], target: Array) -> tuple[Array, Array]:
    """Return the scalar products of directions with each other, and with the target."""
    rows = np.stack(basis) if basis else np.empty((0, len(target)))
    return rows @ rows.T, rows @ target


def _of_members(
    members: Members, directions: Sequence[Direction]
) -> tuple[dict[object, int], dict[object, int]]:
    """Return indices of the directions that take a member out, and of those that move it."""
    out: dict[object, int] = {}
    moves: dict[object, int] = {}
    for hypothesis, _ in members:
        for k, one in enumerate(directions):
            if one.hypothesis.key == hypothesis.key and hypothesis.nominal is not None:
                gone = hypothesis.is_nothing(one.level)
                (out if gone else moves).setdefault(hypothesis.key, k)
    return out, moves


def _useful(
    best: dict[tuple[object, ...], Proposed], directions: Sequence[Direction], count: int
) -> list[int]:
    """Return the indices of up to `count` directions, of the hypotheses in the best sets so far."""
    keys: list[str] = []
    for proposal in sorted(best.values(), key=_cost):
        keys += [str(hypothesis.key) for hypothesis, _ in proposal.members]
    wanted = list(dict.fromkeys(keys))
    indices: list[int] = []
    for key in wanted:
        indices += [
            i for i, direction in enumerate(directions) if str(direction.hypothesis.key) == key
        ]
        if len(indices) >= count:
            break
    return indices[:count]


def promising(proposals: Sequence[Proposed], thresholds: Thresholds) -> list[Proposed]:
    """Choose the best sets of each size; larger sets only if they promise a clearly lower cost."""
    if not proposals:
        return []
    chosen = [proposal for proposal in proposals if len(proposal.members) == 1][:1]
    least = math.inf
    for size in range(1, len(thresholds.candidates) + 1):
        of_size = [proposal for proposal in proposals if len(proposal.members) == size]
        if (
            of_size
            and of_size[0].expected < thresholds.larger_share * least - thresholds.larger_gain
        ):  # more must be gained
            most = thresholds.near_share * of_size[0].expected + thresholds.near_cost
            near = [proposal for proposal in of_size if proposal.expected <= most]
            chosen += near[: thresholds.candidates[size - 1]]
            least = of_size[0].expected
    return list(dict.fromkeys(chosen))


def squared_gap(distance: Distance, base: Reference, periods: int) -> float:
    """Return the sum of squared differences in units of the noise of the scenario as it is.

    Args:
        distance: Distance of a data set from a model.
        base: Statistics of the scenario as it is.
        periods: Number of periods in the data set.
    """
    total = 0.0
    for name, difference in distance.difference.items():
        block = base.blocks[name]
        noise = block.noise(block.weight, periods)
        total += float(
            (
                softened(name, np.nan_to_num(difference / np.sqrt(noise)), base.pools.thresholds)
                ** 2
            ).sum()
        )
    return total
