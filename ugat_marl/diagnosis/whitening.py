"""Differences of statistics as independent numbers of unit noise."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import Tally
from ugat_marl.diagnosis.statistics import SOFT, Reference, added

Array = NDArray[np.float64]

Group = tuple[NDArray[np.int64], NDArray[np.bool_], Array]
"""Members of a block, the features they use, and what makes these independent."""


class Whitener:
    """Turns differences of statistics into independent numbers of unit noise, in one vector.

    Args:
        reference: Whose noise.
        data: The data set, which decides what is used and how precise it is.
        tolerance: Share of a measured difference that counts as noise as well: predictions by
            interpolation are no better.
        relative_to: Whose choice of statistics is used, so that vectors of different models fit.
        blocks: Blocks to use; None for all.
    """

    def __init__(
        self,
        reference: Reference,
        data: Sequence[Tally],
        tolerance: float,
        relative_to: Reference | None = None,
        blocks: Collection[str] | None = None,
    ) -> None:
        chosen = relative_to or reference
        found = reference.distance(data, relative_to=chosen)
        sums = reference.pools.pool(added(data))
        self._parts: list[tuple[str, Array, list[Group]]] = []
        for name, block in reference.blocks.items():
            if blocks is not None and name not in blocks:
                continue
            weight = sums[name][..., 1] / len(data)
            noise = block.noise(weight, len(data))
            difference = found.difference[name]
            soft = 0.0 if SOFT[name] == np.inf else 1.0 / SOFT[name]
            scale = np.sqrt(noise + (max(tolerance, soft) * difference) ** 2)
            used = chosen.blocks[name].used & (weight >= 1.0)
            self._parts.append((name, scale, groups_of(used, block.correlation)))
        self.measured = self(found.difference)

    def __call__(self, differences: Mapping[str, Array]) -> Array:
        """Whitened differences, one after the other."""
        rows: list[Array] = []
        for name, scale, groups in self._parts:
            rows.append(independent(differences[name] / scale, groups))
        return np.concatenate(rows)


def groups_of(used: NDArray[np.bool_], correlation: Array) -> list[Group]:
    """Members that use the same features, with what makes those independent."""
    patterns, kind = np.unique(used, axis=0, return_inverse=True)
    groups: list[Group] = []
    for index, pattern in enumerate(patterns):
        if pattern.any():
            lower = np.linalg.cholesky(correlation[np.ix_(pattern, pattern)])
            members = np.flatnonzero(kind.ravel() == index)
            groups.append((members, pattern, np.asarray(np.linalg.inv(lower), np.float64)))
    return groups


def independent(z: Array, groups: Sequence[Group]) -> Array:
    """Standardised differences as independent numbers, one after the other."""
    z = np.nan_to_num(z)
    rows = [(z[members][:, used] @ inverse.T).ravel() for members, used, inverse in groups]
    return np.concatenate(rows) if rows else np.empty(0)
