"""Lights of a street under their signal machines, with a check of what they really show."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from ugat_marl.errors import OptionError, SimulatorError
from ugat_marl.field.safety import Light
from ugat_marl.field.site import Site
from ugat_marl.field.street import Street
from ugat_marl.field.watchdog import TrustLimits
from ugat_marl.scenarios import Segment

_POLL_S = 0.2
"""Time between two looks at a light that has not obeyed yet, s."""
_SLACK_S = 1e-6


@dataclass
class _Course:
    """States that one light is to show until the end of an interval.

    Attributes:
        segments: Durations and states that are left; the first one is asked for now.
        before: State that the light showed before it was asked.
        asked_s: Time of that command, s.
        since_s: Time at which the light was first seen to obey, s; None before.
    """

    segments: deque[Segment]
    before: str
    asked_s: float
    since_s: float | None = None

    @property
    def state(self) -> str:
        return self.segments[0][1]

    @property
    def until_s(self) -> float | None:
        """End of the state of now, s; None if the light has not obeyed yet."""
        return None if self.since_s is None else self.since_s + self.segments[0][0]

    def moves_on(self, now_s: float) -> bool:
        """Return True after turning to the next state, if the one of now got its full time."""
        if len(self.segments) == 1 or self.ends_after(now_s):
            return False
        _, self.before = self.segments.popleft()
        self.asked_s, self.since_s = now_s, None
        return True

    def goes_on(self, now_s: float) -> bool:
        """Return True if there is more to show: a next state, or the rest of the state of now."""
        return len(self.segments) > 1 or self.ends_after(now_s)

    def ends_after(self, now_s: float) -> bool:
        """Return True if the state of now has not got its full time yet."""
        return self.until_s is None or self.until_s > now_s + _SLACK_S


class Lights:
    """All lights of a street: what they are asked to show, and whether they do.

    A command is sent only to a light that was just seen to show what was asked of it before. A
    light that shows something else is taken over anew, from what it shows. Otherwise the machine
    would clear a green that is not there, and cut the one that is.

    Args:
        site: The intersections.
        street: The street.
        limits: `TrustLimits.obey_s` and `TrustLimits.look_every_s` are used.
        all_seen: Whether it is an error that the street lacks a light, or that a light shows a
            state that it cannot have; else it is a fault of that light.

    Attributes:
        machines: Traffic light to its signal machine.

    Raises:
        OptionError: The street lacks a light, or a light shows a state that it cannot have.
        SimulatorError: The street shows none of the lights.
    """

    def __init__(
        self, site: Site, street: Street, limits: TrustLimits, *, all_seen: bool = True
    ) -> None:
        self._site, self._street, self._limits = site, street, limits
        self._phases = {item.id: item.phases for item in site.network.intersections}
        shown = dict(street.shown())
        if not all_seen:
            own = {light: shown[light] for light in site.lights if light in shown}
            shown = {light: state for light, state in own.items() if self._can_show(light, state)}
        lacking = [light for light in site.lights if light not in shown]
        if lacking and all_seen:
            raise OptionError(f"the street has no traffic light {lacking[0]!r}; it has {[*shown]}")
        if len(lacking) == len(site.lights):
            raise SimulatorError(f"the street does not say what {lacking[0]!r} shows, nor others")
        self._asked: dict[str, str | None] = {light: shown.get(light) for light in site.lights}
        """State that each light was asked for last; None while it does not say what it shows."""
        self.machines = {
            light: Light(phases, site.timing, shown.get(light, "r" * len(phases[0])))
            for light, phases in self._phases.items()
        }
        self._requested = dict.fromkeys(site.lights, 0)
        self._commanded: set[str] = set()
        self._faults: dict[str, str] = {}
        self._seen_s = street.now_s()

    def _can_show(self, light: str, state: str) -> bool:
        """Return whether a light can have a state."""
        try:
            Light(self._phases[light], self._site.timing, state)
        except OptionError:
            return False
        return True

    def faults(self) -> dict[str, str]:
        """Return light to fault, ``<kind>: <details>``, since the last call; look once more."""
        if self._street.now_s() != self._seen_s:
            self._send(self._compare({}, 0.0))
        unseen = [light for light, state in self._asked.items() if state is None]
        found, self._faults = self._faults, {}
        return dict.fromkeys(unseen, "unseen: it does not say what it shows") | found

    def plan(self, phases: Mapping[str, int]) -> dict[str, list[Segment]]:
        """Return light to its states in the coming interval, for the lights that can be seen.

        Args:
            phases: Light to the phase that it is asked for.
        """
        self._requested = dict(phases)
        interval = self._site.decision_interval_s
        return {
            light: machine.advance(phases[light], interval)
            for light, machine in self.machines.items()
            if self._asked[light] is not None
        }

    def act(self, plans: Mapping[str, Sequence[Segment]], begun: Callable[[], None]) -> None:
        """Show the plans; each state gets its full time from when the light is seen to show it.

        Args:
            plans: Light to its states, of `plan`.
            begun: Function that is called when the first states are set.
        """
        now = self._street.now_s()
        end = now + self._site.decision_interval_s
        courses = {
            light: _Course(deque(segments), self._asked[light] or "", now)
            for light, segments in plans.items()
        }
        self._send({light: course.state for light, course in courses.items()})
        begun()
        while True:
            changes = self._compare(courses, end)
            now = self._street.now_s()
            changes |= {
                light: course.state for light, course in courses.items() if course.moves_on(now)
            }
            if changes:
                self._send(changes)
                self._send(self._compare(courses, end))
                now = self._street.now_s()
            if not any(course.goes_on(now) for course in courses.values()):
                break
            self._street.wait(self._next_look(courses.values(), now))
        if not courses and now < end:  # no light can be seen
            self._street.wait(end)

    def _next_look(self, courses: Collection[_Course], now: float) -> float:
        """Return the time of the next command or look, s."""
        looks = [now + self._limits.look_every_s]
        for course in courses:
            if course.until_s is None:
                looks.append(now + _POLL_S)
            elif course.ends_after(now):
                looks.append(course.until_s)
            elif course.goes_on(now):  # its time ended while others were asked
                looks.append(now)
        return min(looks)

    def _send(self, states: Mapping[str, str]) -> None:
        if states:
            self._street.show(states)
            self._asked |= states
            self._commanded |= states.keys()

    def _compare(self, courses: dict[str, _Course], end_s: float) -> dict[str, str]:
        """Compare what lights show with what was asked, and take over those that differ.

        Returns:
            Light to the state to ask for now, for the lights that were taken over.
        """
        shown = self._street.shown()
        now = self._seen_s = self._street.now_s()
        changes: dict[str, str] = {}
        for light, asked in self._asked.items():
            state, course = shown.get(light), courses.get(light)
            if state is None:
                self._asked[light] = None
                courses.pop(light, None)
            elif state == asked:
                if course is not None and course.since_s is None:
                    course.since_s = now
            elif not self._may_be_late(course, state, now):
                if asked is not None and light in self._commanded:
                    self._faults[light] = f"disobeys: shows {state}, was asked for {asked}"
                changes |= self._taken_over(light, state, courses, now, end_s)
        return changes

    def _may_be_late(self, course: _Course | None, state: str, now: float) -> bool:
        return (
            course is not None
            and course.since_s is None
            and state == course.before
            and now - course.asked_s < self._limits.obey_s - _SLACK_S
        )

    def _taken_over(
        self, light: str, state: str, courses: dict[str, _Course], now: float, end_s: float
    ) -> dict[str, str]:
        """Give a light a new machine that begins with what it shows; return what to ask for."""
        try:
            machine = Light(self._phases[light], self._site.timing, state)
        except OptionError:  # not a state of this light, so nobody knows what it shows
            self._asked[light] = None
            courses.pop(light, None)
            return {}
        self.machines[light] = machine
        self._asked[light] = state
        left = end_s - now
        if left <= _SLACK_S:  # the next decision plans for it
            courses.pop(light, None)
            return {light: state}
        course = _Course(deque(machine.advance(self._requested[light], left)), state, now)
        courses[light] = course
        return {light: course.state}
