"""Records that the stages of a diagnosis hand on, and the record that is written.

    Located    where the scenario as it is disagrees with the data
    Proposed   a set of effects that is worth a simulation
    Fitted     a set of effects, simulated, with values for its free numbers
    Selected   the set that is chosen, tested, and its rivals
    Verified   the scenario as it is and the chosen set on periods that were not fitted
    Conclusion the verdict, with its grounds
    Diagnosis  what is said of all this: the content of ``diagnosis.json``

Every stage takes the record of the one before. Only a `Diagnosis` is written, and it holds plain
values alone. The others may hold simulated days and arrays, and end with the diagnosis.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import ConfigDict, TypeAdapter

from ugat_marl.diagnosis.features import Tally
from ugat_marl.diagnosis.hypotheses import Members, effects_of
from ugat_marl.diagnosis.statistics import Array, Distance, Reference
from ugat_marl.effects import Effect
from ugat_marl.files import write_whole

FILE = "diagnosis.json"
"""Name of the file that a diagnosis writes into its directory."""
CORRECTED = "corrected"
"""Name of the folder of the corrected scenario, beside that file."""
SCHEMA = "ugat-marl/diagnosis/2"
"""Form of the file; it rises whenever the form changes."""

Verdict = Literal[
    "no_discrepancy", "explained", "not_identifiable", "partially_explained", "unknown"
]


# --- stages -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Proposed:
    """A set of effects to simulate.

    Attributes:
        members: Hypotheses and values of their free fields.
        expected: Distance that should be left, by the simulated changes of the statistics
            (`propose.Direction`), plus the price of the effects.
    """

    members: Members
    expected: float


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model that was simulated.

    Attributes:
        members: Its effects.
        days: Its simulated days by their numbers.
        reference: Its statistics with their noise, from these days.
        distance: From the data that were fitted.
        cost: Distance, penalty for noise, and price of the effects: less is better.
    """

    members: Members
    days: Mapping[int, Tally]
    reference: Reference
    distance: Distance
    cost: float

    @property
    def tallies(self) -> tuple[Tally, ...]:
        """Its simulated days."""
        return tuple(self.days.values())

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects in the order in which they are applied."""
        return effects_of(self.members)

    @property
    def values(self) -> Array:
        """All free values, one after the other."""
        return np.array([value for _, values in self.members for value in values])


@dataclass(frozen=True)
class Residual:
    """Test of one model on one data set.

    Attributes:
        distance: Total distance of the data from the model.
        floor: Total distance that 99 of 100 data sets of the model itself stay below.
        expected: Mean distance of data sets of the model itself.
        p: Chance of a difference this large under the model: the smallest in `blocks`, corrected
            for their number.
        blocks: This chance for each statistic that is tested, uncorrected.
    """

    distance: float
    floor: float
    expected: float
    p: float
    blocks: dict[str, float]


@dataclass(frozen=True, eq=False)
class Tested:
    """A fitted model with the test of what it leaves.

    Attributes:
        model: The model.
        residual: The test on the fitted periods.
        errors: Standard errors of its free values.
        extra: Variance that is added to that of the noise, by block: for `errors`, and as the
            tolerance of the method.
    """

    model: Fitted
    residual: Residual
    errors: Array
    extra: dict[str, Array]


@dataclass(frozen=True)
class Disagreement:
    """One place and regime in which data and model differ.

    Attributes:
        tls: Traffic light, or None for all of the network.
        approach: Edge, or None for all.
        lane: Lane, or None for all.
        regime: discharge, free flow, approach to red, yellow, storage, volume or vehicles.
        statistic: The one that differs most.
        window: Begin and end on the scenario's clock, s; None for all of the time.
        size: Measured minus simulated, in `unit`.
        unit: Unit of the statistic.
        z: `size` in standard deviations.
        p: Chance of a difference this large under the model.
    """

    tls: str | None
    approach: str | None
    lane: str | None
    regime: str
    statistic: str
    window: tuple[float, float] | None
    size: float
    unit: str
    z: float
    p: float


@dataclass(frozen=True, eq=False)
class Located:
    """The scenario as it is against the data.

    Attributes:
        base: The scenario as it is, tested.
        disagreements: Places and regimes, strongest first; none if `base` is not contradicted.
        complete: False if the budget ended before single effects were looked for.
        examined: Names of effects that were simulated for it.
    """

    base: Tested
    disagreements: tuple[Disagreement, ...]
    complete: bool
    examined: frozenset[str]


@dataclass(frozen=True, eq=False)
class Selected:
    """Result of the search.

    Attributes:
        best: The model selected; without effects if none was worth its price.
        rivals: Other sets of effects that were fitted, best first.
        complete: Whether the search ended by itself, and not by the budget.
        examined: Names of effects that were simulated, or for which no place came into question.
    """

    best: Tested
    rivals: tuple[Fitted, ...]
    complete: bool
    examined: frozenset[str]


@dataclass(frozen=True)
class Verified:
    """The held-out periods under both models.

    Attributes:
        before: Test of the scenario as it is.
        after: Test of the corrected model; the same test if there is none.
        shrink: Share of the gap that is gone, the noise taken off on both sides; None without a
            gap or without a corrected model.
    """

    before: Residual
    after: Residual
    shrink: float | None


@dataclass(frozen=True, eq=False)
class Conclusion:
    """A verdict with its grounds.

    Attributes:
        verdict: One of five.
        best: The model it speaks of; the scenario as it is where nothing is found.
        indistinct: Other models that fit as well.
        sentence: The verdict for people.
        next_measurement: What would tell the rivals apart, or show what is missing.
    """

    verdict: Verdict
    best: Tested
    indistinct: tuple[Fitted, ...]
    sentence: str
    next_measurement: str | None


# --- what is written ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Parameter:
    """A number of an effect.

    Attributes:
        value: The value.
        low: Begin of its 95 % interval; None if it was not estimated.
        high: End of the interval.
        unit: Unit of all three.
    """

    value: float
    low: float | None
    high: float | None
    unit: str


@dataclass(frozen=True)
class EffectRecord:
    """An effect as it is written.

    Attributes:
        name: Name of the effect.
        place: Its edge, lane or detector, several joined by ``>``; None for all of the network.
        window: Begin and end on the scenario's clock, s.
        parameters: Its numbers by name.
    """

    name: str
    place: str | None
    window: tuple[float, float] | None
    parameters: dict[str, Parameter]


@dataclass(frozen=True)
class SearchGrounds:
    """Grounds for an effect that the search found.

    Attributes:
        distance: Distance of the data from the model that holds it.
        runner_up_is_worse_by: Cost by which the best other set of effects is worse, if there is
            one.
    """

    distance: float
    runner_up_is_worse_by: float | None


@dataclass(frozen=True)
class LogGrounds:
    """Grounds for an effect that is read off the data.

    Attributes:
        source: The file it is read from.
    """

    source: str


@dataclass(frozen=True)
class NamedEffect(EffectRecord):
    """An effect that a diagnosis names.

    Attributes:
        evidence: Its grounds.
    """

    evidence: SearchGrounds | LogGrounds


@dataclass(frozen=True)
class Explanation:
    """A set of effects that was simulated.

    Attributes:
        effects: The effects, without intervals.
        distance: Distance of the fitted data from it.
        cost: The same with the penalty for noise and the price of the effects.
    """

    effects: tuple[EffectRecord, ...]
    distance: float
    cost: float


@dataclass(frozen=True)
class HeldOut:
    """Distances on the held-out periods.

    Attributes:
        before: Distance of the data from the scenario as it is.
        after: Distance from the corrected model.
        floor: Distance that 99 of 100 data sets of the corrected model stay below.
        expected: Mean distance of data sets of the corrected model.
        shrink: Share of the gap that is gone.
        p_before: Chance of a difference as large as before, under the scenario as it is.
        p_after: Chance of a difference as large as after, under the corrected model.
    """

    before: float
    after: float
    floor: float
    expected: float
    shrink: float | None
    p_before: float
    p_after: float

    @classmethod
    def of(cls, verified: Verified) -> HeldOut:
        """Take the numbers from a verification."""
        before, after = verified.before, verified.after
        return cls(
            before.distance,
            after.distance,
            after.floor,
            after.expected,
            verified.shrink,
            before.p,
            after.p,
        )


@dataclass(frozen=True)
class FitEvidence:
    """Chances on the fitted periods.

    Attributes:
        p_fit: Chance of the data under the scenario as it is.
        p_fit_after: Chance under the model selected.
    """

    p_fit: float
    p_fit_after: float


@dataclass(frozen=True)
class StatisticRow:
    """A statistic of the network on the held-out periods.

    Attributes:
        statistic: Its name.
        regime: Its regime.
        unit: Unit of `measured` to `noise`.
        measured: Mean of the data.
        before: Mean of the scenario as it is.
        after: Mean of the corrected model; None if nothing was observed there.
        noise: Standard deviation of chance in data sets of this size.
        z_before: Measured minus simulated before, in standard deviations.
        z_after: The same after.
    """

    statistic: str
    regime: str
    unit: str
    measured: float
    before: float
    after: float | None
    noise: float
    z_before: float
    z_after: float


@dataclass(frozen=True)
class LaneRow:
    """Disagreement of a lane on the held-out periods.

    Attributes:
        lane: SUMO id.
        tls: Its traffic light.
        before: Root mean square of its standardised differences from the scenario as it is.
        after: The same from the corrected model.
    """

    lane: str
    tls: str
    before: float
    after: float


@dataclass(frozen=True)
class CriteriaRow:
    """The criteria traffic engineers use, for one model; None without counts or with few days.

    Attributes:
        geh_below_5: Share of hourly counts with GEH below 5.
        geh_largest: Largest GEH.
        within_2_sigma: Criterion I of FHWA, see `Criteria`.
        within_1_sigma: Criterion II.
        absolute_error: Criterion III.
        systematic_error: Criterion IV.
        saturation_headway_s: Mean gap of queued vehicles from the fourth on, s.
    """

    geh_below_5: float | None
    geh_largest: float | None
    within_2_sigma: float | None
    within_1_sigma: float | None
    absolute_error: float | None
    systematic_error: float | None
    saturation_headway_s: float | None


@dataclass(frozen=True)
class MeasuredHeadway:
    """The one number of a `CriteriaRow` that needs no model: it is read off the data.

    Attributes:
        saturation_headway_s: Mean gap of queued vehicles from the fourth on, s.
    """

    saturation_headway_s: float | None


@dataclass(frozen=True)
class EngineeringCriteria:
    """The criteria traffic engineers use, before and after; shown, but they decide nothing.

    Attributes:
        before: The scenario as it is.
        after: The corrected model.
        measured: The data.
    """

    before: CriteriaRow
    after: CriteriaRow
    measured: MeasuredHeadway


@dataclass(frozen=True)
class TravelTimes:
    """Mean simulated travel time of the measured days; None if nobody arrived.

    Attributes:
        before_s: Under the scenario as it is, s.
        after_s: Under the corrected model, s.
    """

    before_s: float | None
    after_s: float | None


@dataclass(frozen=True)
class Tables:
    """Both models side by side.

    Attributes:
        statistics: The statistics of the network.
        lanes: The lanes with detectors.
        courtesy: The usual criteria.
        travel_time: Mean travel times.
    """

    statistics: tuple[StatisticRow, ...] = ()
    lanes: tuple[LaneRow, ...] = ()
    courtesy: EngineeringCriteria | None = None
    travel_time: TravelTimes | None = None


@dataclass(frozen=True)
class Splits:
    """Ids of the measured periods.

    Attributes:
        fit: Those that models were fitted to.
        heldout: The others.
    """

    fit: tuple[str, ...]
    heldout: tuple[str, ...]


@dataclass(frozen=True)
class TravelTimeEstimate:
    """A mean travel time with its 95 % interval, s; None for a single episode.

    Attributes:
        mean: The mean.
        low: Begin of the interval.
        high: End of the interval.
    """

    mean: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class PolicyGap:
    """Travel times of one policy: promised, promised after the correction, and real.

    Attributes:
        sim: In the scenario as it is.
        corrected: In the corrected scenario.
        real: In the real world.
        before: Distance of the first promise from the real world, s.
        after: Distance of the second.
        shrink: Share of the gap that is gone; None where no gap is to be seen before.
    """

    sim: TravelTimeEstimate
    corrected: TravelTimeEstimate
    real: TravelTimeEstimate
    before: float
    after: float
    shrink: float | None


@dataclass(frozen=True)
class Diagnosis:
    """The content of ``diagnosis.json``.

    Attributes:
        schema: Form of the file.
        scenario: Id of the scenario.
        seed: Root of the simulated days.
        alpha: Level of the tests.
        budget_s: Wall time after which no simulation was begun, s.
        left_out: Effects that were not examined on request.
        ruled_out: Effects that the data cannot show.
        findings: Remarks of the check of the files.
        periods: Measured periods.
        verified_on_fitted_periods: True if no period was held out.
        hashes: SHA-256 of the scenario and of the data.
        versions: Versions of the software.
        verdict: One of five.
        sentence: The verdict for people.
        effects: The effects that are named.
        where: Places where the scenario as it is disagrees with the fitted periods.
        left: Places where the model selected still disagrees with them.
        alternatives: Other sets of effects that were simulated, best first.
        best: The model selected, if it has effects.
        heldout: The test on the held-out periods; None if nothing could be compared.
        evidence: Chances on the fitted periods; None if nothing could be compared.
        statistics: The statistics of the network, before and after.
        lanes: The lanes with detectors, before and after.
        courtesy: The usual criteria, before and after.
        travel_time: Mean travel times, before and after.
        next_measurement: What would decide between rivals, or show what is missing.
        complete: Whether the search ended by itself, and not by the budget.
        untried: Effects that were not examined for lack of time.
        corrected: Name of the folder of the corrected scenario; None if nothing is corrected.
        policy_gap: Policy to its travel times, once `ugat-marl policy-gap` has measured them.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    schema: Literal["ugat-marl/diagnosis/2"]
    scenario: str
    seed: int
    alpha: float
    budget_s: float
    left_out: tuple[str, ...]
    ruled_out: tuple[str, ...]
    findings: tuple[str, ...]
    periods: Splits
    verified_on_fitted_periods: bool
    hashes: dict[str, str]
    versions: dict[str, str | None]
    verdict: Verdict
    sentence: str
    effects: tuple[NamedEffect, ...]
    where: tuple[Disagreement, ...]
    left: tuple[Disagreement, ...]
    alternatives: tuple[Explanation, ...]
    best: Explanation | None
    heldout: HeldOut | None
    evidence: FitEvidence | None
    statistics: tuple[StatisticRow, ...]
    lanes: tuple[LaneRow, ...]
    courtesy: EngineeringCriteria | None
    travel_time: TravelTimes | None
    next_measurement: str | None
    complete: bool
    untried: tuple[str, ...]
    corrected: str | None
    policy_gap: dict[str, PolicyGap] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON, numbers rounded to nine digits; None for no number."""
        return _plain(asdict(self))

    @classmethod
    def from_json(cls, content: Any) -> Self:
        """Make the record from what `to_json` returned.

        Raises:
            ValueError: A key is missing or unknown, or a value has another type.
        """
        return _adapter(cls).validate_json(json.dumps(content))

    def write(self, directory: Path) -> None:
        """Write the file into a directory, whole or not at all."""
        text = json.dumps(self.to_json(), indent=1, sort_keys=True, allow_nan=False)
        write_whole(directory / FILE, text + "\n")

    @classmethod
    def read(cls, directory: Path) -> Self:
        """Read the file in a directory.

        Raises:
            OSError: There is none.
            ValueError: It is no diagnosis of this version.
        """
        return cls.from_json(json.loads((directory / FILE).read_text(encoding="utf-8")))


@cache
def _adapter(record: type[Any]) -> TypeAdapter[Any]:
    return TypeAdapter(record)


def _plain(value: Any) -> Any:
    """Return the value with numbers rounded to nine digits, and without what JSON cannot say."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, bool) or value is None or isinstance(value, str | int):
        return value
    number = float(value)
    return float(f"{number:.9g}") if number == number and abs(number) < 1e300 else None
