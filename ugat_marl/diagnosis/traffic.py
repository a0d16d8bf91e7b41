"""Both models in terms of traffic: capacity, queue and delay per approach, on held-out periods.

Travel times and queues between detectors are in no distance. So they also decide if a correction
makes the simulation a better picture of the street.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from ugat_marl.diagnosis.features import (
    ALL_FEATURES,
    BIN_FEATURES,
    COUNT_FEATURES,
    INDEX,
    SATURATION_GAPS,
    SERVICE_COUNTS,
    DetectorLayout,
    Tally,
)
from ugat_marl.diagnosis.records import ApproachRow, Sides, TrafficCheck
from ugat_marl.diagnosis.statistics import Array, Window, means, sum_of
from ugat_marl.diagnosis.supplementary_data import TRAVEL_TIME
from ugat_marl.diagnosis.thresholds import Thresholds

_PASSING = [
    [INDEX[f"{name}_{kind}"] for kind in ("advance", "stop", "exit")]
    for name in ("mean_speed", "over")
]
"""Mean speeds and occupied times per vehicle of intervals."""
_SEED = 11
"""Seed of the drawn data sets; fixed, so that the same days give the same judgement."""


def approach_table(
    layout: DetectorLayout,
    measured: Sequence[Tally],
    before: Sequence[Tally],
    after: Sequence[Tally],
    thresholds: Thresholds,
) -> tuple[ApproachRow, ...]:
    """Compare capacity, queue and delay of every approach with both detectors.

    Args:
        layout: Lanes and detectors.
        measured: Tallies of the held-out periods.
        before: Tallies of days of the scenario as it is.
        after: Tallies of days of the corrected model.
        thresholds: Numbers of the method.
    """
    sides = [sum_of(days) for days in (measured, before, after)]
    if any(side.journeys is None for side in sides):
        return ()
    rows: list[ApproachRow] = []
    for lanes in layout.approaches:
        first = layout.lanes[lanes[0]]
        values = [_of_approach(layout, side, lanes, thresholds) for side in sides]
        if values[0][2] is not None:
            capacity, queue, delay = (Sides(*column) for column in zip(*values, strict=True))
            tls = layout.intersections[first.intersection]
            rows.append(ApproachRow(tls, first.edge, capacity, queue, delay))
    return tuple(rows)


def _of_approach(
    layout: DetectorLayout, tally: Tally, lanes: Sequence[int], thresholds: Thresholds
) -> tuple[float | None, float | None, float | None]:
    """Return capacity in veh/h of green and lane, vehicles held back, delay in s per vehicle.

    Capacity = 3600 / mean gap of queued vehicles. The queue is the sum of the lanes' means per
    green. Delay = time between the detectors minus that at the speed limit.
    """
    assert tally.journeys is not None
    places = list(lanes)
    total, count = tally.sums[list(SATURATION_GAPS)][:, places].sum(axis=(0, 1))
    capacity = 3600.0 * count / total if count >= thresholds.least_gaps else None
    times, queues = tally.journeys[:, places]
    known = times[:, 1].sum()
    if known < thresholds.least_journeys:
        return capacity, None, None
    rides = sum(
        layout.ride_s(lane) * number for lane, number in zip(lanes, times[:, 1], strict=True)
    )
    queue = sum(held / greens for held, greens in queues if greens)
    return capacity, float(queue), float((times[:, 0].sum() - rides) / known)


def traffic_check(
    measured: Sequence[Tally],
    before: Sequence[Tally],
    after: Sequence[Tally],
    thresholds: Thresholds,
    *,
    counts_alone: bool = False,
) -> TrafficCheck | None:
    """Judge a correction on held-out periods.

    Travel times and queues, which no fit uses, decide if there are any; else fitted measures do.

    The error of a model is the sum over the measures of ``Σ w |measured - simulated| / Σ w
    measured``, with the numbers of observations w of the lanes. Data sets are drawn around the
    measured values, with the noise of the model's own days, and days of both models are drawn anew,
    to know the error of the gain.

    Args:
        measured: Tallies of the held-out periods.
        before: Tallies of days of the scenario as it is.
        after: Tallies of days of the corrected model.
        thresholds: Numbers of the method.
        counts_alone: Judge by counts, since the correction changes nothing else of simulated days.

    Returns:
        None if the data hold nothing to judge by.
    """
    stretches = [day.window for day in after]
    measures = _COUNTS if counts_alone else _OF_VEHICLES | _COUNTS
    for measure, (sums, vehicles) in measures.items():
        sides = [sums(days) for days in (measured, before, after)]
        if all(side is not None and side.shape[-2] for side in sides):
            real, old, new = (side for side in sides if side is not None)
            if vehicles(real) >= thresholds.least_journeys:
                return _check(measure, real, old, new, stretches, thresholds)
    return None


def _check(
    measure: str,
    real: Array,
    old: Array,
    new: Array,
    stretches: Sequence[Window],
    thresholds: Thresholds,
) -> TrafficCheck:
    """Judge by sums of days ``(days, measures, places, 2)`` of the data and of both models.

    Both models have the same days. `stretches` are those of their days.
    """
    street, simulated, repaired = (means(side) for side in (real, old, new))
    weight = real.sum(axis=0)[..., 1]
    # A place that one model alone has emptied counts against it, with the whole measured value.
    used = np.isfinite(street) & (np.isfinite(simulated) | np.isfinite(repaired))
    weight = np.where(used, weight, 0.0)
    simulated, repaired = np.nan_to_num(simulated), np.nan_to_num(repaired)

    def error(model: Array, data: Array) -> float:
        apart = np.where(used, np.abs(data - model), 0.0) * weight
        size = (np.where(used, np.abs(street), 0.0) * weight).sum(axis=-1)
        return float((apart.sum(axis=-1)[size > 0] / size[size > 0]).sum())

    generator = np.random.default_rng(_SEED)
    gains: list[float] = []
    (old, _), (new, wider) = (_levelled(side, stretches) for side in (old, new))
    for _ in range(thresholds.check_draws):
        days = generator.choice(len(new), len(real))
        drawn = street + wider * np.nan_to_num(means(new[days]) - repaired)
        again = generator.choice(len(new), len(new))  # the same days of both models
        models = (
            usual + wider * np.nan_to_num(means(side[again]) - usual)
            for side, usual in ((old, simulated), (new, repaired))
        )
        first, last = (error(model, drawn) for model in models)
        gains.append(first - last)
    first, last, noise = error(simulated, street), error(repaired, street), float(np.std(gains))
    # Where even the corrected model is far off, matched vehicles are not the same ones.
    near = last <= thresholds.most_traffic_error
    better = near and first - last > thresholds.check_deviations * noise
    return TrafficCheck(measure, first, last, noise, better, len(stretches))


def _levelled(days: Array, stretches: Sequence[Window]) -> tuple[Array, float]:
    """Give all stretches of the day one mean, since differences between them are systematic.

    Return also sqrt((n - 1) / (n - stretches)), which corrects the standard deviation of n days.
    With less than two days per stretch the days stay as they are, and the factor is 1.
    """
    numbers = Counter(stretches)
    if len(numbers) == 1 or len(days) < 2 * len(numbers):
        return days, 1.0
    level = days.copy()
    for stretch in numbers:
        own = [place for place, other in enumerate(stretches) if other == stretch]
        level[own] += days.mean(axis=0) - days[own].mean(axis=0)
    return level, math.sqrt((len(days) - 1) / (len(days) - len(numbers)))


def _journeys(days: Sequence[Tally]) -> Array | None:
    """Return the sums of `JOURNEYS` of each day, ``(days, measures, places, 2)``."""
    known = [day.journeys for day in days if day.journeys is not None]
    return np.stack(known) if len(known) == len(days) else None


def _timed(days: Sequence[Tally]) -> Array | None:
    """Return sums of travel times between places, ``(days, 1, ways, 2)``; None without any."""
    if any(TRAVEL_TIME not in day.supplementary for day in days):
        return None
    return np.stack([day.supplementary[TRAVEL_TIME].swapaxes(0, 1) for day in days])


def _passing(days: Sequence[Tally]) -> Array | None:
    """Return sums of `_PASSING` of each day, ``(days, 2, kinds * places, 2)``; None without any."""
    if any(len(day.sums) < len(ALL_FEATURES) for day in days):
        return None
    return np.stack([day.sums[_PASSING].reshape(len(_PASSING), -1, 2) for day in days])


def _counts_of(names: Sequence[str]) -> Callable[[Sequence[Tally]], Array | None]:
    """Return a function for the vehicles in bins, ``(days, 1, kinds * places * bins, 2)``."""
    rows = [BIN_FEATURES.index(name) for name in names]

    def counts(days: Sequence[Tally]) -> Array | None:
        shortest = min(day.bins.shape[-1] for day in days)
        sums = [
            np.stack([x[rows, :, :shortest].ravel() for x in (day.bins, day.counted)], axis=-1)
            for day in days
        ]
        return np.stack(sums)[:, None]

    return counts


def _most_observed(real: Array) -> float:
    """Return the number of observations of the measure that has most."""
    return float(real[..., 1].sum(axis=(0, 2)).max())


def _observed_first(real: Array) -> float:
    """Return the observations of the first measure: of queues there is one per green."""
    return float(real[:, 0, :, 1].sum())


def _counted(real: Array) -> float:
    """Return the vehicles of counts, which are observed in each bin, vehicles or not."""
    return float(real[..., 0].sum())


_OF_VEHICLES = {
    "travel time and queue": (_journeys, _observed_first),
    "travel times of probes": (_timed, _most_observed),
    "speed and occupancy": (_passing, _most_observed),
}
_COUNTS = {
    "service counts": (_counts_of(SERVICE_COUNTS), _counted),
    "counts upstream": (_counts_of(COUNT_FEATURES[:1]), _counted),
}
"""Measures of a check, the first that the data have: sums of days, and their vehicles."""
