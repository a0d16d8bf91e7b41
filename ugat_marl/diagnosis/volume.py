"""Where demand and turning differ, from counts alone.

Routes say which detectors a change would reach. They say as well how counts depend on each other by
chance: those of two edges share the vehicles that pass both. So a change is weighed by generalised
least squares, in which a vehicle that is counted twice counts once.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import INDEX
from ugat_marl.diagnosis.hypotheses import Hypothesis
from ugat_marl.diagnosis.site import Site
from ugat_marl.diagnosis.statistics import Distance
from ugat_marl.scenarios import Scenario, driven_routes

Array = NDArray[np.float64]

_ALONE = 0.1
"""Share of the noise of a count that it has to itself: vehicles still under way, detectors' own."""
_SUSPECT = 9.0
"""Squared standardised change from which a place is examined."""
_PLACES = 2


@dataclass(frozen=True, eq=False)
class Routes:
    """Which edges vehicles use: per pair of edges, vehicles per hour of the scenario.

    Attributes:
        origins: Vehicles per hour by first edge.
        passing: ``passing[origin][edge]``, vehicles per hour that start there and pass here.
        turns: ``turns[edge][next edge]``, vehicles per hour.
        joint: ``joint[edge][other]``, vehicles per hour that pass both.
    """

    origins: dict[str, float]
    passing: dict[str, dict[str, float]]
    turns: dict[str, dict[str, float]]
    joint: dict[str, dict[str, float]]

    def share(self, origin: str, edge: str) -> float:
        """Share of the vehicles that pass an edge which start at an origin."""
        own = self.passing[origin].get(edge, 0.0)
        return own / self.joint[edge][edge] if own else 0.0

    @classmethod
    def of(cls, scenario: Scenario) -> Routes:
        """Counts the routes of all vehicles."""
        origins: dict[str, float] = defaultdict(float)
        passing: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        turns: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        joint: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        rate = 3600.0 / scenario.settings.duration_s
        for edges in driven_routes(scenario):
            origins[edges[0]] += rate
            passed = dict.fromkeys(edges)
            for edge in passed:
                passing[edges[0]][edge] += rate
                for other in passed:
                    joint[edge][other] += rate
            for edge, following in pairwise(edges):
                turns[edge][following] += rate
        return cls(
            dict(origins),
            {k: dict(v) for k, v in passing.items()},
            {k: dict(v) for k, v in turns.items()},
            {k: dict(v) for k, v in joint.items()},
        )


@dataclass(frozen=True, eq=False)
class _Counts:
    """Measured minus expected vehicles per hour, by edge.

    Attributes:
        place: Edge to its index.
        whiten: Turns differences into independent ones of unit noise, ``(edges, edges)``.
        measured: The differences, whitened.
    """

    place: dict[str, int]
    whiten: Array
    measured: Array

    def weighed(self, change: dict[str, float]) -> tuple[float, float, float]:
        """A change of vehicles per hour, by edge: strength, squared z, and z of strength 1."""
        ray = np.zeros(len(self.place))
        for edge, value in change.items():
            if edge in self.place:
                ray[self.place[edge]] += value
        ray = self.whiten @ ray
        size = float(ray @ ray)
        strength = float(ray @ self.measured) / max(size, 1e-9)
        return strength, strength**2 * size, size


class Volume:
    """Finds origins and turns.

    Args:
        site: Lanes and detectors.
        routes: Of the scenario.
    """

    def __init__(self, site: Site, routes: Routes) -> None:
        self._site = site
        self._routes = routes
        self._edges = [edge for _, edge, _ in site.places]

    def directed(self, distance: Distance) -> dict[str, float]:
        """Squared standardised size of the best origin and of the best turn."""
        counts = self._counts(distance)
        return {
            "demand": max((item[0] for item in self._origins(counts)), default=0.0),
            "turning": max((item[0] for item in self._turns(counts, distance)), default=0.0),
        }

    def hypotheses(self, distance: Distance) -> list[Hypothesis]:
        """The most suspicious origins and turns, with the strength the counts suggest."""
        counts = self._counts(distance)
        found: list[Hypothesis] = []
        if len(self._routes.passing) > 1:
            for gain, origin, factor in sorted(self._origins(counts), reverse=True)[:_PLACES]:
                level = float(np.clip(factor, 0.3, 3.0))
                fixed = (("edge", origin),)
                if gain > _SUSPECT:
                    found.append(
                        Hypothesis(
                            "demand_level", fixed, ("factor",), ((level,),), (1.0,), 0.03, both=True
                        )
                    )
        for gain, origin, target, share in sorted(self._turns(counts, distance), reverse=True)[
            :_PLACES
        ]:
            fixed = (("from_edge", origin), ("to_edge", target))
            if gain > _SUSPECT:
                found.append(Hypothesis("turning", fixed, ("share",), ((share,),), (0.0,), 0.03))
        return found

    def _counts(self, distance: Distance) -> _Counts:
        hour = 60.0
        lanes = len(self._site.lanes)
        place: dict[str, int] = {}
        differences: list[float] = []
        errors: list[float] = []
        for edge in dict.fromkeys(self._edges):
            members = [i for i, name in enumerate(self._edges) if name == edge]
            kinds = ("count_stop", "count_advance") if members[0] < lanes else ("count_exit",)
            for kind in kinds:
                row = INDEX[kind]
                difference = distance.difference["lane"][members, row]
                z = distance.z["lane"][members, row]
                known = (difference != 0) & (z != 0)
                if known.any():
                    place[edge] = len(place)
                    differences.append(hour * float(difference.sum()))
                    error = np.abs(difference[known] / z[known])
                    errors.append(max(hour * float(np.sqrt((error**2).sum())), 1e-6))
                    break
        lower = np.linalg.cholesky(self._correlation(tuple(place)))
        whiten = np.asarray(np.linalg.inv(lower) / np.array(errors)[None, :], np.float64)
        return _Counts(place, whiten, whiten @ np.array(differences))

    def _correlation(self, edges: tuple[str, ...]) -> Array:
        """Of the counts of edges if vehicles come by chance: what they share."""
        joint = self._routes.joint
        shared = np.array([[joint.get(a, {}).get(b, 0.0) for b in edges] for a in edges])
        shared = shared.reshape(len(edges), len(edges))
        size = np.sqrt(np.maximum(np.diag(shared), 1e-9))
        alone = np.where(np.diag(shared) > 0, _ALONE, 1.0)
        return (1 - _ALONE) * shared / np.outer(size, size) + np.diag(alone)

    def _origins(self, counts: _Counts) -> list[tuple[float, str, float]]:
        """Squared z, origin and factor of every origin that can be told."""
        found: list[tuple[float, str, float]] = []
        for origin, reached in self._routes.passing.items():
            strength, gain, size = counts.weighed(reached)
            if size > _SUSPECT:
                found.append((gain, origin, 1.0 + strength))
        return found

    def _turns(self, counts: _Counts, distance: Distance) -> list[tuple[float, str, str, float]]:
        """Squared z, edges and share of every pair of edges between which vehicles may move.

        What arrives says where to, and hardly where from; that is told by the lanes vehicles left.
        """
        found: list[tuple[float, str, str, float]] = []
        approaches = {lane.edge for lane in self._site.lanes}
        for origin in sorted(approaches & set(self._routes.turns)):
            leaving = self._routes.turns[origin]
            total = sum(leaving.values())
            for target in leaving:
                change = {other: -rate for other, rate in leaving.items()}
                change[target] += total
                strength, gain, size = counts.weighed(change)
                if size > 4.0 and strength > 0.02:
                    gain += self._lanes_left(origin, target, distance)
                    found.append((gain, origin, target, min(strength, 0.9)))
        return found

    def _lanes_left(self, origin: str, target: str, distance: Distance) -> float:
        """Squared z of vehicles that moved to those lanes of an edge that lead to another."""
        rates = self._routes.turns[origin]
        row = INDEX["count_stop"]
        ray: list[float] = []
        z: list[float] = []
        errors: list[float] = []
        lanes = [(i, lane) for i, lane in enumerate(self._site.lanes) if lane.edge == origin]
        for index, lane in lanes:
            difference = float(distance.difference["lane"][index, row])
            score = float(distance.z["lane"][index, row])
            if not difference or not score:
                continue
            change = 0.0
            for edge in sorted(rates.keys() & lane.following):
                alike = sum(edge in other.following for _, other in lanes)
                come = sum(rates.values()) if edge == target else 0.0
                change += (come - rates[edge]) / alike
            ray.append(change)
            z.append(score)
            errors.append(60.0 * abs(difference / score))
        if len(ray) < 2:
            return 0.0
        scaled = np.array(ray) / np.array(errors)
        scaled -= scaled.mean()  # how many came in all is counted already
        found = float(scaled @ np.array(z))
        return max(found, 0.0) ** 2 / max(float(scaled @ scaled), 1e-9)
