"""Command channel of the street: which phase runs, given the phases that were asked for.

On a street a command may be late, lost or refused. The channel is a mixture over the command that
takes effect at a decision t, and a table of permitted phases:

    arrives_t  = asked_(t - k) with chance w_k, k = 0, 1, ..., most_lag;  nothing with chance w_lost
    executed_t = obeyed(arrives_t, running phase, age of its green)

`obeyed` keeps the running phase if nothing arrives or if the command is forbidden. If the running
phase itself must end, the next permitted one follows. A delay of two decisions is w_2 = 1; lost
commands are w_lost; an order of phases and a longest green are entries of the table.

The weights are found by expectation-maximisation, pooled over the network (partial pooling): the
weights of an intersection have the prior Dirichlet(pull * w of the network). Their posterior is
drawn by data augmentation (Tanner, Wong 1987), in which every lag is possible.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr

from ugat_marl.data import AgentLayout, TransitionLog, Transitions, consecutive
from ugat_marl.effects import Actuator, Commands, ControllerPart
from ugat_marl.errors import (
    CheckpointError,
    LogError,
    counted,
    require_kinds,
    require_ranges,
)
from ugat_marl.files import MALFORMED
from ugat_marl.grounding.draws import DRAWS, quantile_metrics
from ugat_marl.scenarios import Network, SignalState, SignalTiming
from ugat_marl.seeding import numpy_generator

Floats = NDArray[np.float64]

LEAST_WHOLE = 0.2
"""Smallest share of decisions that must have a whole history: right before them, as many decisions
of their episode as the longest delay of a command."""
UNEXPLAINED = 1e-3
"""Chance of a decision that no lag explains."""
CHANCE = 1e-3
"""Chance of so few obeyed commands below which a phase is forbidden, where the log has no masks."""
ROUNDS = 200
"""Most rounds of expectation-maximisation, which ends when the weights stay as they are."""
PRIOR_LOST = 0.5
"""Decisions that the prior of draws counts as lost; all lags together count as one decision."""
SWEEPS = 3
"""Sweeps of data augmentation for each draw of the weights."""
BURN_IN = 20
"""First draws that are left out, since they are not yet of the posterior."""
Table = NDArray[np.bool_]
"""Permitted phases of an intersection, bool ``(ages, phases, phases)``: entry (a, p, j) is True if
phase j may run next while p has run for a decisions. Row 0 is not used; the last row is of older
greens, too."""


@dataclass(frozen=True)
class ChannelConfig:
    """Numbers of the method.

    Attributes:
        most_lag: Longest delay of a command, in decisions. Commands that are later still spread
            over all lags, since none explains them.
        pull: Decisions that the weights of a network of many count for at each intersection.
            Halved, intersections with short logs are believed sooner.
        least_rows: Fewest observations of an entry of the table before it may forbid a phase, where
            the log has no masks. Halved, a few lost commands look like a forbidden phase.
        refused: Share of the usual chance of being obeyed below which a phase is forbidden, where
            the log has no masks.
        least_share: Smallest weight of a lag, or of lost commands, that counts as found. Smaller
            ones are set to 0: coincidences give weights below it.
        gain: Gain in log likelihood that a further lag needs, in units of log(decisions). Halved
            (the criterion of Schwarz), late commands are found that are only lost.
    """

    most_lag: int = 6
    pull: float = 30.0
    least_rows: int = 5
    refused: float = 0.2
    least_share: float = 0.02
    gain: float = 1.0

    def __post_init__(self) -> None:
        require_kinds(self, "channel")
        require_ranges(
            self,
            "channel",
            at_least={"most_lag": 0, "least_rows": 1},
            positive=("pull",),
            non_negative=("gain",),
            below_one=("refused", "least_share"),
        )


@dataclass(frozen=True)
class CommandChannel(ControllerPart):
    """Fitted channel of all intersections.

    Attributes:
        agents: The agents, in the environment's order.
        network: Weights pooled over the network, ``(most_lag + 2,)``: those of the lags 0, 1, ...
            and, last, of lost commands.
        weights: Most likely weights of each intersection, ``(agents, most_lag + 2)``.
        draws: Draws of `weights` from their posterior, ``(n, agents, most_lag + 2)``.
        tables: Permitted phases of each intersection.
    """

    name: ClassVar[str] = "command channel"
    agents: tuple[str, ...]
    network: Floats
    weights: Floats
    draws: Floats
    tables: tuple[Table, ...]

    @property
    def lag(self) -> int:
        """Most frequent delay of commands, in decisions."""
        return int(self.network[:-1].argmax())

    @property
    def lost(self) -> float:
        """Share of lost commands in the network."""
        return float(self.network[-1])

    @property
    def late(self) -> bool:
        """True if some commands take effect at a later decision."""
        return bool(self.network[1:-1].any())

    @property
    def forbids(self) -> bool:
        """True if some phase is forbidden at some age."""
        return not all(table[1:].all() for table in self.tables)

    @property
    def changes(self) -> bool:
        """True if the channel is more than "every command is obeyed at once"."""
        return bool(self.network[0] < 1.0) or self.forbids

    @property
    def memory(self) -> int:
        """Number of own commands that a policy has to see; 0 for a channel that changes nothing."""
        late = np.flatnonzero(self.network[:-1] > 0)
        return max(1, int(late.max(initial=0))) if self.changes else 0

    def drawn(self, seed: int) -> Floats:
        """Draw weights from the posterior, ``(agents, most_lag + 2)``."""
        return numpy_generator(seed, "channel", "weights").choice(self.draws)

    def actuator(
        self, network: Network, timing: SignalTiming, decision_interval_s: float
    ) -> FittedActuator | None:
        """Return an actuator that acts as the channel; each episode draws its weights."""
        return FittedActuator(self, timing, decision_interval_s) if self.changes else None

    def describe(self) -> str:
        """Return what was found in one line."""
        shares = dict(enumerate(self.network[:-1].tolist()))
        return f"commands: {commands_in_words(shares, self.lost, self.forbids)}"

    def as_dict(self, interval_s: float) -> dict[str, float]:
        """Return flat numbers for the metrics of a run.

        Args:
            interval_s: Seconds from one decision to the next.
        """
        lags = enumerate(self.network[:-1])
        numbers = {f"channel/lag_{k}": float(w) for k, w in lags if w > 0}
        numbers["channel/lost"] = self.lost
        numbers["channel/forbids"] = float(self.forbids)
        if self.late:
            arrive = self.draws[:, :, :-1] / (1.0 - self.draws[:, :, -1:]).clip(1e-9)
            late_s = interval_s * arrive @ np.arange(arrive.shape[-1])
            numbers |= quantile_metrics("channel/late_s", late_s.T, self.agents)
        if self.lost:
            numbers |= quantile_metrics("channel/missing", self.draws[:, :, -1].T, self.agents)
        return numbers

    def state_dict(self) -> dict[str, Any]:
        """Return the channel as plain values."""
        return {
            "agents": list(self.agents),
            "network": self.network.tolist(),
            "weights": self.weights.tolist(),
            "draws": self.draws.tolist(),
            "tables": [table.astype(int).tolist() for table in self.tables],
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> CommandChannel:
        """Restore `state_dict`.

        Raises:
            CheckpointError: A value is missing or of a wrong shape.
        """
        try:
            channel = cls(
                tuple(map(str, state["agents"])),
                np.array(state["network"], float),
                np.array(state["weights"], float),
                np.array(state["draws"], float),
                tuple(np.array(table, bool) for table in state["tables"]),
            )
        except MALFORMED as error:
            raise CheckpointError(f"the channel in the checkpoint is damaged: {error}") from None
        shape = len(channel.agents), len(channel.network)
        arrays_fit = channel.weights.shape == channel.draws.shape[1:] == shape
        if not arrays_fit or not len(channel.draws) or len(channel.tables) != shape[0]:
            raise CheckpointError("the channel in the checkpoint has parts of unequal length")
        return channel


def commands_in_words(shares: Mapping[int, float], lost: float, forbids: bool) -> str:
    """Return what became of commands, in words.

    Args:
        shares: Delay in decisions to the share of commands that are so late.
        lost: Share of commands that are lost.
        forbids: True if some changes of phase are refused.
    """
    parts = [
        f"{100 * share:.0f} % take effect {counted(lag, 'decision')} late"
        for lag, share in sorted(shares.items())
        if lag and share
    ]
    parts += [f"{100 * lost:.0f} % are lost"] if lost else []
    parts += ["some changes of phase are refused"] if forbids else []
    return ", ".join(parts) or "obeyed at once"


class FittedActuator(Actuator):
    """Actuator that delays, loses and refuses commands as a fitted channel does.

    Args:
        channel: The fitted channel.
        timing: Clearance of the simulation's signals.
        interval_s: Seconds between two decisions.
    """

    def __init__(self, channel: CommandChannel, timing: SignalTiming, interval_s: float) -> None:
        self._channel = channel
        self._timing = timing
        self._interval_s = interval_s
        self._given: deque[Commands] = deque(maxlen=len(channel.network) - 1)
        self._chances: Floats
        self._generator: np.random.Generator

    def reset(self, seed: int) -> None:
        """Draw the weights of the episode."""
        nothing: Commands = [None] * len(self._channel.tables)
        self._given.clear()
        self._given.extend([nothing] * self._channel.lag)
        self._chances = self._channel.drawn(seed).cumsum(1)
        self._generator = numpy_generator(seed, "channel", "commands")

    def send(self, commands: Commands) -> Commands:
        """Return the command that arrives at each intersection; None where nothing arrives."""
        self._given.appendleft(list(commands))
        draws = self._generator.random((len(commands), 1))
        kinds = (draws > self._chances[:, :-1]).sum(1)
        return [
            self._given[kind][place] if kind < len(self._given) else None
            for place, kind in enumerate(kinds.tolist())
        ]

    @property
    def under_way(self) -> Sequence[Commands]:
        """The commands that have not arrived at the most frequent delay, the oldest first."""
        return list(self._given)[: self._channel.lag][::-1]

    def restrict(self, mask: NDArray[np.int8], place: int, state: SignalState) -> None:
        """Forbid the phases that the table forbids; a mask never becomes empty."""
        table = self._channel.tables[place]
        begun_s = state.elapsed_s + (0.0 if state.clearing else self._timing.clearance_s)
        # A phase that began between two decisions is of age 1 at the second, as in a log.
        age = max(1, math.ceil(begun_s / self._interval_s - 1e-6))
        allowed = table[min(age, len(table) - 1), state.phase]
        if (mask * allowed).any():
            mask *= allowed


def require_histories(log: TransitionLog, most: int) -> None:
    """Refuse a log whose decisions are not in sequence, since nothing late can be seen in it.

    Args:
        log: Transitions of the street.
        most: Longest delay that is looked for, in decisions.

    Raises:
        LogError: Too few decisions of an agent have a whole history.
    """
    # episodes of this length have as large a share of whole histories as is asked for
    shortest = math.ceil(most / (1 - LEAST_WHOLE))
    for agent in log.agents:
        rows = log.transitions(agent)
        begins = np.r_[True, ~consecutive(rows.episode, rows.step)]
        places = np.arange(len(rows))
        before = places - np.maximum.accumulate(np.where(begins, places, 0))
        whole = int((before >= most).sum())
        if whole < LEAST_WHOLE * len(rows):
            raise LogError(
                f"only {whole} of the {len(rows)} decisions of {agent} in the log have {most} "
                "decisions right before them in their episode; a fitted street is read from "
                "histories of commands and counts, so record whole episodes of "
                f"{shortest} decisions or more and keep their steps, or choose another grounding "
                "(--grounding timed)"
            )


def fit_channel(
    log: TransitionLog, config: ChannelConfig | None = None, held_s: float = 0.0
) -> CommandChannel:
    """Fit the channel to a log of the street.

    Args:
        log: Transitions with the asked and the executed phases; with masks, if there are any.
        config: Numbers of the method.
        held_s: Time from a command to the end of the shortest green, in s. The simulation keeps a
            phase so long by itself, and so masks that keep it forbid nothing.

    Raises:
        LogError: An agent has fewer than two rows.
    """
    config = config or ChannelConfig()
    interval_s = log.provenance.decision_interval_s
    courses = [
        _Course.of(log.transitions(agent), layout, config, held_s / interval_s)
        for agent, layout in log.provenance.layouts.items()
    ]
    # The network's weights count less the more of them is the intersection's own.
    config = replace(config, pull=max(1.0, config.pull * (1.0 - 1.0 / len(courses))))
    masked = all(course.mask is not None for course in courses)
    tables = [course.free_table() for course in courses]
    explains = _explaining(courses, tables, None, config)
    network, weights = _mixture(explains, config)
    lags = [int(own[:-1].argmax()) for own in weights]
    if masked:
        tables = [course.table_of_masks(lag) for course, lag in zip(courses, lags, strict=True)]
    else:
        tables = [
            course.table_of_refusals(lag, float(own[lag]), config)
            for course, own, lag in zip(courses, weights, lags, strict=True)
        ]
    if not masked or any(lags):
        explains = _explaining(courses, tables, lags, config)
        network, weights = _mixture(explains, config)
    draws = _draws(explains, config.pull)
    return CommandChannel(tuple(log.agents), network, weights, draws, tuple(map(_trimmed, tables)))


@dataclass(frozen=True)
class _Course:
    """Decisions of one intersection in order; n rows.

    Attributes:
        asked: ``(most_lag + 1, n)``, commands at this decision and at earlier ones; -1 before the
            episode.
        running: Phase that runs at the decision, ``(n,)``.
        age: Decisions since it began, ``(n,)``; 0 if it began before the episode.
        executed: Phase that runs afterwards, ``(n,)``.
        mask: Permitted phases, ``(n, phases)``; None if the log has none.
        left: Decisions until the end of the episode, ``(n,)``.
        phases: Number of phases.
        held: Decisions for which the simulation keeps a phase by itself.
    """

    asked: NDArray[np.int64]
    running: NDArray[np.int64]
    age: NDArray[np.int64]
    executed: NDArray[np.int64]
    mask: NDArray[np.bool_] | None
    left: NDArray[np.int64]
    phases: int
    held: float

    @classmethod
    def of(
        cls, rows: Transitions, layout: AgentLayout, config: ChannelConfig, held: float
    ) -> _Course:
        """Read the rows of an agent."""
        count = len(rows)
        if count < 2:
            raise LogError("a channel needs a log with two decisions or more of every agent")
        shown = rows.observation[:, layout.features : layout.features + layout.phases]
        running = shown.argmax(1).astype(np.int64)
        goes_on = consecutive(rows.episode, rows.step)
        asked = np.full((config.most_lag + 1, count), -1, dtype=np.int64)
        asked[0] = rows.action
        for lag in range(1, len(asked)):
            asked[lag, 1:] = np.where(goes_on, asked[lag - 1, :-1], -1)
        age, left = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        for t in range(1, count):
            if goes_on[t - 1]:
                same = running[t] == running[t - 1]
                age[t] = (age[t - 1] + (age[t - 1] > 0)) if same else 1
        for t in range(count - 2, -1, -1):
            left[t] = left[t + 1] + 1 if goes_on[t] else 0
        mask = rows.mask if rows.mask.shape[1] else None
        return cls(asked, running, age, rows.executed, mask, left, layout.phases, held)

    @property
    def ages(self) -> int:
        """Number of ages of the tables."""
        return max(2, int(self.age.max()) + 1)

    def free_table(self) -> Table:
        """Return a table that permits everything."""
        return np.ones((self.ages, self.phases, self.phases), dtype=np.bool_)

    def table_of_masks(self, lag: int) -> Table:
        """Return the table that the masks show, for commands that arrive `lag` decisions later."""
        assert self.mask is not None
        rows = np.flatnonzero(self.left >= lag)
        states = rows + lag
        known = self.age[states] > 0
        alone = self.mask[rows].sum(1) == 1
        known &= ~(alone & (self.age[states] < self.held))  # the green was held, as in sim
        rows, states = rows[known], states[known]
        shape = (self.ages, self.phases)
        cells = np.ravel_multi_index((self.age[states], self.running[states]), shape)
        seen = _tally(cells, shape)
        permitted = np.stack(
            [_tally(cells, shape, mask.astype(float)) for mask in self.mask[rows].T], axis=-1
        )
        return _filled(permitted >= 0.5 * seen[:, :, None], seen > 0)

    def table_of_refusals(self, lag: int, usual: float, config: ChannelConfig) -> Table:
        """Return the table that refused commands show, for a log without masks.

        A phase is forbidden if commands for it were hardly ever obeyed: after this running phase,
        or at this age. A green must end at an age at which commands to keep it were refused.

        Args:
            lag: Delay of commands, in decisions.
            usual: Usual chance that a command is obeyed.
            config: Numbers of the method.
        """
        command = self.asked[lag]
        valid = (command >= 0) & (self.age > 0) & (self.age >= self.held)  # held, as in sim
        changes = valid & (command != self.running)
        stays = valid & (command == self.running)
        obeyed = self.executed == command
        shape = (self.phases, self.phases)
        pairs = np.ravel_multi_index((self.running[changes], command[changes]), shape)
        pair = _tally(pairs, shape), _tally(pairs, shape, obeyed[changes].astype(float))
        by_age = [
            (
                _tally(self.age[rows], (self.ages,)),
                _tally(self.age[rows], (self.ages,), obeyed[rows].astype(float)),
            )
            for rows in (changes, stays)
        ]

        def refused(numbers: tuple[Floats, Floats]) -> NDArray[np.bool_]:
            given, taken = numbers
            few = taken < config.refused * usual * given
            return (
                (given >= config.least_rows)
                & few
                & (bdtr(taken, given.astype(int), usual) < CHANCE)
            )

        table = self.free_table()
        table[:, refused(pair)] = False
        other = ~np.eye(self.phases, dtype=np.bool_)
        table[np.ix_(refused(by_age[0]))] &= ~other
        must_end = np.maximum.accumulate(refused(by_age[1]))
        table[must_end] &= other
        return table

    def permitted(self, table: Table, lag: int) -> NDArray[np.bool_]:
        """Return the phases that may run next, ``(n, phases)``.

        Args:
            table: What counts where the log has no mask.
            lag: Delay of the commands that masks are of, in decisions: a mask is of the state in
                which the command given with it will arrive.
        """
        allowed = table[np.maximum(self.age, 1), self.running]
        allowed[self.age == 0] = True  # the age of a green from before the episode is not known
        if self.mask is not None:
            rows = np.flatnonzero(self.asked[lag] >= 0)
            allowed[rows] = self.mask[rows - lag]
        else:
            young = np.flatnonzero((self.age > 0) & (self.age < self.held))
            allowed[young] = np.eye(self.phases, dtype=np.bool_)[self.running[young]]
        return allowed


def obeyed(
    commands: NDArray[np.int64], running: NDArray[np.int64], allowed: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Return the phases that run if these are asked for, ``(n,)``, by the rule of environments.

    Where a forbidden phase is asked for, the light stays; if it has to change, the next permitted
    phase of its list follows.

    Args:
        commands: ``(n,)`` phases asked for; -1 for none.
        running: ``(n,)`` phases that run now.
        allowed: ``(n, phases)`` action masks.
    """
    rows = np.arange(len(commands))
    taken = (commands >= 0) & allowed[rows, np.maximum(commands, 0)]
    later = allowed & (np.arange(allowed.shape[1]) > running[:, None])
    following = np.where(later.any(1), later.argmax(1), allowed.argmax(1))
    stays = np.where(allowed[rows, running], running, following)
    return np.where(taken, commands, stays)


def _tally(
    cells: NDArray[np.int64], shape: tuple[int, ...], weights: Floats | None = None
) -> Floats:
    """Return the sum of weights (or the number of rows) in each cell, in this shape."""
    size = int(np.prod(shape))
    return np.bincount(cells, weights, size).astype(np.float64).reshape(shape)


def _filled(table: Table, seen: NDArray[np.bool_]) -> Table:
    """Return the table with ages that were not seen filled in from the nearest younger one.

    Without a younger age the nearest older one serves; a phase that was never seen is free.
    """
    ages = np.arange(len(table))[:, None]
    younger = np.maximum.accumulate(np.where(seen, ages, -1))
    nearest = np.where(younger < 0, seen.argmax(0), younger)
    return table[nearest, np.arange(table.shape[1])] | ~seen.any(0, keepdims=True).T


def _trimmed(table: Table) -> Table:
    """Return the table without the last ages that permit what the age before them does."""
    differs = np.flatnonzero((table[1:] != table[-1]).any((1, 2)))
    return table[: 2 + (differs[-1] + 1 if len(differs) else 0)]


def _explaining(
    courses: Sequence[_Course],
    tables: Sequence[Table],
    lags: Sequence[int] | None,
    config: ChannelConfig,
) -> list[NDArray[np.bool_]]:
    """Return the kinds that explain each decision of each intersection, ``(kinds, n)``.

    Args:
        courses: Decisions of each intersection.
        tables: Permitted phases of each intersection, where a log has no masks.
        lags: Delay of commands that the masks of each intersection are of; None where it is not
            known: then each delay is tried with the masks that it would have.
        config: Numbers of the method.
    """
    kinds = config.most_lag + 2
    explains: list[NDArray[np.bool_]] = []
    for place, (course, table) in enumerate(zip(courses, tables, strict=True)):
        nothing = np.full_like(course.running, -1)
        arriving = [*course.asked[: kinds - 1], nothing]
        shown = [*range(kinds - 1), 0] if lags is None else [lags[place]] * kinds
        known = course.asked[kinds - 2] >= 0  # so that every lag can explain the row
        allowed = {lag: course.permitted(table, lag) for lag in set(shown)}
        same = np.stack(
            [
                obeyed(command, course.running, allowed[lag]) == course.executed
                for command, lag in zip(arriving, shown, strict=True)
            ]
        )
        use = known & same.any(0) & ~same.all(0)  # other rows tell nothing of the weights
        explains.append(same[:, use])
    return explains


def _mixture(explains: Sequence[NDArray[np.bool_]], config: ChannelConfig) -> tuple[Floats, Floats]:
    """Find the weights of lags and of lost commands by expectation-maximisation.

    Args:
        explains: Kinds that explain each decision of each intersection, ``(kinds, n)``.
        config: Numbers of the method.

    Returns:
        The network's weights, ``(kinds,)``, and those of each intersection, ``(agents, kinds)``.
    """
    rows, number = _distinct(np.concatenate(explains, axis=1))
    kinds = len(rows)
    if not len(number):
        weights = np.eye(kinds)[0]
        return weights, np.tile(weights, (len(explains), 1))
    # A lost command keeps the phase of the decision before, which a further lag explains almost as
    # well. So lags are added one by one, as long as they explain more than chance does.
    support: set[int] = {kinds - 1}
    best = -np.inf
    weights = np.eye(kinds)[-1]
    while True:
        others = [kind for kind in range(kinds) if kind not in support]
        tried = [(_maximum(rows, number, support | {kind}), kind) for kind in others]
        (likelihood, found), lag = max(tried, key=lambda trial: trial[0][0])
        if likelihood < best + config.gain * math.log(number.sum()):
            break
        best, weights, support = likelihood, found, support | {lag}
        if len(support) == kinds:
            break
    weights = np.where(weights >= min(config.least_share, weights.max()), weights, 0.0)
    weights /= weights.sum()
    found = weights > 0
    # What all kinds that are found explain alike says nothing of their weights.
    telling = [same[:, ~same[found].all(0)] if found.sum() > 1 else same for same in explains]
    return weights, np.stack([_own_weights(same, weights, config.pull) for same in telling])


def _distinct(rows: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return the distinct columns, ``(kinds, n)``, and how often each is there, ``(n,)``.

    Decisions are many, and explained in few ways.
    """
    codes = np.packbits(rows, axis=0)  # whole numbers are sorted sooner than rows
    weights = 256 ** np.arange(len(codes), dtype=np.int64)[:, None]
    _, first, number = np.unique((codes * weights).sum(0), return_index=True, return_counts=True)
    return rows[:, first], number


def _maximum(
    rows: NDArray[np.bool_], number: NDArray[np.int64], support: set[int]
) -> tuple[float, Floats]:
    """Return the largest log likelihood of the decisions, and its weights.

    Args:
        rows: Kinds that explain each distinct decision, ``(kinds, n)``.
        number: How often it is there, ``(n,)``.
        support: Kinds that may have a weight.
    """
    weights = np.array([float(kind in support) for kind in range(len(rows))]) / len(support)
    for _ in range(ROUNDS):
        weights, before = _counts(rows, number, weights), weights
        weights = weights / weights.sum() if weights.sum() else before
        if np.abs(weights - before).max() < 1e-6:
            break
    chances = (rows * weights[:, None]).sum(0)
    return float(np.log(np.maximum(chances, UNEXPLAINED)) @ number), weights


def _own_weights(rows: NDArray[np.bool_], network: Floats, pull: float) -> Floats:
    """Return the weights of an intersection, ``(kinds,)``.

    If several lags explain a decision, the intersection's own weights divide it among them. With
    the network's weights, a light whose commands are late would look punctual.

    Args:
        rows: Kinds that explain each decision, ``(kinds, n)``.
        network: Weights of the network.
        pull: Number of decisions that the weights of the network count as.
    """
    weights = network
    rows, number = _distinct(rows)
    for _ in range(ROUNDS):
        counts = _counts(rows, number, weights)
        weights, before = (pull * network + counts) / (pull + counts.sum()), weights
        if np.abs(weights - before).max() < 1e-6:
            break
    return weights


def _draws(explains: Sequence[NDArray[np.bool_]], pull: float) -> Floats:
    """Draw weights of all intersections from their posterior, ``(n, agents, kinds)``.

    In turn a kind is drawn for each decision, among those that explain it, and weights for these
    kinds. So weights are as uncertain as the kinds are. The network's weights are drawn, too.

    Args:
        explains: Kinds that explain each decision of each intersection, ``(kinds, n)``.
        pull: Number of decisions that the weights of the network count as.
    """
    agents, kinds = len(explains), len(explains[0])
    places = np.repeat(np.arange(agents), [same.shape[1] for same in explains])
    rows = np.column_stack([places, np.concatenate(explains, axis=1).T])
    distinct, number = np.unique(rows, axis=0, return_counts=True)
    place, same = distinct[:, 0], distinct[:, 1:]
    prior = np.r_[np.full(kinds - 1, 1.0 / (kinds - 1)), PRIOR_LOST]
    generator = numpy_generator(0, "channel", "draws")
    weights = np.full((agents, kinds), 1.0 / kinds)
    draws: list[Floats] = []
    for _ in range(SWEEPS * (DRAWS + BURN_IN)):
        chances = same * weights[place]
        drawn = generator.multinomial(number, chances / chances.sum(1, keepdims=True))
        counts = np.zeros((agents, kinds))
        np.add.at(counts, place, drawn)
        network = generator.dirichlet(prior + counts.sum(0))
        shares = generator.standard_gamma(prior + pull * network + counts)
        weights = shares / shares.sum(1, keepdims=True)
        draws.append(weights)
    return np.array(draws[SWEEPS * BURN_IN :: SWEEPS])


def _counts(rows: NDArray[np.bool_], number: NDArray[np.int64], weights: Floats) -> Floats:
    """Return the expected number of decisions of each kind, ``(kinds,)`` (the E step)."""
    chances = rows * weights[:, None]
    total = chances.sum(0)
    return (chances[:, total > 0] / total[total > 0]) @ number[total > 0]
