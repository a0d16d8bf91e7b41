"""Turning counts, travel times of probes and states of lanes: data besides detectors.

Simulated vehicles are followed over the same places. Turning counts are compared in the stretches
of time that were counted, and as vehicles per minute. Travel times are compared as means: probes
are a part of the vehicles, so their number says nothing. A simulation ends with its period, so
vehicles on their way are not timed. Measured vehicles that arrive after the period are left out
for the same reason. Of lanes the mean numbers of vehicles and of halting vehicles are compared,
and the mean speed, each lane alone and all together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data import MeasuredData
from ugat_marl.errors import MeasuredDataError
from ugat_marl.scenarios import Period, edge_of_lane
from ugat_marl.simulation import Place, Way

Array = NDArray[np.float64]
Span = tuple[float, float]

TURNING, TRAVEL_TIME, LANES, EVERY_LANE = "turning", "travel time", "lanes", "every lane"
"""Names of the blocks of statistics."""
SUPPLEMENTARY_MEASURES: Mapping[str, tuple[tuple[str, str], ...]] = {
    TURNING: (("vehicles that turn", "1/min"),),
    TRAVEL_TIME: (("travel time", "s"),),
    **dict.fromkeys(
        (LANES, EVERY_LANE),
        (("vehicles on lane", ""), ("halting vehicles on lane", ""), ("speed on lane", "m/s")),
    ),
}
"""Names and units of the statistics of each block."""


LEAST_OBSERVED = 0.9
"""Smallest share of a period in which a lane must be observed; its mean is compared with that of
the whole period."""


@dataclass(frozen=True)
class Label:
    """Meaning of a member of a block.

    Attributes:
        edge: Edge at which it is reported; "" for all.
        following: Edge behind it; "" for none.
        lane: Lane; "" for none.
    """

    edge: str = ""
    following: str = ""
    lane: str = ""


@dataclass(frozen=True, eq=False)
class SupplementaryData:
    """Measured turning counts, travel times and states of lanes.

    Attributes:
        turns: Pairs of edges whose turning vehicles were counted.
        ways: Pairs of places between which probes were timed.
        spans: For each period, start and end of the counted intervals of each turn, s.
        counts: For each period, vehicles of each turn, ``(turns,)``.
        times: For each period, sum and number of travel times of each way, ``(ways, 2)``, of the
            probes that arrived within the period.
        lanes: SUMO ids of the lanes whose state was measured.
        states: For each period, sums and numbers of observations of the state of each lane,
            ``(lanes, 3, 2)``.
    """

    turns: tuple[tuple[str, str], ...]
    ways: tuple[Way, ...]
    spans: Mapping[str, tuple[tuple[Span, ...], ...]]
    counts: Mapping[str, Array]
    times: Mapping[str, Array]
    lanes: tuple[str, ...] = ()
    states: Mapping[str, Array] = field(default_factory=dict)

    @classmethod
    def of(cls, measured: MeasuredData) -> SupplementaryData | None:
        """Collect turning counts, travel times and lane states; None if the data hold none of them.

        Raises:
            MeasuredDataError: A lane was observed in a part of a period only.
        """
        turning, probes, lanes = measured.turning, measured.travel_times, measured.lanes
        if turning is None and probes is None and lanes is None:
            return None
        names = () if lanes is None else tuple(sorted(set(lanes["lane_id"])))
        states: dict[str, Array] = {}
        if lanes is not None:
            states = {period.id: _states(lanes, period, names) for period in measured.periods}
        turns: tuple[tuple[str, str], ...] = ()
        ways: tuple[Way, ...] = ()
        if turning is not None:
            turns = tuple(sorted(set(turning.select("from_edge", "to_edge").iter_rows())))
        if probes is not None:
            columns = probes.select("from_edge", "from_m", "to_edge", "to_m")
            ways = tuple((Place(a, x), Place(b, y)) for a, x, b, y in sorted(set(columns.rows())))
        spans: dict[str, tuple[tuple[Span, ...], ...]] = {}
        counts: dict[str, Array] = {}
        times: dict[str, Array] = {}
        for period in measured.periods:
            own = pl.col("period_id") == period.id
            rows = [] if turning is None else [_turn(turning.filter(own), turn) for turn in turns]
            spans[period.id] = tuple(spans_of_turn for spans_of_turn, _ in rows)
            counts[period.id] = np.array([count for _, count in rows], np.float64)
            timed = None if probes is None else _arrived(probes.filter(own), period)
            totals = [] if timed is None else [_time(timed, way) for way in ways]
            times[period.id] = np.array(totals, np.float64).reshape(-1, 2)
        return cls(turns, ways, spans, counts, times, names, states)

    @property
    def followed(self) -> tuple[Way, ...]:
        """All pairs of places at which simulated vehicles are followed: turns, then ways."""
        turns = ((Place(a, math.inf), Place(b, 0.0)) for a, b in self.turns)
        return (*turns, *self.ways)

    @property
    def labels(self) -> dict[str, tuple[Label, ...]]:
        """Meanings of the members of the blocks."""
        labels = {
            TURNING: tuple(Label(a, b) for a, b in self.turns),
            TRAVEL_TIME: tuple(Label(a.edge, b.edge) for a, b in self.ways),
            LANES: tuple(Label(edge_of_lane(lane), lane=lane) for lane in self.lanes),
            EVERY_LANE: (Label(),) if self.lanes else (),
        }
        return {name: members for name, members in labels.items() if members}

    def spans_of_turns(self, period: str) -> dict[tuple[str, str], tuple[Span, ...]]:
        """Return start and end of the counted intervals of each turn in a measured period, s."""
        return dict(zip(self.turns, self.spans[period], strict=True))

    def measured(self, period: str) -> dict[str, Array]:
        """Return sums and numbers of observations of a measured period, by block.

        Each array is ``(members, measures, 2)``, with the measures of `SUPPLEMENTARY_MEASURES`.
        """
        states = self.states.get(period, np.zeros((0, 3, 2)))
        return self._blocks(self.counts[period], self._minutes(period), self.times[period], states)

    def simulated(
        self, period: Period, seen: Sequence[Array], lanes: Array | None
    ) -> dict[str, Array]:
        """Return the same of a simulated day.

        Args:
            period: The measured period whose signals the day has.
            seen: For each of `followed`, times at the first place and travel times, s,
                ``(vehicles, 2)``.
            lanes: Vehicle seconds, halting seconds and driven metres of each lane, ``(lanes, 3)``;
                None without lanes.
        """
        turned, timed = seen[: len(self.turns)], seen[len(self.turns) :]
        counts = [
            float(sum(((begin <= x[:, 0]) & (x[:, 0] < end)).sum() for begin, end in spans))
            for x, spans in zip(turned, self.spans[period.id], strict=True)
        ]
        states = np.zeros((0, 3, 2))
        if lanes is not None:
            length = np.full(len(lanes), period.length_s)
            weights = np.stack([length, length, lanes[:, 0]], axis=-1)
            states = np.stack([lanes, weights], axis=-1)
            states[self._unobserved(period.id)] = 0.0
        times = np.array([(x[:, 1].sum(), len(x)) for x in timed], np.float64).reshape(-1, 2)
        return self._blocks(np.array(counts), self._minutes(period.id), times, states)

    def _unobserved(self, period: str) -> list[int]:
        """Return the indices of lanes that were observed in other periods, but not in this one."""
        if period not in self.states:
            return []
        return np.flatnonzero(self.states[period][:, 0, 1] == 0).tolist()

    def _minutes(self, period: str) -> Array:
        return np.array(
            [sum(end - begin for begin, end in spans) / 60.0 for spans in self.spans[period]]
        )

    def _blocks(
        self, counts: Array, minutes: Array, times: Array, states: Array
    ) -> dict[str, Array]:
        every = states.sum(axis=0, keepdims=True)
        sums = {
            TURNING: np.stack([counts, minutes], axis=-1)[:, None],
            TRAVEL_TIME: times[:, None],
            LANES: states,
            EVERY_LANE: every if len(states) else states,
        }
        return {name: values for name, values in sums.items() if len(values)}

    def __repr__(self) -> str:
        """Return everything that simulated days depend on, for the key of the cache."""
        gone = [
            (period, own) for period in sorted(self.states) if (own := self._unobserved(period))
        ]
        key = (self.turns, self.ways, sorted(self.spans.items()), self.lanes)
        return repr((*key, gone) if gone else key)


def _turn(turning: pl.DataFrame, turn: tuple[str, str]) -> tuple[tuple[Span, ...], float]:
    """Return the counted intervals of a turn and its vehicles in them."""
    own = turning.filter((pl.col("from_edge") == turn[0]) & (pl.col("to_edge") == turn[1]))
    spans = tuple(sorted(own.select("begin_s", "end_s").iter_rows()))
    return spans, float(own["count"].sum())


def _arrived(probes: pl.DataFrame, period: Period) -> pl.DataFrame:
    """Return the probes that passed both places within the period, as in `read_between`."""
    begin, end = pl.col("time_s"), pl.col("time_s") + pl.col("travel_s")
    return probes.filter((begin >= period.begin_s) & (end < period.end_s))


def _time(probes: pl.DataFrame, way: Way) -> tuple[float, float]:
    """Return the sum and the number of the travel times of a way."""
    first, last = way
    own = probes.filter(
        (pl.col("from_edge") == first.edge)
        & (pl.col("from_m") == first.position_m)
        & (pl.col("to_edge") == last.edge)
        & (pl.col("to_m") == last.position_m)
    )
    return float(own["travel_s"].sum()), float(own.height)


def _states(lanes: pl.DataFrame, period: Period, names: Sequence[str]) -> Array:
    """Return sums and numbers of observations of the lanes in a period, ``(lanes, 3, 2)``.

    Both are scaled to a moment per second of the period, as simulated lanes have.

    Raises:
        MeasuredDataError: A lane was observed in a part of the period only.
    """
    moments = lanes.filter(pl.col("period_id") == period.id)
    speed = pl.col("mean_speed_mps") if "mean_speed_mps" in lanes.columns else pl.lit(None)
    speed = speed.cast(pl.Float64).fill_nan(None)
    known = pl.col("vehicles").filter(speed.is_not_null())
    sums = moments.group_by("lane_id").agg(
        pl.col("vehicles").sum().alias("vehicles"),
        pl.col("halting").sum().alias("halting"),
        (pl.col("vehicles") * speed).sum().alias("metres"),
        pl.len().alias("moments"),
        pl.col("time_s").sort().diff().median().alias("step_s"),
        known.sum().alias("moving"),
    )
    found = {row["lane_id"]: row for row in sums.iter_rows(named=True)}
    states = np.zeros((len(names), 3, 2))
    for number, name in enumerate(names):
        if (row := found.get(name)) is not None:
            seen, whole_s = float(row["moments"]), period.length_s
            observed_s = float(row["step_s"] or 0.0) * seen
            if observed_s < LEAST_OBSERVED * whole_s:
                raise MeasuredDataError(
                    f"lanes: {name!r} was observed for {observed_s / 60:.0f} of "
                    f"{whole_s / 60:.0f} min of period {period.id!r}, and traffic differs within a "
                    "period; give periods as long as the observation, or leave the lane out"
                )
            rows = [
                (float(row["vehicles"]), seen),
                (float(row["halting"]), seen),
                (float(row["metres"]), float(row["moving"])),
            ]
            states[number] = np.array(rows) * whole_s / seen
    return states
