"""Does without effects that the others make superfluous."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ugat_marl.diagnosis.fit import SETTLING_DAYS, Fitter, cost_of
from ugat_marl.diagnosis.hypotheses import each_left_out, merged, names_of
from ugat_marl.diagnosis.intervals import HALF_INTERVAL
from ugat_marl.diagnosis.records import Fitted, Tested
from ugat_marl.progress import Reporter, Silent

NEGLIGIBLE = 150.0
"""Cost up to which a smaller set of effects is tested in the place of a larger one. Whether it
suffices the test says; this only saves the time of those that plainly do not."""


def pruned(
    best: Tested,
    base: Tested,
    fitter: Fitter,
    kept: Callable[[Fitted], Fitted],
    test: Callable[[Fitted], Tested],
    alpha: float,
    reporter: Reporter | None = None,
) -> Tested:
    """Drops effects that do not matter, or that the others can do without.

    Of two sets that leave no more than chance, the smaller one is the explanation. Costs are
    compared over the same days, and enough of them: with more the same model costs less, and what
    a few cost is luck where queues are long.

    Args:
        best: The set to begin with.
        base: The scenario as it is, which is left if every effect is fitted to nothing.
        fitter: Simulates and fits.
        kept: Remembers what was fitted.
        test: Tests what a model leaves.
        alpha: Level of the tests.
        reporter: Shows progress.
    """
    reporter = reporter or Silent()

    def settled(model: Fitted) -> Fitted:
        return fitter.simulate(model.members, SETTLING_DAYS)

    members = tuple(item for item in best.model.members if item[0].matters(item[1]))
    if members and len(members) < len(best.model.members):
        best = test(fitter.refine(fitter.simulate(members), 2))
    while len(best.model.members) > 1:
        fewer: list[Fitted] = []
        with reporter.task("without single effects", len(best.model.members)) as advance:
            for part in each_left_out(best.model.members):
                fewer.append(kept(settled(fitter.refine(fitter.simulate(part), 2))))
                advance(note=names_of(part))
        doubtful = [fewer[place] for place in _doubtful(best)]
        least = min(fewer, key=cost_of)
        if least.cost - settled(best.model).cost > NEGLIGIBLE:
            if not doubtful:
                break
            least = min(doubtful, key=cost_of)
        tested = test(least)
        enough = tested.residual.p > alpha
        # What may not be there is not named, either, where nothing suffices.
        vain = least in doubtful and best.residual.p <= alpha
        if least.cost > best.model.cost and not enough and not vain:
            break
        best = tested
    something = merged((), best.model.members)
    if len(something) == len(best.model.members):
        return best
    return test(fitter.simulate(something)) if something else base


def _doubtful(tested: Tested) -> list[int]:
    """Places of the effects whose intervals hold the nominal value: they may not be there."""
    found: list[int] = []
    first = 0
    for place, (hypothesis, values) in enumerate(tested.model.members):
        errors = tested.errors[first : first + len(values)]
        first += len(values)
        if values and hypothesis.nominal is not None:
            away = np.abs(np.subtract(values, hypothesis.nominal))
            if (away <= HALF_INTERVAL * errors).all():
                found.append(place)
    return found
