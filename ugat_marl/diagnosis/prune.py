"""Pruning of a set of effects: what does not matter, or is not needed, is not named."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ugat_marl.diagnosis.fit import Fitter, cost_of
from ugat_marl.diagnosis.hypotheses import Members, each_left_out, merged, title_of
from ugat_marl.diagnosis.records import Fitted, Tested
from ugat_marl.progress import Reporter


class ModelTests(Protocol):
    """Tests of fitted models, and the list of those that were fitted."""

    def kept(self, model: Fitted) -> Fitted:
        """Keep a model for the list of rivals if it is the best one of its effects; return it."""
        ...

    def test(self, model: Fitted) -> Tested:
        """Test what a model leaves."""
        ...

    def exact(self, tested: Tested) -> Tested:
        """Make the errors of a tested model exact."""
        ...


class Pruner:
    """Drops effects that do not matter, or that the explanation does not need.

    If two sets of effects leave only chance, the smaller set is the explanation. Costs are compared
    with equal numbers of days, since more days lower the cost of the same model. Few days would
    leave the comparison to chance where queues are long.

    Args:
        fitter: Simulator and fitter of models.
        tests: Tests of models, and where they are kept.
        alpha: Level of the tests.
        reporter: Display of progress.
    """

    def __init__(self, fitter: Fitter, tests: ModelTests, alpha: float, reporter: Reporter) -> None:
        self._fitter = fitter
        self._thresholds = fitter.thresholds
        self._tests = tests
        self._alpha = alpha
        self._reporter = reporter

    def pruned(self, best: Tested, base: Tested) -> Tested:
        """Return the smallest set of effects that explains as much, with exact errors.

        Args:
            best: The tested set to start from.
            base: The scenario as it is; the result if every effect is fitted to nothing.
        """
        members = _that_matter(best.model.members)
        if not members:
            return base
        if len(members) < len(best.model.members):
            best = self._tests.test(self._refined(self._fitter.simulate(members)))
        best = self._tests.exact(best)
        while len(best.model.members) > 1 and (smaller := self._smaller(best)) is not None:
            best = self._tests.exact(smaller)
        # Every effect that is dropped moves the values of the others.
        while (members := self._nameable(best)) != best.model.members:
            if not members:
                return base
            refined = self._refined(self._fitter.simulate(members))
            best = self._tests.exact(self._tests.test(refined))
        return best

    def _smaller(self, best: Tested) -> Tested | None:
        """Return the set with one effect less that suffices; None if every effect is needed."""
        fewer = self._each_left_out(best)
        if not fewer:
            return None
        unsure = [fewer[index] for index in doubtful(best, self._thresholds.half_interval)]
        least = min(fewer.values(), key=cost_of)
        now = self._settled(best.model).cost
        if least.cost - now > self._thresholds.negligible:
            if not unsure:
                return None
            least = min(unsure, key=cost_of)
        tested = self._tests.test(least)
        enough = tested.residual.p > self._alpha
        # If no set suffices anyway, an effect that may be absent is not named either.
        vain = least in unsure and best.residual.p <= self._alpha
        return tested if least.cost <= now or enough or vain else None

    def _each_left_out(self, best: Tested) -> dict[int, Fitted]:
        """Fit the sets without one of the effects that are not beyond doubt, by its index."""
        parts = each_left_out(best.model.members)
        indices = [index for index in range(len(parts)) if not self._beyond_doubt(best, index)]
        fewer: dict[int, Fitted] = {}
        if not indices:
            return fewer
        with self._reporter.task("without single effects", len(indices)) as advance:
            for index in indices:
                without = self._refined(self._fitter.simulate(parts[index]))
                fewer[index] = self._tests.kept(self._settled(without))
                advance(note=title_of(parts[index]))
        return fewer

    def _nameable(self, best: Tested) -> Members:
        """Return the effects without those that do not matter, or else without a doubtful one.

        That is the least certain of those whose intervals hold their usual values. The errors of
        `best` are exact.
        """
        members = _that_matter(best.model.members)
        unsure = doubtful(best, self._thresholds.half_interval)
        if len(members) < len(best.model.members) or not unsure:
            return members
        return each_left_out(members)[min(unsure, key=lambda index: _deviations(best, index))]

    def _refined(self, model: Fitted) -> Fitted:
        return self._fitter.refine(model, self._thresholds.steps_without)

    def _settled(self, model: Fitted) -> Fitted:
        """Return a model with the number of days by which costs are compared."""
        return self._fitter.simulate(model.members, self._thresholds.settling_days)

    def _beyond_doubt(self, tested: Tested, index: int) -> bool:
        """Return True if the data fit so much worse without the member at `index` that it stays.

        The standard errors come from a joint fit, so they include the uncertainty from other
        effects.
        """
        hypothesis, values = tested.model.members[index]
        certain = bool((tested.errors_of(index) > 0.0).all())
        known = bool(values) and hypothesis.nothing is not None and certain
        return known and _deviations(tested, index) > self._thresholds.beyond_doubt


def _that_matter(members: Members) -> Members:
    """Return the effects that are strong enough to be named."""
    return tuple(member for member in merged((), members) if member[0].matters(member[1]))


def _deviations(tested: Tested, index: int) -> float:
    """Return how many standard errors the member at `index` is away from its usual values."""
    hypothesis, values = tested.model.members[index]
    errors = np.maximum(tested.errors_of(index), 1e-12)
    return float((np.abs(np.subtract(values, hypothesis.nothing or 0.0)) / errors).max())


def doubtful(tested: Tested, half_interval: float) -> list[int]:
    """Return indices of effects whose intervals hold values that change nothing."""
    indices: list[int] = []
    for index, (hypothesis, values) in enumerate(tested.model.members):
        if values and hypothesis.nothing is not None:
            away = np.abs(np.subtract(values, hypothesis.nothing))
            if (away <= half_interval * tested.errors_of(index)).all():
                indices.append(index)
    return indices
