"""Fit of the free numbers of a set of effects, by simulation."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.engine import Engine
from ugat_marl.diagnosis.features import Tally
from ugat_marl.diagnosis.hypotheses import (
    WINDOW,
    WINDOWS_IN_THE_LOG,
    Hypothesis,
    Members,
    each_left_out,
    effects_of,
)
from ugat_marl.diagnosis.propose import Direction
from ugat_marl.diagnosis.records import Fitted
from ugat_marl.diagnosis.statistics import (
    Array,
    Pools,
    Reference,
    Whitener,
    Window,
    change_between,
    shrunk,
)
from ugat_marl.diagnosis.supplementary_data import EVERY_LANE, TRAVEL_TIME
from ugat_marl.effects import EVERYWHERE, NO_SOFTER

Change = tuple[dict[str, Array], float]
"""Change of the statistics when a free value moves, by block, and length of this move."""

WIDE = ("network", "intersection", TRAVEL_TIME, EVERY_LANE)
"""Blocks for the fit of effects on the whole network. Single lanes would add more noise than
information."""


cost_of = operator.attrgetter("cost")
"""Cost of a model, as a key for sorting."""


class Fitter:
    """Simulator and fitter of models against one data set.

    Args:
        engine: Simulator of days.
        pools: Pools of places.
        base: Statistics of the scenario as it is.
        base_days: Tallies of its simulated days, by number of the day.
        data: Tallies of the periods to fit.
        days: Number of simulated days for each evaluation.
        speeds: True if speeds were measured.
    """

    def __init__(
        self,
        engine: Engine,
        pools: Pools,
        base: Reference,
        base_days: Mapping[int, Tally],
        data: Sequence[Tally],
        *,
        days: int,
        speeds: bool,
    ) -> None:
        self.engine = engine
        self.pools = pools
        self.base = base
        self.base_days = base_days
        self.data = tuple(data)
        self.days = days
        self.thresholds = pools.thresholds
        self.speeds = speeds

    def simulate(self, members: Members, days: int | None = None) -> Fitted:
        """Simulate a set of effects and measure the distance of the data from it.

        Args:
            members: Hypotheses and values of their free fields.
            days: Number of days; None for the fitter's.
        """
        numbers = list(self.base_days)[: days or self.days]
        simulated = self.engine.ordinary(effects_of(members), numbers)
        reference = Reference(
            self.pools,
            [day.tally for day in simulated.values()],
            speeds=self.speeds,
            prior=self.base,
            paired=[self.base_days[number] for number in simulated],
        )
        distance = reference.distance(self.data, relative_to=self.base)
        cost = distance.total + distance.penalty + self.thresholds.price * len(members)
        known = {number: day.tally for number, day in simulated.items()}
        return Fitted(members, known, reference, distance, cost)

    def refine(
        self,
        start: Fitted,
        rounds: int | None = None,
        directions: Sequence[Direction] = (),
        *,
        closely: bool = False,
    ) -> Fitted:
        """Take Gauss-Newton steps from a simulated model.

        The first derivatives are those between simulated strengths of `directions`, where these
        cover every free value, and each step corrects them (Broyden 1965). Both cost no simulation.
        If they lead nowhere, or cover not every value, derivatives are finite differences.

        Args:
            start: The model to start from.
            rounds: Largest number of steps; None for `Thresholds.steps`. While each takes more
                than `Thresholds.falling` off the cost, they go on beyond it.
            directions: Changes of the statistics by single effects.
            closely: True if the data are near, see `changes`.
        """
        best, left = start, self.thresholds.steps if rounds is None else rounds
        changes = self._known_changes(start, directions)
        exact = falls = False
        while (left > 0 or falls) and len(best.values):
            if changes is None:
                changes, exact = self.changes(best, closely=closely), True
            after = self._after_step(best, changes)
            if after is None:
                if exact:
                    break
                changes = None
                continue
            left -= 1
            gain, changes = best.cost - after.cost, self._corrected(changes, best, after)
            falls = gain > self.thresholds.falling * best.cost
            best, exact = after, False
            if gain < self.thresholds.least_gain:
                break
        return best

    def _after_step(self, model: Fitted, changes: Sequence[Change]) -> Fitted | None:
        """Return the model after a step, or a shorter one; None if neither costs less."""
        whitener = self.whitener(model)
        slopes = derivatives(changes, whitener)
        for free in _may_move(model.members):
            step = np.zeros(len(slopes))
            step[free] = _solve(slopes[free], whitener.measured, self.thresholds.ridge)
            for share in (1.0, self.thresholds.shorter_step):
                moved = self._moved(model, share * step)
                if moved == model.members:
                    break
                after = self.simulate(moved)
                if after.cost < model.cost:
                    return after
        return None

    def _known_changes(self, model: Fitted, directions: Sequence[Direction]) -> list[Change] | None:
        """Return `changes` from simulated strengths; None if one is not known."""
        changes: list[Change] = []
        for hypothesis, values in model.members:
            near = [
                direction
                for direction in directions
                if direction.hypothesis.key == hypothesis.key
                and len(direction.level) == len(values) == 1
                and direction.origin not in (None, direction.level)
            ]
            if hypothesis.step or not near:
                return None
            nearest = min(near, key=lambda one: abs(one.level[0] - values[0]))
            assert nearest.origin is not None
            change = shrunk(nearest.difference, nearest.variance, self.thresholds)
            changes.append((change, nearest.level[0] - nearest.origin[0]))
        return changes or None

    def _corrected(self, changes: Sequence[Change], before: Fitted, after: Fitted) -> list[Change]:
        """Return changes by moves of 1 which, for the step, add up to what was simulated."""
        shared = [number for number in before.days if number in after.days]
        simulated, _ = change_between(
            self.pools, [after.days[n] for n in shared], [before.days[n] for n in shared]
        )
        move = np.subtract(after.values, before.values)
        least = [hypothesis.least for hypothesis, values in before.members for _ in values]
        weight = move / np.square(np.maximum(least, 1e-6))
        weight /= float(move @ weight)
        left = {
            name: values
            - sum(
                x / delta * change[name] for x, (change, delta) in zip(move, changes, strict=True)
            )
            for name, values in simulated.items()
        }
        return [
            ({name: change[name] / delta + share * left[name] for name in change}, 1.0)
            for share, (change, delta) in zip(weight, changes, strict=True)
        ]

    def settled(self, model: Fitted, errors: Array) -> Fitted:
        """Take a last step with more days, since the search stops at a small gain.

        A model whose effects have no free value is only simulated on these days, so that its cost
        can be compared with those of others.

        Args:
            model: The model.
            errors: Standard errors of its free values.
        """
        if not model.members:
            return model
        precise = self.simulate(model.members, self.thresholds.settling_days)
        if not len(precise.values):
            return precise
        whitener = self.whitener(precise)
        jacobian = derivatives(self.changes(model), whitener)
        step = _solve(jacobian, whitener.measured, self.thresholds.ridge)
        if (np.abs(step) <= self.thresholds.settled_within * errors).all():
            return precise
        moved = self.simulate(self._moved(precise, step), self.thresholds.settling_days)
        return moved if moved.cost < precise.cost else precise

    def fitted(self, start: Fitted, directions: Sequence[Direction] = ()) -> Fitted:
        """Fit the free values, and the windows of effects that have one; see `refine`."""
        best = self.refine(start, directions=directions)
        if any(set(WINDOW) <= dict(h.fixed).keys() for h, _ in best.members):
            moved = self._windows(best)
            best = self.refine(moved, 1) if moved is not best else best
        return best

    def _windows(self, best: Fitted) -> Fitted:
        """Move start and end of windows in ever smaller steps, as long as the cost falls.

        The same few days are simulated before and after a move.
        """
        members = best.members
        cost = self.simulate(members, self.thresholds.window_days).cost
        for step in self.thresholds.window_steps_s:
            sides = ((-1, 0), (1, 0), (0, -1), (0, 1))
            for place, direction in itertools.product(range(len(members)), sides):
                while True:
                    move = (step * direction[0], step * direction[1])
                    hypothesis, values = members[place]
                    shifted = _shifted(hypothesis, move, self.thresholds.shortest_window_s)
                    moved = (*members[:place], (shifted, values), *members[place + 1 :])
                    if moved == members:
                        break
                    cost_after = self.simulate(moved, self.thresholds.window_days).cost
                    if cost_after >= cost - self.thresholds.least_gain:
                        break
                    members, cost = moved, cost_after
        if members == best.members:
            return best
        after = self.simulate(members)
        return after if after.cost < best.cost else best

    def whitener(self, model: Fitted) -> Whitener:
        """Return the whitener for a model; it uses lanes and bins if an effect has a place."""
        places = [
            value
            for hypothesis, _ in model.members
            for _, value in hypothesis.fixed
            if value != EVERYWHERE
        ]
        blocks = None if places else WIDE
        return Whitener(
            model.reference, self.data, self.thresholds.interpolation, self.base, blocks
        )

    def changes(self, model: Fitted, *, closely: bool = False) -> list[Change]:
        """Move every free value; return the changes of the statistics and the lengths of the moves.

        A move is lengthened if its change of the statistics may be chance.

        Args:
            model: The model.
            closely: True to shorten moves that leave the region where statistics are linear. Far
                from the data, long moves lead farther.
        """
        whitener, thresholds = self.whitener(model), self.thresholds
        changes: list[Change] = []
        for place, (hypothesis, values) in enumerate(model.members):
            for index in range(len(values)):
                change, delta = self._change(model, place, index, thresholds.nearby)
                errors = float(np.linalg.norm(whitener(change)))
                most = thresholds.largest_move if closely else math.inf
                wanted = min(max(errors, thresholds.plain_move), most)
                if errors != wanted and not hypothesis.step:
                    share = thresholds.nearby * wanted / max(errors, 1e-9)
                    share = min(share, thresholds.far)
                    change, delta = self._change(model, place, index, share)
                changes.append((change, delta))
        return changes

    def _change(self, model: Fitted, place: int, index: int, share: float) -> Change:
        """Move one value by a share of its distance from nominal."""
        hypothesis, values = model.members[place]
        moved = _moved_a_little(hypothesis, values, index, share)
        members = replaced(model.members, place, moved)
        return shrunk(*self.difference(model, members), self.thresholds), (
            moved[index] - values[index]
        ) or 1.0

    def window_changes(self, model: Fitted) -> list[Change]:
        """Move start and end of windows a minute inwards, for effects with free values.

        Strength and duration of an effect are estimated together, so their errors are correlated.
        """
        shortest_s = self.thresholds.shortest_window_s
        changes: list[Change] = []
        for place, (hypothesis, values) in enumerate(model.members):
            for move in ((shortest_s, 0.0), (0.0, -shortest_s)):
                moved = _shifted(hypothesis, move, shortest_s) if values else hypothesis
                if moved is not hypothesis:
                    members = (*model.members[:place], (moved, values), *model.members[place + 1 :])
                    changes.append(
                        (shrunk(*self.difference(model, members), self.thresholds), shortest_s)
                    )
        return changes

    def difference(
        self, model: Fitted, members: Members, days: int | None = None
    ) -> tuple[dict[str, Array], dict[str, Array]]:
        """Return the change of the statistics from a model to other members, on the same days.

        Args:
            model: The model before the change.
            members: Members of the changed model.
            days: Number of days; None for the fitter's.

        Returns:
            Differences and their variances, by block.
        """
        numbers = list(model.days)[: days or self.days]
        simulated = self.engine.ordinary(effects_of(members), numbers)
        before = [model.days[number] for number in simulated]
        return change_between(self.pools, [day.tally for day in simulated.values()], before)

    def _moved(self, model: Fitted, step: Array) -> Members:
        """Return the model's members after a step, clipped to the ranges and to a longest move."""
        moved: list[tuple[Hypothesis, tuple[float, ...]]] = []
        place = 0
        for hypothesis, values in model.members:
            changed: list[float] = []
            for index, value in enumerate(values):
                nominal = hypothesis.nominal[index] if hypothesis.nominal else value
                most = max(
                    abs(value - nominal), self.thresholds.longest_move * hypothesis.least, 1e-6
                )
                changed.append(value + float(np.clip(step[place], -most, most)))
                place += 1
            moved.append((hypothesis, hypothesis.clipped(changed)))
        return tuple(moved)


def _may_move(members: Members) -> list[NDArray[np.bool_]]:
    """Return which values move in a step that is tried, and in the next one if that fails.

    An effect with a bound changes nothing until it comes near it. Then its slope leads nowhere, and
    the other values move alone.
    """
    bounded = np.array([h.name in NO_SOFTER for h, values in members for _ in values], dtype=bool)
    every = np.ones(len(bounded), dtype=bool)
    return [every, ~bounded] if bounded.any() and not bounded.all() else [every]


def _moved_a_little(
    hypothesis: Hypothesis, values: tuple[float, ...], index: int, share: float
) -> tuple[float, ...]:
    """Return the values with one of them moved for a derivative, inside its range.

    It moves up, and down if the range ends before: a slope of too short a move is noise.
    """
    nominal = hypothesis.nominal[index] if hypothesis.nominal else 0.0
    delta = hypothesis.step or max(share * abs(values[index] - nominal), hypothesis.least, 1e-3)

    def moved(by: float) -> tuple[float, ...]:
        changed = list(values)
        changed[index] += by
        return hypothesis.clipped(changed)

    up, down = moved(delta), moved(-delta)
    far, back = (abs(other[index] - values[index]) for other in (up, down))
    return up if far >= back * (1 - 1e-9) else down


def _shifted(hypothesis: Hypothesis, move: tuple[float, float], shortest_s: float) -> Hypothesis:
    """Return the hypothesis with a moved window; itself without a window or if it gets too short.

    The silence of a detector, and a time for which it is on, are read off its log and stay.

    Args:
        hypothesis: The hypothesis.
        move: Moves of start and end, s.
        shortest_s: Shortest window, s.
    """
    known = dict(hypothesis.fixed)
    if not set(WINDOW) <= known.keys() or hypothesis.name in WINDOWS_IN_THE_LOG:
        return hypothesis
    begin, end = (known[name] + shift for name, shift in zip(WINDOW, move, strict=True))
    if begin < 0 or end - begin < shortest_s:
        return hypothesis
    changed = {**known, WINDOW[0]: begin, WINDOW[1]: end}
    return replace(hypothesis, fixed=tuple((name, changed[name]) for name, _ in hypothesis.fixed))


def replaced(members: Members, place: int, values: tuple[float, ...]) -> Members:
    """Return the members with other values for the one at index `place`."""
    hypothesis = members[place][0]
    return (*members[:place], (hypothesis, values), *members[place + 1 :])


def _solve(jacobian: Array, residual: Array, ridge: float) -> Array:
    """Solve ``(J J' + ridge I) x = J r`` for the step x, with the rows of J scaled to length 1.

    `scipy.optimize.least_squares` does not fit here. It chooses the points of evaluation itself,
    and each point costs a set of simulated days. It also knows no grids of values.

    Args:
        jacobian: J, ``(free values, statistics)``.
        residual: r, ``(statistics,)``.
        ridge: Ridge of the normal equations.
    """
    scale = np.sqrt((jacobian**2).sum(axis=1)) + 1e-12
    scaled = jacobian / scale[:, None]
    normal = scaled @ scaled.T + ridge * np.eye(len(scaled))
    return np.linalg.solve(normal, scaled @ residual) / scale


def derivatives(changes: Sequence[Change], whitener: Whitener) -> Array:
    """Return the whitened changes divided by their moves, ``(changes, statistics)``."""
    return np.stack([whitener(change) / delta for change, delta in changes])


# --- intervals ------------------------------------------------------------------------------------


def _straightness(
    fitter: Fitter, model: Fitted, errors: Array, response: Callable[[dict[str, Array]], Array]
) -> tuple[Array, Array]:
    """Return how the estimates of the free values follow the values.

    A value that moves by x should move its estimate by x. An estimate that moves by a part of it
    is as much less certain. Deviations from the best straight line through these moves are errors
    of the value. What all moves have in common is no such error: it is noise of the days before the
    move, which `errors` hold.

    Args:
        fitter: Simulator of models.
        model: The model.
        errors: Standard errors of its free values, ``(free values,)``.
        response: Function from a change of the statistics to the change of the estimates.

    Returns:
        Slopes of these lines, up to 1, and mean squares of the deviations, ``(free values,)`` each.
        Where an estimate does not follow, the slope is 1, and the moves count as deviations.
    """
    slopes: list[float] = []
    squares: list[float] = []
    for row, moves in enumerate(_moves(fitter, model, errors)):
        changes = [fitter.difference(model, members)[0] for _, members in moves]
        asked = np.array([move for move, _ in moves])
        got = np.array([float(response(change)[row]) for change in changes])
        size = float(np.mean(asked**2)) if moves else 0.0
        free = len(moves) - 1
        if len(set(asked)) > 2:  # a line through two moves is exact if it need not begin at 0
            asked, got, free = asked - asked.mean(), got - got.mean(), free - 1
        slope = float(asked @ got) / max(float(asked @ asked), 1e-12)
        follows = free >= 1 and slope >= fitter.thresholds.blunt
        slopes.append(min(slope, 1.0) if follows else 1.0)
        if follows:
            squares.append(float(((got / slope - asked) ** 2).sum()) / free)
        else:
            squares.append(size if free >= 1 else 0.0)
    return np.array(slopes), np.array(squares)


def _possible(fitter: Fitter, model: Fitted, errors: Array) -> Array:
    """Return the largest standard errors that the data leave possible, ``(free values,)``.

    An interval ends half a grid step before a value with which the data fit worse beyond doubt.
    Intervals are symmetric, so a bound applies only if values on both sides are excluded. The
    neutral value is enough by itself: if it is excluded, the interval ends half of
    `Hypothesis.least` before it.

    Args:
        fitter: Simulator of models.
        model: The model.
        errors: Standard errors of its free values, ``(free values,)``.
    """
    thresholds, cost = fitter.thresholds, fitter.simulate(model.members).cost

    def impossible(members: Members) -> bool:
        return fitter.simulate(members).cost - cost > thresholds.beyond_doubt**2

    bounds: list[float] = []
    rest, tried = each_left_out(model.members), _moves(fitter, model, errors)
    for (hypothesis, values), without in zip(model.members, rest, strict=True):
        for value in values:
            moves = tried[len(bounds)]
            nearest = {move > 0: math.inf for move, _ in moves}
            for move, members in moves:
                if impossible(members):
                    nearest[move > 0] = min(nearest[move > 0], abs(move))
            end = max(nearest.values(), default=math.inf)
            if hypothesis.nothing is not None and len(values) == 1 and impossible(without):
                away = abs(hypothesis.nothing[0] - value)
                end = min(end, max(away - hypothesis.least / 2, away / 2))
            bounds.append(max(end - hypothesis.step / 2, end / 2) / thresholds.half_interval)
    return np.array(bounds)


def _moves(fitter: Fitter, model: Fitted, errors: Array) -> list[list[tuple[float, Members]]]:
    """Return moves of each free value, within its range, with the members after the move."""
    moves: list[list[tuple[float, Members]]] = []
    for place, (hypothesis, values) in enumerate(model.members):
        for index, value in enumerate(values):
            error, of_value = errors[len(moves)], list[tuple[float, Members]]()
            for share in fitter.thresholds.straightness_moves:
                changed = list(values)
                changed[index] = value + share * error
                moved = hypothesis.clipped(changed)
                if moved != values:
                    members = replaced(model.members, place, moved)
                    of_value.append((moved[index] - value, members))
            moves.append(of_value)
    return moves


def _spread_of_days(
    fitter: Fitter, days: Sequence[Tally], response: Callable[[dict[str, Array]], Array]
) -> Array:
    """Return the covariance of the changes that single days would make in the estimate.

    Each day is compared with the mean of its own stretch of the day. If no two days are of the same
    stretch, the days of the scenario as it is stand in for them.
    """
    if len({day.window for day in days}) == len(days):
        days = list(fitter.base_days.values())
    stretches: dict[Window, list[Tally]] = {}
    for day in days:
        stretches.setdefault(day.window, []).append(day)
    changes = [
        response(change_between(fitter.pools, [day], stretches[day.window])[0]) for day in days
    ]
    free = max(len(days) - len(stretches), 1)
    return np.atleast_2d(np.cov(np.stack(changes).T)) * (len(days) - 1) / free


def uncertainty(
    fitter: Fitter, model: Fitted, days: Sequence[Tally] = (), *, steps: bool = False
) -> tuple[Array, dict[str, Array]]:
    """Estimate standard errors of the free values, and the variances they give the statistics.

    The parts of the distance depend on each other, so curvature alone gives wrong errors. Instead,
    each simulated day d gives the change ``(J J')^-1 J r_d`` that it would make in the estimate,
    and the errors come from the covariance of these changes (a sandwich estimate). Begins and ends
    of windows are included. If the move of a value changes no statistic beyond chance, this move is
    added to its error.

    Args:
        fitter: Simulator of models.
        model: The model.
        days: Simulated days of the model, the more the better; empty for its own days.
        steps: True to add the error of statistics that are not linear in the values. Effects of a
            value may come in steps, when whole vehicles cross a detector or the start of green.

    Returns:
        Standard errors ``(free values,)``, and variances of the expected statistics by block.
    """
    if not len(model.values):
        return np.empty(0), {
            name: np.zeros_like(b.mean) for name, b in model.reference.blocks.items()
        }
    whitener = fitter.whitener(model)
    changes = fitter.changes(model)
    free = len(changes)
    changes += fitter.window_changes(model)
    jacobian = derivatives(changes, whitener)
    inverse = np.linalg.pinv(jacobian @ jacobian.T)

    def response(change: dict[str, Array]) -> Array:
        return inverse @ (jacobian @ whitener(change))

    spread = _spread_of_days(fitter, days or model.tallies, response)
    # measured periods and simulated days both vary
    covariance = spread * (1.0 / len(fitter.data) + 1.0 / len(model.tallies))
    grids = np.array([h.step for h, values in model.members for _ in values])
    # rounding to a grid of step s has the variance s^2 / 12
    covariance[:free, :free] += np.diag(grids**2 / 12.0)
    unseen = np.flatnonzero(~jacobian[:free].any(axis=1))
    covariance[unseen, unseen] += [changes[index][1] ** 2 for index in unseen]
    extra: dict[str, Array] = {}
    for name, block in model.reference.blocks.items():
        slopes = np.stack([change[name] / delta for change, delta in changes])
        # variance of a statistic = d' C d, with d its derivatives by the values
        variances = np.einsum("imf,ij,jmf->mf", slopes, covariance, slopes)
        extra[name] = np.where(np.isfinite(block.mean), np.nan_to_num(variances), 0.0)
    errors = np.sqrt(np.diag(covariance)[:free])
    if steps:
        slopes, squares = _straightness(fitter, model, errors, response)
        wide = np.sqrt((errors / slopes) ** 2 + squares)
        errors = np.minimum(wide, _possible(fitter, model, errors))
    return errors, extra
