"""Sparse selection of detector errors: which detectors err, and by how much.

Every group of detectors gives linear equations ``value = coefficients . numbers + error``. A number
belongs to all detectors, to those of a kind, or to a group; each one costs a price. Differences
between drivers are an error that all groups of a kind share, so they cannot single out a group.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ugat_marl.effects import EVERYWHERE, group_name

Array = NDArray[np.float64]

Group = tuple[str, str]
"""Kind of detectors and edge."""


@dataclass(frozen=True)
class Equation:
    """One linear equation of a group of detectors.

    Attributes:
        value: Measured minus expected.
        coefficients: One for each number, such as extension and zone.
        error: Standard error of `value`, of this equation alone.
        shared: Cause to the change of `value` per standard deviation of the cause. All equations
            with this cause change together, in the direction of their sign.
        other_end: Change of `value` if speeds are measured at the other end of a passage.
    """

    value: float
    coefficients: tuple[float, ...]
    error: float
    shared: Mapping[str, float] = field(default_factory=dict)
    other_end: float = 0.0


@dataclass(frozen=True)
class ValueWithError:
    """A number with its standard error."""

    value: float
    error: float

    def differs(self, least: float, deviations: float) -> bool:
        """Return True if the value is away from 0 by at least `least`, and beyond chance."""
        return abs(self.value) >= least and abs(self.value) > deviations * self.error


Number = tuple[str, int]
"""A place (see `ugat_marl.effects.detectors_at`) and the index of a number there."""


@dataclass(frozen=True)
class Choice:
    """Numbers that explain the equations.

    Attributes:
        estimates: The numbers.
        cost: Squared standardised misfit, with the priors and a price for every number.
    """

    estimates: Mapping[Number, ValueWithError]
    cost: float


class ErrorPlaces:
    """Search for the numbers that explain the equations of groups of detectors.

    Args:
        equations: Equations by group.
        priors: Prior standard deviation of each number; the mean is 0.
        price: Price of a number, in squared deviations; `multiplicity` of its place is added.

    Attributes:
        places: All detectors, kinds and groups, the larger places first.
        multiplicity: Penalty of each place, twice the logarithm of the number of places of its
            size: of many places, one differs by chance.
    """

    def __init__(
        self,
        equations: Mapping[Group, Sequence[Equation]],
        priors: Sequence[float],
        price: float,
    ) -> None:
        rows = [(group, one) for group, group_rows in equations.items() for one in group_rows]
        self._groups = [group for group, _ in rows]
        self._priors = np.array(priors)
        self._below = _places_below(list(equations))
        self.places = [place for size in _SIZES for place in self._below if _size(place) == size]
        sizes = Counter(map(_size, self.places))
        self.multiplicity = {p: 2.0 * math.log(sizes[_size(p)]) for p in self.places}
        self._prices = {place: price + more for place, more in self.multiplicity.items()}
        self._white = _whitening([one for _, one in rows])
        self._value = self._white @ np.array([one.value for _, one in rows])
        self._other_end = np.array([one.other_end for _, one in rows])
        design = np.array([one.coefficients for _, one in rows]).reshape(len(rows), len(priors))
        self._inside = {place: self._rows_at(place) for place in self.places}
        self._columns = {
            (place, index): self._white @ (design[:, index] * self._inside[place])
            for place in self.places
            for index in range(len(priors))
        }

    def choose(
        self, elsewhere: Mapping[str, float] | None = None, start: Collection[Number] = ()
    ) -> Choice:
        """Return the numbers that cost least.

        Numbers are added, replaced and removed one at a time until nothing costs less. No detector
        has the same number twice.

        Args:
            elsewhere: Places whose speeds are measured elsewhere than stated: 1 at the other end of
                a passage, 0.5 in the mean of both.
            start: Numbers to begin with.
        """
        value = self._value - self._change_by_points(elsewhere or {})
        choice = self._solved([*start], value)
        while True:
            tried = (self._solved(numbers, value) for numbers in self._next_to([*choice.estimates]))
            cheapest = min(tried, key=lambda one: one.cost, default=choice)
            if cheapest.cost > choice.cost - 1e-9:
                return choice
            choice = cheapest

    def solved(
        self, numbers: Collection[Number], elsewhere: Mapping[str, float] | None = None
    ) -> Choice:
        """Return given numbers, with their best values; `elsewhere` as in `choose`."""
        return self._solved([*numbers], self._value - self._change_by_points(elsewhere or {}))

    def _rows_at(self, place: str) -> NDArray[np.bool_]:
        return np.array(
            [place in (EVERYWHERE, kind, group_name(kind, edge)) for kind, edge in self._groups]
        )

    def _change_by_points(self, elsewhere: Mapping[str, float]) -> Array:
        share = np.zeros(len(self._other_end))
        for place, at in elsewhere.items():
            share[self._inside[place]] = at
        return self._white @ (share * self._other_end)

    def _next_to(self, numbers: Sequence[Number]) -> Iterator[tuple[Number, ...]]:
        """Yield the neighbouring sets: one number added, replaced, removed or split into parts."""
        for number in self._columns:
            if number in numbers:
                continue
            place, index = number
            rivals = [x for x in numbers if (self._inside[x[0]] & self._inside[place]).any()]
            same = [x for x in rivals if x[1] == index]
            yield (*(x for x in numbers if x not in same), number)
            if len(rivals) > len(same):
                yield (*(x for x in numbers if x not in rivals), number)
        for gone in numbers:
            others = tuple(other for other in numbers if other != gone)
            yield others
            place, index = gone
            taken = {other for other, i in others if i == index}
            if len(self._below[place]) > 1 and taken.isdisjoint(self._below[place]):
                yield (*others, *((below, index) for below in self._below[place]))

    def _solved(self, numbers: Sequence[Number], value: Array) -> Choice:
        if not numbers:
            return Choice({}, float(value @ value))
        design = np.column_stack([self._columns[number] for number in numbers])
        scale = self._priors[[index for _, index in numbers]]
        covariance = np.linalg.inv(design.T @ design + np.diag(scale**-2.0))
        found = covariance @ (design.T @ value)
        left = value - design @ found
        cost = left @ left + ((found / scale) ** 2).sum()
        cost += sum(self._prices[place] for place, _ in numbers)
        errors = np.sqrt(np.diag(covariance))
        estimates = [ValueWithError(float(x), float(e)) for x, e in zip(found, errors, strict=True)]
        return Choice(dict(zip(numbers, estimates, strict=True)), float(cost))


def _whitening(equations: Sequence[Equation]) -> Array:
    """Return the matrix that makes the errors of all equations independent and 1."""
    own = np.array([one.error for one in equations])
    covariance = np.diag(own**2)
    for cause in sorted({cause for one in equations for cause in one.shared}):
        sizes = np.array([one.shared.get(cause, 0.0) for one in equations])
        covariance += np.outer(sizes, sizes)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)


_SIZES = ("all", "kind", "group")


def _size(place: str) -> str:
    return "all" if place == EVERYWHERE else "group" if "@" in place else "kind"


def _places_below(groups: Sequence[Group]) -> dict[str, list[str]]:
    """Return all detectors, kinds, and groups of kinds that have several, with their parts."""
    kinds = sorted({kind for kind, _ in groups})
    below: dict[str, list[str]] = {EVERYWHERE: kinds} if len(kinds) > 1 else {}
    for kind in kinds:
        edges = [edge for other, edge in groups if other == kind]
        below[kind] = [group_name(kind, edge) for edge in edges] if len(edges) > 1 else []
        below |= {place: [] for place in below[kind]}
    return below
