"""Proposes faults of detectors: from counts that are missing, silence, and lamps that stay on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ugat_marl.diagnosis.features import INDEX
from ugat_marl.diagnosis.hypotheses import Hypothesis, Members
from ugat_marl.diagnosis.site import Site
from ugat_marl.diagnosis.statistics import Distance, Reference
from ugat_marl.scenarios import Passages, Period, edge_of

_SILENT = 15.0
"""Vehicles that must be missing before silence is a fault."""
_STUCK_S = 240.0


def fault_hypotheses(
    site: Site, reference: Reference, distance: Distance, periods: Sequence[Period]
) -> list[Hypothesis]:
    """Detectors that count too few, stick, fall silent, or have each other's place."""
    found: list[Hypothesis] = []
    places = {name: (place, INDEX[kind]) for name, (kind, place) in site.counted.items()}
    z = {name: float(distance.z["lane"][row]) for name, row in places.items()}
    mean = {name: float(reference.blocks["lane"].mean[row]) for name, row in places.items()}
    difference = {n: float(distance.difference["lane"][r]) for n, r in places.items()}
    for name in sorted(z, key=lambda name: z[name])[:3]:
        if z[name] < -2.5 and mean[name] > 0:
            share = float(np.clip(-difference[name] / mean[name], 0.03, 0.9))
            found.append(
                Hypothesis("undercount", (("place", name),), ("share",), ((share,),), (0.0,), 0.02)
            )
    stuck = _stuck(periods)
    on = {dict(item.fixed)["detector"] for item in stuck}
    silent = [x for x in _silent(periods, mean) if dict(x.fixed)["detector"] not in on]
    found += stuck + silent
    kinds = {item.id: item.kind for item in site.detectors}
    found += _swapped(kinds, mean, difference, z)
    return found


def _stuck(periods: Sequence[Period]) -> list[Hypothesis]:
    """Detectors that were on for minutes at the same time of every period."""
    found: list[Hypothesis] = []
    for name in sorted(set.intersection(*(set(p.passages) for p in periods))):
        windows: list[tuple[float, float]] = []
        for period in periods:
            item = period.passages[name]
            time = np.nan_to_num(item.off_s, nan=period.end_s) - np.nan_to_num(
                item.on_s, nan=period.begin_s
            )
            longest = int(np.argmax(time))
            if time[longest] < _STUCK_S:
                break
            on, off = float(item.on_s[longest]), float(item.off_s[longest])
            on = period.begin_s if np.isnan(on) else on
            windows.append((on, period.end_s if np.isnan(off) else off))
        if len(windows) == len(periods):
            begin = float(np.median([w[0] for w in windows]))
            end = float(np.median([w[1] for w in windows]))
            if max(w[0] for w in windows) < min(w[1] for w in windows):
                fixed = (("detector", name), ("begin_s", begin), ("end_s", end))
                found.append(Hypothesis("stuck", fixed, (), ((),), None))
    return found[:3]


def _silent(periods: Sequence[Period], rate: Mapping[str, float]) -> list[Hypothesis]:
    """Detectors that saw nothing at the same time of every period, though vehicles came."""
    found: list[tuple[float, Hypothesis]] = []
    for name, expected in rate.items():
        begin, end = -np.inf, np.inf
        for period in periods:
            item = period.passages.get(name, Passages.none())
            times = np.concatenate((item.on_s, item.off_s))
            times = np.sort(times[np.isfinite(times)])
            times = np.concatenate(([period.begin_s], times, [period.end_s]))
            longest = int(np.argmax(np.diff(times)))
            begin, end = max(begin, float(times[longest])), min(end, float(times[longest + 1]))
        missing = expected * (end - begin) / 60.0 * len(periods)
        if end > begin and missing > _SILENT:
            fixed = (("detector", name), ("begin_s", round(begin, 1)), ("end_s", round(end, 1)))
            found.append((missing, Hypothesis("dropout", fixed, (), ((),), None)))
    found.sort(key=lambda item: -item[0])
    return [item for _, item in found[:3]]


def _swapped(
    kinds: Mapping[str, str],
    mean: Mapping[str, float],
    difference: Mapping[str, float],
    z: Mapping[str, float],
) -> list[Hypothesis]:
    """Pairs of detectors of one kind whose counts fit once they are exchanged."""
    found: list[tuple[float, Hypothesis]] = []
    suspects = [name for name in mean if abs(z[name]) > 4.0]
    for first in suspects:
        for second in suspects:
            if first < second and kinds[first] == kinds[second]:
                error = abs(difference[first] / z[first]) + abs(difference[second] / z[second])
                change = mean[second] - mean[first]
                before = difference[first] ** 2 + difference[second] ** 2
                after = (difference[first] - change) ** 2 + (difference[second] + change) ** 2
                if after < 0.3 * before and abs(change) > 3 * error:
                    fixed = (("detector", first), ("other", second))
                    found.append((before - after, Hypothesis("swapped", fixed, (), ((),), None)))
    found.sort(key=lambda item: -item[0])
    return [item for _, item in found[:2]]


def one_behind_the_other(members: Members, site: Site) -> tuple[str, str] | None:
    """Two detectors of one stream that are both said to miss vehicles, in its direction.

    One detector of a stream that counts too few stands against the others. Where those behind it
    count too few as well, the vehicles may have left the road.
    """
    short = [dict(item.fixed)["place"] for item, _ in members if item.name == "undercount"]
    known = {item.id: item for item in site.detectors}
    lanes = {lane.id: lane for lane in site.lanes}
    found = [known[str(name)] for name in short if name in known]
    for one in found:
        for other in found:
            lane, edge = lanes.get(one.lane), edge_of(other.lane)
            if lane is None:
                continue
            if other.kind == "exit":
                behind = one.kind != "exit" and edge in lane.following
            else:
                behind = (one.kind, other.kind) == ("advance", "stop") and edge == lane.edge
            if behind:
                return one.id, other.id
    return None
