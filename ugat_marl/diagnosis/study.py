"""Inputs of one diagnosis: the scenario, the data, the simulated days and the budget."""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import polars as pl

from ugat_marl.data import Finding, MeasuredData, is_actuated, recording_holes
from ugat_marl.diagnosis.compared_detectors import compared_detectors
from ugat_marl.diagnosis.demand_variation import measured_variation, variation_findings
from ugat_marl.diagnosis.engine import Budget, Engine, default_cache
from ugat_marl.diagnosis.features import (
    COUNT_FEATURES,
    DetectorLayout,
    Greens,
    Tally,
    bins_in,
    tally,
)
from ugat_marl.diagnosis.fit import Fitter
from ugat_marl.diagnosis.hypotheses import Hypothesis, global_hypotheses, library
from ugat_marl.diagnosis.intervals import (
    bins_together,
    counts_tally,
    implausible,
    reports_of_counts,
    reports_of_passages,
    seeming_lengths,
    usual_length,
    without_gaps,
    without_occupancies,
)
from ugat_marl.diagnosis.measurement import DetectorError, Measurement
from ugat_marl.diagnosis.patterns import QUANTITIES, cells_of, patterns
from ugat_marl.diagnosis.places import PlaceFinder, Routes
from ugat_marl.diagnosis.records import Fitted, Pattern, Tested
from ugat_marl.diagnosis.replay import Replay
from ugat_marl.diagnosis.residual import Directed, Directions, Null
from ugat_marl.diagnosis.select import MOVES_OF_A_VALUE, Selector
from ugat_marl.diagnosis.sightings import Sightings, together
from ugat_marl.diagnosis.statistics import Array, Distance, Pools, Reference, change_between, sum_of
from ugat_marl.diagnosis.supplementary_data import TRAVEL_TIME, SupplementaryData
from ugat_marl.diagnosis.thresholds import (
    DAYS_OF_A_STRETCH,
    EFFORTS,
    LEAST_EFFORT,
    Effort,
    Thresholds,
)
from ugat_marl.diagnosis.unmeasured import Unmeasured, without_holes
from ugat_marl.effects import DetectorPulse, Effect, detectors_at
from ugat_marl.errors import MeasuredDataError, OptionError, counted, require_kinds
from ugat_marl.parallel import Workers
from ugat_marl.progress import Reporter, Share
from ugat_marl.scenarios import (
    Network,
    Period,
    Scenario,
    SpeedPoint,
)

SAME_TIME_S = 0.5
"""Difference of the begins or ends of periods that are meant to be the same, s."""


@dataclass(frozen=True)
class DiagnosisConfig:
    """Options of a diagnosis.

    Attributes:
        budget_h: Simulated hours after which no further simulation is begun. Days from the cache
            do not count, nor does the warm-up before a period.
        budget_s: Wall time after which no further simulation is begun either, s; None for no limit.
        alpha: Level of the tests: chance of naming an effect where there is none.
        seed: Root seed of the simulated days.
        leave_out: Names of effects that are not examined.
        cache: Folder of cached days; None for the user's cache folder.
        workers: Simulations at a time, None for one per core; or an executor.
        effort: Numbers of simulated days; None for those that suit the size of the network. Periods
            at several times of day need at least `DAYS_OF_A_STRETCH` for each time.
        correct_anyway: Write ``corrected`` also if its effects explain only a part, or bring
            held-out traffic no nearer.
        unnamed: Try a correction of service and demand that has no name, where the named effects do
            not explain the data.
        limits: Find from which strength on the data would show effects that are not named.
        thresholds: Numbers of the method.
    """

    budget_h: float = 1500.0
    budget_s: float | None = None
    alpha: float = 0.05
    seed: int = 0
    leave_out: tuple[str, ...] = ()
    cache: Path | None = None
    workers: Workers = None
    effort: Effort | None = None
    correct_anyway: bool = False
    unnamed: bool = False
    limits: bool = False
    thresholds: Thresholds = field(default_factory=Thresholds)

    def __post_init__(self) -> None:
        require_kinds(self, "diagnosis")
        if self.cache is not None:
            object.__setattr__(self, "cache", Path(self.cache))
        for name in ("budget_h", "budget_s"):
            budget = getattr(self, name)
            if budget is not None and not budget > 0:
                raise OptionError(f"{name} = {budget:g} must be above 0")
        if not 0 < self.alpha < 0.5:
            raise OptionError(f"alpha = {self.alpha:g} must be between 0 and 0.5")
        if self.seed < 0:
            raise OptionError(f"seed = {self.seed} must not be negative")
        library(self.leave_out)

    def budget(self) -> Budget:
        """Return the budget of a diagnosis that begins now."""
        deadline = None if self.budget_s is None else time.monotonic() + self.budget_s
        return Budget(self.budget_h, deadline)


@dataclass(frozen=True, eq=False)
class Study:
    """State that all stages share.

    Attributes:
        scenario: The scenario as it is.
        network: The network of the scenario.
        measured: The measured data of the street, without times that were not recorded.
        config: Options of the diagnosis.
        layout: Measured lanes, with their signals and detectors.
        engine: Simulator of days.
        pools: Pools of lanes: network, intersections, lanes.
        allowed: Names of the effects that are examined.
        hypotheses: Hypotheses about the whole network.
        effort: Numbers of simulated days.
        fit: Tallies of the periods that models are fitted to.
        heldout: Tallies of the held-out periods; `fit` again if no period is held out.
        other_days: Simulator of days that keep the model's own arrivals; None if the signals did
            not follow the traffic, since `engine` does the same then.
        ruled_out: Names of the effects that the data cannot show.
        detection: Errors of measurement, which all simulated days have.
        holes: Times in which nothing was recorded, begin and end in s; left out of them too.
        day_to_day: Variation of demand from day to day, which they have too, as a share.
        data_hash: Hash of the data as they were given.
    """

    scenario: Scenario
    network: Network
    measured: MeasuredData
    config: DiagnosisConfig
    layout: DetectorLayout
    engine: Engine
    pools: Pools
    allowed: frozenset[str]
    hypotheses: tuple[Hypothesis, ...]
    effort: Effort
    fit: tuple[Tally, ...]
    heldout: tuple[Tally, ...]
    other_days: Engine | None = None
    ruled_out: frozenset[str] = field(default=frozenset())
    detection: tuple[DetectorError, ...] = ()
    holes: tuple[tuple[float, float], ...] = ()
    day_to_day: float = 0.0
    data_hash: str = ""
    _doubts: dict[tuple[Effect, ...], Mapping[str, Array]] = field(default_factory=dict, init=False)

    @property
    def errors_of_detectors(self) -> tuple[Effect, ...]:
        """The errors of `detection`."""
        return tuple(error.effect for error in self.detection)

    @property
    def all_days(self) -> tuple[Tally, ...]:
        """Tallies of every measured period, each once."""
        return self.fit + self.heldout if self.measured.of("heldout") else self.fit

    @classmethod
    def of(cls, scenario: Scenario, measured: MeasuredData, config: DiagnosisConfig) -> Study:
        """Prepare a diagnosis; nothing is simulated yet.

        Raises:
            MeasuredDataError: The data hold nothing to compare, or no vehicle of the scenario
                reaches a measured lane.
            OptionError: The effort has too few days for the stretches of the day.
        """
        network, thresholds = Network.read(scenario), config.thresholds
        detectors, findings = compared_detectors(scenario, measured, thresholds)
        measured, data_hash = _noted(measured, findings), measured.hash
        given = measured.periods
        measured, holes = _without_holes(measured)
        layout = DetectorLayout.of(network, detectors, scenario.settings.begin_s)
        ruled_out = frozenset(name for finding in measured.findings for name in finding.rules_out)
        allowed = library(config.leave_out) - ruled_out
        periods = _fitted_periods(measured, given, thresholds)
        answering = _answering(measured, layout.intersections)
        effort = effort_for(len(layout.intersections), measured.periods, config.effort)
        supplementary = SupplementaryData.of(measured)
        fit = _tallies(layout, measured, periods, thresholds, supplementary)
        heldout = _tallies(layout, measured, measured.of("heldout"), thresholds, supplementary)
        variation = measured_variation(layout, measured, (fit, heldout), thresholds)
        # Single vehicles that nobody saw are a finding; counts that nobody made are none.
        summed = None if measured.has_events else sum_of((*fit, *heldout)).sums[..., 1:] > 0
        measured = _noted(measured, variation_findings(variation, len(measured.periods)))

        simulating = functools.partial(
            _engine,
            scenario,
            network,
            layout,
            measured,
            config,
            budget=config.budget(),
            day_to_day=variation,
            supplementary=supplementary,
            unmeasured=Unmeasured.of(_examined(measured), holes, summed),
        )
        return cls(
            scenario=scenario,
            network=network,
            measured=measured,
            config=config,
            layout=layout,
            engine=simulating(answering=answering, base_days=effort.base),
            pools=_pools(layout, measured, supplementary, thresholds),
            allowed=allowed,
            hypotheses=tuple(global_hypotheses(scenario, allowed)),
            effort=effort,
            fit=fit,
            heldout=heldout or fit,
            other_days=simulating(answering=False, base_days=0) if answering else None,
            ruled_out=ruled_out,
            holes=holes,
            day_to_day=variation,
            data_hash=data_hash,
        )

    @property
    def speeds(self) -> bool:
        """True if speeds were measured."""
        return self.measured.has_speeds

    def work(self) -> dict[str, Share]:
        """Return the work of the tasks of a whole diagnosis, weighed in simulated days.

        The length of a search is not known before. It is expected to end in its second round; a
        search that ends sooner leaves the rest of the bar.
        """
        effort, limits = self.effort, self.config.thresholds
        moves = limits.steps * (1 + limits.candidates_fitted)
        strengths = sum(len(hypothesis.levels) for hypothesis in self.hypotheses)
        lanes = min(len(self.layout.lanes), limits.most_lanes)
        test = limits.settling_days + effort.test + MOVES_OF_A_VALUE * effort.fit
        limit_days = limits.days_of_a_limit(len(self.fit))
        return {
            "the detectors": Share(limits.measurement_days),
            "the scenario as it is": Share(effort.base),
            "the same with": Share(limits.doubt_days if self.other_days is not None else 0),
            "round 1: library": Share(strengths, effort.bank),
            "round 1: places": Share(lanes, effort.bank),
            "round 1: candidates": Share(2 * sum(limits.candidates), effort.fit),
            "fitting": Share(2 * limits.candidates_fitted, moves * effort.fit),
            "closer fits": Share(2, 2 * limits.steps_of_the_best * effort.fit),
            "is what is left chance": Share(2 * test),
            "how certain the values are": Share(2 * len(limits.straightness_moves), effort.fit),
            "round 2": Share(2 * len(self.hypotheses), effort.bank),
            "patterns": Share(limits.pattern_days),
            "unnamed": Share(limits.settling_days if self.config.unnamed else 0),
            "without single": Share(2, limits.steps_without * effort.fit + limits.settling_days),
            "what the data would show": Share(
                strengths if self.config.limits else 0, (1 + limits.limit_halvings) * limit_days
            ),
        }

    def detectors_as_they_are(self, reporter: Reporter) -> Study:
        """Find errors of measurement from what detectors say of single vehicles.

        All days of the returned study are seen by detectors with these errors. See `measurement`.

        Raises:
            OutOfTime: The budget does not suffice for the days to compare with.
        """
        thresholds = self.config.thresholds
        if not thresholds.measurement_days:
            return self
        if not self.measured.has_events:
            return self._occupancies_as_they_are(reporter)
        measurement = self._measurement((), reporter)
        measured = self.measured
        if measurement.too_coarse:
            measured = _said(measured, [_of_coarse_stamps(measurement.grain_s)], reporter)
        if (points := measurement.contradicted_point()) is not None:
            measured = _said(measured, [_of_speed_points(*points)], reporter)
        errors = measurement.errors(self.config.leave_out)
        if self.other_days is not None and not self.speeds and self._pulses_upstream(errors):
            finding = Finding(
                "signals follow the traffic, and advance detectors report pulses without speeds: "
                "a vehicle that queued on one seems to arrive when it moves on, so queues that "
                "reach these detectors come out shorter in the simulation"
            )
            measured = _said(measured, [finding], reporter)
        return replace(self._detecting(errors) if errors else self, measured=measured)

    def _pulses_upstream(self, errors: Sequence[DetectorError]) -> bool:
        """Return True if advance detectors report pulses in place of presence."""
        upstream = {item.id for item in self.layout.detectors if item.kind == "advance"}
        return any(
            upstream & detectors_at(error.effect.place, self.layout.detectors, error.effect.name)
            for error in errors
            if isinstance(error.effect, DetectorPulse)
        )

    def detectors_beside(self, effects: tuple[Effect, ...], reporter: Reporter) -> Study | None:
        """Find errors of measurement again, on days with the effects that a search has found.

        Errors show where vehicles accelerate, so that drivers who are slower than those of the
        scenario hide them: speeds at both ends of a passage then differ less.

        Args:
            effects: The effects, with their values.
            reporter: Display of progress.

        Returns:
            The study with these errors; None if the kinds and places of errors are known.

        Raises:
            OutOfTime: The budget does not suffice for the days to compare with.
        """
        if not self.config.thresholds.measurement_days or not self.measured.has_events:
            return None
        errors = self._measurement(effects, reporter).errors(self.config.leave_out)
        known = {error.kind_and_place for error in self.detection}
        if {error.kind_and_place for error in errors} == known:
            return None
        return self._detecting(errors)

    def _measurement(self, effects: tuple[Effect, ...], reporter: Reporter) -> Measurement:
        """Compare single vehicles of the fitted periods with days of correct detectors."""
        thresholds = self.config.thresholds
        numbers = range(min(thresholds.measurement_days, self.effort.base))
        with reporter.task("the detectors", len(numbers)) as advance:
            days = self.engine.detecting(()).sightings(effects, numbers, advance)
        seen = [
            Sightings.of(self.layout, period, self.layout.greens(period), thresholds)
            for period in self.measured.of("fit")
        ]
        return Measurement(self.layout.detectors, together(seen), together(days), thresholds)

    def _detecting(self, errors: tuple[DetectorError, ...]) -> Study:
        """Return a study whose simulated days are all seen by detectors with these errors."""
        effects = tuple(error.effect for error in errors)
        other = None if self.other_days is None else self.other_days.detecting(effects)
        engine = self.engine.detecting(effects)
        return replace(self, engine=engine, other_days=other, detection=errors)

    def _occupancies_as_they_are(self, reporter: Reporter) -> Study:
        """Set occupancies aside that do not fit counts and speeds, see `intervals.implausible`.

        Raises:
            OutOfTime: The budget does not suffice for the days to compare with.
        """
        counts, thresholds = self.measured.counts, self.config.thresholds
        length_s = usual_length(counts)
        if counts is None or length_s is None:
            return self
        fitted = counts.filter(pl.col("period_id").is_in([p.id for p in self.measured.of("fit")]))
        here = seeming_lengths(reports_of_counts(self.layout, fitted), thresholds)
        if not any(vehicles for _, vehicles in here.values()):
            return self  # no occupancies, or no speeds

        def lengths(period: Period, _: Sequence[Greens]) -> dict[str, Array]:
            reports = reports_of_passages(self.layout, period, length_s)
            return seeming_lengths(reports, thresholds)

        numbers = range(min(thresholds.measurement_days, self.effort.base))
        name = f"lengths up to {thresholds.free_occupancy:g}"
        with reporter.task("the detectors", len(numbers)) as advance:
            days = self.engine.reduced((), numbers, name, lengths, advance)
        there = {kind: sum((day[kind] for day in days), np.zeros(2)) for kind in here}
        wrong = implausible(here, there, thresholds)
        if not wrong:
            return self
        findings = [_of_length(kind, *both) for kind, both in wrong.items()]
        fit, heldout = (
            tuple(without_occupancies(day, wrong) for day in days)
            for days in (self.fit, self.heldout)
        )
        noted = _said(self.measured, findings, reporter)
        return replace(self, measured=noted, fit=fit, heldout=heldout)

    def base(self, reporter: Reporter) -> Tested:
        """Simulate the scenario as it is, and test if it could have made the data.

        Raises:
            OutOfTime: The budget does not suffice for these days.
            MeasuredDataError: The scenario's vehicles do not reach the measured lanes.
        """
        with reporter.task("the scenario as it is", self.effort.base) as advance:
            days = self.engine.replicates([], range(self.effort.base), advance)
        if self.other_days is not None:
            numbers = range(min(self.config.thresholds.doubt_days, self.effort.base))
            with reporter.task("the same with other vehicles", len(numbers)) as advance:
                self.other_days.replicates([], numbers, advance)  # `doubt` takes them from memory
        aside = self.engine.ordinary_days.set_aside
        known = {number: day.tally for number, day in enumerate(days) if number not in aside}
        tallies = list(known.values())
        reference = Reference(self.pools, tallies, speeds=self.speeds, doubt=self.doubt())
        counted = len(COUNT_FEATURES)
        counts = sum(float(day.bins[:counted].sum()) for day in tallies) / len(tallies)
        if counts < 1.0:
            raise MeasuredDataError(
                f"scenario {self.scenario.id!r}: in the simulation hardly a vehicle reaches the "
                "measured lanes; check lane_id in detectors.csv, and the demand of the scenario"
            )
        distance = reference.distance(self.fit)
        model = Fitted((), known, reference, distance, distance.total)
        residual = self.null(tallies, self.fit).test(self.fit)
        return Tested(model, residual, np.empty(0), {})

    def with_empty_start_finding(self, base: Tested, reporter: Reporter) -> Study:
        """Note it if simulated days begin on an empty network, and those of the street do not.

        Args:
            base: The scenario as it is.
            reporter: Reporter of the note.
        """
        thresholds, begin_s = self.config.thresholds, self.scenario.settings.begin_s
        early = [p for p in self.measured.of("fit") if p.begin_s < begin_s + thresholds.bin_s]
        if not early or not self.measured.has_events:
            return self
        windows = {period.window for period in early}

        def first_and_all(days: Sequence[Tally]) -> Array:
            own = [
                day.bins[: len(COUNT_FEATURES)].sum(axis=(0, 1))
                for day in days
                if day.window in windows
            ]
            return np.array([(bins[0], bins.sum()) for bins in own])

        here, there = first_and_all(self.fit), first_and_all(base.model.tallies)
        if len(there) < 2:
            return self
        usual = there[:, 0] * here[:, 1].mean() / there[:, 1].mean()
        more = float(here[:, 0].mean() - usual.mean())
        error = float(usual.std(ddof=1)) * math.sqrt(1 / len(here) + 1 / len(there))
        if more < thresholds.fuller * max(error, 1.0):
            return self
        finding = Finding(
            f"simulated days begin empty with period {early[0].id!r}, the street does not: it has "
            f"{more:.0f} passages more in the first {thresholds.bin_s / 60:g} minutes. "
            "Begin the scenario ten minutes earlier (begin_s), with its vehicles"
        )
        return replace(self, measured=_said(self.measured, [finding], reporter))

    def with_findings_on_travel_times(self, base: Tested, reporter: Reporter) -> Study:
        """Note the travel times that cannot be compared."""
        probes = [day.supplementary.get(TRAVEL_TIME) for day in self.fit]
        if any(block is None for block in probes):
            return self
        measured, simulated = (
            np.mean([day.supplementary[TRAVEL_TIME][:, 0, 1] for day in days], axis=0)
            for days in (self.fit, base.model.tallies)
        )
        few = measured < self.config.thresholds.least_measured
        nobody = ~few & (simulated == 0)
        texts = [
            f"travel_times: {int(ways.sum())} of {counted(len(ways), 'pair')} of places {what}, "
            f"and not compared; {way_out}"
            for ways, what, way_out in (
                (few, "with less than a vehicle a period", "give the same places in each row"),
                (
                    nobody,
                    "that no simulated vehicle passes in this order",
                    "are from_edge and to_edge exchanged, or is the way in no route?",
                ),
            )
            if ways.any()
        ]
        findings = [Finding(text) for text in texts]
        return replace(self, measured=_said(self.measured, findings, reporter))

    @property
    def shows_patterns(self) -> bool:
        """True if single vehicles were detected, always at one time of day."""
        windows = {period.window for period in self.measured.periods}
        return self.measured.has_events and len(windows) == 1

    def left_over(self, model: Tested, reporter: Reporter) -> tuple[Pattern, ...]:
        """Find patterns in what a model leaves; none if the data cannot show any.

        Raises:
            OutOfTime: The budget does not suffice for days of the model to compare with.
        """
        fit, heldout = self.measured.of("fit"), self.measured.of("heldout")
        if not self.shows_patterns:
            return ()
        thresholds, effects = self.config.thresholds, model.model.effects

        def cells(period: Period, greens: Sequence[Greens]) -> dict[str, Array]:
            return cells_of(self.layout, period, greens, thresholds)

        # By periods, so that every other day has some of each, as in `by_turns`.
        numbers = sorted(self.engine.first(thresholds.pattern_days), key=self.engine.place_of)
        with reporter.task("patterns in what is left", len(numbers)) as advance:
            simulated = self.engine.reduced(
                effects,
                numbers,
                f"cells of {thresholds.pattern_bin_s:g} s, {thresholds.most_pattern_bins}",
                cells,
                advance,
            )
        # Under signals that follow the traffic, simulated counts are the measured ones.
        quantities = QUANTITIES if self.other_days is None else QUANTITIES[:-1]
        return patterns(
            self.layout,
            [cells(period, self.layout.greens(period)) for period in fit],
            [cells(period, self.layout.greens(period)) for period in heldout],
            simulated,
            quantities,
            fit[0].window,
            thresholds,
            self.config.alpha,
        )

    def null(
        self,
        tallies: Sequence[Tally],
        data: Sequence[Tally],
        directions: Directions | None = None,
        effects: tuple[Effect, ...] = (),
    ) -> Null:
        """Make the distribution of chance from a model's own days.

        Only features and bins that the data hold too are used of these days.

        Args:
            tallies: Tallies of the model's days.
            data: Tallies of the periods that are to be tested.
            directions: Changes of the statistics under single effects; None to test without them.
            effects: Effects of the model.

        Raises:
            OutOfTime: The budget does not suffice for the days that `doubt` needs.
        """
        total = sum_of(data)
        supplied = {name: sums[..., 1:] > 0 for name, sums in total.supplementary.items()}
        counted = total.sums[..., 1:] > 0
        enough = self.pools.pool_all(data)["time"][..., 1] >= self.pools.least_weight("time") * len(
            data
        )
        groups = enough.reshape(*total.bins.shape[:2], -1)
        known = np.repeat(groups, self.pools.together, axis=-1)
        width = min(known.shape[-1], *(day.bins.shape[-1] for day in tallies))
        seen = [
            Tally(
                day.sums * counted,
                day.bins[..., :width] * known[..., :width],
                day.days,
                supplementary={
                    name: sums * supplied[name] for name, sums in day.supplementary.items()
                },
                window=day.window,
                period=day.period,
            )
            for day in tallies
        ]

        def directed(reference: Reference) -> Directed:
            filters = {} if directions is None else directions.filters(reference, data)

            def statistics(distance: Distance) -> dict[str, float]:
                values = self.place_finder.directed(distance)
                return values | {name: matched(distance) for name, matched in filters.items()}

            return statistics

        return Null(
            self.pools,
            seen,
            len(data),
            speeds=self.speeds,
            directed=directed,
            doubt=self.doubt(effects),
        )

    def test_days(self, model: Fitted) -> tuple[Tally, ...]:
        """Return the days with which a model is tested; those of the scenario as it is, all.

        Raises:
            OutOfTime: The budget does not suffice.
        """
        if not model.members:
            return model.tallies
        return self.engine.test_days(model.effects, self.effort.test)

    def doubt(self, effects: tuple[Effect, ...] = ()) -> Mapping[str, Array] | None:
        """Return variances for errors of arrivals and of detectors that stay unknown, by block.

        Each model has its own, since they depend on the length of queues.

        Args:
            effects: Effects of the model; none for the scenario as it is.

        Returns:
            None if no measured arrivals are used and no detector errs by an uncertain number.

        Raises:
            OutOfTime: The budget does not suffice.
        """
        if effects not in self._doubts:
            doubts = [*self._doubts_of_arrivals(effects), *self._doubts_of_detectors(effects)]
            self._doubts[effects] = {
                name: np.sum([doubt[name] for doubt in doubts], axis=0)
                for name in (doubts[0] if doubts else ())
            }
        return self._doubts[effects] or None

    def _doubts_of_arrivals(self, effects: tuple[Effect, ...]) -> Iterator[dict[str, Array]]:
        """Yield variances for errors of the measured arrivals, if these are used.

        Detectors see arrivals near the traffic lights, not at the end of queues. So arrivals in
        long queues are known only roughly. The error is estimated by days with the model's own
        arrivals.
        """
        if self.other_days is None:
            return
        numbers = range(min(self.config.thresholds.doubt_days, self.effort.base))
        replayed = self.engine.ordinary(effects, numbers)
        other = self.other_days.ordinary(effects, numbers)
        both = [number for number in replayed if number in other]
        share = self.config.thresholds.arrivals_error_share
        yield self._squared_change(
            [other[number].tally for number in both],
            [replayed[number].tally for number in both],
            share**2,
        )

    def _doubts_of_detectors(self, effects: tuple[Effect, ...]) -> Iterator[dict[str, Array]]:
        """Yield the variance by each error of detectors: that between the ends of its interval.

        A loop a metre farther on may lie under a standing vehicle, and not between two. So single
        statistics change by far more than by chance within the interval of a position.
        """
        ends = [(error, end) for error in self.detection for end in error.ends]
        if not ends:
            return
        numbers = self.engine.first(min(self.config.thresholds.measurement_days, self.effort.base))
        known = self.engine.ordinary(effects, numbers)
        for error, end in ends:
            errors = [end if other is error else other.effect for other in self.detection]
            days = self.engine.detecting(errors).replicates(effects, list(known))
            yield self._squared_change(
                [day.tally for day in days], [day.tally for day in known.values()], 0.5
            )

    def _squared_change(
        self, after: Sequence[Tally], before: Sequence[Tally], share: float
    ) -> dict[str, Array]:
        """Return a share of the squared change of the statistics between two models, by block."""
        apart, _ = change_between(self.pools, after, before)
        return {name: share * values**2 for name, values in apart.items()}

    @functools.cached_property
    def place_finder(self) -> PlaceFinder:
        """Finder of places and windows."""
        return PlaceFinder(
            self.layout,
            Routes.of(self.scenario, self.measured.of("fit")),
            self.allowed,
            self.config.thresholds,
            self.holes,
        )

    def fitter(self, base: Tested) -> Fitter:
        """Make the fitter of single models; see `selector` for the search."""
        return Fitter(
            self.engine,
            self.pools,
            base.model.reference,
            base.model.days,
            self.fit,
            days=self.effort.fit,
            speeds=self.speeds,
        )

    def selector(self, base: Tested, reporter: Reporter) -> Selector:
        """Make the search for sets of effects."""
        return Selector(
            self.fitter(base),
            self.place_finder,
            self.hypotheses,
            self.measured.of("fit"),
            self.effort,
            self.config.alpha,
            self.null,
            reporter,
        )


def _noted(measured: MeasuredData, findings: Sequence[Finding]) -> MeasuredData:
    return replace(measured, findings=(*measured.findings, *findings))


def _fitted_periods(
    measured: MeasuredData, given: Sequence[Period], thresholds: Thresholds
) -> tuple[Period, ...]:
    if not (periods := measured.of("fit")):
        raise MeasuredDataError("no period has the split 'fit'; there is nothing to fit")
    _refuse_lengths(given, measured.periods, thresholds)
    _refuse_near_windows(given, measured.periods, thresholds)
    return periods


def _said(measured: MeasuredData, findings: Sequence[Finding], reporter: Reporter) -> MeasuredData:
    """Say findings as notes, and return the data with them."""
    for finding in findings:
        reporter.say(f"note: {finding.text}")
    return _noted(measured, findings)


def _engine(
    scenario: Scenario,
    network: Network,
    layout: DetectorLayout,
    measured: MeasuredData,
    config: DiagnosisConfig,
    *,
    answering: bool,
    base_days: int,
    budget: Budget,
    day_to_day: float,
    supplementary: SupplementaryData | None,
    unmeasured: Unmeasured,
) -> Engine:
    """Return the simulator of days under the signals of the measured periods."""
    replay = Replay(
        scenario,
        network,
        layout.detectors,
        layout.owner,
        config.thresholds,
        answering=answering,
        day_to_day=day_to_day,
        followed=supplementary.followed if supplementary else (),
        watched=supplementary.lanes if supplementary else (),
    )
    return Engine(
        scenario,
        layout,
        replay,
        _examined(measured),
        config.seed,
        config.thresholds,
        budget=budget,
        unmeasured=unmeasured,
        cache=config.cache or default_cache(),
        workers=config.workers,
        base_days=base_days,
        interval_s=None if measured.has_events else usual_length(measured.counts),
        supplementary=supplementary,
    )


def _examined(measured: MeasuredData) -> list[Period]:
    return [*measured.of("fit"), *measured.of("heldout")]


def _without_holes(measured: MeasuredData) -> tuple[MeasuredData, tuple[tuple[float, float], ...]]:
    """Return the data without times that were not recorded, in common windows, and these times."""
    holes = recording_holes(measured.periods)
    kept = tuple(without_holes(period, holes) for period in measured.periods)
    return replace(measured, periods=_of_common_windows(kept)), holes


def _of_common_windows(periods: tuple[Period, ...]) -> tuple[Period, ...]:
    """Return the periods with one window for each time of day: what its periods have in common.

    Their begins and ends differ from those of the first one by at most `SAME_TIME_S`. Exactly equal
    windows are days of one time of day.
    """
    groups: list[list[tuple[float, float]]] = []
    for window in sorted({period.window for period in periods}):
        own = next((group for group in groups if _near(window, group[0], SAME_TIME_S)), None)
        if own is None:
            groups.append([window])
        else:
            own.append(window)
    common = {
        window: (max(begin for begin, _ in group), min(end for _, end in group))
        for group in groups
        for window in group
    }
    return tuple(
        replace(period, begin_s=common[period.window][0], end_s=common[period.window][1])
        for period in periods
    )


def _near(one: tuple[float, float], other: tuple[float, float], apart_s: float) -> bool:
    """Return True if begins and ends of two windows differ by at most `apart_s`."""
    return all(abs(a - b) <= apart_s for a, b in zip(one, other, strict=True))


def _refuse_near_windows(
    given: Sequence[Period], common: Sequence[Period], thresholds: Thresholds
) -> None:
    """Refuse overlapping periods of nearly one time of day: each would be a stretch of its own.

    Args:
        given: The periods as they were given.
        common: The same periods in common windows.
        thresholds: Numbers of the method.

    Raises:
        MeasuredDataError: Two windows differ by at most a bin of time, and by less than half of
            their length.
    """
    first = {period.window: number for number, period in reversed([*enumerate(common)])}
    for one, other in itertools.combinations(sorted(first), 2):
        if other[0] < sum(one) / 2.0 and _near(one, other, thresholds.bin_s):
            two = " and ".join(
                f"{period.id!r} from {period.begin_s} to {period.end_s} s"
                for period in (given[first[one]], given[first[other]])
            )
            raise MeasuredDataError(
                f"periods.csv: {two} are nearly the same time of day; give both the same begin_s "
                "and end_s"
            )


def _refuse_lengths(
    given: Sequence[Period], common: Sequence[Period], thresholds: Thresholds
) -> None:
    """Refuse periods of different lengths: their statistics are not of one kind.

    Args:
        given: The periods as they were given.
        common: The same periods in common windows.
        thresholds: Numbers of the method.

    Raises:
        MeasuredDataError: The periods have different lengths, or different numbers of bins.
    """
    lengths = {period.id: period.length_s for period in given}
    if max(lengths.values()) - min(lengths.values()) <= 2.0 * SAME_TIME_S:  # at both ends
        lengths = {period.id: period.length_s for period in common}
        if len({bins_in(length, thresholds) for length in lengths.values()}) == 1:
            return
    shortest, longest = min(lengths, key=lengths.__getitem__), max(lengths, key=lengths.__getitem__)
    raise MeasuredDataError(
        f"periods.csv: {longest!r} is {lengths[longest]:g} s long, and {shortest!r} only "
        f"{lengths[shortest]:g} s; a diagnosis needs periods of one length, so cut the longer "
        "ones in begin_s and end_s"
    )


def _answering(measured: MeasuredData, lights: Sequence[str]) -> bool:
    """Return True if signals followed traffic whose arrivals are known."""
    return measured.has_events and any(is_actuated(measured.periods, tls) for tls in lights)


def _pools(
    layout: DetectorLayout,
    measured: MeasuredData,
    supplementary: SupplementaryData | None,
    thresholds: Thresholds,
) -> Pools:
    together = 1 if measured.has_events else bins_together(measured.counts, thresholds)
    return Pools.of(layout, thresholds, together, supplementary.labels if supplementary else None)


def effort_for(
    intersections: int, periods: Sequence[Period] = (), given: Effort | None = None
) -> Effort:
    """Return the numbers of days that suit the size of a network, and the stretches of the day.

    Args:
        intersections: Number of intersections.
        periods: The measured periods. Each stretch of the day has a mean of its own, so that tests
            need some days of each.
        given: Numbers to use instead.

    Raises:
        OptionError: `given` has too few days for the stretches of the day.
    """
    effort = given or next((own for most, own in EFFORTS if intersections <= most), LEAST_EFFORT)
    stretches = len({period.window for period in periods})
    least = DAYS_OF_A_STRETCH * stretches
    if stretches < 2 or min(effort.base, effort.test) >= least:
        return effort
    if given is not None:
        raise OptionError(
            f"effort base = {given.base} and test = {given.test} are too few days for periods at "
            f"{stretches} times of day; give at least {least} for both"
        )
    return replace(effort, base=max(effort.base, least), test=max(effort.test, least))


def _tallies(
    layout: DetectorLayout,
    measured: MeasuredData,
    periods: Sequence[Period],
    thresholds: Thresholds,
    supplementary: SupplementaryData | None,
) -> tuple[Tally, ...]:
    if measured.has_events or measured.counts is None:
        days = [tally(layout, period, layout.greens(period), thresholds) for period in periods]
    else:
        whole = without_gaps(measured.counts, measured.periods, thresholds)
        days = [
            counts_tally(layout, period, measured.counts, whole, thresholds) for period in periods
        ]
    if supplementary is not None:
        days = [
            replace(day, supplementary=supplementary.measured(period.id))
            for day, period in zip(days, periods, strict=True)
        ]
    return tuple(days)


def _of_coarse_stamps(grain_s: float) -> Finding:
    """Return a finding on stamps that are too coarse to show errors of the detectors."""
    return Finding(
        f"stamps of detections have a grain of {grain_s:g} s: errors of the detectors (extension, "
        "zone, position, splash) were not examined, and may be taken for effects of drivers; "
        "stamps in tenths of seconds would show them"
    )


def _of_speed_points(stated: SpeedPoint, seen: SpeedPoint) -> Finding:
    """Return a finding on a stated point of speed measurement that vehicles contradict."""
    text = (
        f"detectors.csv: speed_at = {stated}, but the vehicles that accelerate speak for {seen}; "
        f"the stated point was used, so check it, or leave the column empty"
    )
    return Finding(text)


def _of_length(kind: str, street_m: float, model_m: float) -> Finding:
    """Return a finding on occupancies that do not fit counts and speeds."""
    return Finding(
        f"counts.csv: by their occupancies, counts and speeds, vehicle and zone are together "
        f"{street_m:.1f} m long at {kind} detectors, and {model_m:.1f} m in the simulation; check "
        "length_m and extensions. These occupancies were not used"
    )
