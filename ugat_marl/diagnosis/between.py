"""Turning counts and travel times of probes: vehicles that pass two places one after the other.

Simulated vehicles are followed over the same places. Turning counts are compared in the stretches
of time that were counted, and as vehicles per minute. Travel times are compared as means: probes
are a part of the vehicles, so their number says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data import MeasuredData
from ugat_marl.simulation import Place, Way

Array = NDArray[np.float64]
Span = tuple[float, float]

TURNING, TRAVEL_TIME = "turning", "travel time"
"""Names of the blocks of statistics."""


@dataclass(frozen=True)
class Label:
    """Meaning of a member of a block.

    Attributes:
        edge: Edge at which it is reported.
        following: Edge behind it.
        unit: Unit of its statistic.
    """

    edge: str
    following: str
    unit: str


@dataclass(frozen=True, eq=False)
class Between:
    """Measured turning counts and travel times, and the places at which vehicles are followed.

    Attributes:
        turns: Pairs of edges whose turning vehicles were counted.
        ways: Pairs of places between which probes were timed.
        spans: For each period, begin and end of the counted intervals of each turn, s.
        counts: For each period, vehicles of each turn, ``(turns,)``.
        times: For each period, sum and number of travel times of each way, ``(ways, 2)``.
    """

    turns: tuple[tuple[str, str], ...]
    ways: tuple[Way, ...]
    spans: Mapping[str, tuple[tuple[Span, ...], ...]]
    counts: Mapping[str, Array]
    times: Mapping[str, Array]

    @classmethod
    def of(cls, measured: MeasuredData) -> Between | None:
        """Collect the measured data; None if they hold neither kind."""
        turning, probes = measured.turning, measured.travel_times
        if turning is None and probes is None:
            return None
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
            totals = [] if probes is None else [_time(probes.filter(own), way) for way in ways]
            times[period.id] = np.array(totals, np.float64).reshape(-1, 2)
        return cls(turns, ways, spans, counts, times)

    @property
    def followed(self) -> tuple[Way, ...]:
        """All pairs of places at which simulated vehicles are followed: turns, then ways."""
        turns = ((Place(a, math.inf), Place(b, 0.0)) for a, b in self.turns)
        return (*turns, *self.ways)

    @property
    def labels(self) -> dict[str, tuple[Label, ...]]:
        """Meanings of the members of the blocks."""
        labels = {
            TURNING: tuple(Label(a, b, "1/min") for a, b in self.turns),
            TRAVEL_TIME: tuple(Label(a.edge, b.edge, "s") for a, b in self.ways),
        }
        return {name: members for name, members in labels.items() if members}

    def measured(self, period: str) -> dict[str, Array]:
        """Return sums and numbers of observations of a measured period, ``(members, 1, 2)``."""
        return self._blocks(self.counts[period], self._minutes(period), self.times[period])

    def simulated(self, period: str, seen: Sequence[Array]) -> dict[str, Array]:
        """Return the same of a simulated day.

        Args:
            period: Id of the measured period whose signals the day has.
            seen: For each of `followed`, times at the first place and travel times, s,
                ``(vehicles, 2)``.
        """
        turned, timed = seen[: len(self.turns)], seen[len(self.turns) :]
        counts = [
            float(sum(((begin <= x[:, 0]) & (x[:, 0] < end)).sum() for begin, end in spans))
            for x, spans in zip(turned, self.spans[period], strict=True)
        ]
        times = np.array([(x[:, 1].sum(), len(x)) for x in timed], np.float64).reshape(-1, 2)
        return self._blocks(np.array(counts), self._minutes(period), times)

    def _minutes(self, period: str) -> Array:
        return np.array(
            [sum(end - begin for begin, end in spans) / 60.0 for spans in self.spans[period]]
        )

    def _blocks(self, counts: Array, minutes: Array, times: Array) -> dict[str, Array]:
        sums = {TURNING: np.stack([counts, minutes], axis=-1), TRAVEL_TIME: times}
        return {name: values[:, None] for name, values in sums.items() if len(values)}

    def __repr__(self) -> str:
        """Return everything that simulated days depend on, for the key of the cache."""
        return repr((self.turns, self.ways, sorted(self.spans.items())))


def _turn(turning: pl.DataFrame, turn: tuple[str, str]) -> tuple[tuple[Span, ...], float]:
    """Return the counted intervals of a turn and its vehicles in them."""
    own = turning.filter((pl.col("from_edge") == turn[0]) & (pl.col("to_edge") == turn[1]))
    spans = tuple(sorted(own.select("begin_s", "end_s").iter_rows()))
    return spans, float(own["count"].sum())


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
