"""Findings on measured data that look like another unit, another order or another place.

Each finding names the likely mistake of an export. Nothing is corrected: only whoever made the
files knows what they hold.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import get_args

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data.measured.copies import FEWEST
from ugat_marl.data.measured.values import Finding, MeasuredData
from ugat_marl.errors import listed
from ugat_marl.scenarios import (
    Detector,
    DetectorKind,
    Intersection,
    Network,
    Passages,
    Period,
)

MOST_ON_RED = 0.6
"""Largest plausible share of a lane's vehicles that leave on red."""
LONGEST_ZONE_M = 60.0
"""Longest usual zone of a detector, m; zones of video and radar reach about as far."""
FARTHEST_STOP_M = 30.0
"""Largest usual distance from the end of a stop detector to the stop line, m."""
FASTER_THAN_LIMIT = 1.6
"""Largest plausible 85 % quantile of speeds, as a multiple of the speed limit.

On urban streets it is near 1.1. Miles per hour taken for m/s are 2.2 times as many, km/h 3.6 times.
"""
LENGTHS_M = (2.5, 10.0)
"""Plausible median length of vehicles, m. In feet it would be about 15."""


def implausible(measured: MeasuredData, network: Network) -> list[Finding]:
    """Return findings on data that look mistaken, most important first."""
    return [
        *_on_red(measured, network),
        *_swapped_events(measured),
        *_speeds(measured, network),
        *_rates(measured),
        *_lengths(measured),
        *_places(measured.detectors, network),
    ]


# --- signals --------------------------------------------------------------------------------------


def _on_red(measured: MeasuredData, network: Network) -> Iterator[Finding]:
    """Yield a finding for each light on lanes of which most vehicles leave on red."""
    stops: dict[str, list[str]] = {}
    for detector in measured.detectors:
        if detector.kind == "stop" and not detector.beside:
            stops.setdefault(detector.lane, []).append(detector.id)
    for light in network.intersections:
        wrong: dict[str, tuple[int, int]] = {}
        for lane in light.incoming_lanes:
            red, total = np.sum(
                [
                    _left_on_red(period, light, lane, stops.get(lane, ()))
                    for period in measured.periods
                ],
                axis=0,
            )
            # two standard deviations of a share of one half above it
            if total >= FEWEST and red - math.sqrt(total) > MOST_ON_RED * total:
                wrong[lane] = int(red), int(total)
        if wrong:
            red, total = np.sum(list(wrong.values()), axis=0)
            yield Finding(
                f"{red} of {total} vehicles leave the stop detectors of traffic light "
                f"{light.id!r} while their lane has red, on {listed(list(wrong), 'lane')} of "
                f"{len(light.incoming_lanes)}; are lanes, links and phases the right ones, and the "
                "clocks? Or do vehicles turn on red there?"
            )


def _left_on_red(
    period: Period, light: Intersection, lane: str, stops: Sequence[str]
) -> tuple[int, int]:
    """Return how many vehicles left the stop detectors of a lane on red, and in all."""
    log = period.signals.get(light.id)
    if not log:
        return 0, 0
    links = sorted({link.index for link in light.links if link.from_lane == lane})
    since = np.array([since for since, _ in log])
    # on links of lights that flash or are off vehicles may go
    is_red = np.array([all(s[i] == "r" for i in links) for _, s in log])
    red = total = 0
    for name in stops:
        if name in period.passages:
            off = period.passages[name].off_s
            shown = np.searchsorted(since, off[np.isfinite(off)], side="right") - 1
            total += len(shown)
            red += int(is_red[shown].sum())
    return red, total


# --- passages -------------------------------------------------------------------------------------


_EVERY_KIND: tuple[DetectorKind, ...] = get_args(DetectorKind)


def _passages(
    measured: MeasuredData, kinds: Sequence[DetectorKind] = _EVERY_KIND
) -> list[tuple[Detector, Passages]]:
    """Return the passages over detectors of some kinds, of all periods."""
    by_name = {detector.id: detector for detector in measured.detectors if detector.kind in kinds}
    return [
        (by_name[name], passages)
        for period in measured.periods
        for name, passages in period.passages.items()
        if name in by_name
    ]


def _joined(arrays: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the finite numbers of several arrays."""
    values = np.concatenate([np.empty(0), *arrays])
    return values[np.isfinite(values)]


def _swapped_events(measured: MeasuredData) -> Iterator[Finding]:
    """Yield a finding if vehicles stay on moving-traffic detectors longer than between them.

    Detectors at a stop line are left out: queues stand on them.
    """
    moving = [passages for _, passages in _passages(measured, ("advance", "exit"))]
    on = _joined([passages.off_s - passages.on_s for passages in moving])
    gaps = _joined([passages.on_s[1:] - passages.off_s[:-1] for passages in moving])
    if min(len(on), len(gaps)) >= FEWEST and np.median(on) > np.median(gaps):
        yield Finding(
            f"detections: vehicles are on advance and exit detectors for {np.median(on):.1f} s, "
            f"and {np.median(gaps):.1f} s pass until the next one (medians); are on and off "
            "swapped?"
        )


def _speeds(measured: MeasuredData, network: Network) -> Iterator[Finding]:
    """Yield a finding if speeds are too high for m/s, or are not measured at all."""
    limits = {name: lane.speed_mps for name, lane in network.lanes.items()}
    found = _passages(measured)
    shares = {
        "detections: speed_mps": _joined(
            [passages.speed_mps / limits[detector.lane] for detector, passages in found]
        )
    }
    if measured.counts is not None and "mean_speed_mps" in measured.counts.columns:
        of_detector = {detector.id: limits[detector.lane] for detector in measured.detectors}
        names = measured.counts["detector_id"]
        limit = names.replace_strict(of_detector, default=None).to_numpy()
        means = measured.counts["mean_speed_mps"].cast(pl.Float64).to_numpy()
        shares["counts.csv: mean_speed_mps"] = _joined([means / limit])
    for where, values in shares.items():
        if len(values) < FEWEST:
            continue
        fast = float(np.quantile(values, 0.85))
        if not values.any():
            yield Finding(f"{where} is 0 everywhere; leave the cells empty if it was not measured")
        elif fast > FASTER_THAN_LIMIT:
            yield Finding(
                f"{where} is above {fast:.1f} times the speed limit of the network in 15 % of the "
                "rows; is it in km/h or mph, or is the limit wrong?"
            )


def _rates(measured: MeasuredData) -> Iterator[Finding]:
    """Yield a finding if counts have a common factor, as vehicles per hour have."""
    if measured.counts is None:
        return
    counted = measured.counts.filter(pl.col("count") > 0)["count"].cast(pl.Int64).to_numpy()
    if len(counted) < FEWEST or len(np.unique(counted)) < 3:
        return
    if (factor := int(np.gcd.reduce(counted))) > 1:
        yield Finding(
            f"counts.csv: every count is a multiple of {factor}; are they vehicles per hour? count "
            "is the number of vehicles in the interval"
        )


def _lengths(measured: MeasuredData) -> Iterator[Finding]:
    """Yield a finding if lengths of vehicles are none in m."""
    found = _passages(measured)
    lengths = _joined([passages.length_m for _, passages in found])
    low, high = LENGTHS_M
    if len(lengths) >= FEWEST and not low <= (median := float(np.median(lengths))) <= high:
        yield Finding(
            f"detections: the median of length_m is {median:.1f} m, and cars have about 5 m; is it "
            "in feet, or swapped with speed_mps?"
        )


# --- places ---------------------------------------------------------------------------------------


def _places(detectors: Sequence[Detector], network: Network) -> Iterator[Finding]:
    """Yield findings on zones in an unusual place on their lane."""
    stops: dict[str, float] = {}
    for detector in detectors:
        if detector.kind == "stop":
            begin = min(detector.position_m, stops.get(detector.lane, np.inf))
            stops[detector.lane] = begin
    swapped = [
        detector.id
        for detector in detectors
        if detector.kind == "advance" and detector.position_m >= stops.get(detector.lane, np.inf)
    ]
    if swapped:
        yield Finding(
            f"detectors.csv: {listed(swapped, 'advance detector')} not upstream of the stop "
            "detector on the lane; are the kinds swapped?"
        )
    far = [
        detector.id
        for detector in detectors
        if detector.kind == "stop"
        and network.lanes[detector.lane].length_m - detector.position_m - detector.length_m
        > FARTHEST_STOP_M
    ]
    if far:
        yield Finding(
            f"detectors.csv: {listed(far, 'stop detector')} more than {FARTHEST_STOP_M:g} m "
            "upstream of the end of the lane; position_m counts from its upstream end. Is the kind "
            "advance?"
        )
    long = [detector.id for detector in detectors if detector.length_m > LONGEST_ZONE_M]
    if long:
        yield Finding(
            f"detectors.csv: {listed(long, 'detector')} longer than {LONGEST_ZONE_M:g} m; are "
            "position_m and length_m swapped?"
        )
