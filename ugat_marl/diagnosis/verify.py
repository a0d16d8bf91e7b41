"""Before and after, on periods that were not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ugat_marl.diagnosis.criteria import Criteria, fhwa, geh, hourly
from ugat_marl.diagnosis.features import FEATURES, INDEX, Tally
from ugat_marl.diagnosis.residual import Null, Residual, Tested
from ugat_marl.diagnosis.statistics import Array, added
from ugat_marl.diagnosis.study import Study
from ugat_marl.effects import Effect


@dataclass(frozen=True)
class Verification:
    """The held-out periods under both models.

    Attributes:
        before: Test of the scenario as it is.
        after: Test of the corrected model.
        shrink: Share of the gap that is gone, the noise taken off on both sides.
    """

    before: Residual
    after: Residual
    shrink: float | None

    def as_dict(self) -> dict[str, Any]:
        """The fields for JSON."""
        return {
            "before": self.before.distance,
            "after": self.after.distance,
            "floor": self.after.floor,
            "expected": self.after.expected,
            "shrink": self.shrink,
            "p_before": self.before.p,
            "p_after": self.after.p,
        }


def verify(study: Study, base: Tested, best: Tested) -> Verification:
    """Tests both models on the held-out periods."""
    count = len(study.heldout)

    def null(model: Tested) -> Null:
        days = model.model.tallies
        if model.model.members:
            numbers = study.engine.first(study.effort.test)
            found = study.engine.ordinary(model.model.effects, numbers)
            days = tuple(day.tally for day in found.values())
        return study.null(days, count, effects=model.model.effects)

    before = null(base).test(study.heldout)
    after = null(best).test(study.heldout, best.extra or None) if best.model.members else before
    gap = max(0.0, before.distance - before.expected)
    left = max(0.0, after.distance - after.expected)
    shrink = 1.0 - left / gap if gap > 0.0 and best.model.members else None
    return Verification(before, after, shrink)


def statistics_table(study: Study, base: Tested, best: Tested) -> list[dict[str, Any]]:
    """Each statistic of the network on the held-out periods, before and after, with its noise."""
    before = base.model.reference.distance(study.heldout)
    after = best.model.reference.distance(study.heldout, relative_to=base.model.reference)
    block = base.model.reference.blocks["network"]
    fitted = best.model.reference.blocks["network"]
    rows: list[dict[str, Any]] = []
    for index, (name, regime, unit) in enumerate(FEATURES):
        if before.z["network"][0, index] == 0.0:
            continue
        noise = float(np.sqrt(fitted.variance[0, index] / len(study.heldout)))
        rows.append(
            {
                "statistic": name,
                "regime": regime,
                "unit": unit,
                "measured": float(block.mean[0, index] + before.difference["network"][0, index]),
                "before": float(block.mean[0, index]),
                "after": float(fitted.mean[0, index]),
                "noise": noise,
                "z_before": float(before.z["network"][0, index]),
                "z_after": float(after.z["network"][0, index]),
            }
        )
    return rows


def lanes_table(study: Study, base: Tested, best: Tested) -> list[dict[str, Any]]:
    """Root mean square of the standardised differences of every lane, before and after."""
    before = base.model.reference.distance(study.heldout).z["lane"]
    after = best.model.reference.distance(study.heldout, relative_to=base.model.reference).z["lane"]
    return [
        {
            "lane": name,
            "tls": study.site.intersections[owner],
            "before": _rms(before[index]),
            "after": _rms(after[index]),
        }
        for index, (owner, _, name) in enumerate(study.site.places)
        if np.any(before[index])
    ]


def _rms(z: Array) -> float:
    used = z[z != 0]
    return float(np.sqrt((used**2).mean())) if len(used) else 0.0


def courtesy(study: Study, base: Tested, best: Tested) -> dict[str, Any]:
    """What traffic engineers are used to see: GEH, the criteria of FHWA, discharge headway.

    None of them decides anything here. GEH and headways are those of the held-out days; what
    FHWA asks for is how much days differ, which takes all that were measured.
    """
    data, every = added(study.heldout), study.all_days
    found: dict[str, Any] = {}
    for name, model in (("before", base), ("after", best)):
        tallies = model.model.tallies
        off = geh(hourly(data), hourly(added(tallies)))
        four = fhwa(every, tallies, study.pools.together)
        found[name] = {
            "geh_below_5": float((off < 5).mean()) if len(off) else None,
            "geh_largest": float(off.max()) if len(off) else None,
            **(dict.fromkeys(f.name for f in fields(Criteria)) if four is None else asdict(four)),
            "saturation_headway_s": _headway(tallies),
        }
    found["measured"] = {"saturation_headway_s": _headway(study.heldout)}
    return found


def _headway(days: Sequence[Tally]) -> float | None:
    """Mean gap of queued vehicles from the fourth on, s."""
    sums = added(days).sums
    rows = [INDEX["gap4-5"], INDEX["gap6-8"], INDEX["gap9+"]]
    total = sums[rows].sum(axis=(0, 1))
    return float(total[0] / total[1]) if total[1] else None


def travel_times(study: Study, best: Tested) -> dict[str, float]:
    """Mean simulated travel time of the measured days, before and after, s.

    Detectors do not know travel times, so the measured one has no place here.
    """
    numbers = study.engine.first(min(study.effort.test, study.effort.base))

    def mean(effects: tuple[Effect, ...]) -> float:
        found = study.engine.ordinary(effects, numbers)
        return float(np.nanmean([day.travel_time_s for day in found.values()]))

    return {"before_s": mean(()), "after_s": mean(best.model.effects)}
