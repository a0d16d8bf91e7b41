"""Location of the gap: the test of the scenario as it is, and the places that contradict it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import special

from ugat_marl.diagnosis.engine import OutOfTime
from ugat_marl.diagnosis.features import (
    ALL_FEATURES,
    BIN_FEATURES,
    OF_SEVERAL_LANES,
    DetectorLayout,
    Tally,
)
from ugat_marl.diagnosis.hypotheses import each_left_out
from ugat_marl.diagnosis.records import Disagreement, Located, Tested
from ugat_marl.diagnosis.select import Selector
from ugat_marl.diagnosis.statistics import Array, Distance, Reference
from ugat_marl.diagnosis.study import Study
from ugat_marl.diagnosis.supplementary_data import SUPPLEMENTARY_MEASURES
from ugat_marl.diagnosis.thresholds import Thresholds

_Place = tuple[str | None, str | None, str | None]
"""Traffic light, edge and lane; None for all."""
SHOWN = 40
"""Largest number of disagreements that are reported."""
_REGIME_OF_BINS = ("volume", "volume", "volume", "storage")


def locate_gap(study: Study, base: Tested, selector: Selector) -> Located:
    """Test the scenario as it is, and find the places where the data contradict it."""
    complete = True
    if base.residual.p > study.config.alpha:
        try:
            base = selector.tested_along_effects(base)
        except OutOfTime:
            complete = False
    contradicted = base.residual.p <= study.config.alpha
    places = disagreements(study, base) if contradicted else ()
    return Located(base, places, complete, frozenset(selector.examined))


def disagreements(study: Study, model: Tested) -> tuple[Disagreement, ...]:
    """Find where the fitted periods disagree with a model, with the noise of its test."""
    periods = study.measured.of("fit")
    spans = {(period.begin_s, period.end_s) for period in periods}
    span = spans.pop() if len(spans) == 1 else None
    reference = model.model.reference
    if model.extra:
        days, doubt = study.test_days(model.model), study.doubt(model.model.effects)
        reference = Reference(study.pools, days, speeds=study.speeds, doubt=doubt)
    distance = of_no_single_day(reference, study.fit, model.extra or None)
    return locate(study.layout, reference, distance, study.config.alpha, span)


def of_no_single_day(
    reference: Reference, data: Sequence[Tally], extra: Mapping[str, Array] | None = None
) -> Distance:
    """Return the distance of data, in which no difference depends on a single day.

    Statistics that are not unusual without some period are as they are without it, as in
    `Null.test`.

    Args:
        reference: Statistics of the model.
        data: Tallies of the periods.
        extra: Further variance of the expected statistics, by block.
    """
    distance, thresholds = reference.distance(data, extra=extra), reference.pools.thresholds
    if len(data) < 2:
        return distance
    parts = [reference.distance(part, extra=extra).z for part in each_left_out(data)]
    usual = difference_of(thresholds.one_day, thresholds.heavy_tail)
    z: dict[str, Array] = {}
    for name, values in distance.z.items():
        others = np.stack([part[name] for part in parts])
        nearest = np.take_along_axis(others, np.abs(others).argmin(axis=0)[None], axis=0)[0]
        z[name] = np.where(np.abs(nearest) < usual, nearest, values)
    return replace(distance, z=z)


def locate(
    layout: DetectorLayout,
    reference: Reference,
    distance: Distance,
    alpha: float,
    span: tuple[float, float] | None,
) -> tuple[Disagreement, ...]:
    """Find the strongest disagreements that remain after the control of false discoveries.

    The procedure of Benjamini and Hochberg (1995) covers all statistics of all pools and all
    stretches of time. Then the strongest statistic of each place and regime is kept.

    Lanes come after wider places, and the strongest come first among either.

    Args:
        layout: Lanes and detectors.
        reference: Statistics of the model.
        distance: Distance of the data from the model.
        alpha: Largest expected share of false discoveries.
        span: Begin and end of all periods, s; None if they differ, and then bins of time are not
            compared.
    """
    candidates: list[Disagreement] = []
    for name, z in distance.z.items():
        if name in reference.pools.supplementary:
            candidates += _between(layout, reference, name, z, distance.difference[name])
        elif name != "time":
            candidates += _statistics(
                layout, name, z, distance.difference[name], reference.pools.thresholds
            )
    if span is not None:
        candidates += _stretches(layout, reference, distance, span)
    tested = sum(int(block.used.sum()) for block in reference.blocks.values())
    candidates.sort(key=lambda one: one.p)
    kept = discoveries([one.p for one in candidates], tested, alpha)
    strongest = _gathered(candidates[:kept])[:SHOWN]
    return tuple(sorted(strongest, key=lambda one: one.lane is not None))


def discoveries(chances: Sequence[float], tested: int, alpha: float) -> int:
    """Return the number of discoveries (Benjamini and Hochberg 1995).

    Args:
        chances: The smallest p values, in order.
        tested: Number of all tests; p values that are not given count as 1.
        alpha: Largest expected share of false discoveries.
    """
    ranks = np.arange(1, len(chances) + 1)
    small = np.flatnonzero(np.asarray(chances) * (tested / ranks) <= alpha)
    return int(ranks[small].max(initial=0))


def two_sided(z: float, tail: float) -> float:
    """Return the two-sided p value of a standardised difference: ``2 Phi(-t asinh(|z| / t))``.

    Its tail is heavier than that of the normal distribution, like that of simulated data sets.

    Args:
        z: Standardised difference.
        tail: The value t up to which the tail is nearly normal.
    """
    soft = tail * math.asinh(abs(z) / tail)
    return max(2.0 * float(special.ndtr(-soft)), 1e-300)


def difference_of(p: float, tail: float) -> float:
    """Return the standardised difference, above 0, of which `two_sided` has this p value."""
    return tail * math.sinh(-float(special.ndtri(p / 2.0)) / tail)


def _statistics(
    layout: DetectorLayout, pool: str, z: Array, difference: Array, thresholds: Thresholds
) -> list[Disagreement]:
    rows: list[Disagreement] = []
    for member, feature in zip(*np.nonzero(z), strict=True):
        tls, approach, lane = _place(layout, pool, int(member))
        name, regime, unit = ALL_FEATURES[int(feature)]
        if pool == "lane" and name in OF_SEVERAL_LANES:
            lane = None  # it is kept with the first of them
            if name == "kept_to_exit":
                continue  # the light has it, too
        both = float(difference[member, feature]), float(z[member, feature])
        place = tls, approach, lane
        rows.append(_disagreement(place, (regime, name, unit), *both, thresholds))
    return rows


def _disagreement(
    place: _Place,
    statistic: tuple[str, str, str],
    size: float,
    z: float,
    thresholds: Thresholds,
    window: tuple[float, float] | None = None,
    tests: float = 1.0,
) -> Disagreement:
    """Return a disagreement with its chance.

    Args:
        place: Traffic light, edge and lane.
        statistic: Regime, name and unit.
        size: Measured minus simulated.
        z: The same in standard deviations.
        thresholds: Numbers of the method.
        window: Begin and end, s; None for all of the time.
        tests: Number of windows of which this is the most unusual one.
    """
    regime, name, unit = statistic
    p = min(1.0, tests * two_sided(z, thresholds.heavy_tail))
    return Disagreement(*place, regime, name, window, size, unit, z, p)


def _between(
    layout: DetectorLayout, reference: Reference, block: str, z: Array, difference: Array
) -> list[Disagreement]:
    """Return the disagreements of turning counts, travel times or states of lanes."""
    owner = {edge: layout.intersections[index] for index, edge, _ in layout.places}
    rows: list[Disagreement] = []
    for member, feature in zip(*np.nonzero(z), strict=True):
        label = reference.pools.supplementary[block][int(member)]
        name, unit = SUPPLEMENTARY_MEASURES[block][int(feature)]
        both = float(difference[member, feature]), float(z[member, feature])
        said = f"{name} {label.edge} → {label.following}" if label.following else name
        place = owner.get(label.edge), label.edge or None, label.lane or None
        thresholds = reference.pools.thresholds
        rows.append(_disagreement(place, (block, said, unit), *both, thresholds))
    return rows


def _place(layout: DetectorLayout, pool: str, member: int) -> _Place:
    if pool == "network":
        return (layout.intersections[0] if len(layout.intersections) == 1 else None, None, None)
    if pool == "intersection":
        return (layout.intersections[member], None, None)
    owner, edge, name = layout.places[member]
    return (layout.intersections[owner], edge, name)


def _stretches(
    layout: DetectorLayout, reference: Reference, distance: Distance, span: tuple[float, float]
) -> list[Disagreement]:
    """Find the most unusual stretch of every kind of count at every place."""
    thresholds = reference.pools.thresholds
    z, difference = distance.z["time"], distance.difference["time"]
    used = reference.blocks["time"].used & (z != 0.0)  # an interval without a count has z = 0
    places = len(layout.places)
    bins = z.shape[1]
    width = reference.pools.grouped_s(span[1] - span[0]) / bins
    rows: list[Disagreement] = []
    for row in range(z.shape[0]):
        if used[row].sum() < thresholds.least_bins:
            continue
        middle = float(np.median(z[row][used[row]]))
        best = _stretch(np.where(used[row], z[row] - middle, 0.0), thresholds)
        if best is None:
            continue
        value, first, last = best
        kind, place = divmod(row, places)
        noise = np.where(used[row], difference[row] / np.where(used[row], z[row], 1.0), 0.0)
        size = float((difference[row] - middle * noise)[first:last].sum())  # as z: beside the rest
        unit = "s" if kind == 3 else "vehicles"
        rows.append(
            _disagreement(
                _place(layout, "lane", place),
                (_REGIME_OF_BINS[kind], f"{BIN_FEATURES[kind]} in time", unit),
                size,
                value,
                thresholds,
                window=(span[0] + width * first, span[0] + width * last),
                tests=bins * (bins + 1) / 2,
            )
        )
    return rows


def _stretch(z: Array, thresholds: Thresholds) -> tuple[float, int, int] | None:
    """Find the contiguous bins with the largest standardised sum, ``sum(z) / sqrt(bins)``.

    Returns:
        This sum, the first bin and the bin after the last; None without bins.
    """
    sums = np.concatenate(
        ([0.0], np.cumsum(np.clip(z, -thresholds.largest_z, thresholds.largest_z)))
    )
    best: tuple[float, int, int] | None = None
    for length in range(1, max(int(thresholds.longest_stretch * len(z)), 1) + 1):
        values = (sums[length:] - sums[:-length]) / math.sqrt(length)
        place = int(np.argmax(np.abs(values)))
        if best is None or abs(values[place]) > abs(best[0]):
            best = (float(values[place]), place, place + length)
    return best


def _gathered(discovered: Sequence[Disagreement]) -> list[Disagreement]:
    """Keep the strongest statistic of each place, regime and kind of window, strongest first."""
    best: dict[tuple[Any, ...], Disagreement] = {}
    for one in discovered:
        key = (one.tls, one.approach, one.lane, one.regime, one.window is None)
        if key not in best or abs(one.z) > abs(best[key].z):
            best[key] = one
    return sorted(best.values(), key=lambda one: -abs(one.z))
