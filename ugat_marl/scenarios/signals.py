"""Signal timing as pure functions: requested phase -> min green, yellow, all-red, green.

The state machine shows yellow between green and red, unless its duration is 0. It holds every green
for the minimum, and it completes each clearance that it has begun. It does not depend on SUMO.
"""

from __future__ import annotations

import bisect
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ugat_marl.errors import OptionError, ScenarioError

GREEN = frozenset("Gg")
AMBER = frozenset("yY")
"""Yellow after a green. Red-amber (u) comes before one."""
YELLOW = AMBER | {"u"}
SIGNAL_LETTERS = frozenset("rugGyYoOs")
"""SUMO's letters: red, red-yellow, green (minor g, major G), yellow, off, right on red (s)."""

Segment = tuple[float, str]
"""A duration in seconds and the state shown for it."""

_INSTANT_S = 1e-6
"""Tolerance in comparisons of times: sums of tenths are not exact, and SUMO counts milliseconds."""


@dataclass(frozen=True)
class SignalTiming:
    """Clearance and minimum green in seconds."""

    yellow_s: float
    all_red_s: float
    min_green_s: float

    def __post_init__(self) -> None:
        for name in ("yellow_s", "all_red_s", "min_green_s"):
            if getattr(self, name) < 0:
                raise OptionError(f"{name} = {getattr(self, name)} must not be negative")

    @property
    def clearance_s(self) -> float:
        """Seconds between the end of a green and the start of the next."""
        return self.yellow_s + self.all_red_s


class SignalState(NamedTuple):
    """State of the signal machine of one intersection.

    Attributes:
        phase: Green phase that is shown, or that follows the current clearance.
        origin: Green phase before the current clearance; equal to `phase` when green.
        elapsed_s: Seconds since the green or the clearance began.
    """

    phase: int
    origin: int
    elapsed_s: float

    @property
    def clearing(self) -> bool:
        """True while yellow or all-red is shown."""
        return self.phase != self.origin

    def later(self, seconds: float) -> SignalState:
        """Return the state `seconds` later, with no change in between."""
        return SignalState(self.phase, self.origin, self.elapsed_s + seconds)


def initial_state(timing: SignalTiming) -> SignalState:
    """Return phase 0, green for the minimum green, so that any phase may follow."""
    return SignalState(0, 0, timing.min_green_s)


def free_to_change(state: SignalState, timing: SignalTiming, within_s: float) -> bool:
    """Return True if a change requested now begins within the next `within_s` seconds."""
    wait = timing.min_green_s - state.elapsed_s
    if state.clearing:
        wait = timing.clearance_s - state.elapsed_s + timing.min_green_s
    return wait < within_s - _INSTANT_S


def phase_mask(phases: int, running: int, *, free: bool) -> NDArray[np.int8]:
    """Return 1 for each phase that may be requested now, else 0.

    Args:
        phases: Number of phases of the light.
        running: The phase that runs.
        free: True if the light may change, see `free_to_change`.

    Returns:
        int8, ``(phases,)``: all ones, or one for the phase that runs.
    """
    if free:
        return np.ones(phases, dtype=np.int8)
    mask = np.zeros(phases, dtype=np.int8)
    mask[running] = 1
    return mask


def green_begins_at_once(timing: SignalTiming, interval_s: float) -> bool:
    """Return True if every green begins within the decision that requests it.

    This holds if the clearance is shorter than an interval and the minimum green fits into the rest
    of the interval. Then a light may change at once at every decision.
    """
    left_s = interval_s - timing.clearance_s
    return left_s > _INSTANT_S and timing.min_green_s <= left_s + _INSTANT_S


def advance(
    phases: Sequence[str],
    state: SignalState,
    requested: int,
    seconds: float,
    timing: SignalTiming,
) -> tuple[SignalState, list[Segment]]:
    """Run the machine of one intersection for `seconds` under one request.

    The machine completes a running clearance, holds the minimum green, and then shows yellow,
    all-red and the requested phase. Links that are green in both phases stay green in between.

    Args:
        phases: Green states of the intersection, one letter per link.
        state: State of the machine.
        requested: Index of the requested phase.
        seconds: Length of the decision interval.
        timing: Clearance and minimum green.

    Returns:
        The state afterwards, and the segments shown. Their durations add up to `seconds`.
    """
    assert 0 <= requested < len(phases)
    if requested == state.phase and not state.clearing:
        return state.later(seconds), [(seconds, phases[requested])]
    if not state.clearing:  # beyond the minimum, the age of a green does not matter: fewer cases
        state = SignalState(state.phase, state.origin, min(state.elapsed_s, timing.min_green_s))
    after, shown = _course(tuple(phases), state, requested, seconds, timing)
    return after, list(shown)


@functools.lru_cache(maxsize=65536)
def _course(
    phases: tuple[str, ...],
    state: SignalState,
    requested: int,
    seconds: float,
    timing: SignalTiming,
) -> tuple[SignalState, tuple[Segment, ...]]:
    """Compute `advance`. The cache helps because the machine visits few states many times."""
    shown: list[Segment] = []
    left = seconds
    while left > _INSTANT_S:
        state, segment = _next_segment(phases, state, requested, left, timing)
        if segment[0] > 0:
            _append(shown, segment)
        left -= segment[0]
    return state, tuple(shown)


def _next_segment(
    phases: Sequence[str], state: SignalState, requested: int, left: float, timing: SignalTiming
) -> tuple[SignalState, Segment]:
    """Return the longest stretch of constant state from now on, at most `left` seconds."""
    green = phases[state.phase]
    if state.clearing:
        origin = phases[state.origin]
        if state.elapsed_s < timing.yellow_s - _INSTANT_S:
            until, shown = timing.yellow_s, yellow_between(origin, green)
        elif state.elapsed_s < timing.clearance_s - _INSTANT_S:
            until, shown = timing.clearance_s, red_between(origin, green)
        else:
            return SignalState(state.phase, state.phase, 0.0), (0.0, green)
        duration = min(until - state.elapsed_s, left)
        return state.later(duration), (duration, shown)
    if requested == state.phase:
        return state.later(left), (left, green)
    held = timing.min_green_s - state.elapsed_s
    if held > _INSTANT_S:
        duration = min(held, left)
        return state.later(duration), (duration, green)
    return SignalState(requested, state.phase, 0.0), (0.0, green)


def _append(shown: list[Segment], segment: Segment) -> None:
    if shown and shown[-1][1] == segment[1]:
        shown[-1] = (shown[-1][0] + segment[0], segment[1])
    else:
        shown.append(segment)


@functools.cache
def yellow_between(origin: str, target: str) -> str:
    """Return yellow where a green ends; green where it continues, ``g`` if either one is ``g``."""
    return "".join(_ending(a, b, "y") for a, b in zip(origin, target, strict=True))


@functools.cache
def red_between(origin: str, target: str) -> str:
    """Return red where a green ended or is about to begin; green where it continues."""
    return "".join(_ending(a, b, "r") for a, b in zip(origin, target, strict=True))


def _ending(before: str, after: str, cleared: str) -> str:
    if before in GREEN and after in GREEN:
        return "g" if "g" in (before, after) else "G"
    if before in GREEN:
        return cleared
    return before if before == after else "r"


class LateGreenMemory(NamedTuple):
    """Memory of `with_late_green` about one traffic light.

    Attributes:
        commanded: State commanded last, one letter per link.
        shown: State shown last, one letter per link.
        waiting_s: Seconds until each link's green is shown; 0 if it is not delayed, infinite if its
            green was never shown before its yellow.
        owed_s: Delay not yet given to each link, less than one step.
    """

    commanded: str
    shown: str
    waiting_s: tuple[float, ...]
    owed_s: tuple[float, ...]

    @classmethod
    def after(cls, state: str) -> LateGreenMemory:
        """Return the memory of a light that shows `state` and has no delays."""
        nothing = (0.0,) * len(state)
        return cls(state, state, nothing, nothing)


def with_late_green(
    segments: Sequence[Segment],
    late_s: float | Sequence[float],
    step_s: float,
    before: LateGreenMemory,
) -> tuple[LateGreenMemory, list[Segment]]:
    """Delay greens: every link that turns green stays red for `late_s` first.

    The end of the green does not move. Greens are delayed by whole steps of the simulation, and the
    remainder is added to the delay of the link's next green:

        steps = floor((owed + late_s) / step_s),  owed' = owed + late_s - steps * step_s.

    The mean delay over many greens is therefore `late_s`. If a green is shorter than its delay,
    neither it nor its yellow is shown.

    Args:
        segments: Commanded states.
        late_s: Delay of each green, s; one for all links, or one for each.
        step_s: Length of a simulation step, s.
        before: Memory of earlier commands.

    Returns:
        The new memory, and the segments shown. Their total duration is that of `segments`.
    """
    late = late_s if isinstance(late_s, float | int) else tuple(late_s)
    after, shown = _late_course(tuple(segments), late, step_s, before)
    return after, list(shown)


@functools.lru_cache(maxsize=65536)
def _late_course(
    segments: tuple[Segment, ...],
    late_s: float | tuple[float, ...],
    step_s: float,
    before: LateGreenMemory,
) -> tuple[LateGreenMemory, tuple[Segment, ...]]:
    """Compute `with_late_green`. The cache helps because plans and memories recur."""
    shown: list[Segment] = []
    state = before
    late = (late_s,) * len(state.commanded) if isinstance(late_s, float | int) else late_s
    for duration, commanded in segments:
        state = _commanded(state, commanded, late, step_s)
        left = duration
        while left > _INSTANT_S:
            visible = "".join(
                held if wait > _INSTANT_S else letter
                for letter, held, wait in zip(commanded, state.shown, state.waiting_s, strict=True)
            )
            waits = [wait for wait in state.waiting_s if wait > _INSTANT_S]
            part = min([left, *(wait for wait in waits if wait < math.inf)])
            _append(shown, (part, visible))
            waiting = tuple(max(wait - part, 0.0) for wait in state.waiting_s)
            state = LateGreenMemory(commanded, visible, waiting, state.owed_s)
            left -= part
    return state, tuple(shown)


class Withheld(NamedTuple):
    """Red that is shown to single links while they have green, in s.

    Attributes:
        begin_s: For each link, red at the beginning of its green.
        each_s: For each link, red at the beginning of every decision in which its green goes on.
    """

    begin_s: tuple[float, ...]
    each_s: tuple[float, ...]


class GreenDelays:
    """Delay greens at many traffic lights: always by their late green, or once on request.

    Args:
        shown: Traffic light to the state it shows at the start.
        late_s: Traffic light to the delay of each green, s; lights left out have no delay.
        step_s: Length of a simulation step, s.
        withheld: Traffic light to the red of its single links, beside `late_s`.
    """

    def __init__(
        self,
        shown: Mapping[str, str],
        late_s: Mapping[str, float],
        step_s: float,
        withheld: Mapping[str, Withheld] | None = None,
    ) -> None:
        self._late_s = late_s
        self._step_s = step_s
        self._withheld = withheld or {}
        self._asked: Mapping[str, float] = {}
        self._commanded = dict(shown)
        self._held: dict[
            str, LateGreenMemory
        ] = {}  # lights with a delayed link or an owed remainder

    def ask(self, seconds: Mapping[str, float]) -> None:
        """Set, per traffic light, the extra delay in s of greens that begin in the next `hold`."""
        self._asked = seconds

    def hold(self, plans: Mapping[str, list[Segment]]) -> dict[str, list[Segment]]:
        """Return the segments shown instead of `plans`, which hold one decision of every light."""
        shown = dict(plans)
        for tls, plan in plans.items():
            late: float | list[float]
            late = self._late_s.get(tls, 0.0) + self._asked.get(tls, 0.0)
            before = self._held.pop(tls, None)
            withheld = self._withheld.get(tls)
            if late or before or withheld:
                before = before or LateGreenMemory.after(self._commanded[tls])
                if withheld:
                    late = [late + own for own in withheld.begin_s]
                    before = _paused(before, plan[0][1], withheld.each_s, self._step_s)
                after, shown[tls] = with_late_green(plan, late, self._step_s, before)
                if after.shown != after.commanded or any(after.owed_s):
                    self._held[tls] = after
            self._commanded[tls] = plan[-1][1]
        self._asked = {}
        return shown


def _paused(
    state: LateGreenMemory, commanded: str, each_s: Sequence[float], step_s: float
) -> LateGreenMemory:
    """Return the memory after a pause has begun in every shown green that goes on."""
    shown, waiting, owed = list(state.shown), list(state.waiting_s), list(state.owed_s)
    for link, (letter, new) in enumerate(zip(state.shown, commanded, strict=True)):
        if each_s[link] and letter in GREEN and new in GREEN:
            total = owed[link] + each_s[link]
            steps = math.floor(total / step_s + _INSTANT_S)
            waiting[link], owed[link] = steps * step_s, total - steps * step_s
            if steps:
                shown[link] = "r"
    return LateGreenMemory(state.commanded, "".join(shown), tuple(waiting), tuple(owed))


def _commanded(
    state: LateGreenMemory, commanded: str, late_s: Sequence[float], step_s: float
) -> LateGreenMemory:
    """Return the memory when `commanded` begins; its `shown` holds the letters of delayed links."""
    if commanded == state.commanded:
        return state
    shown, waiting, owed = list(state.shown), list(state.waiting_s), list(state.owed_s)
    for link, (old, new) in enumerate(zip(state.commanded, commanded, strict=True)):
        if new in GREEN and old not in GREEN:
            total = owed[link] + late_s[link]
            steps = math.floor(total / step_s + _INSTANT_S)
            waiting[link], owed[link] = steps * step_s, total - steps * step_s
            shown[link] = "s" if old == "s" else "r"
        elif new in YELLOW and (
            waiting[link] == math.inf or (old in GREEN and shown[link] not in GREEN)
        ):
            waiting[link] = math.inf  # its green was never shown
        elif new not in GREEN:
            waiting[link] = 0.0
    return LateGreenMemory(commanded, "".join(shown), tuple(waiting), tuple(owed))


def late_green_log(
    log: Sequence[tuple[float, str]], late_s: float, step_s: float
) -> tuple[tuple[float, str], ...]:
    """Apply `with_late_green` to the log of a light.

    Args:
        log: ``(since_s, state)`` at every change.
        late_s: Delay of each green, s.
        step_s: Length of a simulation step, s.
    """
    if len(log) < 2:
        return tuple(log)
    state = LateGreenMemory.after(log[0][1])
    delayed = [(float(log[0][0]), log[0][1])]
    for (since, commanded), until in zip(
        log[1:], [*(since for since, _ in log[2:]), math.inf], strict=True
    ):
        duration = until - since if until < math.inf else late_s + 2 * step_s
        state, shown = with_late_green([(duration, commanded)], late_s, step_s, state)
        time = since
        for seconds, visible in shown:
            if visible != delayed[-1][1]:
                delayed.append((time, visible))
            time += seconds
    return tuple(delayed)


def withheld_log(
    log: Sequence[tuple[float, str]],
    red: Withheld,
    late_s: float,
    step_s: float,
    decision_s: float,
    end_s: float,
) -> tuple[tuple[float, str], ...]:
    """Show red to single links in the log of a light, as `GreenDelays` does in an environment.

    Args:
        log: ``(since_s, state)`` at every change.
        red: Red of single links.
        late_s: Delay of each green, s.
        step_s: Length of a simulation step, s.
        decision_s: Time between two decisions, s; the first one is at the start of the log.
        end_s: End of the log, s.
    """
    if not log:
        return ()
    since = [time for time, _ in log]
    delays = GreenDelays({"": log[0][1]}, {"": late_s}, step_s, {"": red})
    shown: list[tuple[float, str]] = [(float(since[0]), log[0][1])]
    time = float(since[0])
    while time < end_s:
        after = time + decision_s
        first = bisect.bisect_right(since, time) - 1
        last = bisect.bisect_left(since, after)
        edges = [time, *since[first + 1 : last], after]
        states = [state for _, state in log[first:last]]
        plan = [(b - a, s) for a, b, s in zip(edges[:-1], edges[1:], states, strict=True)]
        for seconds, state in delays.hold({"": plan})[""]:
            if state != shown[-1][1]:
                shown.append((time, state))
            time += seconds
        time = after  # sums of tenths are not exact
    return tuple(shown)


def check_phases(phases: Sequence[str], links: int, source: str) -> None:
    """Refuse phase lists a signal cannot show.

    Args:
        phases: Green states.
        links: Number of links the traffic light controls.
        source: Name of the list in errors.

    Raises:
        ScenarioError: A phase has a wrong length, an unknown letter, yellow or no green, or is
            listed twice.
    """
    seen: dict[str, int] = {}
    for index, phase in enumerate(phases):
        where = f"{source}: phase {index} ({phase!r})"
        if len(phase) != links:
            raise ScenarioError(
                f"{where} has {len(phase)} letters, but the traffic light controls {links} links; "
                "give one letter per link"
            )
        if unknown := sorted(set(phase) - SIGNAL_LETTERS):
            raise ScenarioError(
                f"{where} has unknown letters {unknown}; allowed: {sorted(SIGNAL_LETTERS)}"
            )
        if set(phase) & YELLOW:
            raise ScenarioError(
                f"{where} has yellow; list green phases only, yellow is put in between them"
            )
        if not set(phase) & GREEN:
            raise ScenarioError(f"{where} has no green (G or g); leave it out or give it one")
        if phase in seen:
            raise ScenarioError(f"{where} is listed twice, as phase {seen[phase]} before")
        seen[phase] = index
