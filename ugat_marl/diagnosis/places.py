"""Effects proposed at places and in windows, from the differences of data and model there.

Nothing is simulated here. Counts show places where demand and turning differ (`Volume`). A scan
over all stretches of time finds the window in which a place differs most from the model. Faults of
detectors show in their own data.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ugat_marl.data import occupied_between
from ugat_marl.diagnosis.features import (
    BIN_FEATURES,
    COUNT_FEATURES,
    INDEX,
    DetectorLayout,
    bins_in,
    occupations,
)
from ugat_marl.diagnosis.hypotheses import Hypothesis, Members, examined
from ugat_marl.diagnosis.statistics import Distance, Reference
from ugat_marl.diagnosis.supplementary_data import TURNING
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.effects import ExaminedStrengths
from ugat_marl.scenarios import Passages, Period, Scenario, departures, edge_of_lane

Array = NDArray[np.float64]

_FLOW = (
    "gap_long", "occupied_in_green", "gap9+", "free_speed", "queue_over", "platoon_gap",
    "count_advance", "count_stop",
)  # fmt: skip
"""Features that change if a vehicle stands on a lane."""
_AVOIDED = ("count_advance", "count_stop")
"""Features that show that drivers avoid a lane."""


def _speed_row(distance: Distance) -> int:
    """Return the feature that shows speeds: of free vehicles, or means of intervals."""
    z = distance.z["lane"]
    means = INDEX["mean_speed_advance"]
    return means if means < z.shape[1] and z[:, means].any() else INDEX["free_speed"]


class PlaceFinder:
    """Finder of places and windows.

    Args:
        layout: Lanes and detectors.
        routes: Routes of the scenario.
        allowed: Names of effects to examine.
        thresholds: Numbers of the method.
        holes: Times in which nothing was recorded, begin and end in s.
    """

    def __init__(
        self,
        layout: DetectorLayout,
        routes: Routes,
        allowed: Collection[str],
        thresholds: Thresholds,
        holes: Sequence[tuple[float, float]] = (),
    ) -> None:
        self._holes = tuple(holes)
        self._layout = layout
        self._thresholds = thresholds
        self._routes = routes
        self.allowed = frozenset(allowed)
        self._volume = Volume(layout, routes, thresholds)

    def hypotheses(
        self, reference: Reference, distance: Distance, periods: Sequence[Period]
    ) -> list[Hypothesis]:
        """Propose effects at places, strongest first within each kind.

        Args:
            reference: Statistics of the model so far.
            distance: Distance of the data from the model.
            periods: The fitted periods.
        """
        hypotheses: list[Hypothesis] = []
        hypotheses += self._volume.hypotheses(distance)
        hypotheses += turned(reference, distance)
        hypotheses += self._timing(reference, distance, periods[0].end_s - periods[0].begin_s)
        hypotheses += self._windows(reference, distance, periods)
        hypotheses += self._places(reference, distance)
        hypotheses += fault_hypotheses(self._layout, reference, distance, periods, self._holes)
        return [hypothesis for hypothesis in hypotheses if hypothesis.name in self.allowed]

    def everywhere(self) -> list[Hypothesis]:
        """Propose parking on every lane, if there are few lanes.

        Drivers avoid a lane with parked vehicles and use its neighbour. The sum over both lanes
        hardly changes, so differences of the data do not show parking reliably.
        """
        lanes = self._layout.lanes
        if len(lanes) > self._thresholds.most_lanes or "parking" not in self.allowed:
            return []
        return [_parking(lane.id, self._thresholds) for lane in lanes]

    def directed(self, distance: Distance) -> dict[str, float]:
        """Return the squared standardised sizes of the best origin, turn and stretch of time."""
        return self._volume.directed(distance) | largest_stretches(self._layout, distance)

    # --- time ---------------------------------------------------------------------------------

    def _timing(
        self, reference: Reference, distance: Distance, length_s: float
    ) -> list[Hypothesis]:
        """Find origins whose demand would fit if it came sooner or later."""
        z, difference = distance.z["time"], distance.difference["time"]
        block = reference.blocks["time"]
        least, most = self._thresholds.strengths_of_a_shift
        fitting: list[tuple[float, str, float]] = []
        first = BIN_FEATURES.index("count_advance") * len(self._layout.places)
        width = length_s / bins_in(length_s, self._thresholds) * reference.pools.together
        for origin in self._routes.passing:
            rows = [
                first + index
                for index, lane in enumerate(self._layout.lanes)
                if self._routes.share(origin, lane.edge) > self._thresholds.mostly
            ]
            known = z[rows] != 0
            if not known.any():
                continue
            mean = np.where(np.isfinite(block.mean[rows]), block.mean[rows], 0.0)
            noise = np.where(known, difference[rows] / np.where(known, z[rows], 1.0), np.inf)
            for shift in self._thresholds.shifts_s:
                change = (_later(mean, shift / width) - mean) / np.abs(noise)
                size = float((change**2).sum())
                strength = float((change * z[rows]).sum()) / max(size, 1e-9)
                if least < strength < most and strength**2 * size > self._thresholds.suspect_timing:
                    fitting.append((strength**2 * size, origin, shift))
        chosen: dict[str, float] = {}
        for _, origin, shift in sorted(fitting, reverse=True):
            chosen.setdefault(origin, shift)
        return [
            Hypothesis(
                "demand_timing",
                (("edge", origin),),
                ("seconds",),
                ((shift,),),
                (0.0,),
                self._thresholds.least_shift_s,
            )
            for origin, shift in list(chosen.items())[: self._thresholds.places_of_a_kind]
        ]

    def _windows(
        self, reference: Reference, distance: Distance, periods: Sequence[Period]
    ) -> list[Hypothesis]:
        """Propose surges and closures in the stretches of time that differ most."""
        if len({(p.begin_s, p.end_s) for p in periods}) > 1:
            return []
        thresholds = self._thresholds
        ranked: list[tuple[float, Hypothesis]] = []
        for origin in self._routes.passing:
            measured = self._measured_edge(origin)
            members = self._layout.places_of_edge.get(measured or "", ())
            window = self._scan(
                reference, distance, periods, members, "count_advance", "count_exit"
            )
            if window is not None:
                z, begin, end, factor = window
                fixed = (("edge", origin), ("begin_s", begin), ("end_s", end))
                level = float(np.clip(factor, *thresholds.surge_factors))
                surge = Hypothesis(
                    "demand_surge", fixed, ("factor",), ((level,),), (1.0,), thresholds.least_surge
                )
                ranked.append((z, surge))
        scanned: list[tuple[float, str, float, float]] = []
        for index, lane in enumerate(self._layout.lanes):
            # The queue that leaves after a closure differs more than the closure itself, so each
            # kind of count is scanned to the side that a closure changes.
            for kind, side in (("occupied", 1), ("count_stop", -1), ("count_advance", -1)):
                option = self._scan(reference, distance, periods, [index], kind, kind, side)
                if option is not None:
                    z, begin, end, _ = option
                    scanned.append((z, lane.id, begin, end))
        ranked.sort(key=lambda pair: -pair[0])
        scanned.sort(key=lambda option: -option[0])
        surges = [hypothesis for _, hypothesis in ranked][: thresholds.surges]
        windows = [option[1:] for option in scanned]
        places = list(dict.fromkeys(windows))[: thresholds.closures]
        places += _mixed(windows)[: thresholds.mixed_closures]
        return [*surges, *itertools.starmap(_closure, dict.fromkeys(places))]

    def _measured_edge(self, origin: str) -> str | None:
        """Return the first measured edge on the ways of an origin that is mostly its own."""
        for edge in self._routes.passing[origin]:  # in the order of a route
            own = edge == origin or self._routes.share(origin, edge) > self._thresholds.mostly
            if own and edge in self._layout.places_of_edge:
                return edge
        return None

    def _scan(
        self,
        reference: Reference,
        distance: Distance,
        periods: Sequence[Period],
        members: Sequence[int],
        kind: str,
        other: str,
        side: int = 0,
    ) -> tuple[float, float, float, float] | None:
        """Find the stretch of time whose counts differ most from the ratio over the rest.

        The ratio is that of measured to expected counts.

        Args:
            reference: Statistics of the model.
            distance: Distance of the data from the model.
            periods: The fitted periods.
            members: Indices of the places whose counts are added.
            kind: Bin feature for incoming lanes.
            other: Bin feature for outgoing lanes.
            side: -1 or 1 to find only fewer or only more counts; 0 for both.

        Returns:
            Standardised size, start and end in s, ratio to the expected; None if all is chance.
        """
        block = reference.blocks["time"]
        places = len(self._layout.places)
        rows: list[int] = []
        for index in members:
            name = kind if index < len(self._layout.lanes) else other
            row = BIN_FEATURES.index(name) * places + index
            if block.used[row].any():
                rows.append(row)
        if not rows:
            return None
        begin, end = periods[0].begin_s, periods[0].end_s
        length_s = reference.pools.grouped_s(end - begin)
        minutes = max(int(length_s / self._thresholds.scan_s), 1)
        bins = block.mean.shape[1]
        which = np.minimum((np.arange(minutes) * bins) // minutes, bins - 1)
        per_bin = np.bincount(which, minlength=bins)
        expected = (block.mean[rows].sum(axis=0) / np.maximum(per_bin, 1))[which]
        variance = (block.variance[rows].sum(axis=0) / np.maximum(per_bin, 1))[which] / len(periods)
        if any(period.passages for period in periods):
            measured = self._minutes(periods, members, kind, other, minutes)
            length_s = end - begin
        else:  # without passages only the counts of whole bins are known
            more = distance.difference["time"][rows].sum(axis=0) / np.maximum(per_bin, 1)
            measured = expected + more[which]
        width_s = length_s / minutes
        return most_unusual(measured, expected, variance, begin, width_s, self._thresholds, side)

    def _minutes(
        self, periods: Sequence[Period], members: Sequence[int], kind: str, other: str, minutes: int
    ) -> Array:
        """Return counts, or occupied seconds, per minute, ``(minutes,)``: mean of the periods."""
        total = np.zeros(minutes)
        for period in periods:
            edges = np.linspace(period.begin_s, period.end_s, minutes + 1)
            for index in members:
                passages = self._passages(
                    period, index, kind if index < len(self._layout.lanes) else other
                )
                if passages is None or not len(passages):
                    continue
                if kind == "occupied":
                    on, off = occupations(passages, period, self._thresholds)
                    total += occupied_between(on, off, edges)
                else:
                    total += np.histogram(passages.counted_s, edges)[0]
        return total / len(periods)

    def _passages(self, period: Period, index: int, kind: str) -> Passages | None:
        lanes = self._layout.lanes
        if index >= len(lanes):
            return period.of_detector(self._layout.exits[index - len(lanes)][2])
        return lanes[index].passages(period, "stop" if kind == "count_stop" else "advance")

    # --- places -------------------------------------------------------------------------------

    def _places(self, reference: Reference, distance: Distance) -> list[Hypothesis]:
        """Propose parking on lanes, speeds on edges, lost time and clocks at traffic lights."""
        hypotheses: list[Hypothesis] = []
        lanes = self._layout.lanes
        hypotheses += [_parking(lane, self._thresholds) for lane in self._disturbed(distance)]
        speed = distance.z["lane"][: len(lanes), _speed_row(distance)]
        by_edge: dict[str, float] = defaultdict(float)
        for lane, value in zip(lanes, speed, strict=True):
            by_edge[lane.edge] += float(value)
        if len(by_edge) > 1:
            typical = float(np.median(list(by_edge.values())))
            ranked = sorted(by_edge, key=lambda edge: -abs(by_edge[edge] - typical))
            hypotheses += [
                Hypothesis(
                    "local_speed",
                    (("edge", edge),),
                    ("factor",),
                    ((self._speed_ratio(reference, distance, edge),),),
                    (1.0,),
                    self._thresholds.least_speed_change,
                    both=True,
                )
                for edge in ranked[: self._thresholds.places_of_a_kind]
            ]
        if len(self._layout.intersections) > 1:
            hypotheses += self._traffic_lights(distance)
        return hypotheses

    def _disturbed(self, distance: Distance) -> list[str]:
        """Return lanes on which a vehicle may stand: lanes with odd flow, and avoided lanes."""
        lanes = self._layout.lanes
        largest = self._thresholds.largest_z
        z = np.clip(distance.z["lane"][: len(lanes)], -largest, largest)
        unusual = np.abs(z[:, [INDEX[name] for name in _FLOW]]).sum(axis=1)
        fewer = z[:, [INDEX[name] for name in _AVOIDED]].sum(axis=1)
        by_edge: dict[str, list[int]] = defaultdict(list)
        for index, lane in enumerate(lanes):
            by_edge[lane.edge].append(index)
        edges = sorted(by_edge.values(), key=lambda members: -max(unusual[members]))
        names: list[str] = []
        for members in edges[: self._thresholds.places_of_a_kind]:
            avoided = sorted(members, key=lambda index: fewer[index])[:1]
            stuck = sorted(members, key=lambda index: -unusual[index])[:1]
            names += [lanes[index].id for index in dict.fromkeys((*avoided, *stuck))]
        return names

    def _speed_ratio(self, reference: Reference, distance: Distance, edge: str) -> float:
        """Return the free speed on an edge, as a multiple of the simulated one."""
        thresholds = self._thresholds
        rows = self._layout.places_of_edge[edge]
        row = _speed_row(distance)
        mean = reference.blocks["lane"].mean[rows, row]
        difference = distance.difference["lane"][rows, row]
        known = np.isfinite(mean) & (difference != 0) & (mean > 0)
        if not known.any():
            return thresholds.usual_speed_ratio
        ratio = float(np.mean(1.0 + difference[known] / mean[known]))
        if abs(ratio - 1.0) <= thresholds.least_speed_ratio:
            return thresholds.usual_speed_ratio
        return float(np.clip(ratio, *thresholds.speed_ratios))

    def _traffic_lights(self, distance: Distance) -> list[Hypothesis]:
        """Find the traffic lights whose lost time, or its trend, differs most from the rest."""
        thresholds = self._thresholds
        lost = distance.z["intersection"][:, INDEX["lost"]]
        lost = lost - np.median(lost)
        drift = distance.z["intersection"][:, INDEX["lost_trend"]]
        drift = drift - np.median(drift)
        names = self._layout.intersections
        hypotheses: list[Hypothesis] = []
        for index in np.argsort(-np.abs(lost))[: thresholds.places_of_a_kind]:
            place = (("place", names[int(index)]),)
            late_step_s = examined("late_green").step
            hypotheses.append(
                Hypothesis(
                    "late_green",
                    place,
                    ("seconds",),
                    ((thresholds.first_late_green_s,),),
                    (0.0,),
                    thresholds.least_late_green_s,
                    late_step_s,
                )
            )
            sign = 1.0 if lost[index] > 0 else -1.0
            levels = _towards(sign, examined("signal_clock"))
            hypotheses.append(
                Hypothesis(
                    "signal_clock", place, ("seconds",), levels, (0.0,), thresholds.least_clock_s
                )
            )
        for index in np.argsort(-np.abs(drift))[: thresholds.drifting_clocks]:
            sign = 1.0 if drift[index] > 0 else -1.0
            levels = _towards(sign, examined("clock_drift"))
            place = (("place", names[int(index)]),)
            hypotheses.append(
                Hypothesis(
                    "clock_drift",
                    place,
                    ("seconds_per_hour",),
                    levels,
                    (0.0,),
                    thresholds.least_drift,
                )
            )
        return hypotheses


def _parking(lane: str, thresholds: Thresholds) -> Hypothesis:
    fixed = (("lane", lane), ("dwell_s", thresholds.dwell_s))
    return Hypothesis(
        "parking",
        fixed,
        ("per_hour",),
        ((thresholds.first_parking,),),
        (0.0,),
        thresholds.least_parking,
    )


def _later(counts: Array, bins: float) -> Array:
    """Return counts ``(rows, bins)`` moved later by `bins`; 0 where nothing is known."""
    moved = np.zeros_like(counts)
    whole = int(np.floor(bins))
    for part, step in ((1.0 - (bins - whole), whole), (bins - whole, whole + 1)):
        if abs(step) >= counts.shape[1]:
            continue
        if step >= 0:
            moved[:, step:] += part * counts[:, : counts.shape[1] - step]
        else:
            moved[:, :step] += part * counts[:, -step:]
    return moved


# --- counts: demand and turning -------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Routes:
    """Mean flows of the scenario's vehicles over edges and pairs of edges, vehicles per hour.

    Attributes:
        origins: Flow that starts on an edge.
        passing: ``passing[origin][edge]``, flow that starts on `origin` and passes `edge`.
        turns: ``turns[edge][next edge]``, flow from an edge to the next one.
        joint: ``joint[edge][other]``, flow that passes both edges.
    """

    origins: dict[str, float]
    passing: dict[str, dict[str, float]]
    turns: dict[str, dict[str, float]]
    joint: dict[str, dict[str, float]]

    def share(self, origin: str, edge: str) -> float:
        """Return the share of an edge's vehicles that start at an origin, in [0, 1]."""
        flow = self.passing[origin].get(edge, 0.0)
        return flow / self.joint[edge][edge] if flow else 0.0

    @classmethod
    def of(cls, scenario: Scenario, periods: Sequence[Period] = ()) -> Routes:
        """Count the routes of the vehicles that depart within periods.

        Args:
            scenario: The scenario.
            periods: Periods over which flows are means; none for the whole scenario.
        """
        origins: dict[str, float] = defaultdict(float)
        passing: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        turns: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        joint: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        begin_s = scenario.settings.begin_s
        whole = begin_s, begin_s + scenario.settings.duration_s
        windows = Counter([period.window for period in periods] or [whole])
        length_s = sum(times * (end - begin) for (begin, end), times in windows.items())
        for _, depart, edges in departures(scenario, routed=False):
            rate = sum(
                3600.0 * times / length_s
                for (begin, end), times in windows.items()
                if begin <= depart < end
            )
            if not edges or not rate:
                continue
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
        place: Index by edge.
        whiten: Matrix that makes differences independent with unit noise, ``(edges, edges)``.
        measured: The whitened differences, ``(edges,)``.
    """

    place: dict[str, int]
    whiten: Array
    measured: Array

    def weighed(self, change: dict[str, float]) -> tuple[float, float, float]:
        """Fit a change of flows to the measured differences.

        With r the whitened change and m the measured differences: strength s = r·m / r·r.

        Args:
            change: Vehicles per hour by edge, for strength 1.

        Returns:
            Strength s, squared z of the fit ``s^2 r·r``, squared z of strength 1 ``r·r``.
        """
        expected = np.zeros(len(self.place))
        for edge, value in change.items():
            if edge in self.place:
                expected[self.place[edge]] += value
        expected = self.whiten @ expected
        size = float(expected @ expected)
        strength = float(expected @ self.measured) / max(size, 1e-9)
        return strength, strength**2 * size, size


class Volume:
    """Finder of origins and turns, from counts alone.

    Args:
        layout: Lanes and detectors.
        routes: Routes of the scenario.
        thresholds: Numbers of the method.
    """

    def __init__(self, layout: DetectorLayout, routes: Routes, thresholds: Thresholds) -> None:
        self._layout = layout
        self._thresholds = thresholds
        self._routes = routes

    def directed(self, distance: Distance) -> dict[str, float]:
        """Return the squared standardised sizes of the best origin and of the best turn.

        Their names are not those of hypotheses: "turning" is a block, of measured turning counts.
        """
        counts = self._counts(distance)
        return {
            "best origin": max((row[0] for row in self._origins(counts)), default=0.0),
            "best turn": max((row[0] for row in self._turns(counts, distance)), default=0.0),
        }

    def hypotheses(self, distance: Distance) -> list[Hypothesis]:
        """Propose the most suspicious origins and turns, with strengths estimated from counts."""
        counts = self._counts(distance)
        hypotheses: list[Hypothesis] = []
        if len(self._routes.passing) > 1:
            for gain, origin, factor in sorted(self._origins(counts), reverse=True)[
                : self._thresholds.places_of_a_kind
            ]:
                level = float(np.clip(factor, *self._thresholds.demand_factors))
                fixed = (("edge", origin),)
                if gain > self._thresholds.suspect_change:
                    hypotheses.append(
                        Hypothesis(
                            "demand_level",
                            fixed,
                            ("factor",),
                            ((level,),),
                            (1.0,),
                            self._thresholds.least_demand,
                            both=True,
                        )
                    )
        for gain, origin, target, shares in sorted(self._turns(counts, distance), reverse=True)[
            : self._thresholds.places_of_a_kind
        ]:
            fixed = (("from_edge", origin), ("to_edge", target))
            if gain > self._thresholds.suspect_change:
                hypotheses.append(
                    Hypothesis(
                        "turning",
                        fixed,
                        ("share",),
                        tuple((share,) for share in shares),
                        (0.0,),
                        self._thresholds.least_turning,
                    )
                )
        return hypotheses

    def _counts(self, distance: Distance) -> _Counts:
        hour = 60.0
        place: dict[str, int] = {}
        differences: list[float] = []
        errors: list[float] = []
        for edge, members in self._layout.places_of_edge.items():
            for kind in ("count_stop", "count_advance", "count_exit"):
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
        """Return the correlation of the counts of edges, ``(edges, edges)``.

        With independent vehicles, flows a and b that share the flow j correlate by j / sqrt(a b). A
        share `alone` of the variance of each count is its own.
        """
        joint = self._routes.joint
        shared = np.array([[joint.get(a, {}).get(b, 0.0) for b in edges] for a in edges])
        shared = shared.reshape(len(edges), len(edges))
        size = np.sqrt(np.maximum(np.diag(shared), 1e-9))
        alone = np.where(np.diag(shared) > 0, self._thresholds.alone, 1.0)
        return (1 - self._thresholds.alone) * shared / np.outer(size, size) + np.diag(alone)

    def _origins(self, counts: _Counts) -> list[tuple[float, str, float]]:
        """Return squared z, origin and factor of every origin that the counts can show."""
        origins: list[tuple[float, str, float]] = []
        for origin, reached in self._routes.passing.items():
            strength, gain, size = counts.weighed(reached)
            if size > self._thresholds.suspect_change:
                origins.append((gain, origin, 1.0 + strength))
        return origins

    def _turns(
        self, counts: _Counts, distance: Distance
    ) -> list[tuple[float, str, str, tuple[float, ...]]]:
        """Return squared z, edge, next edge and shares for every turn that may take more vehicles.

        Counts behind the intersection show the next edge, but hardly the edge before. The counts of
        the lanes that vehicles left show that one. Each has its own estimate of the share, the
        larger one first. Where demand varies from day to day, that of the lanes is nearer.
        """
        thresholds = self._thresholds
        turns: list[tuple[float, str, str, tuple[float, ...]]] = []
        approaches = {lane.edge for lane in self._layout.lanes}
        for origin in sorted(approaches & set(self._routes.turns)):
            leaving = self._routes.turns[origin]
            total = sum(leaving.values())
            for target in leaving:
                change = {other: -rate for other, rate in leaving.items()}
                change[target] += total
                behind, gain, size = counts.weighed(change)
                left, more = self._lanes_left(origin, target, distance)
                if size > thresholds.visible_turn and behind > thresholds.least_turn:
                    told = (x for x in (behind, left) if x > thresholds.least_turn)
                    shares = {round(min(x, thresholds.most_turning), 2) for x in told}
                    ordered = tuple(sorted(shares, reverse=True))
                    turns.append((gain + more, origin, target, ordered))
        return turns

    def _lanes_left(self, origin: str, target: str, distance: Distance) -> tuple[float, float]:
        """Fit more vehicles on those lanes of an edge that lead to the target.

        Returns:
            Share of the edge's vehicles that would have to turn, and squared z of the fit; zeros if
            the lanes cannot tell, or there are fewer vehicles.
        """
        rates = self._routes.turns[origin]
        row = INDEX["count_stop"]
        changes: list[float] = []
        z: list[float] = []
        errors: list[float] = []
        lanes = [(i, lane) for i, lane in enumerate(self._layout.lanes) if lane.edge == origin]
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
            changes.append(change)
            z.append(score)
            errors.append(60.0 * abs(difference / score))
        if len(changes) < 2:
            return 0.0, 0.0
        scaled = np.array(changes) / np.array(errors)
        scaled -= scaled.mean()  # the total over the lanes is tested by `weighed` already
        match, size = float(scaled @ np.array(z)), max(float(scaled @ scaled), 1e-9)
        return (match / size, match**2 / size) if match > 0 else (0.0, 0.0)


def turned(reference: Reference, distance: Distance) -> list[Hypothesis]:
    """Propose turns of which turning counts hold more than the model.

    A share s of the vehicles of the other turns from an edge takes the turn: with the measured
    share m and the share k in the model, ``m = k + s (1 - k)``.
    """
    thresholds = reference.pools.thresholds
    labels = reference.pools.supplementary.get(TURNING, ())
    if not labels:
        return []
    mean = reference.blocks[TURNING].mean[:, 0]
    difference, z = (side[TURNING][:, 0] for side in (distance.difference, distance.z))
    ranked: list[tuple[float, Hypothesis]] = []
    for edge in dict.fromkeys(label.edge for label in labels):
        members = [i for i, label in enumerate(labels) if label.edge == edge]
        model, street = mean[members], mean[members] + difference[members]
        if len(members) < 2 or not (np.isfinite(model).all() and model.sum() > 0 < street.sum()):
            continue
        for index, before, now in zip(
            members, model / model.sum(), street / street.sum(), strict=True
        ):
            share = float((now - before) / max(1.0 - before, 1e-9))
            if share > thresholds.least_turn and z[index] ** 2 > thresholds.suspect_change:
                fixed = (("from_edge", edge), ("to_edge", labels[index].following))
                level = ((min(share, thresholds.most_turning),),)
                turn = Hypothesis(
                    "turning", fixed, ("share",), level, (0.0,), thresholds.least_turning
                )
                ranked.append((float(z[index]) ** 2, turn))
    ranked.sort(key=lambda pair: -pair[0])
    return [turn for _, turn in ranked[: thresholds.places_of_a_kind]]


# --- stretches of time ----------------------------------------------------------------------------


def largest_stretches(layout: DetectorLayout, distance: Distance) -> dict[str, float]:
    """Return the largest squared standardised difference over any stretch of bins.

    Args:
        layout: Lanes and detectors.
        distance: Distance of the data from a model.

    Returns:
        "window" for edges, "lane window" for single lanes.
    """
    z, difference = distance.z["time"], distance.difference["time"]
    variance = np.where(z != 0, (difference / np.where(z != 0, z, 1.0)) ** 2, 0.0)
    places = len(layout.places)
    groups = [
        [kind * places + index for index in members]
        for members in layout.places_of_edge.values()
        for kind in range(len(COUNT_FEATURES))
    ]
    of_edges = np.stack([difference[rows].sum(axis=0) for rows in groups])
    noise = np.stack([variance[rows].sum(axis=0) for rows in groups])
    return {"window": _largest(of_edges, noise), "lane window": _largest(difference, variance)}


def _largest(difference: Array, variance: Array) -> float:
    """Return the largest squared standardised sum over all rows and all stretches of bins.

    Args:
        difference: Data minus model, ``(rows, bins)``.
        variance: Variance of the differences, ``(rows, bins)``.
    """
    sums, noise = (
        np.concatenate((np.zeros((len(values), 1)), np.cumsum(values, axis=1)), axis=1)
        for values in (difference, variance)
    )
    largest = 0.0
    for length in range(1, sums.shape[1]):
        part = noise[:, length:] - noise[:, :-length]
        squared = (sums[:, length:] - sums[:, :-length]) ** 2 / np.maximum(part, 1e-9)
        largest = max(largest, float(np.where(part > 0, squared, 0.0).max()))
    return largest


def _closure(lane: str, begin_s: float, end_s: float) -> Hypothesis:
    fixed = (("lane", lane), ("begin_s", begin_s), ("end_s", end_s))
    return Hypothesis("lane_closure", fixed, (), ((),), None)


def _mixed(windows: Sequence[tuple[str, float, float]]) -> list[tuple[str, float, float]]:
    """Return the windows of the first lane with the begin of one and the end of another."""
    own = [window for window in windows if window[0] == windows[0][0]]
    pairs = itertools.product(own, repeat=2)
    mixed = [(lane, begin, end) for (lane, begin, _), (_, _, end) in pairs if begin < end]
    return [window for window in dict.fromkeys(mixed) if window not in own]


def most_unusual(
    measured: Array,
    expected: Array,
    variance: Array,
    begin_s: float,
    width_s: float,
    thresholds: Thresholds,
    side: int = 0,
) -> tuple[float, float, float, float] | None:
    """Scan all stretches of time for the largest standardised difference from a constant ratio.

    The ratio is that of measured to expected outside the stretch.

    Args:
        measured: Measured values per minute, ``(minutes,)``.
        expected: Expected values per minute.
        variance: Variances of the expected values per minute.
        begin_s: Start of the first minute, s.
        width_s: Length of a minute, s; periods are no whole minutes long.
        thresholds: Numbers of the method.
        side: -1 or 1 to find only smaller or only larger values; 0 for both.

    Returns:
        Standardised size, start and end in s, ratio to the rest; None if all is chance.
    """
    minutes = len(measured)
    if expected.sum() <= 0 or minutes * thresholds.scan_s <= thresholds.shortest_stretch_s:
        return None
    sums = [np.concatenate(([0.0], np.cumsum(row))) for row in (measured, expected, variance)]
    shortest = int(thresholds.shortest_stretch_s / thresholds.scan_s)
    best: tuple[float, int, int, float] | None = None
    for length in range(shortest, max(int(thresholds.longest_stretch * minutes), shortest) + 1):
        inside = [row[length:] - row[:-length] for row in sums]
        # z = (measured - rest * expected) / noise in the stretch, rest = their ratio outside
        rest = (sums[0][-1] - inside[0]) / np.maximum(sums[1][-1] - inside[1], 1e-9)
        excess = inside[0] - rest * inside[1]
        share = inside[1] / np.maximum(sums[1][-1] - inside[1], 1e-9)
        noise = np.sqrt(np.maximum(inside[2] * (1 + share), 1e-6))
        z = excess / noise
        size = side * z if side else np.abs(z)
        place = int(np.argmax(size))
        if best is None or size[place] > best[0]:
            ratio = float(inside[0][place] / max(rest[place] * inside[1][place], 1e-9))
            best = (float(size[place]), place, place + length, ratio)
    if best is None or best[0] < thresholds.unusual_stretch:
        return None
    z, first, last, ratio = best
    return z, begin_s + width_s * first, begin_s + width_s * last, ratio


# --- faults of detectors --------------------------------------------------------------------------


def fault_hypotheses(
    layout: DetectorLayout,
    reference: Reference,
    distance: Distance,
    periods: Sequence[Period],
    holes: Sequence[tuple[float, float]],
) -> list[Hypothesis]:
    """Propose detectors that count too few, stay on, fall silent, or are exchanged.

    Args:
        layout: Lanes and detectors.
        reference: Statistics of the model so far.
        distance: Distance of the data from the model.
        periods: The fitted periods.
        holes: Times in which nothing was recorded, begin and end in s.
    """
    thresholds = reference.pools.thresholds
    hypotheses: list[Hypothesis] = []
    places = {name: (place, INDEX[kind]) for name, (kind, place) in layout.counted.items()}
    z = {name: float(distance.z["lane"][row]) for name, row in places.items()}
    mean = {name: float(reference.blocks["lane"].mean[row]) for name, row in places.items()}
    difference = {n: float(distance.difference["lane"][r]) for n, r in places.items()}
    for name in sorted(z, key=lambda name: z[name])[: thresholds.faults_of_a_kind]:
        if z[name] < -thresholds.short_count and mean[name] > 0:
            share = float(np.clip(-difference[name] / mean[name], *thresholds.missed_shares))
            hypotheses.append(
                Hypothesis(
                    "undercount",
                    (("place", name),),
                    ("share",),
                    ((share,),),
                    (0.0,),
                    thresholds.least_undercount,
                )
            )
    stuck = _stuck(periods, places, thresholds)
    on = {dict(fault.fixed)["detector"] for fault in stuck}
    silent = _silent(periods, mean, thresholds, holes)
    hypotheses += stuck + [fault for fault in silent if dict(fault.fixed)["detector"] not in on]
    kinds = {detector.id: detector.kind for detector in layout.detectors}
    minutes = sum(period.length_s for period in periods) / 60.0
    hypotheses += _swapped(kinds, mean, difference, minutes, thresholds)
    return hypotheses


def _stuck(
    periods: Sequence[Period], compared: Collection[str], thresholds: Thresholds
) -> list[Hypothesis]:
    """Find compared detectors that were on for minutes at the same time of every period."""
    faults: list[Hypothesis] = []
    for name in sorted(set(compared).intersection(*(p.passages for p in periods))):
        windows: list[tuple[float, float]] = []
        for period in periods:
            seen = period.passages[name]
            if not len(seen):
                break
            time = np.nan_to_num(seen.off_s, nan=period.end_s) - np.nan_to_num(
                seen.on_s, nan=period.begin_s
            )
            longest = int(np.argmax(time))
            if time[longest] < thresholds.stuck_s:
                break
            on, off = float(seen.on_s[longest]), float(seen.off_s[longest])
            on = period.begin_s if np.isnan(on) else on
            windows.append((on, period.end_s if np.isnan(off) else off))
        if len(windows) == len(periods):
            begin = float(np.median([w[0] for w in windows]))
            end = float(np.median([w[1] for w in windows]))
            if max(w[0] for w in windows) < min(w[1] for w in windows):
                fixed = (("detector", name), ("begin_s", begin), ("end_s", end))
                faults.append(Hypothesis("stuck", fixed, (), ((),), None))
    return faults[: thresholds.faults_of_a_kind]


def _silent(
    periods: Sequence[Period],
    rate: Mapping[str, float],
    thresholds: Thresholds,
    holes: Sequence[tuple[float, float]],
) -> list[Hypothesis]:
    """Find detectors that were silent at the same time of every period, against expectation.

    Silence in a hole of the recording does not count.
    """

    def recorded(time: Array) -> Array:
        """Return the seconds that were recorded before a time, from some origin on."""
        return time - sum(np.clip(time - begin, 0.0, end - begin) for begin, end in holes)

    ranked: list[tuple[float, Hypothesis]] = []
    if not any(period.passages for period in periods):
        return []  # counts alone do not say when a detector was silent
    for name, expected in rate.items():
        begin, end = -np.inf, np.inf
        for period in periods:
            seen = period.of_detector(name)
            times = np.concatenate((seen.on_s, seen.off_s))
            times = np.sort(times[np.isfinite(times)])
            times = np.concatenate(([period.begin_s], times, [period.end_s]))
            longest = int(np.argmax(np.diff(recorded(times))))
            begin, end = max(begin, float(times[longest])), min(end, float(times[longest + 1]))
        silence_s = float(np.diff(recorded(np.array([begin, end])))[0])
        missing = expected * silence_s / 60.0 * len(periods)
        if end > begin and missing > thresholds.silent:
            fixed = (("detector", name), ("begin_s", round(begin, 1)), ("end_s", round(end, 1)))
            ranked.append((missing, Hypothesis("dropout", fixed, (), ((),), None)))
    ranked.sort(key=lambda pair: -pair[0])
    return [hypothesis for _, hypothesis in ranked[: thresholds.faults_of_a_kind]]


def _swapped(
    kinds: Mapping[str, str],
    mean: Mapping[str, float],
    difference: Mapping[str, float],
    minutes: float,
    thresholds: Thresholds,
) -> list[Hypothesis]:
    """Find pairs of detectors of one kind whose counts fit if they are exchanged.

    Their errors are those of counts by chance alone: that days differ changes both alike.

    Args:
        kinds: Kind of each detector.
        mean: Expected vehicles per minute at each detector.
        difference: Measured minus expected ones.
        minutes: Length of all periods, min.
        thresholds: Numbers of the method.
    """
    ranked: list[tuple[float, Hypothesis]] = []
    chance = {
        name: math.sqrt(max(rate, rate + difference[name], 0.0) / minutes)
        for name, rate in mean.items()
    }
    suspects = [
        name for name in mean if abs(difference[name]) > thresholds.swap_suspect * chance[name]
    ]
    for first in suspects:
        for second in suspects:
            if first < second and kinds[first] == kinds[second]:
                error = chance[first] + chance[second]
                change = mean[second] - mean[first]
                before = difference[first] ** 2 + difference[second] ** 2
                after = (difference[first] - change) ** 2 + (difference[second] + change) ** 2
                if (
                    after < thresholds.swap_left * before
                    and abs(change) > thresholds.swap_errors * error
                ):
                    fixed = (("detector", first), ("other", second))
                    ranked.append((before - after, Hypothesis("swapped", fixed, (), ((),), None)))
    ranked.sort(key=lambda pair: -pair[0])
    return [hypothesis for _, hypothesis in ranked[: thresholds.places_of_a_kind]]


def one_behind_the_other(members: Members, layout: DetectorLayout) -> tuple[str, str] | None:
    """Find two consecutive detectors of one stream that both count too few.

    A single detector with too few vehicles contradicts its neighbours, so it is at fault. If the
    next detector counts too few as well, the vehicles may have left the road. Those that leave it
    change lanes before, so the stream is that of the whole road.

    Returns:
        Ids of the upstream and the downstream detector, or None.
    """
    short = [
        dict(hypothesis.fixed)["place"]
        for hypothesis, _ in members
        if hypothesis.name == "undercount"
    ]
    known = layout.by_id
    order = ("exit", "advance", "stop")
    following: defaultdict[str, set[str]] = defaultdict(set)
    for lane in layout.lanes:
        following[lane.edge] |= lane.following
    suspects = [known[str(name)] for name in short if name in known]
    for one in suspects:
        for other in suspects:
            edge, next_edge = edge_of_lane(one.lane), edge_of_lane(other.lane)
            if other.kind == "exit":
                behind = one.kind != "exit" and next_edge in following[edge]
            else:
                behind = edge == next_edge and order.index(one.kind) < order.index(other.kind)
            if behind:
                return one.id, other.id
    return None


def _towards(sign: float, strengths: ExaminedStrengths) -> tuple[tuple[float, ...], ...]:
    """Return the positive levels times the sign, in their order."""
    return tuple((sign * level,) for level in strengths.levels if level > 0)
