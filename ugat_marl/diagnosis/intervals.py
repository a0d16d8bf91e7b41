"""How well fitted values are known: by chance in the data, by windows, and by steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ugat_marl.diagnosis.features import Tally
from ugat_marl.diagnosis.fit import Fitter, derivatives, replaced
from ugat_marl.diagnosis.records import Fitted
from ugat_marl.diagnosis.statistics import Array, shift

HALF_INTERVAL = 1.96
"""Half of a 95 % interval, in standard errors."""
AWAY = (-5.0, -2.0, 2.0, 5.0)
"""Standard errors by which values are moved to see how straight the way is."""
BLUNT = 0.2
"""Share of such moves that statistics must follow, or values are not known better than to them."""


def _crookedness(
    fitter: Fitter, model: Fitted, errors: Array, response: Callable[[dict[str, Array]], Array]
) -> Array:
    """By how much an estimate is off, squared, since statistics do not follow a value straight.

    Args:
        fitter: Simulates.
        model: The model.
        errors: Standard errors of its free values.
        response: What a change of the statistics would make of the free values.
    """
    found: list[float] = []
    for place, (hypothesis, values) in enumerate(model.members):
        for index, value in enumerate(values):
            row = len(found)
            moves: list[tuple[float, float]] = []
            for share in AWAY:
                changed = list(values)
                changed[index] = value + share * errors[row]
                moved = hypothesis.clipped(changed)
                if moved != values:
                    change, _ = fitter.difference(model, replaced(model.members, place, moved))
                    moves.append((moved[index] - value, float(response(change)[row])))
            asked, got = np.array(moves).reshape(-1, 2).T
            slope = float(asked @ got) / max(float(asked @ asked), 1e-12)
            if len(moves) < 2:
                found.append(0.0)
            elif slope < BLUNT:
                found.append(float(np.mean(asked**2)))
            else:
                found.append(float(((got / slope - asked) ** 2).sum()) / (len(moves) - 1))
    return np.array(found)


def uncertainty(
    fitter: Fitter, model: Fitted, days: Sequence[Tally] = (), *, steps: bool = False
) -> tuple[Array, dict[str, Array]]:
    """Standard errors of the free values, and what they make uncertain in the statistics.

    The parts of the distance depend on each other, so the errors come from how much the estimate
    would move between simulated days (a sandwich estimate), not from the curvature alone. Where
    windows begin and end is estimated as well. A value whose change does nothing that is more than
    chance is not known better than to this change.

    Args:
        fitter: Simulates.
        model: The model.
        days: Simulated days of it, the more the better; none for those it was fitted with.
        steps: Whether to look, too, how far from straight the way is within the interval: as whole
            vehicles cross a detector or the start of green, what a value does may come in steps.

    Returns:
        Standard errors ``(free values,)``, and variances of the expected statistics per block.
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
    influences: list[Array] = []
    days = days or model.tallies
    for item in days:
        difference, _ = shift(fitter.pools, [item], days)
        influences.append(inverse @ (jacobian @ whitener(difference)))
    spread = np.atleast_2d(np.cov(np.stack(influences).T))
    covariance = spread * (1.0 / len(fitter.data) + 1.0 / len(model.tallies))
    grids = np.array([h.step for h, values in model.members for _ in values])
    covariance[:free, :free] += np.diag(grids**2 / 12.0)
    unseen = np.flatnonzero(~jacobian[:free].any(axis=1))
    covariance[unseen, unseen] += [changes[index][1] ** 2 for index in unseen]
    extra: dict[str, Array] = {}
    for name, block in model.reference.blocks.items():
        slopes = np.stack([change[name] / delta for change, delta in changes])
        extra[name] = np.einsum("imf,ij,jmf->mf", slopes, covariance, slopes) + 0.0 * block.mean
        extra[name] = np.nan_to_num(extra[name])
    errors = np.sqrt(np.diag(covariance)[:free])
    if steps:

        def response(change: dict[str, Array]) -> Array:
            return inverse @ (jacobian @ whitener(change))

        errors = np.sqrt(errors**2 + _crookedness(fitter, model, errors, response))

    return errors, extra
