"""Looks for single effects in what a model leaves, each along its own direction."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import Tally
from ugat_marl.diagnosis.fit import WIDE
from ugat_marl.diagnosis.search import Ray
from ugat_marl.diagnosis.statistics import (
    SINGLE,
    Distance,
    Reference,
    added,
    softened,
    without_noise,
)
from ugat_marl.diagnosis.whitening import Group, groups_of, independent

Array = NDArray[np.float64]

LEAST_APART = 0.3
"""Directions of which a fit has used up all but this share are not looked at."""


class Matched:
    """Asks of each known direction whether a difference points there: a matched filter.

    What an effect does is spread over many statistics, each of them within its noise. Along its own
    direction it is one number of unit noise, and so it shows when the sum over everything does not.

    Args:
        directions: Changes of the statistics, per block.
        reference: Whose noise.
        data: The data set, which decides what is used and how precise it is.
        blocks: Blocks that are looked at.
        extra: Further variance of the expected statistics.
        fitted: Changes the model's own parameters make, which a fit has used up.
    """

    def __init__(
        self,
        directions: Sequence[Mapping[str, Array]],
        reference: Reference,
        data: Sequence[Tally],
        blocks: Collection[str],
        extra: Mapping[str, Array] | None = None,
        fitted: Sequence[Mapping[str, Array]] = (),
    ) -> None:
        sums = reference.pools.pool(added(data))
        self._parts: list[tuple[str, list[Group]]] = []
        scales: dict[str, Array] = {}
        for name in blocks:
            if name not in reference.blocks:
                continue
            block = reference.blocks[name]
            weight = sums[name][..., 1] / len(data)
            groups = groups_of(block.used & (weight >= 1.0), block.correlation)
            self._parts.append((name, groups))
            more = 0.0 if extra is None else extra[name]
            scales[name] = np.sqrt(block.noise(weight, len(data)) + more)

        def rows(changes: Sequence[Mapping[str, Array]]) -> Array:
            scaled = [{n: change[n] / scales[n] for n in scales} for change in changes]
            return np.stack([self._whitened(item) for item in scaled])

        found = rows(directions)
        size = np.sqrt((found**2).sum(axis=1))
        self._away = np.zeros((found.shape[1], 0))
        if fitted:
            self._away = _spanned(rows(fitted))
        found = found - (found @ self._away) @ self._away.T
        left = np.sqrt((found**2).sum(axis=1))
        seen = (left > LEAST_APART * size) & (size > 0)
        self._units = found[seen] / left[seen, None]

    def __call__(self, distance: Distance) -> float:
        """The largest squared component along any of the directions."""
        counted = {name: softened(name, distance.z[name]) for name, _ in self._parts}
        components = self._units @ self._whitened(counted)
        return float((components**2).max(initial=0.0))

    def _whitened(self, z: Mapping[str, Array]) -> Array:
        return np.concatenate([independent(z[name], groups) for name, groups in self._parts])


def _spanned(rows: Array) -> Array:
    """Orthonormal columns that span the rows; rows of 0, or the same twice, add nothing."""
    _, sizes, directions = np.linalg.svd(rows, full_matrices=False)
    return directions[sizes > 1e-9 * max(float(sizes.max(initial=0.0)), 1e-300)].T


@dataclass(frozen=True, eq=False)
class Directions:
    """Where single effects would show in what a model leaves.

    Attributes:
        rays: What effects do, simulated upon the scenario as it is.
        extra: Variance of the model's statistics for its parameters' errors.
        fitted: What moving the model's own parameters does.
    """

    rays: tuple[Ray, ...]
    extra: Mapping[str, Array] | None = None
    fitted: tuple[Mapping[str, Array], ...] = ()

    def filters(self, reference: Reference, data: Sequence[Tally]) -> dict[str, Matched]:
        """Matched filters on what the pools show, and on what single lanes and minutes show."""
        if not self.rays:
            return {}
        wide = [ray.difference for ray in self.rays]
        single = [without_noise(ray.difference, ray.variance) for ray in self.rays]
        return {
            name: Matched(changes, reference, data, blocks, self.extra, self.fitted)
            for name, changes, blocks in (
                ("one effect", wide, WIDE), ("one effect, lanes", single, SINGLE)
            )
        }  # fmt: skip
