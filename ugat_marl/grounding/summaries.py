"""Summary statistics of a transition log, by lane: how vehicles arrive and how greens serve them.

A log shows the vehicles c on a lane at a decision, c' at the next one, and the mean number that
had left during the interval, m (if it was measured). The statistics are means over decisions of one
kind, by classes of c, so that they depend little on the length of queues. Greens that lead to a
full lane say nothing of their service, and full lanes nothing of their arrivals: both are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ugat_marl.data import TransitionLog, consecutive
from ugat_marl.envs import COUNT_SCALE
from ugat_marl.errors import OptionError
from ugat_marl.scenarios import GREEN, Intersection, Network

Floats = NDArray[np.float64]

CLASSES = (2.0, 5.0, 9.0)
"""Lower ends of the classes of vehicles on a lane."""
CLOSE = 1e-4
"""Distance in vehicles below which a count is a whole number."""
FULL = 0.9
"""Share of the vehicles that fit on a lane from which it is full. At 0.8 long queues that still
move are taken for full; at 1.0 trucks and gaps keep a jam from being seen."""
LEAST_HOLDS = 3.0
"""Fewest vehicles that a lane holds for it to be called full. In a shorter one, as between two
nodes of a map, a single vehicle that passes or stops looks like a jam."""
MOST_DEVIATION = 1.5
"""Standard deviation of the vehicles on a lane, in vehicles, above which only the service of its
greens is used: the fall of a queue by two or three vehicles would be lost in it. At 3.0 lanes are
used whose queue is guessed; at 0.7 a lane is left out for a few queues beyond its detector."""
LEAST_ROWS = 3
"""Fewest decisions whose mean is used."""
COUNTED = ("count", "density", "movements", "queue")
"""Observations in vehicles; the others cannot be summarised."""

LONG_S = 15.0
"""Age of a green, in s, from which it is long."""

GREENS = ("begins", "goes on", "is long")
"""Ages of a green. Seconds lost at its beginning, slow vehicles and a low flow are told apart by
what passes later."""
NAMES = (
    *(
        f"{what}, green {green}, {low:g} or more"
        for what in ("left", "fall")
        for green in GREENS
        for low in CLASSES
    ),
    "rise in red",
    "mean",
    "spread",
    "most",
)
"""Names of the statistics of a lane."""
OF_COUNTS = np.array([not name.startswith("left") for name in NAMES])
"""True for statistics that need the vehicles on a lane; the others need those that left it."""


@dataclass(frozen=True)
class Summary:
    """Statistics of one log.

    Attributes:
        values: ``(lanes, len(NAMES))``, vehicles; NaN where too few decisions are of the kind.
        rows: Decisions behind each value, ``(lanes, len(NAMES))``.
    """

    values: Floats
    rows: Floats

    @classmethod
    def of(cls, values: Floats, rows: Floats) -> Summary:
        """Return a summary in which values of too few decisions are NaN."""
        return cls(np.where(rows < LEAST_ROWS, np.nan, values), rows)

    def where(self, usable: NDArray[np.bool_]) -> Summary:
        """Return the summary without values that may not be used, ``(lanes, len(NAMES))``."""
        return Summary(np.where(usable, self.values, np.nan), np.where(usable, self.rows, 0.0))

    @property
    def network(self) -> Floats:
        """Mean over the lanes, weighted by decisions, ``(len(NAMES),)``; NaN without any."""
        rows = np.where(np.isnan(self.values), 0.0, self.rows)
        total = rows.sum(0)
        sums = (np.nan_to_num(self.values) * rows).sum(0)
        return np.where(total > 0, sums / np.maximum(total, 1.0), np.nan)


@dataclass(frozen=True)
class LaneRows:
    """Decisions of one lane, ordered by episode and step; arrays ``(n,)``.

    Attributes:
        episode: Number of the episode.
        step: Number of the decision in its episode.
        before: Vehicles at the decision.
        after: Vehicles at the next decision.
        left: Mean number of vehicles that had left in between; NaN if it was not measured.
        age_s: Seconds for which the lane had had green at the decision, or more; 0 in red.
        has: True if the lane has green afterwards.
        full: True if the lane is full at the decision or at the next one.
        held: True if a lane that its green leads to is full at either of them.
    """

    episode: NDArray[np.int64]
    step: NDArray[np.int64]
    before: Floats
    after: Floats
    left: Floats
    age_s: Floats
    has: NDArray[np.bool_]
    full: NDArray[np.bool_]
    held: NDArray[np.bool_]

    @property
    def had(self) -> NDArray[np.bool_]:
        """True if the lane had green at the decision."""
        return self.age_s > 0.0

    @property
    def key(self) -> NDArray[np.int64]:
        """A number for each decision, equal in all lanes of a network."""
        return self.episode * (1 << 32) + self.step


@dataclass(frozen=True)
class LaneView:
    """Lanes of a network in the order of summaries, and the phases that serve them.

    Attributes:
        lanes: Ids of all incoming lanes, intersection by intersection.
        green: For each intersection, bool ``(lanes, phases)``: True if a link has green.
        scale: For each intersection, vehicles per unit of its features, ``(lanes,)``.
        first: For each intersection, the position of the first count among its features.
        holds: Vehicles that each lane holds, as far as the observation can tell, ``(lanes,)``.
        passed_s: Time in which a vehicle at the speed limit passes all that is counted with each
            lane, in s, ``(lanes,)``.
        onward: For each lane, the positions of the lanes at lights that its links lead to.
        beyond: For each intersection, the lanes at no light that its links lead to, as far as the
            observation shows them: position among its features, and places of the lanes that lead
            there among its own.
    """

    lanes: tuple[str, ...]
    green: tuple[NDArray[np.bool_], ...]
    scale: tuple[Floats, ...]
    first: tuple[int, ...]
    holds: Floats
    passed_s: Floats
    onward: tuple[tuple[int, ...], ...]
    beyond: tuple[tuple[tuple[int, tuple[int, ...]], ...], ...] = ()

    @classmethod
    def of(cls, network: Network, observation: str) -> LaneView:
        """Return the lanes of a network for logs with this observation.

        Raises:
            OptionError: The observation holds no vehicles.
        """
        if observation not in COUNTED:
            raise OptionError(
                f"observation {observation!r} shows no numbers of vehicles, from which service is "
                f"fitted; use one of {', '.join(COUNTED)}"
            )
        lanes: list[str] = []
        green: list[NDArray[np.bool_]] = []
        scale: list[Floats] = []
        first: list[int] = []
        holds: list[float] = []
        passed_s: list[float] = []
        for item in network.intersections:
            own = item.incoming_lanes
            lanes += own
            green.append(_greens(item))
            capacity = np.array([network.lanes[lane].storage_veh for lane in own])
            fixed = observation in ("count", "queue")
            scale.append(np.full(len(own), COUNT_SCALE) if fixed else capacity)
            holds += np.minimum(capacity, scale[-1]).tolist()
            along = (network.lanes[lane] for lane in own)
            passed_s += [lane.counted_m / max(lane.speed_mps, 0.1) for lane in along]
            first.append(len(own) if observation == "movements" else 0)
        onward = _onward(network, lanes)
        beyond = _beyond(network, lanes) if observation == "movements" else ()
        return cls(
            tuple(lanes),
            tuple(green),
            tuple(scale),
            tuple(first),
            np.array(holds),
            np.array(passed_s),
            onward,
            beyond,
        )

    def lanes_of(self, agents: Sequence[str]) -> dict[str, range]:
        """Return the positions of the lanes of each agent.

        Args:
            agents: All agents, in the order of the network.
        """
        ends = np.cumsum([len(scale) for scale in self.scale]).tolist()
        begins = [0, *ends[:-1]]
        return {a: range(*ends_of) for a, *ends_of in zip(agents, begins, ends, strict=True)}

    def rows(self, log: TransitionLog) -> list[LaneRows]:
        """Return the decisions of every lane, in the order of `lanes`."""
        limits = np.where(self.holds < LEAST_HOLDS, np.inf, FULL * self.holds)
        rows = [
            row
            for place, (agent, lanes) in enumerate(self.lanes_of(log.agents).items())
            for row in self._rows_of(place, log, agent, limits[lanes.start : lanes.stop])
        ]
        jams = [row.key[row.full] for row in rows]
        return [
            replace(row, held=row.held | np.isin(row.key, np.concatenate([jams[k] for k in ways])))
            if ways
            else row
            for row, ways in zip(rows, self.onward, strict=True)
        ]

    def summary(self, log: TransitionLog) -> Summary:
        """Return the statistics of a log."""
        values, numbers = zip(*map(_statistics, self.rows(log)), strict=True)
        summary = Summary.of(np.stack(values), np.stack(numbers))
        deviation = log.provenance.deviation
        if not deviation:
            return summary
        unsure = np.array([deviation.get(lane, 0.0) > MOST_DEVIATION for lane in self.lanes])
        return summary.where(~(unsure[:, None] & OF_COUNTS))

    def _rows_of(
        self, place: int, log: TransitionLog, agent: str, limits: Floats
    ) -> Iterator[LaneRows]:
        """Return the decisions of the lanes of an intersection; at `limits` vehicles they are full.

        Jams that `onward` leads to are not yet among those that hold a lane.
        """
        rows, layout = log.transitions(agent), log.provenance.layouts[agent]
        green, scale, first = self.green[place], self.scale[place], self.first[place]
        part = slice(first, first + len(scale))
        before = rows.observation[:, part].astype(np.float64) * scale
        after = rows.next_observation[:, part].astype(np.float64) * scale
        left = np.full_like(before, np.nan)
        if rows.served_features.shape[1]:
            left = before - rows.served_features[:, part] * scale
        phase = rows.observation[:, layout.features : layout.features + layout.phases].argmax(1)
        had, has = green[:, phase], green[:, rows.executed]
        follows = consecutive(rows.episode, rows.step)
        age_s = log.provenance.decision_interval_s * _ages(had, follows)
        before, after = _whole(before), _whole(after)
        full = np.maximum(before, after) >= limits
        held = np.zeros(before.shape, dtype=np.bool_)
        for feature, ways in self.beyond[place] if self.beyond else ():
            filled = np.maximum(rows.observation[:, feature], rows.next_observation[:, feature])
            held[:, ways] |= (filled >= FULL)[:, None]
        for k in range(len(scale)):
            yield LaneRows(
                rows.episode,
                rows.step,
                before[:, k],
                after[:, k],
                left[:, k],
                age_s[k],
                has[k],
                full[:, k],
                held[:, k],
            )


def _ages(had: NDArray[np.bool_], follows: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return for how many decisions in sequence each lane had green, ``(lanes, n)``.

    Args:
        had: True if a lane had green at a decision, ``(lanes, n)``.
        follows: True if a decision but the first follows the one before it, ``(n - 1,)``.
    """
    place = np.arange(had.shape[1])
    begins = had.copy()
    begins[:, 1:] &= ~(had[:, :-1] & follows)
    begun = np.maximum.accumulate(np.where(begins, place, 0), axis=1)
    return np.where(had, place - begun + 1, 0)


def _whole(counts: Floats) -> Floats:
    """Return counts without the error of float32: numbers close to a whole one become it."""
    whole = np.round(counts)
    return np.where(np.abs(counts - whole) < CLOSE, whole, counts)


def _statistics(rows: LaneRows) -> tuple[Floats, Floats]:
    """Return the statistics of a lane, and the numbers of decisions behind them; NaN for none."""
    before, fall = rows.before, rows.before - rows.after
    goes_on, is_long = rows.has & rows.had, rows.age_s >= LONG_S
    greens = (rows.has & ~rows.had, goes_on & ~is_long, goes_on & is_long)
    ends = (*CLASSES[1:], np.inf)
    cells = [
        (outcome, green & ~rows.held & (before >= low) & (before < end))
        for outcome in (rows.left, fall)
        for green in greens
        for low, end in zip(CLASSES, ends, strict=True)
    ]
    cells.append((-fall, ~rows.has & ~rows.had & ~rows.full))
    means, counts = zip(*(_mean(outcome, use) for outcome, use in cells), strict=True)
    whole = [np.nan] * 3
    if len(before):
        whole = [before.mean(), before.std(), np.quantile(before, 0.99)]
    return np.array([*means, *whole]), np.array([*counts, *[float(len(before))] * len(whole)])


def _mean(outcome: Floats, use: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the mean of the used decisions, and their number; NaN for none."""
    rows = outcome[use & ~np.isnan(outcome)]
    return float(rows.mean()) if len(rows) else np.nan, float(len(rows))


def _onward(network: Network, lanes: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """Return, for each lane, the positions in `lanes` of the lanes that its links lead to."""
    places = {lane: k for k, lane in enumerate(lanes)}
    ways: list[dict[int, None]] = [{} for _ in lanes]
    for item in network.intersections:
        for link in item.links:
            if link.to_lane in places:
                ways[places[link.from_lane]][places[link.to_lane]] = None
    return tuple(map(tuple, ways))


def _beyond(
    network: Network, lanes: Sequence[str]
) -> tuple[tuple[tuple[int, tuple[int, ...]], ...], ...]:
    """Return `LaneView.beyond` for the observation `movements`, which shows outgoing lanes last."""
    at_lights = frozenset(lanes)
    found: list[tuple[tuple[int, tuple[int, ...]], ...]] = []
    for item in network.intersections:
        own = {lane: k for k, lane in enumerate(item.incoming_lanes)}
        ways: dict[str, set[int]] = {}
        for link in item.links:
            ways.setdefault(link.to_lane, set()).add(own[link.from_lane])
        found.append(
            tuple(
                (2 * len(own) + place, tuple(sorted(ways[lane])))
                for place, lane in enumerate(item.outgoing_lanes)
                if lane not in at_lights and network.lanes[lane].storage_veh >= LEAST_HOLDS
            )
        )
    return tuple(found)


def _greens(item: Intersection) -> NDArray[np.bool_]:
    table = np.zeros((len(item.incoming_lanes), len(item.phases)), dtype=np.bool_)
    places = {lane: k for k, lane in enumerate(item.incoming_lanes)}
    for link in item.links:
        if link.from_lane in places:
            shown: Sequence[str] = [phase[link.index] for phase in item.phases]
            table[places[link.from_lane]] |= np.array([letter in GREEN for letter in shown])
    return table
