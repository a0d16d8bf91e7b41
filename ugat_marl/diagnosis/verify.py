"""Verification of the scenario as it is and the selected model on held-out periods.

Two tests decide. The usual criteria on counts are computed for comparison: GEH below 5 on 85 % of
the counts (UK TAG unit M3.1), and the four criteria of FHWA (Traffic Analysis Toolbox, volume III,
FHWA-HOP-18-036, 2019, chapter 5). Those of FHWA compare the simulation with one representative day,
interval by interval, relative to the variation between measured days.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ugat_marl.diagnosis.features import (
    ALL_FEATURES,
    BIN_FEATURES,
    INDEX,
    SATURATION_GAPS,
    SERVICE_COUNTS,
    DetectorLayout,
    Tally,
)
from ugat_marl.diagnosis.records import (
    CriteriaRow,
    EngineeringCriteria,
    LaneRow,
    MeasuredHeadway,
    StatisticRow,
    Tables,
    Tested,
    TrafficCheck,
    TravelTimes,
    Verified,
)
from ugat_marl.diagnosis.residual import Null
from ugat_marl.diagnosis.statistics import Array, Distance, of_the_same_stretches, sum_of
from ugat_marl.diagnosis.study import Study
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.diagnosis.traffic import approach_table, traffic_check
from ugat_marl.effects import Effect
from ugat_marl.scenarios import geh_of


def verify_model(study: Study, base: Tested, best: Tested) -> Verified:
    """Test both models on the held-out periods.

    With e the excess of the distance over its expected value, at least 0:
    shrink = 1 - e_after / e_before. The gain is compared as in a fit, with the penalty for noise: a
    model that is merely noisier is nearer to all data.
    """

    def null(model: Tested) -> Null:
        days = study.test_days(model.model)
        return study.null(days, study.heldout, effects=model.model.effects)

    before = null(base).test(study.heldout)
    after = null(best).test(study.heldout, best.extra or None) if best.model.members else before
    gap = max(0.0, before.distance - before.expected)
    left = max(0.0, after.distance - after.expected)
    shrink = 1.0 - left / gap if gap > 0.0 and best.model.members else None
    cost_before, cost_after = (
        distance.total + distance.penalty for distance in _held_out(study, base, best)
    )
    return Verified(before, after, shrink, cost_before - cost_after)


def _held_out(study: Study, base: Tested, best: Tested) -> tuple[Distance, Distance]:
    """Return the distances of the held-out periods from both models, relative to `base`."""
    before, after = (
        tested.model.reference.distance(study.heldout, relative_to=base.model.reference)
        for tested in (base, best)
    )
    return before, after


def tables_of(study: Study, base: Tested, best: Tested) -> Tables:
    """Make the tables that compare both models."""
    before, after = _held_out(study, base, best)
    return Tables(
        statistics_table(study, base, best, before, after),
        lanes_table(study.layout, before, after),
        engineering_criteria(study, base, best),
        travel_times(study, base, best),
        approach_table(
            study.layout,
            study.heldout,
            *_same_days(study, base, best),
            study.config.thresholds,
        ),
    )


def judged(study: Study, base: Tested, best: Tested) -> TrafficCheck | None:
    """Judge the correction on the held-out periods; None if it changes no traffic.

    Where arrivals are measured, simulated days show effects on departures in counts alone. So these
    decide if there are no other effects; beside others, those on departures are not judged.
    """
    of_traffic = [effect for effect in best.model.effects if not effect.on_detectors]
    if not of_traffic:
        return None
    arrivals_given = study.other_days is not None
    return traffic_check(
        study.heldout,
        *_same_days(study, base, best),
        study.config.thresholds,
        counts_alone=arrivals_given and all(effect.on_departures for effect in of_traffic),
    )


def _same_days(study: Study, base: Tested, best: Tested) -> tuple[list[Tally], list[Tally]]:
    """Return days that both models have, of the stretches of the held-out periods."""
    before, after = base.model.days, best.model.days
    return (
        of_the_same_stretches([before[number] for number in after], study.heldout),
        of_the_same_stretches(list(after.values()), study.heldout),
    )


def statistics_table(
    study: Study, base: Tested, best: Tested, before: Distance, after: Distance
) -> tuple[StatisticRow, ...]:
    """Compare each statistic of the network on the held-out periods, with its noise.

    Args:
        study: The inputs of the diagnosis.
        base: The scenario as it is.
        best: The selected model.
        before: Distance of the held-out periods from `base`.
        after: Their distance from `best`.
    """
    block = base.model.reference.blocks["network"]
    fitted = best.model.reference.blocks["network"]
    sums = study.pools.pool(sum_of(study.heldout))["network"][0]
    # A model compares each stretch of the day with its own mean; rows show the held-out ones'.
    measured = sums[:, 0] / np.maximum(sums[:, 1], 1e-9)
    shift = measured - (block.mean + before.difference["network"])[0]
    rows: list[StatisticRow] = []
    width = before.z["network"].shape[1]
    for index, (name, regime, unit) in enumerate(ALL_FEATURES[:width]):
        if not before.used["network"][0, index]:
            continue
        rows.append(
            StatisticRow(
                statistic=name,
                regime=regime,
                unit=unit,
                measured=float(measured[index]),
                before=float(block.mean[0, index] + shift[index]),
                after=_number(fitted.mean[0, index] + shift[index]),
                noise=float(np.sqrt(fitted.variance[0, index] / len(study.heldout))),
                z_before=float(before.z["network"][0, index]),
                z_after=float(after.z["network"][0, index]),
            )
        )
    return tuple(rows)


def lanes_table(layout: DetectorLayout, before: Distance, after: Distance) -> tuple[LaneRow, ...]:
    """Return the root mean square of every lane's standardised differences.

    Args:
        layout: Lanes and detectors.
        before: Distance of the held-out periods from the scenario as it is.
        after: Their distance from the selected model.
    """
    used = before.used["lane"]
    return tuple(
        LaneRow(
            lane=name,
            tls=layout.intersections[owner],
            before=_rms(before.z["lane"][index][used[index]]),
            after=_rms(after.z["lane"][index][used[index]]),
        )
        for index, (owner, _, name) in enumerate(layout.places)
        if used[index].any()
    )


def _rms(z: Array) -> float:
    return float(np.sqrt((z**2).mean()))


def engineering_criteria(study: Study, base: Tested, best: Tested) -> EngineeringCriteria:
    """Compute the usual criteria of traffic engineers: GEH, those of FHWA, saturation headway.

    They do not affect the verdict. GEH and headway use the held-out days. The criteria of FHWA use
    all measured days, since they need the variation between days.
    """
    data, every = sum_of(study.heldout), study.all_days

    def row(model: Tested) -> CriteriaRow:
        tallies = of_the_same_stretches(model.model.tallies, study.heldout)
        values = geh(hourly(data), hourly(sum_of(tallies)))
        # They need the variation between days at the same time of day.
        same = len({day.window for day in every}) == 1
        criteria = (
            fhwa(every, tallies, study.pools.together, study.config.thresholds) if same else None
        )
        some = len(values) > 0
        return CriteriaRow(
            geh_below_5=float((values < 5).mean()) if some else None,
            geh_largest=float(values.max()) if some else None,
            within_2_sigma=criteria and criteria.within_2_sigma,
            within_1_sigma=criteria and criteria.within_1_sigma,
            absolute_error=criteria and criteria.absolute_error,
            systematic_error=criteria and criteria.systematic_error,
            saturation_headway_s=_headway(tallies),
        )

    return EngineeringCriteria(row(base), row(best), MeasuredHeadway(_headway(study.heldout)))


def _headway(days: Sequence[Tally]) -> float | None:
    """Return the mean gap of queued vehicles from the fourth on, s."""
    sums = sum_of(days).sums
    total = sums[list(SATURATION_GAPS)].sum(axis=(0, 1))
    return float(total[0] / total[1]) if total[1] else None


def travel_times(study: Study, base: Tested, best: Tested) -> TravelTimes:
    """Return the mean simulated travel time of the measured days, before and after.

    Detectors do not measure travel times, so there is no measured value to compare with.
    """
    wanted = study.engine.first(min(study.effort.test, study.effort.base))
    # no others, which a spent budget would not allow
    numbers = [number for number in wanted if number in base.model.days]

    def mean(effects: tuple[Effect, ...]) -> float | None:
        days = study.engine.ordinary(effects, numbers)
        return _number(np.nanmean([day.travel_time_s for day in days.values()]))

    return TravelTimes(mean(()), mean(best.model.effects))


def _number(value: float | np.floating) -> float | None:
    return float(value) if math.isfinite(value) else None


# --- usual criteria on counts ---------------------------------------------------------------------


@dataclass(frozen=True)
class Criteria:
    """Results of the four criteria: shares of detectors or of their intervals, in [0, 1].

    Attributes:
        within_2_sigma: Share of intervals within 1.96 standard deviations of the representative
            day. Criterion I asks for at least 0.95.
        within_1_sigma: Share of intervals within one standard deviation. Criterion II asks for at
            least two thirds.
        absolute_error: Share of detectors whose mean absolute error is at most that of the other
            measured days. Criterion III (bounded dynamic absolute error) asks for 1.
        systematic_error: Share of detectors whose mean error is at most a third of that. Criterion
            IV (bounded dynamic systematic error) asks for 1.
    """

    within_2_sigma: float
    within_1_sigma: float
    absolute_error: float
    systematic_error: float


def hourly(tally: Tally) -> Array:
    """Return vehicles per hour at every stop and exit detector, ``(2 places,)``.

    It is nan where nothing was counted: without a detector, or if a day lacks an interval.
    """
    sums = tally.sums[[INDEX[name] for name in SERVICE_COUNTS]].reshape(-1, 2)
    counted = sums[:, 1] > 0
    return np.where(counted, 60.0 * sums[:, 0] / np.where(counted, sums[:, 1], 1.0), np.nan)


def geh(measured: Array, simulated: Array) -> Array:
    """Return the GEH of hourly counts, without empty pairs and those that were not counted.

    Args:
        measured: Counts, vehicles per hour.
        simulated: Counts, vehicles per hour.
    """
    some = measured + simulated > 1.0  # False for nan
    return geh_of(measured[some], simulated[some])


def fhwa(
    measured: Sequence[Tally], simulated: Sequence[Tally], together: int, thresholds: Thresholds
) -> Criteria | None:
    """Compute the four criteria on the counts of stop and exit detectors.

    Args:
        measured: Tallies of the measured days, at least `Thresholds.least_days`.
        simulated: Tallies of simulated days; their mean is compared.
        together: Number of bins of time that one measured count covers.
        thresholds: Numbers of the method.

    Returns:
        None if there are too few days, or if no detector counts in all intervals of all days.
    """
    shortest = min(day.bins.shape[-1] for day in (*measured, *simulated))
    wanted = max(round(thresholds.interval_s / thresholds.bin_s), together)
    bins = min(together * math.ceil(wanted / together), shortest)  # no measured interval is split
    real = [_intervals(day, bins, shortest // bins) for day in measured]
    days = np.stack([counts for counts, _ in real])
    model = np.mean([_intervals(day, bins, shortest // bins)[0] for day in simulated], axis=0)
    whole = np.all([known for _, known in real], axis=(0, 2))
    used = whole & (days.sum(axis=(0, 2)) > 0)
    if len(measured) < thresholds.least_days or not used.any():
        return None
    days, model = days[:, used], model[used]
    chosen = representative(days)
    error = model - days[chosen]  # (detectors, intervals)
    sigma = np.maximum(days.std(axis=0, ddof=1), 1e-9)
    others = np.delete(days, chosen, axis=0)
    bound = np.abs(others - days[chosen]).mean(axis=(0, 2)) + 1e-9
    return Criteria(
        float((np.abs(error) <= 1.96 * sigma).mean()),
        float((np.abs(error) <= sigma).mean()),
        float((np.abs(error).mean(axis=1) <= bound).mean()),
        float((np.abs(error.mean(axis=1)) <= bound / 3.0).mean()),
    )


def representative(days: Array) -> int:
    """Return the index of the day with the least relative difference from the mean of all days.

    Args:
        days: Counts, ``(days, detectors, intervals)``.
    """
    mean = days.mean(axis=0)
    relative = np.abs(days - mean) / np.where(mean > 0, mean, 1.0)
    return int(relative.mean(axis=(1, 2)).argmin())


def _intervals(day: Tally, bins: int, count: int) -> tuple[Array, NDArray[np.bool_]]:
    """Return counts of the first intervals, and a mask of complete ones.

    Args:
        day: The day.
        bins: Number of bins in an interval.
        count: Number of intervals.

    Returns:
        Both ``(detectors, intervals)``.
    """
    rows = [BIN_FEATURES.index(name) for name in SERVICE_COUNTS]
    sums, known = (values[rows, :, :count].reshape(-1, count) for values in day.gathered(bins))
    return sums, known > 0
