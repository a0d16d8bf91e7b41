"""Proposes effects at places and in windows: by what is left over there, before any simulation.

Counts tell where demand and turning differ: see `volume`. Time tells windows: the stretch of
minutes in which a place departs most from the model, found by a scan over all stretches. Detectors
tell their own faults.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.faults import fault_hypotheses
from ugat_marl.diagnosis.features import BIN_FEATURES, BIN_S, INDEX
from ugat_marl.diagnosis.hypotheses import CLOCK_S, DRIFT, LATE_STEP_S, Hypothesis
from ugat_marl.diagnosis.site import Site
from ugat_marl.diagnosis.statistics import Distance, Reference
from ugat_marl.diagnosis.stretches import SCAN_S, largest_stretches, most_unusual, occupied_between
from ugat_marl.diagnosis.volume import Routes, Volume
from ugat_marl.scenarios import Passages, Period

Array = NDArray[np.float64]

_DWELL_S = 40.0
_MOST_LANES = 24
"""With more incoming lanes not every one of them is tried."""
_FLOW = (
    "gap_long", "occupied_in_green", "gap9+", "free_speed", "queue_over", "platoon_gap",
    "count_advance", "count_stop",
)  # fmt: skip
_AVOIDED = ("count_advance", "count_stop")
_SHIFTS_S = (-900.0, -600.0, -300.0, -150.0, 150.0, 300.0, 600.0, 900.0)
_SUSPECT = 16.0
_MOSTLY = 0.7
"""Share of the vehicles on an edge from which its counts are those of one origin."""


class Proposer:
    """Finds places and windows.

    Args:
        site: Lanes and detectors.
        routes: Of the scenario.
        allowed: Names of effects to examine.
    """

    def __init__(self, site: Site, routes: Routes, allowed: Collection[str]) -> None:
        self._site = site
        self._routes = routes
        self.allowed = frozenset(allowed)
        self._edges = [edge for _, edge, _ in site.places]
        self._volume = Volume(site, routes)

    def hypotheses(
        self, reference: Reference, distance: Distance, periods: Sequence[Period]
    ) -> list[Hypothesis]:
        """What may be wrong at some place, strongest first within each kind.

        Args:
            reference: The model so far.
            distance: Of the data from it.
            periods: The data.
        """
        found: list[Hypothesis] = []
        found += self._volume.hypotheses(distance)
        found += self._timing(reference, distance)
        found += self._windows(reference, distance, periods)
        found += self._places(reference, distance)
        found += fault_hypotheses(self._site, reference, distance, periods)
        return [item for item in found if item.name in self.allowed]

    def everywhere(self) -> list[Hypothesis]:
        """What may be wrong at any of the places, if there are few: parking on each lane.

        A lane on which vehicles stand is avoided; its neighbour takes what it loses, so that
        neither pools nor single statistics show it, and no other effect leads there.
        """
        lanes = self._site.lanes
        if len(lanes) > _MOST_LANES or "parking" not in self.allowed:
            return []
        return [_parking(lane.id) for lane in lanes]

    def directed(self, distance: Distance) -> dict[str, float]:
        """What the best origin, turn and stretch would explain: few counts, but the right ones."""
        return self._volume.directed(distance) | largest_stretches(self._edges, distance)

    # --- time ---------------------------------------------------------------------------------

    def _timing(self, reference: Reference, distance: Distance) -> list[Hypothesis]:
        """Origins whose profile over time would fit if it came sooner or later."""
        z, difference = distance.z["time"], distance.difference["time"]
        block = reference.blocks["time"]
        found: list[tuple[float, str, float]] = []
        first = BIN_FEATURES.index("count_advance") * len(self._edges)
        width = BIN_S * reference.pools.together
        for origin in self._routes.passing:
            rows = [
                first + index
                for index, lane in enumerate(self._site.lanes)
                if self._routes.share(origin, lane.edge) > _MOSTLY
            ]
            known = z[rows] != 0
            if not known.any():
                continue
            mean = np.where(np.isfinite(block.mean[rows]), block.mean[rows], 0.0)
            noise = np.where(known, difference[rows] / np.where(known, z[rows], 1.0), np.inf)
            for shift in _SHIFTS_S:
                ray = (_later(mean, shift / width) - mean) / np.abs(noise)
                size = float((ray**2).sum())
                strength = float((ray * z[rows]).sum()) / max(size, 1e-9)
                if 0.5 < strength < 2.0 and strength**2 * size > _SUSPECT:
                    found.append((strength**2 * size, origin, shift))
        chosen: dict[str, float] = {}
        for _, origin, shift in sorted(found, reverse=True):
            chosen.setdefault(origin, shift)
        return [
            Hypothesis(
                "demand_timing", (("edge", origin),), ("seconds",), ((shift,),), (0.0,), 45.0
            )
            for origin, shift in list(chosen.items())[:2]
        ]

    def _windows(
        self, reference: Reference, distance: Distance, periods: Sequence[Period]
    ) -> list[Hypothesis]:
        """Surges and closures in the stretches that depart most."""
        if len({(p.begin_s, p.end_s) for p in periods}) > 1:
            return []
        found: list[tuple[float, Hypothesis]] = []
        for origin in self._routes.passing:
            members = [i for i, edge in enumerate(self._edges) if edge == origin]
            window = self._scan(
                reference, distance, periods, members, "count_advance", "count_exit"
            )
            if window is not None:
                z, begin, end, factor = window
                fixed = (("edge", origin), ("begin_s", begin), ("end_s", end))
                level = float(np.clip(factor, 0.1, 4.0))
                surge = Hypothesis("demand_surge", fixed, ("factor",), ((level,),), (1.0,), 0.1)
                found.append((z, surge))
        for index, lane in enumerate(self._site.lanes):
            # What comes after a closure, the queue that is let go, is more unusual than itself.
            for kind, side in (("occupied", 1), ("count_stop", -1), ("count_advance", -1)):
                option = self._scan(reference, distance, periods, [index], kind, kind, side)
                if option is not None:
                    z, begin, end, _ = option
                    fixed = (("lane", lane.id), ("begin_s", begin), ("end_s", end))
                    found.append((z, Hypothesis("lane_closure", fixed, (), ((),), None)))
        found.sort(key=lambda item: -item[0])
        chosen: list[Hypothesis] = []
        for kind, most in (("demand_surge", 2), ("lane_closure", 4)):
            chosen += list(dict.fromkeys(item for _, item in found if item.name == kind))[:most]
        return chosen

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
        """The stretch in which counts depart most from their ratio over the rest of the period.

        Returns:
            Standardised size, begin, end, ratio to the expected; or None if all is chance.
        """
        block = reference.blocks["time"]
        places = len(self._edges)
        rows: list[int] = []
        for index in members:
            name = kind if index < len(self._site.lanes) else other
            row = BIN_FEATURES.index(name) * places + index
            if block.used[row].any():
                rows.append(row)
        if not rows:
            return None
        begin, end = periods[0].begin_s, periods[0].end_s
        minutes = max(int((end - begin) / SCAN_S), 1)
        bins = block.mean.shape[1]
        which = np.minimum((np.arange(minutes) * bins) // minutes, bins - 1)
        per_bin = np.bincount(which, minlength=bins)
        expected = (block.mean[rows].sum(axis=0) / np.maximum(per_bin, 1))[which]
        variance = (block.variance[rows].sum(axis=0) / np.maximum(per_bin, 1))[which] / len(periods)
        if any(period.passages for period in periods):
            measured = self._minutes(periods, members, kind, other, minutes)
        else:  # counts alone say no more than how many came in each bin
            more = distance.difference["time"][rows].sum(axis=0) / np.maximum(per_bin, 1)
            measured = expected + more[which]
        return most_unusual(measured, expected, variance, begin, side)

    def _minutes(
        self, periods: Sequence[Period], members: Sequence[int], kind: str, other: str, minutes: int
    ) -> Array:
        """Counts, or occupied seconds, per minute: the mean over the periods."""
        total = np.zeros(minutes)
        for period in periods:
            edges = np.linspace(period.begin_s, period.end_s, minutes + 1)
            for index in members:
                passages = self._passages(
                    period, index, kind if index < len(self._site.lanes) else other
                )
                if passages is None or not len(passages):
                    continue
                on = np.where(np.isfinite(passages.on_s), passages.on_s, passages.off_s)
                if kind == "occupied":
                    off = np.where(np.isfinite(passages.off_s), passages.off_s, period.end_s)
                    total += occupied_between(on, np.maximum(off, on), edges)
                else:
                    total += np.histogram(on[np.isfinite(on)], edges)[0]
        return total / len(periods)

    def _passages(self, period: Period, index: int, kind: str) -> Passages | None:
        lanes = self._site.lanes
        if index >= len(lanes):
            names = self._site.exits[index - len(lanes)][2]
        else:
            names = lanes[index].detectors.get("stop" if kind == "count_stop" else "advance", ())
        return next((period.passages[n] for n in names if n in period.passages), None)

    # --- places -------------------------------------------------------------------------------

    def _places(self, reference: Reference, distance: Distance) -> list[Hypothesis]:
        """Lanes for parking, edges for slow roads, traffic lights for lost time and clocks."""
        found: list[Hypothesis] = []
        lanes = self._site.lanes
        found += [_parking(lane) for lane in self._disturbed(distance)]
        speed = distance.z["lane"][: len(lanes), INDEX["free_speed"]]
        by_edge: dict[str, float] = defaultdict(float)
        for lane, value in zip(lanes, speed, strict=True):
            by_edge[lane.edge] += float(value)
        if len(by_edge) > 1:
            typical = float(np.median(list(by_edge.values())))
            ranked = sorted(by_edge, key=lambda edge: -abs(by_edge[edge] - typical))
            found += [
                Hypothesis(
                    "local_speed",
                    (("edge", edge),),
                    ("factor",),
                    ((self._speed_ratio(reference, distance, edge),),),
                    (1.0,),
                    0.02,
                    both=True,
                )
                for edge in ranked[:2]
            ]
        if len(self._site.intersections) > 1:
            found += self._traffic_lights(distance)
        return found

    def _disturbed(self, distance: Distance) -> list[str]:
        """Lanes on which something may stand: traffic does not flow there, or avoids the lane."""
        lanes = self._site.lanes
        z = np.clip(distance.z["lane"][: len(lanes)], -15, 15)
        unusual = np.abs(z[:, [INDEX[name] for name in _FLOW]]).sum(axis=1)
        fewer = z[:, [INDEX[name] for name in _AVOIDED]].sum(axis=1)
        by_edge: dict[str, list[int]] = defaultdict(list)
        for index, lane in enumerate(lanes):
            by_edge[lane.edge].append(index)
        edges = sorted(by_edge.values(), key=lambda members: -max(unusual[members]))
        found: list[str] = []
        for members in edges[:2]:
            avoided = sorted(members, key=lambda index: fewer[index])[:1]
            stuck = sorted(members, key=lambda index: -unusual[index])[:1]
            found += [lanes[index].id for index in dict.fromkeys((*avoided, *stuck))]
        return found

    def _speed_ratio(self, reference: Reference, distance: Distance, edge: str) -> float:
        """Free speed on an edge, as a multiple of the simulated one."""
        rows = [index for index, name in enumerate(self._edges) if name == edge]
        mean = reference.blocks["lane"].mean[rows, INDEX["free_speed"]]
        difference = distance.difference["lane"][rows, INDEX["free_speed"]]
        known = np.isfinite(mean) & (difference != 0) & (mean > 0)
        if not known.any():
            return 0.8
        ratio = float(np.mean(1.0 + difference[known] / mean[known]))
        return float(np.clip(ratio, 0.2, 2.0)) if abs(ratio - 1.0) > 0.03 else 0.8

    def _traffic_lights(self, distance: Distance) -> list[Hypothesis]:
        """The two traffic lights whose starts of green differ most from the others'."""
        lost = distance.z["intersection"][:, INDEX["lost"]]
        lost = lost - np.median(lost)
        drift = distance.z["intersection"][:, INDEX["lost_trend"]]
        drift = drift - np.median(drift)
        names = self._site.intersections
        found: list[Hypothesis] = []
        for index in np.argsort(-np.abs(lost))[:2]:
            place = (("place", names[int(index)]),)
            found.append(
                Hypothesis("late_green", place, ("seconds",), ((2.0,),), (0.0,), 0.3, LATE_STEP_S)
            )
            sign = 1.0 if lost[index] > 0 else -1.0
            levels = tuple((sign * level,) for level in CLOCK_S)
            found.append(Hypothesis("signal_clock", place, ("seconds",), levels, (0.0,), 0.2))
        for index in np.argsort(-np.abs(drift))[:1]:
            sign = 1.0 if drift[index] > 0 else -1.0
            levels = tuple((sign * level,) for level in DRIFT)
            place = (("place", names[int(index)]),)
            found.append(
                Hypothesis("clock_drift", place, ("seconds_per_hour",), levels, (0.0,), 0.5)
            )
        return found


def _parking(lane: str) -> Hypothesis:
    fixed = (("lane", lane), ("dwell_s", _DWELL_S))
    return Hypothesis("parking", fixed, ("per_hour",), ((20.0,),), (0.0,), 3.0)


def _later(counts: Array, bins: float) -> Array:
    """Counts ``(rows, bins)`` so many bins later; nobody comes from before the first bin."""
    moved = np.zeros_like(counts)
    whole = int(np.floor(bins))
    for part, step in ((1.0 - (bins - whole), whole), (bins - whole, whole + 1)):
        if step >= 0:
            moved[:, step:] += part * counts[:, : counts.shape[1] - step]
        else:
            moved[:, :step] += part * counts[:, -step:]
    return moved
