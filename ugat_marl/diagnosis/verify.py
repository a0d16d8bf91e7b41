"""Verification of the scenario as it is and the selected model on held-out periods."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ugat_marl.diagnosis.criteria import fhwa, geh, hourly
from ugat_marl.diagnosis.features import FEATURES, INDEX, Tally
from ugat_marl.diagnosis.records import (
    CriteriaRow,
    EngineeringCriteria,
    LaneRow,
    MeasuredHeadway,
    StatisticRow,
    Tables,
    Tested,
    TravelTimes,
    Verified,
)
from ugat_marl.diagnosis.residual import Null
from ugat_marl.diagnosis.statistics import Array, added
from ugat_marl.diagnosis.study import Study
from ugat_marl.effects import Effect


def verify_model(study: Study, base: Tested, best: Tested) -> Verified:
    """Test both models on the held-out periods.

    With e the excess of the distance over its expected value, at least 0:
    shrink = 1 - e_after / e_before.
    """
    count = len(study.heldout)

    def null(model: Tested) -> Null:
        days = model.model.tallies
        if model.model.members:
            numbers = study.engine.first(study.effort.test)
            ordinary = study.engine.ordinary(model.model.effects, numbers)
            days = tuple(day.tally for day in ordinary.values())
        return study.null(days, count, effects=model.model.effects)

    before = null(base).test(study.heldout)
    after = null(best).test(study.heldout, best.extra or None) if best.model.members else before
    gap = max(0.0, before.distance - before.expected)
    left = max(0.0, after.distance - after.expected)
    shrink = 1.0 - left / gap if gap > 0.0 and best.model.members else None
    return Verified(before, after, shrink)


def tables_of(study: Study, base: Tested, best: Tested) -> Tables:
    """Make the tables that compare both models."""
    return Tables(
        statistics_table(study, base, best),
        lanes_table(study, base, best),
        courtesy(study, base, best),
        travel_times(study, best),
    )


def statistics_table(study: Study, base: Tested, best: Tested) -> tuple[StatisticRow, ...]:
    """Compare each statistic of the network on the held-out periods, with its noise."""
    before = base.model.reference.distance(study.heldout)
    after = best.model.reference.distance(study.heldout, relative_to=base.model.reference)
    block = base.model.reference.blocks["network"]
    fitted = best.model.reference.blocks["network"]
    rows: list[StatisticRow] = []
    for index, (name, regime, unit) in enumerate(FEATURES):
        if before.z["network"][0, index] == 0.0:
            continue
        rows.append(
            StatisticRow(
                statistic=name,
                regime=regime,
                unit=unit,
                measured=float(block.mean[0, index] + before.difference["network"][0, index]),
                before=float(block.mean[0, index]),
                after=_number(fitted.mean[0, index]),
                noise=float(np.sqrt(fitted.variance[0, index] / len(study.heldout))),
                z_before=float(before.z["network"][0, index]),
                z_after=float(after.z["network"][0, index]),
            )
        )
    return tuple(rows)


def lanes_table(study: Study, base: Tested, best: Tested) -> tuple[LaneRow, ...]:
    """Return the root mean square of every lane's standardised differences."""
    before = base.model.reference.distance(study.heldout).z["lane"]
    after = best.model.reference.distance(study.heldout, relative_to=base.model.reference).z["lane"]
    return tuple(
        LaneRow(
            lane=name,
            tls=study.site.intersections[owner],
            before=_rms(before[index]),
            after=_rms(after[index]),
        )
        for index, (owner, _, name) in enumerate(study.site.places)
        if np.any(before[index])
    )


def _rms(z: Array) -> float:
    used = z[z != 0]
    return float(np.sqrt((used**2).mean())) if len(used) else 0.0


def courtesy(study: Study, base: Tested, best: Tested) -> EngineeringCriteria:
    """Compute the usual criteria of traffic engineers: GEH, those of FHWA, saturation headway.

    They do not affect the verdict. GEH and headway use the held-out days. The criteria of FHWA use
    all measured days, since they need the variation between days.
    """
    data, every = added(study.heldout), study.all_days

    def row(model: Tested) -> CriteriaRow:
        tallies = model.model.tallies
        values = geh(hourly(data), hourly(added(tallies)))
        criteria = fhwa(every, tallies, study.pools.together)
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
    sums = added(days).sums
    rows = [INDEX["gap4-5"], INDEX["gap6-8"], INDEX["gap9+"]]
    total = sums[rows].sum(axis=(0, 1))
    return float(total[0] / total[1]) if total[1] else None


def travel_times(study: Study, best: Tested) -> TravelTimes:
    """Return the mean simulated travel time of the measured days, before and after.

    Detectors do not measure travel times, so there is no measured value to compare with.
    """
    numbers = study.engine.first(min(study.effort.test, study.effort.base))

    def mean(effects: tuple[Effect, ...]) -> float | None:
        days = study.engine.ordinary(effects, numbers)
        return _number(np.nanmean([day.travel_time_s for day in days.values()]))

    return TravelTimes(mean(()), mean(best.model.effects))


def _number(value: float | np.floating) -> float | None:
    return float(value) if math.isfinite(value) else None
