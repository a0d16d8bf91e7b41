"""Eyes of the street: dead lanes, short zones, noise, lag and dropout of detectors, from logs.

Counts on a lane obey rules that no traffic breaks: nobody leaves while the light is red, a queue
falls when it gets green, and counts are whole numbers. Where the street's counts break a rule that
those of the simulation keep, a detector is at fault. Each fault is estimated from its own rule:

- dead lane: it reports 0 in a whole episode, although vehicles arrive there in the simulation;
- zone: no count is ever above n, although counts above n are common in the simulation and n
  itself is often reached; in light traffic vehicles leave lanes that were empty a moment before;
- noise: counts fall in red, as far and as often as those of the simulation do with the same noise;
- coarse counts: all counts are multiples of a number;
- lag: the number of decisions for which counts go on falling in the red;
- dropout: a count stays the same while a long queue is served.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ugat_marl.data import TransitionLog, consecutive
from ugat_marl.effects import (
    ControllerPart,
    CountingError,
    CountingNoise,
    DeadDetectors,
    DetectionZone,
    LostReadings,
    ObservationDelay,
    QuantisedCounts,
    Sensor,
)
from ugat_marl.errors import CheckpointError, OptionError, counted, require_kinds, require_ranges
from ugat_marl.files import MALFORMED
from ugat_marl.grounding.draws import DRAWS, quantile_metrics
from ugat_marl.grounding.summaries import CLOSE, Floats, LaneRows, LaneView
from ugat_marl.scenarios import VEHICLE_SPACE_M, Network
from ugat_marl.seeding import numpy_generator

LEVELS = (0.0, 0.5, 2.0, 5.0, 9.0, np.inf)
"""Limits of the classes of counts in which falls in red are compared."""
FASTER = 1.25
"""Multiple of the speed limit that hardly anybody drives: 1 in 160 of SUMO's passenger cars."""
ZONES_M = (10.0, 15.0, 20.0, 30.0, 45.0, 70.0, 100.0)
"""Lengths of zones that are simulated, in m."""


@dataclass(frozen=True)
class EyesConfig:
    """Numbers of the method.

    Attributes:
        surprise: Smallest number of observations before a fault is found: on a lane, so many of the
            simulation would have broken the street's limit. Halved, a quiet hour looks like a zone
            or a dead lane.
        together: Decisions that count as one observation, because queues change slowly.
        limit: Quantile of the counts that is taken for their limit. By hand: single larger counts
            are noise. At 1 one reading decides.
        margin: Standard deviations of the noise by which the limit is lowered, since noise raises
            the largest counts. Halved, zones look longer under noise.
        filled: Smallest share of counts at the limit of a zone, of that of the simulation's counts
            which reach it: queues fill a zone, and quiet traffic never does. On the shipped
            networks zones have 0.4 or more, half of the traffic 0.05 or less.
        unseen: Share of the greens that vehicles pass in which the lane was empty before, beyond
            the simulation's, from which zones are simulated. Perfect detectors have 0.01 on roads
            of 360 m under V1 and V4, late, lost and noisy counts as well; a zone of 50 m has 0.2.
        shift: Relative difference that is allowed between the street's share and the simulation's
            in a zone of the same length. V1, V3 and V4 have 0.14 to 0.21 less than `sim`.
        pull: Episodes that the network's share of dead lanes counts for at each lane.
        queue: Vehicles on a lane from which its count must fall when it has green.
        fraction: Distance from a whole number, in vehicles, above which a count has noise.
        most_lag: Longest lag, in decisions.
        absolute: Standard deviations of the absolute error that are tried, in vehicles.
        relative: Standard deviations of the relative error that are tried.
        long_queue: Vehicles on a lane that is served without pause.
        least_served: Fewest decisions with a long queue from which lost readings, or late counts,
            are estimated.
        least_stays: Fewest of them in which the count stayed.
        least_lost: Smallest share of lost readings that counts as found.
    """

    surprise: float = 8.0
    together: float = 10.0
    limit: float = 0.998
    margin: float = 2.0
    filled: float = 0.2
    unseen: float = 0.05
    shift: float = 0.2
    pull: float = 2.0
    queue: float = 4.0
    fraction: float = 0.02
    most_lag: int = 4
    absolute: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 14.0, 20.0)
    relative: tuple[float, ...] = (0.0, 0.03, 0.06, 0.1, 0.15, 0.2, 0.3)
    long_queue: float = 7.0
    least_served: int = 20
    least_stays: int = 5
    least_lost: float = 0.08

    def __post_init__(self) -> None:
        require_kinds(self, "eyes")
        require_ranges(
            self,
            "eyes",
            at_least={"most_lag": 0, "least_served": 1, "least_stays": 1},
            positive=("surprise", "together", "pull"),
            non_negative=("queue", "long_queue", "fraction", "margin"),
            shares=("limit", "filled", "unseen", "shift", "least_lost"),
        )
        for name in ("absolute", "relative"):
            tried = getattr(self, name)
            if not tried or not all(0 <= value < math.inf for value in tried):
                raise OptionError(f"eyes {name} is {tried}; allowed: numbers >= 0, at least one")


@dataclass(frozen=True)
class Eyes:
    """Fitted faults of detectors.

    Attributes:
        dead: Expected chance that a lane is dead in an episode, ``(lanes,)``.
        zone_m: Shortest and longest zone that the counts allow, in m; (0, 0) for whole lanes.
        absolute: Standard deviation of an error that does not depend on the count, in vehicles.
        relative: Standard deviation of an error relative to the count.
        lag: Decisions by which counts are late.
        lost: Share of readings that are lost.
        step: Number of which all counts are multiples, in vehicles; 0 for whole numbers.
    """

    dead: Floats
    zone_m: tuple[float, float]
    absolute: float
    relative: float
    lag: int
    lost: float
    step: float = 0.0

    @property
    def changes(self) -> bool:
        """True if some fault was found."""
        faults = (self.zone_m[1], self.absolute, self.relative, self.lag, self.lost, self.step)
        return bool(self.dead.any()) or any(faults)

    def parts(self, seed: int, lanes: Sequence[str], interval_s: float) -> list[ControllerPart]:
        """Return the faults of an episode, drawn where they are not certain.

        Args:
            seed: Seed of the episode.
            lanes: Ids of the lanes.
            interval_s: Seconds from one decision to the next.
        """
        generator = numpy_generator(seed, "eyes")
        found: list[ControllerPart] = []
        if self.zone_m[1]:
            found.append(DetectionZone(float(generator.uniform(*self.zone_m))))
        if self.absolute:
            found.append(CountingError(self.absolute))
        if self.relative:
            found.append(CountingNoise(self.relative))
        if self.lag:
            found.append(ObservationDelay(self.lag * interval_s))
        if self.lost:
            found.append(LostReadings(self.lost))
        if self.step:
            found.append(QuantisedCounts(self.step))
        dead = generator.random(len(lanes)) < self.dead
        if dead.any():
            found.append(DeadLanes([lane for lane, gone in zip(lanes, dead, strict=True) if gone]))
        return found

    def describe(self) -> str:
        """Return what was found in one line."""
        return f"detectors: {detectors_in_words(self._numbers())}"

    def _numbers(self) -> dict[str, float]:
        """Return the faults as numbers, without chances of single lanes."""
        return {
            "dead": float(self.dead.sum()),
            "zone_m": self.zone_m[1],
            "absolute": self.absolute,
            "relative": self.relative,
            "lag": float(self.lag),
            "lost": self.lost,
            "step": self.step,
        }

    def as_dict(self, lanes_of: Mapping[str, Sequence[int]]) -> dict[str, float]:
        """Return flat numbers for the metrics of a run.

        Args:
            lanes_of: Agent to the positions of its lanes.
        """
        numbers = {f"eyes/{name}": value for name, value in self._numbers().items()}
        if self.dead.any():
            dead = numpy_generator(0, "eyes", "dead").random((DRAWS, len(self.dead))) < self.dead
            unseen = [dead[:, list(places)].sum(1) for places in lanes_of.values()]
            numbers |= quantile_metrics("eyes/unseen", np.array(unseen), lanes_of)
        return numbers

    def state_dict(self) -> dict[str, Any]:
        """Return the faults as plain values."""
        return {**asdict(self), "dead": self.dead.tolist(), "zone_m": list(self.zone_m)}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Eyes:
        """Restore `state_dict`.

        Raises:
            CheckpointError: A value is missing.
        """
        try:
            low_m, high_m = map(float, state["zone_m"])
            return cls(
                np.array(state["dead"], dtype=np.float64),
                (low_m, high_m),
                float(state["absolute"]),
                float(state["relative"]),
                int(state["lag"]),
                float(state["lost"]),
                float(state["step"]),
            )
        except MALFORMED as error:
            raise CheckpointError(f"the eyes in the checkpoint are damaged: {error}") from None


_FAULTS = {
    "dead": lambda lanes: f"{lanes:.1f} lanes are not seen",
    "zone_m": lambda zone_m: f"vehicles count only within {zone_m:.0f} m of the stop line",
    "absolute": lambda error: f"counts err by {error:.1f} vehicles",
    "relative": lambda error: f"counts err by {100 * error:.0f} %",
    "lag": lambda lag: f"counts are {counted(round(lag), 'decision')} late",
    "lost": lambda share: f"{100 * share:.0f} % of the counts are lost",
    "step": lambda step: f"counts come in steps of {step:g} vehicles",
}


def detectors_in_words(numbers: Mapping[str, float]) -> str:
    """Return the faults of detectors in words.

    Args:
        numbers: Fault to its number, as `Eyes` has them: dead lanes in all, longest zone.
    """
    parts = [say(numbers[name]) for name, say in _FAULTS.items() if numbers.get(name)]
    return ", ".join(parts) or "no fault found"


class DeadLanes(ControllerPart):
    """Detectors of given lanes that report 0."""

    name: ClassVar[str] = "dead lanes"

    def __init__(self, lanes: Sequence[str]) -> None:
        self._lanes = tuple(lanes)

    def state_dict(self) -> dict[str, Any]:
        """Return the lanes."""
        return {"lanes": list(self._lanes)}

    def sensor(self, network: Network, decision_interval_s: float) -> Sensor:
        """Make a sensor with these dead detectors."""
        table = network.lane_table()
        dead = np.zeros(len(table.ids), dtype=np.bool_)
        dead[table.indices(self._lanes)] = True
        return _DeadSensor(dead)


class _DeadSensor(DeadDetectors):
    """Dead detectors that are the same in every episode."""

    def __init__(self, dead: NDArray[np.bool_]) -> None:
        super().__init__(1.0, len(dead))
        self.dead = dead

    def reset(self, seed: int) -> None:
        """Draw nothing."""


def fit_eyes(
    street: TransitionLog,
    simulated: TransitionLog,
    view: LaneView,
    config: EyesConfig | None = None,
) -> Eyes:
    """Fit the faults of detectors to a log of the street.

    Args:
        street: Transitions of the street.
        simulated: Transitions of the same policy in the simulation, whose detectors are perfect.
        view: Lanes of the network.
        config: Numbers of the method.
    """
    config = config or EyesConfig()
    rows, perfect = view.rows(street), view.rows(simulated)
    lag = _lag(rows, perfect, config)
    noisy, step = _noisy(rows, perfect, config), _step(rows)
    absolute, relative = _noise(rows, perfect, config) if noisy else (0.0, 0.0)
    return Eyes(
        dead=_dead(rows, perfect, config),
        zone_m=_zone(rows, perfect, absolute, config),
        absolute=absolute,
        relative=relative,
        lag=lag,
        lost=0.0 if noisy or step else _lost(rows, config),
        step=step,
    )


def _dead(rows: Sequence[LaneRows], perfect: Sequence[LaneRows], config: EyesConfig) -> Floats:
    """Return each lane's expected chance to be dead in an episode."""
    dead, episodes = np.zeros(len(rows)), np.zeros(len(rows))
    busy_lanes = [float((x.before > 0).mean()) if len(x.before) else 0.0 for x in perfect]
    quiet = _quietness(rows, busy_lanes)
    for place, (lane, busy) in enumerate(zip(rows, busy_lanes, strict=True)):
        leaving = _leaving(perfect[place])
        for episode in np.unique(lane.episode):
            counts = lane.before[lane.episode == episode]
            expected = quiet[int(episode)] * len(counts)
            if min(busy * expected / config.together, leaving * expected) < config.surprise:
                continue  # nobody might have come
            episodes[place] += 1
            dead[place] += not counts.any()
    share = dead.sum() / max(episodes.sum(), 1.0)
    return (dead + config.pull * share) / (episodes + config.pull)


def _leaving(perfect: LaneRows) -> float:
    """Return how many vehicles leave a lane in a decision; infinite if that was not measured.

    Very short lanes: the simulation counts the upstream queue on them. If no vehicle leaves such a
    lane, a street detector that does not reach upstream reports 0 without being dead.
    """
    left = perfect.left[np.isfinite(perfect.left)]
    return float(left.mean()) if len(left) else math.inf


def _quietness(rows: Sequence[LaneRows], busy: Sequence[float]) -> dict[int, float]:
    """Return, by episode, how often lanes had vehicles, as a share of the simulation's; at most 1.

    Lanes without any vehicle in the log are left out, since they may be dead. It is 1 if no lane
    has one.
    """
    shares: dict[int, float] = {}
    alive = [k for k, own in enumerate(rows) if own.before.any()]
    usual = sum(busy[k] for k in alive)
    for episode in np.unique(np.concatenate([own.episode for own in rows])).tolist():
        seen = [rows[k].before[rows[k].episode == episode] > 0 for k in alive]
        share = sum(float(lane.mean()) for lane in seen if len(lane))
        shares[episode] = min(1.0, share / usual) if usual > 0 else 1.0
    return shares


_BEYOND = 0.3
"""Largest share of the counts at the limit of a zone that are above it. By hand. Half of the queues
of a busy lane without a zone go on; under noise some counts are above."""


def _zone(
    rows: Sequence[LaneRows],
    perfect: Sequence[LaneRows],
    noise: float,
    config: EyesConfig,
) -> tuple[float, float]:
    """Return the shortest and longest zone in m; (0, 0) if counts are not cut."""
    alive = [place for place, own in enumerate(rows) if own.before.any()]
    if not alive:
        return 0.0, 0.0
    every = _counts([rows[place] for place in alive])
    most = float(np.quantile(every, config.limit)) - config.margin * noise
    cut = max(1.0, round(most))
    # One lane of a city is long, and ten are shorter than a zone: each tells for itself.
    telling = [
        k
        for k in alive
        if float((perfect[k].before > cut + 0.5).mean()) * len(rows[k].before)
        >= config.surprise * config.together
    ]
    if not telling:
        return 0.0, 0.0
    counts, usual = (_counts([lanes[k] for k in telling]) for lanes in (rows, perfect))
    at_limit, reaching = (float((x > cut - 0.5).mean()) for x in (counts, usual))
    piled_up = float((counts > cut + 0.5).mean()) <= _BEYOND * at_limit
    if not piled_up or at_limit < config.filled * reaching:
        return 0.0, 0.0
    return VEHICLE_SPACE_M * max(cut - 1.0, 0.5), VEHICLE_SPACE_M * (cut + 0.5)


def leave_unseen(
    street: TransitionLog, simulated: TransitionLog, view: LaneView, config: EyesConfig
) -> bool:
    """Return True if vehicles leave empty lanes of the street, though not of the simulation.

    Whoever leaves a lane that is longer than the way of a decision was there before.

    Args:
        street: Transitions of the street.
        simulated: Transitions of the same policy in the simulation, whose detectors are perfect.
        view: Lanes of the network.
        config: Numbers of the method.
    """
    long = _long(street, view)
    (seen, passed), (usual, _) = (_unseen(view.rows(log), long) for log in (street, simulated))
    beyond = seen - usual
    return beyond > config.unseen and beyond * passed > config.surprise


def zone_of_unseen(
    street: TransitionLog,
    simulated: Mapping[float, TransitionLog],
    view: LaneView,
    config: EyesConfig,
) -> tuple[float, float]:
    """Return the shortest and longest zone from which as many vehicles leave unseen, in m.

    Args:
        street: Transitions of the street.
        simulated: Length of a zone in m, to transitions of the same policy in the simulation.
        view: Lanes of the network.
        config: Numbers of the method.

    Returns:
        Zones in m; (0, 0) if fewer leave unseen than from the longest zone that was simulated.
    """
    metres, long = np.array(sorted(simulated)), _long(street, view)
    rows, tried = view.rows(street), [view.rows(simulated[each]) for each in metres.tolist()]
    share, passed = _unseen(rows, long)
    error = 2.0 * math.sqrt(share * (1.0 - share) / max(passed, 1))
    most, least = (share + error) * (1.0 + config.shift), (share - error) * (1.0 - config.shift)
    # the longer a zone, the fewer leave it unseen
    unseen = np.minimum.accumulate([_unseen(zone, long)[0] for zone in tried])
    if most < unseen[-1]:
        return 0.0, 0.0
    low, high = np.interp([-most, -least], -unseen, metres).tolist()
    counts = _counts(rows)
    most_seen = float(counts.max())
    low = max(low, VEHICLE_SPACE_M * (most_seen - 1.0))  # so many stand in it
    # and in a longer zone more of them would
    above = [(_counts(zone) > most_seen).mean() for zone in tried]
    too_long = metres[np.array(above) * len(counts) > config.surprise]
    return low, max(low, min([high, *too_long.tolist()]))


def _counts(rows: Sequence[LaneRows]) -> Floats:
    """Return the counts of all lanes."""
    return np.concatenate([own.before for own in rows])


def _long(log: TransitionLog, view: LaneView) -> NDArray[np.bool_]:
    """Return True for the lanes that nobody passes within a decision, ``(lanes,)``."""
    return view.passed_s > FASTER * log.provenance.decision_interval_s


def _unseen(rows: Sequence[LaneRows], long: NDArray[np.bool_]) -> tuple[float, int]:
    """Return how often vehicles pass long lanes, and the share in which these were empty before.

    Returns:
        The share, and the number of decisions in which vehicles pass.
    """
    used = [own for own, use in zip(rows, long, strict=True) if use]
    passed = sum(int((own.left > CLOSE).sum()) for own in used)
    empty = sum(int(((own.left > CLOSE) & (own.before == 0)).sum()) for own in used)
    return empty / max(passed, 1), passed


def _fraction(rows: Sequence[LaneRows]) -> float:
    """Return the mean distance of counts from whole numbers."""
    counts = _counts(rows)
    return float(np.abs(counts - np.round(counts)).mean())


def _noisy(rows: Sequence[LaneRows], perfect: Sequence[LaneRows], config: EyesConfig) -> bool:
    """Return True if counts are no whole numbers.

    Lanes that share the road behind them have halves of vehicles even in the simulation, the more
    the longer queues are. Such lanes are used only if every lane is of this kind.
    """
    whole = [own for own, usual in zip(rows, perfect, strict=True) if not _fraction([usual])]
    if whole:
        return _fraction(whole) > config.fraction
    return _fraction(rows) - _fraction(perfect) > config.fraction


def _noise(
    rows: Sequence[LaneRows], perfect: Sequence[LaneRows], config: EyesConfig
) -> tuple[float, float]:
    """Return the absolute and relative standard deviation of counting errors.

    Both kinds of noise are added to the simulation's counts on a grid. The pair whose falls in red
    are most like the street's is the answer.
    """
    generator = numpy_generator(0, "eyes", "noise")
    before, after = _in_red(perfect)
    seen = _in_red(rows)
    if not len(before) or not len(seen[0]):  # no red tells nothing of noise
        return 0.0, 0.0
    drawn = generator.standard_normal((2, 2, len(before)))
    wanted = _falls(*seen)
    best, answer = np.inf, (0.0, 0.0)
    for absolute in config.absolute:
        for relative in config.relative:
            noisy = [
                np.maximum(counts * np.maximum(1.0 + relative * z[0], 0.0) + absolute * z[1], 0.0)
                for counts, z in zip((before, after), drawn, strict=True)
            ]
            misfit = float(((_falls(*noisy) - wanted) ** 2).sum())
            if misfit < best:
                best, answer = misfit, (absolute, relative)
    return answer


def _in_red(rows: Sequence[LaneRows]) -> tuple[Floats, Floats]:
    """Return counts before and after the decisions in which a lane has red; dead lanes are out."""
    alive = [own for own in rows if own.before.any()] or list(rows)
    red = [~own.had & ~own.has for own in alive]
    before = np.concatenate([own.before[use] for own, use in zip(alive, red, strict=True)])
    after = np.concatenate([own.after[use] for own, use in zip(alive, red, strict=True)])
    return before, after


def _falls(before: Floats, after: Floats) -> Floats:
    """Return root mean squares of falls by classes of the count, and the share of zeros."""
    fall = np.maximum(before - after, 0.0) ** 2
    found: list[float] = []
    for low, high in itertools.pairwise(LEVELS):
        use = (before >= low) & (before < high)
        found.append(float(np.sqrt(fall[use].mean())) if use.sum() > 2 else 0.0)
    return np.array([*found, float((before == 0).mean())])


def _step(rows: Sequence[LaneRows]) -> float:
    """Return the number of which all counts are multiples; 0 if it is 1 or there is none."""
    counts = _counts(rows)
    counts = np.unique(counts[counts > 0])
    if len(counts) < 2 or np.abs(counts - np.round(counts)).max() > 0:
        return 0.0
    step = float(np.gcd.reduce(counts.astype(np.int64)))
    return step if step > 1 else 0.0


def _lag(rows: Sequence[LaneRows], perfect: Sequence[LaneRows], config: EyesConfig) -> int:
    """Return the number of decisions by which counts are late.

    Late counts go on falling in the red after a green, for as many decisions as they are late.
    Slow drivers do not: their queues begin to fall late in the green, and stand in the red. A
    decision of red counts as late if counts fall there at least half as far as in green, measured
    from the fall that perfect detectors show there.
    """
    greens = [_fall_in_green(rows, lag, config) for lag in range(config.most_lag + 1)]
    most = max((fall for fall in greens if not math.isnan(fall)), default=0.0)
    for lag in range(1, config.most_lag + 1):
        late, usual = (_fall_in_red(lanes, lag, config) for lanes in (rows, perfect))
        if not late - usual > max(0.0, (most - usual) / 2):  # also if one is not known
            return lag - 1
    return config.most_lag


def _since_green(own: LaneRows) -> NDArray[np.int64]:
    """Return the decisions since a lane had its last green; 0 in green, -1 if none is known."""
    since = np.zeros(len(own.has), dtype=np.int64)
    goes_on = np.concatenate([[False], consecutive(own.episode, own.step)])
    for t in range(len(since)):
        before = since[t - 1] if goes_on[t] else -1
        since[t] = 0 if own.has[t] else before + (before >= 0)
    return since


def _fall_in_red(rows: Sequence[LaneRows], lag: int, config: EyesConfig) -> float:
    """Return the mean fall of long queues in the decision of red of this number.

    It is NaN with fewer than `least_served` of them, as where zones are too short for queues.
    """
    falls = [
        (own.before - own.after)[(own.before >= config.queue) & (_since_green(own) == lag)]
        for own in rows
    ]
    return _mean_of_many(falls, config)


def _fall_in_green(rows: Sequence[LaneRows], lag: int, config: EyesConfig) -> float:
    """Return the mean fall of long queues, `lag` decisions after a green; NaN if there are few."""
    falls: list[Floats] = []
    for own in rows:
        green = own.has.copy()
        for _ in range(lag):
            green = np.concatenate([[False], green[:-1] & consecutive(own.episode, own.step)])
        falls.append((own.before - own.after)[(own.before >= config.queue) & green])
    return _mean_of_many(falls, config)


def _mean_of_many(parts: Sequence[Floats], config: EyesConfig) -> float:
    together = np.concatenate(parts)
    return float(together.mean()) if len(together) >= config.least_served else math.nan


def _lost(rows: Sequence[LaneRows], config: EyesConfig) -> float:
    """Return the share of lost readings, from counts that stay while a long queue is served.

    After a lost reading the count falls by what left in two decisions; after a decision in which
    nobody left it falls as usual. With r the ratio of the two falls, r - 1 of the stays are lost.
    """
    stays: list[bool] = []
    after_stay: list[float] = []
    after_fall: list[float] = []
    for own in rows:
        served = own.had & own.has & (own.before >= config.long_queue)
        follows = served[:-1] & served[1:] & consecutive(own.episode, own.step)
        fall = own.before - own.after
        stayed = follows & (fall[:-1] == 0)
        stays += (fall[served] == 0).tolist()
        after_stay += fall[1:][stayed].tolist()
        after_fall += fall[1:][follows & (fall[:-1] > 0)].tolist()
    if len(stays) < config.least_served or len(after_stay) < config.least_stays:
        return 0.0
    usual = float(np.mean(after_fall)) if after_fall else 0.0
    ratio = float(np.mean(after_stay)) / usual if usual > 0 else 1.0
    share = float(np.mean(stays)) * min(max(ratio - 1.0, 0.0), 1.0)
    return share if share >= config.least_lost else 0.0
