"""Measured data of a street as a transition log, from which grounding learns.

The signals give the phases, the detectors the vehicles on each lane and the service of greens
(`detected`). A table of lanes or trajectories, from cameras or radar, takes the place of the
estimate where there is one. What nothing measured is not in the log: masks, delays of greens, and
commands that were not obeyed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data import (
    COARSEST_S,
    MeasuredData,
    Provenance,
    TransitionLog,
    TransitionRecorder,
    installed_version,
    step_of_tracks,
    traffic_of_lanes,
)
from ugat_marl.envs import OBSERVATION_UNITS, Observer, Rewarder
from ugat_marl.errors import MeasuredDataError, OptionError, UnknownNameError, listed
from ugat_marl.grounding.detected import (
    DetectionConfig,
    LaneCourse,
    LaneDetectors,
    LaneEstimate,
    greens_of,
)
from ugat_marl.scenarios import GREEN, YELLOW, Intersection, Network, Period, Scenario, SignalLog
from ugat_marl.simulation import Snapshot

Floats = NDArray[np.float64]

MeasuredSource = Literal["best", "detections"]
"""Where vehicles on lanes come from: a table of lanes or trajectories if there is one, or always
the detections."""

MeasuredPeriods = Literal["fit", "all"]
"""Periods that a log is of: those to which models are fitted, or those held out as well."""

WITH_OUTGOING = ("movements", "pressure")
"""Observations that read the lanes that lead away, too."""
REWARD = "queue"
"""Reward of the log. Vehicles outside of the measured lanes are unknown, so not `total-queue`."""
LONG_EMPTY_S = 30.0
"""Longest time without any vehicle that is not reported: a street at night, or a camera that was
off, have longer ones."""
LEAST_STRANGE = 0.005
"""Share of time with greens of no phase above which it is reported; a smaller one reads "0 %"."""


@dataclass(frozen=True)
class MeasuredLog:
    """A transition log of measured data, and what is known of its errors.

    Attributes:
        log: The log; its episodes are the periods. Its provenance has the standard deviation of
            the vehicles on each lane, root mean square over the decisions, if they are estimated.
        findings: What the log does not know, a sentence each.
    """

    log: TransitionLog
    findings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _LaneSeries:
    """Traffic of a lane at the decisions of a period; arrays ``(decisions + 1,)``.

    Attributes:
        vehicles: Vehicles on the lane.
        halting: Vehicles that stand.
        mean_left: Vehicles that left after a decision, averaged over the interval.
        deviation: Standard deviation of `vehicles`; None where they are not estimated.
    """

    vehicles: Floats
    halting: Floats
    mean_left: Floats
    deviation: Floats | None = None


def log_of_measured(
    measured: MeasuredData,
    scenario: Scenario,
    network: Network,
    place: str,
    observation: str = "movements",
    source: MeasuredSource = "best",
    config: DetectionConfig | None = None,
    periods: MeasuredPeriods = "fit",
) -> MeasuredLog:
    """Return the transitions of measured data.

    Args:
        measured: Measured data with signals, and with single detections or trajectories.
        scenario: Scenario with the decision interval and the timing of the signals.
        network: Network of the scenario.
        place: Name of the street, for the provenance.
        observation: Observation to record; `waiting` cannot be known.
        source: Where vehicles on lanes come from.
        config: Numbers of the estimate.
        periods: Periods that the log is of.

    Raises:
        MeasuredDataError: Signals or detectors are missing, or no phase of the scenario was shown.
        OptionError: The observation cannot be known from measured data.
        UnknownNameError: There is no such source, or there are no such periods.
    """
    if periods not in get_args(MeasuredPeriods):
        raise UnknownNameError("periods", periods, get_args(MeasuredPeriods))
    if source not in get_args(MeasuredSource):
        raise UnknownNameError("source of vehicles", source, get_args(MeasuredSource))
    if observation == "waiting":
        raise OptionError(
            "observation 'waiting' sums up how long each vehicle stands, which detectors do not "
            f"see; use one of {', '.join(name for name in OBSERVATION_UNITS if name != 'waiting')}"
        )
    left_out = measured.of("heldout") if periods == "fit" else ()
    if left_out and not measured.of("fit"):
        raise MeasuredDataError("all periods are held out; --periods all takes them")
    if left_out:
        measured = replace(measured, periods=measured.of("fit"))
    street = _Street(measured, scenario, network, observation, source, config or DetectionConfig())
    street.require_detectors()
    made = street.log(place)
    if not left_out:
        return made
    finding = (
        f"{listed([period.id for period in left_out], 'held-out period')}: left out, to judge on; "
        "--periods all takes all periods"
    )
    return replace(made, findings=(finding, *made.findings))


@dataclass(frozen=True)
class _Street:
    """Measured data with all that is needed to read them as decisions."""

    measured: MeasuredData
    scenario: Scenario
    network: Network
    observation: str
    source: MeasuredSource
    config: DetectionConfig

    @property
    def interval_s(self) -> float:
        return self.scenario.control.decision_interval_s

    @property
    def table(self) -> pl.DataFrame | None:
        """Vehicles per lane and second, from the table of lanes or from trajectories."""
        if self.source == "detections":
            return None
        if self.measured.lanes is not None:
            own = [period.id for period in self.measured.periods]
            return self.measured.lanes.filter(pl.col("period_id").is_in(own))
        if self.measured.trajectories is None:
            return None
        step = step_of_tracks(self.measured.trajectories)
        if step > COARSEST_S:
            raise MeasuredDataError(
                f"trajectories: positions every {step:g} s; vehicles on lanes need positions at "
                f"most {COARSEST_S:g} s apart: choose --vehicles detections, or add a table of "
                "lanes"
            )
        lanes = self.network.lane_table().ids
        parts = [
            traffic_of_lanes(
                self.measured.trajectories.filter(pl.col("period_id") == period.id), lanes, period
            )
            for period in self.measured.periods
        ]
        return pl.concat(parts)

    def require_detectors(self) -> None:
        """Refuse data in which a lane of the observation was not seen."""
        if not self.measured.has_events:
            raise MeasuredDataError(
                "counts only: when single vehicles leave a lane stays unknown, so there is no log "
                "of transitions; add detections (on and off of every vehicle)"
            )
        incoming = self._incoming
        seen = {lane: LaneDetectors.of(self.measured.detectors, lane) for lane in self._lanes}
        blind = [lane for lane in incoming if seen[lane].stop is None]
        if blind:
            raise MeasuredDataError(
                f"detectors.csv: no stop detector on {listed(blind, 'lane')}, of {len(incoming)} "
                "incoming lanes: when vehicles leave there stays unknown; add one, or leave the "
                "traffic light out of the scenario"
            )
        ends = [lane for lane in self._lanes if lane not in incoming and seen[lane].exit is None]
        if ends and self.observation in WITH_OUTGOING:
            raise MeasuredDataError(
                f"detectors.csv: no exit detector on {listed(ends, 'lane')}, which the observation "
                f"{self.observation!r} reads; add one, or choose --observation count"
            )

    def log(self, place: str) -> MeasuredLog:
        """Return the log, and what it does not know."""
        courses = self._courses()
        table, observer = self.table, Observer(self.network, self.observation)
        joined = self._joined()
        if table is not None:
            table = table.filter(~pl.col("lane_id").is_in(joined))
        estimated = {x: own for x, own in courses.items() if x not in self._measured_lanes(table)}
        recorder = TransitionRecorder(self._provenance(observer, place))
        variances: dict[str, list[Floats]] = {}
        unlike: dict[str, list[float]] = {}
        for episode, period in enumerate(self.measured.periods):
            blind_s = max((c[episode].blind_s for c in estimated.values()), default=0.0)
            last = int((period.end_s - blind_s - period.begin_s) / self.interval_s + 1e-9)
            if last < 2:
                raise MeasuredDataError(
                    f"periods.csv: period {period.id!r} has fewer than two decisions of "
                    f"{self.interval_s:g} s; join periods, or leave it out"
                )
            times_s = period.begin_s + self.interval_s * np.arange(last + 1, dtype=np.float64)
            phases: list[NDArray[np.int64]] = []
            for item in self.network.intersections:
                shown, strange = self._phases(item, period, times_s)
                phases.append(shown)
                unlike.setdefault(item.id, []).append(strange)
            rows = table.filter(pl.col("period_id") == period.id) if table is not None else None
            lanes = [
                self._series(lane, courses.get(lane), episode, times_s, rows)
                for lane in self._lanes
            ]
            for lane, one in zip(self._lanes, lanes, strict=True):
                if one.deviation is not None:
                    variances.setdefault(lane, []).append(one.deviation**2)
            self._record(recorder, observer, episode, times_s, np.stack(phases, 1), lanes)
        deviation = {
            x: float(np.sqrt(np.concatenate(variances[x]).mean()))
            for x in self._incoming
            if x in estimated
        }
        findings = self._findings(estimated, deviation, unlike)
        if table is not None:
            findings = (*_unseen(table), *findings)
            if joined:
                findings += (
                    f"vehicles of lanes are estimated from detections on {listed(joined, 'lane')}: "
                    "agents count them together with lanes upstream, and the table does not",
                )
        log = recorder.log()
        if deviation:
            log = TransitionLog(replace(log.provenance, deviation=deviation), log.frame)
        return MeasuredLog(log, findings)

    def _joined(self) -> list[str]:
        """Return the lanes that are counted together with lanes upstream."""
        behind = {lane: self.network.lanes[lane].behind for lane in self._lanes}
        return [lane for lane, upstream in behind.items() if upstream.lanes or upstream.roads]

    def _measured_lanes(self, table: pl.DataFrame | None) -> set[str]:
        """Return the lanes whose vehicles the table holds in every period."""
        if table is None:
            return set()
        held = table.group_by("lane_id").agg(pl.col("period_id").n_unique())
        return set(held.filter(pl.col("period_id") == len(self.measured.periods))["lane_id"])

    @property
    def _lanes(self) -> tuple[str, ...]:
        return self.network.lane_table().ids

    @property
    def _incoming(self) -> list[str]:
        """Lanes that lead to a light."""
        return [lane for item in self.network.intersections for lane in item.incoming_lanes]

    def _courses(self) -> dict[str, list[LaneCourse]]:
        """Return the courses of all lanes with detectors."""
        estimate = LaneEstimate(
            self.measured.periods,
            self.network.lanes,
            self.measured.detectors,
            self.config,
            self.scenario.settings.step_length_s,
        )
        courses: dict[str, list[LaneCourse]] = {}
        for lane in self._lanes:
            own = LaneDetectors.of(self.measured.detectors, lane)
            if own.stop is not None:
                courses[lane] = estimate.incoming(lane)
            elif own.exit is not None:
                courses[lane] = estimate.outgoing(lane)
        return courses

    def _series(
        self,
        lane: str,
        courses: list[LaneCourse] | None,
        episode: int,
        times_s: Floats,
        table: pl.DataFrame | None,
    ) -> _LaneSeries:
        """Return the traffic of a lane at some times."""
        none = np.zeros(len(times_s))
        if courses is None:  # leads away, and the observation does not read it
            return _LaneSeries(none, none, none)
        course, period = courses[episode], self.measured.periods[episode]
        left = course.mean_left(times_s, self.interval_s)
        seen = table.filter(pl.col("lane_id") == lane).sort("time_s") if table is not None else None
        if seen is not None and not seen.is_empty():
            at = seen["time_s"].to_numpy()
            rows = np.clip(np.searchsorted(at, times_s + 1e-6, side="right") - 1, 0, None)
            most_s = max(COARSEST_S, self.interval_s / 2) + 1e-6
            if (holes := np.abs(times_s - at[rows]) > most_s).any():
                raise MeasuredDataError(
                    f"lanes: nothing of lane {lane!r} in period {period.id!r} at "
                    f"{times_s[holes][0]:g} s; a log needs the vehicles of every decision: end the "
                    "period before the hole, or choose --vehicles detections"
                )
            # Where nothing was seen the street counts as empty; `_unseen` reports it.
            known = seen.select(pl.col("vehicles", "halting").fill_null(0.0))
            vehicles, halting = (known[x].to_numpy()[rows] for x in ("vehicles", "halting"))
            return _LaneSeries(vehicles, halting, left)
        vehicles, deviation = course.vehicles(times_s), course.deviation(times_s)
        light = next(
            (item for item in self.network.intersections if lane in item.incoming_lanes), None
        )
        if light is None:
            return _LaneSeries(vehicles, none, left, deviation)
        links = sorted({link.index for link in light.links if link.from_lane == lane})
        greens = greens_of(period, light.id, links)
        halting = course.halting(times_s, greens, self.config)
        return _LaneSeries(vehicles, halting, left, deviation)

    def _phases(
        self, item: Intersection, period: Period, times_s: Floats
    ) -> tuple[NDArray[np.int64], float]:
        """Return the phase that is green or about to be at each time, and the share of others.

        A change at the very moment of a decision is its result, so the state before it counts.
        """
        shown = period.signals.get(item.id)
        if not shown:
            raise MeasuredDataError(
                f"signals: nothing of traffic light {item.id!r} in period {period.id!r}; without "
                "its phases there is no log of transitions: add them, or leave the period out"
            )
        phases, strange = phases_shown(shown, item, period.end_s, self.scenario.timing.min_green_s)
        since = np.array([begin for begin, _ in shown])
        at = np.searchsorted(since, times_s - 1e-6, side="right") - 1
        return phases[np.clip(at, 0, None)], strange

    def _record(
        self,
        recorder: TransitionRecorder,
        observer: Observer,
        episode: int,
        times_s: Floats,
        phases: NDArray[np.int64],
        lanes: Sequence[_LaneSeries],
    ) -> None:
        """Add the decisions of a period."""
        vehicles, halting, left = (
            np.stack([getattr(one, name) for one in lanes], 1)
            for name in ("vehicles", "halting", "mean_left")
        )
        nothing = np.zeros(len(lanes))
        snapshots = [
            Snapshot(float(time), vehicles[k], halting[k], nothing, np.empty(0), 0, 0)
            for k, time in enumerate(times_s)
        ]
        rewarder = Rewarder(self.network, REWARD)
        first = round((times_s[0] - self.scenario.settings.begin_s) / self.interval_s)

        def seen(snapshot: Snapshot, row: int) -> dict[str, NDArray[np.float32]]:
            shown = observer.observe(snapshot, phases[row].tolist())
            return dict(zip(observer.agents, shown, strict=True))

        for step, (before, after) in enumerate(zip(snapshots, snapshots[1:], strict=False)):
            ran = dict(zip(observer.agents, phases[step + 1].tolist(), strict=True))
            rewards = rewarder.rewards(before, after)
            served = seen(before.less(left[step]), step)  # newcomers too, as in a simulated log
            recorder.record(
                episode,
                first + step,
                seen(before, step),
                ran,
                ran,
                dict(zip(observer.agents, rewards, strict=True)),
                seen(after, step + 1),
                served={
                    agent: served[agent][: layout.features]
                    for agent, layout in zip(observer.agents, observer.layouts, strict=True)
                },
            )

    def _provenance(self, observer: Observer, place: str) -> Provenance:
        return Provenance(
            scenario=self.scenario.id,
            scenario_hash="",
            domain=place,
            seeds=(),
            decision_interval_s=self.interval_s,
            observation=observer.name,
            layouts=dict(zip(observer.agents, observer.layouts, strict=True)),
            source="measured",
            versions={"ugat-marl": installed_version("ugat-marl") or "not installed"},
            units={"observation": OBSERVATION_UNITS[observer.name], "reward": REWARD},
            from_begin=True,
        )

    def _findings(
        self,
        courses: dict[str, list[LaneCourse]],
        deviation: dict[str, float],
        unlike: dict[str, list[float]],
    ) -> tuple[str, ...]:
        """Return what the log does not know, most important first.

        Args:
            courses: Courses of the lanes whose vehicles are estimated.
            deviation: Their standard deviations where they lead to a traffic light.
            unlike: Shares of time with greens of no phase, at each light.
        """
        found = [*self._of_estimates(courses, deviation)] if deviation else []
        strange = {
            light: max(shares) for light, shares in unlike.items() if max(shares) > LEAST_STRANGE
        }
        if strange:
            light = max(strange, key=lambda x: strange[x])
            found.append(
                f"{listed(list(strange), 'traffic light')}: greens of no phase of the scenario for "
                f"up to {100 * strange[light]:.0f} % of the time; the most similar phase is taken"
            )
        found.append(
            "the phases that ran are taken for the commands: late, lost or refused commands, masks "
            "and delays of greens are not in the data"
        )
        return tuple(found)

    def _of_estimates(
        self, courses: Mapping[str, Sequence[LaneCourse]], deviation: Mapping[str, float]
    ) -> Iterator[str]:
        """Yield what is not known of estimated vehicles, for the arguments of `_findings`."""
        worst = max(deviation, key=lambda lane: deviation[lane])
        yield (
            f"vehicles on a lane are estimated to {np.median(list(deviation.values())):.1f} "
            f"(median of {len(deviation)} lanes) to {deviation[worst]:.1f} vehicles ({worst}), "
            "standard deviation; how many of them stand follows from the greens"
        )
        stuck = [lane for lane in deviation if any(j.long for c in courses[lane] for j in c.jams)]
        if stuck:
            yield (
                f"{listed(stuck, 'lane')}: a queue stood on the first detector to the end of "
                "a period, so how fast it grew stays unknown; the rate of free times is taken"
            )
        late = sum(c.unmatched for lane in deviation for c in courses[lane])
        total = sum(len(c.leave_s) for lane in deviation for c in courses[lane])
        if late:
            yield (
                f"{100 * late / total:.0f} % of the vehicles were seen by one detector of "
                "their lane only: they changed lanes, or a detector missed them"
            )
        alone = [
            x for x in deviation if LaneDetectors.of(self.measured.detectors, x).advance is None
        ]
        if alone:
            yield (
                f"{listed(alone, 'lane')}: no advance detector, so vehicles that wait are "
                "known only when they leave"
            )
        blind_s = max(one.blind_s for own in courses.values() for one in own)
        yield (
            f"the last {blind_s:.0f} s of each period are left out: vehicles that came then "
            "had not reached a detector"
        )


def _unseen(table: pl.DataFrame) -> tuple[str, ...]:
    """Return a finding on the longest time without any vehicle; none if it is short.

    Args:
        table: Traffic of lanes as in `traffic_of_lanes`.
    """
    times = table.filter(pl.col("vehicles").is_null()).select("period_id", "time_s").unique()
    runs: list[tuple[int, str, float]] = []
    for (period,), seconds in times.group_by("period_id", maintain_order=True):
        when = np.sort(seconds["time_s"].to_numpy())
        parts = np.split(when, np.flatnonzero(np.diff(when) > 1.0) + 1)
        runs += [(len(part), str(period), float(part[0])) for part in parts]
    longest, period, begin_s = max(runs, default=(0, "", 0.0))
    if longest < LONG_EMPTY_S:
        return ()
    return (
        f"no vehicle was seen anywhere for up to {longest} s (period {period!r}, from {begin_s:g} "
        "s on), which counts as an empty street; if nothing was recorded then, end the period "
        "before it",
    )


def phases_shown(
    shown: SignalLog, item: Intersection, end_s: float, min_green_s: float
) -> tuple[NDArray[np.int64], float]:
    """Return the phase that each state of a traffic light shows or leads to.

    A state with the greens of a phase shows it. Another one that lasts for a minimum green shows
    the phase with the most similar greens. The rest are clearances, which lead to the next phase:
    states with yellow, and what follows one for less than a minimum green, with greens that were
    there before it.

    Args:
        shown: States of the light.
        item: Its intersection.
        end_s: End of the last state.
        min_green_s: Minimum green.

    Returns:
        Index of a phase for each state, and the share of time with greens of no phase.

    Raises:
        MeasuredDataError: No state has green on a link of any phase.
    """
    links = sorted({link.index for link in item.links})
    greens = [frozenset(i for i in links if phase[i] in GREEN) for phase in item.phases]
    times = np.array([begin for begin, _ in shown] + [max(end_s, shown[-1][0])])
    lengths = np.diff(times)
    phases = np.full(len(shown), -1, dtype=np.int64)
    strange, ending = 0.0, None  # greens before a yellow, until another green follows
    before: frozenset[int] = frozenset()
    for k, (_, state) in enumerate(shown):
        lit = frozenset(i for i in links if state[i] in GREEN)
        if any(state[i] in YELLOW for i in links):
            ending = before if ending is None else ending
            continue
        short = lengths[k] < max(min_green_s, 1.0)
        if ending is not None and lit <= ending and short:
            continue  # links that stay green may be all the greens of a third phase
        ending, before = None, lit
        if lit in greens:
            phases[k] = greens.index(lit)
        elif lit and not short:
            alike = [len(lit & own) / len(lit | own) for own in greens]
            if max(alike) > 0:
                phases[k] = int(np.argmax(alike))
                strange += float(lengths[k])
    known = np.flatnonzero(phases >= 0)
    if not len(known):
        raise MeasuredDataError(
            f"signals: traffic light {item.id!r} never shows a phase of the scenario "
            f"({', '.join(item.phases[:3])}, ...); give it the phases of the street in "
            "scenario.toml (intersections.<light>.phases)"
        )
    after = np.searchsorted(known, np.arange(len(shown)))
    return phases[known[np.minimum(after, len(known) - 1)]], strange / max(float(lengths.sum()), 1)
