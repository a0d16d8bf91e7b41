"""Records of the stages of a diagnosis, and the record that is written to disk.

    Located    places where the scenario as it is disagrees with the data
    Proposed   a set of effects that is worth a simulation
    Fitted     a set of effects, simulated, with values for its free numbers
    Selected   the chosen set of effects with its test, and its rivals
    Verified   tests of the scenario as it is and of the chosen set on held-out periods
    Conclusion the verdict, with its grounds
    Diagnosis  the content of ``diagnosis.json``

Every stage takes the record of the stage before. Only a `Diagnosis` is written, and it holds only
plain values. The other records may hold simulated days and arrays, and are never written.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import ConfigDict, TypeAdapter

from ugat_marl.diagnosis.engine import EndedBudget
from ugat_marl.diagnosis.features import Tally
from ugat_marl.diagnosis.hypotheses import Members, effects_of
from ugat_marl.diagnosis.statistics import Array, Distance, Reference
from ugat_marl.effects import Effect
from ugat_marl.errors import OptionError, counted
from ugat_marl.files import read_json, write_whole

FILE = "diagnosis.json"
"""Name of the file that a diagnosis writes into its directory."""
CORRECTED = "corrected"
"""Name of the folder of the corrected scenario, beside that file."""
SCHEMA = "ugat-marl/diagnosis/7"
"""Form of the file; it rises whenever the form changes."""

Verdict = Literal[
    "no_discrepancy",
    "explained",
    "not_identifiable",
    "partially_explained",
    "provisional",
    "unknown",
]


# --- stages -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Proposed:
    """A set of effects to simulate.

    Attributes:
        members: Hypotheses and values of their free fields.
        expected: Predicted distance of the data from this set, plus the price of its effects. The
            prediction uses the simulated changes of the statistics (`propose.Direction`).
    """

    members: Members
    expected: float


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model that was simulated.

    Attributes:
        members: Hypotheses and values of their free fields.
        days: Tallies of its simulated days, by number of the day.
        reference: Its statistics with their noise, from these days.
        distance: Distance of the fitted data from the model.
        cost: Distance, plus penalty for noise, plus price of the effects; less is better.
    """

    members: Members
    days: Mapping[int, Tally]
    reference: Reference
    distance: Distance
    cost: float

    @property
    def tallies(self) -> tuple[Tally, ...]:
        """Tallies of the simulated days."""
        return tuple(self.days.values())

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects in the order in which they are applied."""
        return effects_of(self.members)

    @property
    def values(self) -> Array:
        """All free values, one after the other, ``(free values,)``."""
        return np.array([value for _, values in self.members for value in values])


@dataclass(frozen=True)
class ResidualTest:
    """Test of one model on one data set.

    Attributes:
        distance: Total distance of the data from the model.
        floor: Total distance that 99 of 100 data sets of the model itself stay below.
        expected: Mean distance of data sets of the model itself.
        p: Chance of a difference this large under the model: the smallest value of `blocks` times
            their number, at most 1.
        blocks: The chance for each tested statistic, not corrected for their number.
    """

    distance: float
    floor: float
    expected: float
    p: float
    blocks: dict[str, float]


@dataclass(frozen=True, eq=False)
class Tested:
    """A fitted model with the test of the remaining difference.

    Attributes:
        model: The model.
        residual: The test on the fitted periods.
        errors: Standard errors of its free values, ``(free values,)``.
        extra: Variance that is added to the noise, by block. It covers `errors` and the tolerance
            of the method.
    """

    model: Fitted
    residual: ResidualTest
    errors: Array
    extra: dict[str, Array]

    def errors_of(self, index: int) -> Array:
        """Return the standard errors of the free values of the member at `index`."""
        first = sum(len(values) for _, values in self.model.members[:index])
        return self.errors[first : first + len(self.model.members[index][1])]


@dataclass(frozen=True)
class Disagreement:
    """One place and regime in which data and model differ.

    Attributes:
        tls: SUMO id of the traffic light; None for all of the network.
        approach: SUMO id of the edge; None for all.
        lane: SUMO id of the lane; None for all.
        regime: discharge, free flow, approach to red, yellow, storage, volume, vehicles, occupancy,
            mean speed, turning, travel time, lanes or every lane.
        statistic: The statistic that differs most there.
        window: Begin and end on the scenario's clock, s; None for all of the time.
        size: Measured minus simulated, in `unit`.
        unit: Unit of the statistic.
        z: `size` in standard deviations.
        p: Chance of a difference this large under the model, two-sided.
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
    """Comparison of the scenario as it is with the data.

    Attributes:
        base: The scenario as it is, tested.
        disagreements: The strongest places and regimes, see `locate`; empty if the data do not
            contradict `base`.
        complete: False if the budget ended before the test along single effects.
        examined: Names of the effects that were simulated for this test.
    """

    base: Tested
    disagreements: tuple[Disagreement, ...]
    complete: bool
    examined: frozenset[str]


@dataclass(frozen=True, eq=False)
class Selected:
    """Result of the search.

    Attributes:
        best: The selected model; without effects if no effect was worth its price.
        rivals: All sets of effects that were simulated, least cost first.
        complete: True if the search ended by itself, False if the budget ended it.
        examined: Names of effects that were simulated, or for which no place was suspicious.
        runner_up_is_worse_by: Cost of the best model with other effects, or with the same ones
            elsewhere, above that of `best` on as many days; None without one.
    """

    best: Tested
    rivals: tuple[Fitted, ...]
    complete: bool
    examined: frozenset[str]
    runner_up_is_worse_by: float | None = None


@dataclass(frozen=True)
class Verified:
    """Tests of both models on the held-out periods.

    Attributes:
        before: Test of the scenario as it is.
        after: Test of the corrected model; `before` again if there is none.
        shrink: Share of the gap that is gone: 1 minus the excess distance after over the excess
            distance before. The excess is the distance minus its expected value, at least 0. None
            without a gap or without a corrected model.
        gain: Distance plus penalty for noise before, minus the same after; see `Fitted.cost`.
            0 without a corrected model.
    """

    before: ResidualTest
    after: ResidualTest
    shrink: float | None
    gain: float


@dataclass(frozen=True, eq=False)
class Conclusion:
    """A verdict with its grounds.

    Attributes:
        verdict: One of the values of `Verdict`.
        best: The model that the verdict is about; the scenario as it is if nothing is found.
        indistinct: Other models that fit equally well.
        sentence: The verdict as a sentence.
        next_measurement: A measurement that would separate the rivals, or show the missing effect;
            None if none is needed.
    """

    verdict: Verdict
    best: Tested
    indistinct: tuple[Fitted, ...]
    sentence: str
    next_measurement: str | None


# --- the written record -------------------------------------------------------------------------


@dataclass(frozen=True)
class Parameter:
    """A number of an effect.

    Attributes:
        value: The value.
        low: Lower end of its 95 % interval; None if it was not estimated.
        high: End of its 95 % interval; None if it was not estimated.
        unit: Unit of all three.
    """

    value: float
    low: float | None
    high: float | None
    unit: str


@dataclass(frozen=True)
class EffectRecord:
    """An effect in ``diagnosis.json``.

    Attributes:
        name: Name of the effect.
        place: Its edge, lane or detector, several joined by ``>``, or ``*`` for every place; None
            without a place.
        window: Begin and end on the scenario's clock, s; None for all of the time.
        parameters: Numbers of the effect by name.
    """

    name: str
    place: str | None
    window: tuple[float, float] | None
    parameters: dict[str, Parameter]


@dataclass(frozen=True)
class SearchGrounds:
    """Grounds for an effect that the search found.

    Attributes:
        distance: Distance of the data from the model with this effect.
        runner_up_is_worse_by: Cost by which the best other set of effects is worse; None if there
            is no other.
    """

    distance: float
    runner_up_is_worse_by: float | None

    def in_words(self, number: Callable[[float], str]) -> str:
        """Return the grounds as a phrase; `number` writes a number, "" without a runner-up."""
        worse_by = self.runner_up_is_worse_by
        return "" if worse_by is None else f"next set of effects is worse by {number(worse_by)}"


@dataclass(frozen=True)
class LogGrounds:
    """Grounds for an effect that is read off the data.

    Attributes:
        source: The data it is read from.
        rival: Text of another effect that looks the same in the data; None if none does.
    """

    source: str
    rival: str | None = None

    def in_words(self, number: Callable[[float], str]) -> str:
        """Return the grounds as a phrase; it has no number."""
        return self.source if self.rival is None else f"{self.source}; looks like {self.rival} too"


@dataclass(frozen=True)
class NamedEffect(EffectRecord):
    """An effect that a diagnosis names.

    Attributes:
        evidence: Grounds for naming it.
    """

    evidence: SearchGrounds | LogGrounds


@dataclass(frozen=True)
class Explanation:
    """A set of effects that was simulated.

    Attributes:
        effects: The effects, without intervals.
        distance: Distance of the fitted data from the model with these effects.
        cost: This distance, plus the penalty for noise, plus the price of the effects.
    """

    effects: tuple[EffectRecord, ...]
    distance: float
    cost: float


@dataclass(frozen=True)
class Alternative(Explanation):
    """A set of effects that was simulated and not selected.

    Attributes:
        indistinct: Whether it fits as well as the selected set, so that these data cannot tell
            which of them is right.
    """

    indistinct: bool


@dataclass(frozen=True)
class HeldOut:
    """Distances on the held-out periods.

    Attributes:
        before: Distance of the data from the scenario as it is.
        after: Distance of the data from the corrected model; None if it was not tested, since the
            budget ended.
        floor: Distance that 99 of 100 data sets of the corrected model stay below.
        expected: Mean distance of data sets of the corrected model.
        shrink: Share of the gap that is gone; see `Verified`.
        p_before: Chance of a difference this large under the scenario as it is.
        p_after: Chance of a difference this large under the corrected model; None likewise.
    """

    before: float
    after: float | None
    floor: float
    expected: float
    shrink: float | None
    p_before: float
    p_after: float | None

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
        p_fit: Chance of a difference this large under the scenario as it is.
        p_fit_after: Chance of a difference this large under the selected model; None if it was not
            tested, since the budget ended.
    """

    p_fit: float
    p_fit_after: float | None


@dataclass(frozen=True)
class StatisticRow:
    """A statistic of the network on the held-out periods.

    Attributes:
        statistic: Name of the statistic.
        regime: Regime of the statistic.
        unit: Unit of `measured`, `before`, `after` and `noise`.
        measured: Mean of the data.
        before: Mean of the scenario as it is.
        after: Mean of the corrected model; None if nothing was observed there.
        noise: Standard deviation of `measured` by chance under the corrected model.
        z_before: Data minus scenario as it is, in standard deviations.
        z_after: Data minus corrected model, in standard deviations.
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
        lane: SUMO id of the lane.
        tls: SUMO id of its traffic light.
        before: Root mean square of its standardised differences from the scenario as it is.
        after: Root mean square of its standardised differences from the corrected model.
    """

    lane: str
    tls: str
    before: float
    after: float


@dataclass(frozen=True)
class CriteriaRow:
    """Usual criteria of traffic engineers for one model; None without counts or with few days.

    Attributes:
        geh_below_5: Share of hourly counts with GEH below 5.
        geh_largest: Largest GEH.
        within_2_sigma: Criterion I of FHWA, see `Criteria`.
        within_1_sigma: Criterion II of FHWA.
        absolute_error: Criterion III of FHWA.
        systematic_error: Criterion IV of FHWA.
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
    """Saturation headway of the data: the only number of a `CriteriaRow` that needs no model.

    Attributes:
        saturation_headway_s: Mean gap of queued vehicles from the fourth on, s.
    """

    saturation_headway_s: float | None


@dataclass(frozen=True)
class EngineeringCriteria:
    """Usual criteria of traffic engineers, before and after; for information only.

    Attributes:
        before: Criteria of the scenario as it is.
        after: Criteria of the corrected model.
        measured: Saturation headway of the data.
    """

    before: CriteriaRow
    after: CriteriaRow
    measured: MeasuredHeadway


@dataclass(frozen=True)
class TravelTimes:
    """Mean simulated travel times of the measured days; None if no vehicle has one.

    Attributes:
        before_s: Mean travel time in the scenario as it is, s.
        after_s: Mean travel time in the corrected model, s.
    """

    before_s: float | None
    after_s: float | None


@dataclass(frozen=True)
class Sides:
    """A number of traffic on the held-out periods; None where too few vehicles tell.

    Attributes:
        measured: The data.
        before: The scenario as it is.
        after: The corrected model.
    """

    measured: float | None
    before: float | None
    after: float | None


@dataclass(frozen=True)
class ApproachRow:
    """Capacity, queue and delay of one approach on the held-out periods.

    Attributes:
        tls: SUMO id of the traffic light.
        approach: SUMO id of the edge.
        capacity: Saturation flow, vehicles per hour of green and lane.
        queue: Vehicles held back between the detectors when green begins, all lanes together.
        delay: Time between the detectors beyond that at the speed limit, s per vehicle.
    """

    tls: str
    approach: str
    capacity: Sides
    queue: Sides
    delay: Sides


@dataclass(frozen=True)
class TrafficCheck:
    """Judgement of a correction on the held-out periods, if possible by measures no fit uses.

    Attributes:
        measure: The measures: ``travel time and queue``, else ``travel times of probes``, else
            ``speed and occupancy`` of intervals, else ``service counts`` at stop and exit
            detectors, else ``counts upstream``. If measured arrivals are given and all effects are
            of demand, counts alone.
        error_before: Sum of the relative errors of the scenario as it is.
        error_after: Sum of the relative errors of the corrected model.
        noise: Standard error of their difference.
        better: True if the correction lowers the error by more than 1.645 times the noise, and to
            at most 1.
        days: Number of simulated days, the same of both models; None if that is not known.
    """

    measure: str
    error_before: float
    error_after: float
    noise: float
    better: bool
    days: int | None = None

    @property
    def undecided(self) -> bool:
        """True if the error falls, but by no more than chance could do: the data are too few."""
        return not self.better and self.error_after < min(self.error_before, 1.0)

    @property
    def days_in_words(self) -> str:
        """The number of days behind a noun, as in " (16 simulated days)"; "" if not known."""
        return "" if self.days is None else f" ({counted(self.days, 'simulated day')})"


@dataclass(frozen=True)
class Pattern:
    """A set of vehicles for which the model is wrong by the same share, see `patterns`.

    Attributes:
        quantity: ``discharge``, ``free speed`` or ``count``.
        place: SUMO id of an edge or a lane; None for all.
        movement: ``s`` straight, ``l`` left, ``r`` right: lanes of this movement alone; ``lane`` if
            `place` is a lane; ``exit`` if it is a lane of which the detectors behind an
            intersection differ, and that leads to another one; None for all lanes.
        detectors: Kind of detectors that differ; None for all.
        vehicles: First and last position in the queue; None for no limit.
        green_s: Least and largest age of green, s; None for no limit.
        window: Begin and end on the scenario's clock, s; None for all of the time.
        long_vehicles: True if only long vehicles differ.
        change: Measured over simulated, minus 1.
        error: Standard error of `change`.
        heldout_change: The same on the held-out periods; None without any.
        p: Chance of such a pattern under the model.
    """

    quantity: str
    place: str | None
    movement: str | None
    detectors: str | None
    vehicles: tuple[float | None, float | None] | None
    green_s: tuple[float | None, float | None] | None
    window: tuple[float, float] | None
    long_vehicles: bool
    change: float
    error: float
    heldout_change: float | None
    p: float


@dataclass(frozen=True)
class Tables:
    """Both models side by side.

    Attributes:
        statistics: Rows for the statistics of the network.
        lanes: Rows for the lanes with detectors.
        criteria: Usual criteria of traffic engineers.
        travel_time: Mean simulated travel times.
        approaches: Rows for the approaches, in terms of traffic.
    """

    statistics: tuple[StatisticRow, ...] = ()
    lanes: tuple[LaneRow, ...] = ()
    criteria: EngineeringCriteria | None = None
    travel_time: TravelTimes | None = None
    approaches: tuple[ApproachRow, ...] = ()


@dataclass(frozen=True)
class DetectionLimit:
    """Strength of an effect from which on the data would show it, on one side of the usual value.

    Attributes:
        name: Name of the effect.
        parameter: Name of its number.
        unit: Unit of the numbers, "" for a pure one.
        usual: Value in the scenario.
        hidden: Strongest value found that would not show; `usual` if the weakest one tried would.
        shown: Weakest value found that would show; None if the farthest one would not.
    """

    name: str
    parameter: str
    unit: str
    usual: float
    hidden: float
    shown: float | None


@dataclass(frozen=True)
class Splits:
    """Ids of the measured periods.

    Attributes:
        fit: Ids of the periods that models were fitted to.
        heldout: Ids of the held-out periods.
    """

    fit: tuple[str, ...]
    heldout: tuple[str, ...]


@dataclass(frozen=True)
class TravelTimeEstimate:
    """A mean travel time with its 95 % interval.

    Attributes:
        mean: The mean, s.
        low: Lower end of the interval, s; None for a single episode.
        high: End of the interval, s; None for a single episode.
    """

    mean: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class PolicyGap:
    """Travel times of one policy: before the correction, after it, and in the real domain.

    Attributes:
        sim: Travel time in the scenario as it is.
        corrected: Travel time in the corrected scenario.
        real: Travel time in the real domain.
        before: Absolute difference of the means of `sim` and `real`, s.
        after: Absolute difference of the means of `corrected` and `real`, s.
        shrink: Share of the gap that is gone; None if there is no visible gap before.
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
        schema: Name and version of the file's form.
        scenario: Id of the scenario.
        seed: Root seed of the simulated days.
        alpha: Level of the tests.
        budget_h: Simulated hours after which no simulation was begun.
        budget_s: Wall time after which no simulation was begun, s; None if it was not limited.
        left_out: Names of effects that the user excluded.
        ruled_out: Names of effects that the data cannot show.
        findings: Remarks from the check of the data.
        periods: Ids of the measured periods.
        verified_on_fitted_periods: True if no period was held out.
        hashes: SHA-256 of the scenario and of the data.
        versions: Versions of the software.
        verdict: One of the values of `Verdict`.
        sentence: The verdict as a sentence.
        effects: The named effects.
        where: Places where the scenario as it is disagrees with the fitted periods.
        left: Places where the selected model still disagrees with the fitted periods.
        alternatives: Other sets of effects that were simulated, best first.
        best: The selected model; None if it has no effects.
        heldout: The test on the held-out periods; None if nothing could be compared.
        evidence: Chances on the fitted periods; None if nothing could be compared.
        statistics: Statistics of the network, before and after the correction.
        lanes: Lanes with detectors, before and after.
        criteria: Usual criteria of traffic engineers, before and after.
        travel_time: Mean simulated travel times, before and after.
        approaches: Capacity, queue and delay of each approach, before and after.
        traffic_check: Judgement of the correction on the held-out periods; None if there is
            nothing to judge, or nothing to judge by.
        patterns: Patterns in what is left where the effects do not explain the data.
        unnamed: Correction of service and demand that imitates these patterns, whatever their
            cause; empty unless it was asked for and brings held-out traffic nearer.
        next_measurement: A measurement that would separate the rivals, or show the missing effect.
        complete: True if the diagnosis ended by itself, False if the budget ended it.
        untried: Names of effects that were not examined for lack of time.
        corrected: Name of the folder of the corrected scenario; None if nothing is corrected.
        not_corrected: Reason why effects of the search are in no corrected scenario; None without
            one.
        policy_gap: Travel times by policy; None until `ugat-marl policy-gap` has measured them.
        ended_by: Setting of the budget that ended the diagnosis; None if none did.
        limits: Detection limits of effects on the whole network; empty unless they were asked for
            and nothing but chance is left.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    schema: Literal["ugat-marl/diagnosis/7"]
    scenario: str
    seed: int
    alpha: float
    budget_h: float | None
    budget_s: float | None
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
    alternatives: tuple[Alternative, ...]
    best: Explanation | None
    heldout: HeldOut | None
    evidence: FitEvidence | None
    statistics: tuple[StatisticRow, ...]
    lanes: tuple[LaneRow, ...]
    criteria: EngineeringCriteria | None
    travel_time: TravelTimes | None
    approaches: tuple[ApproachRow, ...]
    traffic_check: TrafficCheck | None
    patterns: tuple[Pattern, ...]
    unnamed: tuple[NamedEffect, ...]
    next_measurement: str | None
    complete: bool
    untried: tuple[str, ...]
    corrected: str | None
    not_corrected: str | None
    policy_gap: dict[str, PolicyGap] | None = None
    ended_by: EndedBudget | None = None
    limits: tuple[DetectionLimit, ...] = ()

    @property
    def budget_in_words(self) -> str:
        """The budget with its unit: simulated hours, seconds, or both."""
        return " or ".join(self._budgets.values()) or "no limit"

    @property
    def ended_budget_in_words(self) -> str:
        """The budget that ended, with its option; all of it if that is not known."""
        if self.ended_by not in self._budgets:
            return self.budget_in_words
        return f"{self._budgets[self.ended_by]} (--{self.ended_by.replace('_', '-')})"

    @property
    def _budgets(self) -> dict[EndedBudget, str]:
        budgets: dict[EndedBudget, str] = {}
        if self.budget_h is not None:
            budgets["budget_h"] = f"{self.budget_h:g} simulated hours"
        if self.budget_s is not None:
            budgets["budget_s"] = f"{self.budget_s:g} s"
        return budgets

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON: numbers with nine digits, None for NaN and infinity."""
        return _plain(asdict(self))

    @classmethod
    def from_json(cls, content: Any) -> Self:
        """Make the record from the result of `to_json`.

        Raises:
            ValueError: A key is missing or unknown, a value has another type, or a number is not
                finite.
        """
        return _adapter(cls).validate_json(json.dumps(content, allow_nan=False))

    def write(self, directory: Path) -> None:
        """Write the file into a directory atomically."""
        text = json.dumps(self.to_json(), indent=1, sort_keys=True, allow_nan=False)
        write_whole(directory / FILE, text + "\n")

    @classmethod
    def read(cls, directory: Path) -> Self:
        """Read the file in a directory.

        Raises:
            OptionError: There is no such file, or it is no JSON.
            ValueError: The file is not a diagnosis of this version.
        """
        return cls.from_json(read_json(directory / FILE, OptionError))


@cache
def _adapter(record: type[Any]) -> TypeAdapter[Any]:
    return TypeAdapter(record)


def _plain(value: Any) -> Any:
    """Return the value with numbers of nine digits, and None for numbers that JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, bool) or value is None or isinstance(value, str | int):
        return value
    number = float(value)
    return float(f"{number:.9g}") if number == number and abs(number) < 1e300 else None
