"""Signal timing as pure functions: requested phase -> min green, yellow, all-red, green.

The machine never shows green and then red without yellow, holds every green for the minimum, and
does not change its mind while clearing. It knows nothing of SUMO.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ugat_marl.errors import OptionError, ScenarioError

GREEN = frozenset("Gg")
YELLOW = frozenset("yYu")
STATES = frozenset("rugGyYoOs")
"""Letters SUMO knows: red, red-yellow, green (minor, major), yellow, off, right-on-red."""

Segment = tuple[float, str]
"""A duration in seconds and the state shown for it."""

_INSTANT_S = 1e-6
"""Sums of tenths are not exact in binary; SUMO counts in milliseconds."""


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
    """Where the machine of one intersection stands.

    Attributes:
        phase: Green phase shown, or cleared towards.
        origin: Green phase being cleared; equal to `phase` when green.
        elapsed_s: Seconds since the green began, or since the clearance began.
    """

    phase: int
    origin: int
    elapsed_s: float

    @property
    def clearing(self) -> bool:
        """Whether yellow or all-red is shown."""
        return self.phase != self.origin

    def later(self, seconds: float) -> SignalState:
        """The same light, `seconds` later."""
        return SignalState(self.phase, self.origin, self.elapsed_s + seconds)


def initial_state(timing: SignalTiming) -> SignalState:
    """Phase 0, green for long enough that any phase may follow."""
    return SignalState(0, 0, timing.min_green_s)


def free_to_change(state: SignalState, timing: SignalTiming, within_s: float) -> bool:
    """Whether a request made now is begun within the next `within_s` seconds."""
    wait = timing.min_green_s - state.elapsed_s
    if state.clearing:
        wait = timing.clearance_s - state.elapsed_s + timing.min_green_s
    return wait < within_s - _INSTANT_S


def advance(
    phases: Sequence[str],
    state: SignalState,
    requested: int,
    seconds: float,
    timing: SignalTiming,
) -> tuple[SignalState, list[Segment]]:
    """Runs the machine of one intersection for `seconds` under one request.

    A clearance in progress is completed, the minimum green is held, and then the requested phase
    follows behind yellow and all-red. Links that are green in both phases stay green in between.

    Args:
        phases: Green states of the intersection, one letter per link.
        state: Where the machine stands.
        requested: Index of the phase asked for.
        seconds: Length of the decision interval.
        timing: Clearance and minimum green.

    Returns:
        The state afterwards, and what is shown: segments whose durations add up to `seconds`.
    """
    assert 0 <= requested < len(phases)
    if requested == state.phase and not state.clearing:
        return state.later(seconds), [(seconds, phases[requested])]
    if not state.clearing:  # a long green behaves like one of the minimum: few cases to remember
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
    """`advance`, remembered: the machine is in few states, and asked many times in each."""
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
    """The longest stretch of constant state that starts now, at most `left` seconds."""
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
    """Yellow where a green ends; green where it goes on, with the weaker of the two rights."""
    return "".join(_ending(a, b, "y") for a, b in zip(origin, target, strict=True))


@functools.cache
def red_between(origin: str, target: str) -> str:
    """Red where a green ended or is about to begin; green where it goes on."""
    return "".join(_ending(a, b, "r") for a, b in zip(origin, target, strict=True))


def _ending(before: str, after: str, cleared: str) -> str:
    if before in GREEN and after in GREEN:
        return "g" if "g" in (before, after) else "G"
    if before in GREEN:
        return cleared
    return before if before == after else "r"


def check_phases(phases: Sequence[str], links: int, source: str) -> None:
    """Refuses phase lists a signal cannot show.

    Args:
        phases: Green states.
        links: Number of links the traffic light controls.
        source: What to call the list in errors.

    Raises:
        ScenarioError: A wrong length, an unknown letter, yellow, no green, or a phase given twice.
    """
    seen: dict[str, int] = {}
    for index, phase in enumerate(phases):
        where = f"{source}: phase {index} ({phase!r})"
        if len(phase) != links:
            raise ScenarioError(
                f"{where} has {len(phase)} letters, but the traffic light controls {links} links; "
                "give one letter per link"
            )
        if unknown := sorted(set(phase) - STATES):
            raise ScenarioError(f"{where} has unknown letters {unknown}; allowed: {sorted(STATES)}")
        if set(phase) & YELLOW:
            raise ScenarioError(
                f"{where} has yellow; list green phases only, yellow is put in between them"
            )
        if not set(phase) & GREEN:
            raise ScenarioError(f"{where} has no green (G or g); leave it out or give it one")
        if phase in seen:
            raise ScenarioError(f"{where} is listed twice, as phase {seen[phase]} before")
        seen[phase] = index
