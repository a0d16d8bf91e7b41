"""Lights that do not do what they are told: nothing unsafe follows, and the log says so."""

from __future__ import annotations

import itertools
import random
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import pytest

from tests.field.loop_test import LIGHT, QUICK, SITE, MadeUpStreet, Scripted, broken_rules
from ugat_marl.errors import OptionError, SimulatorError
from ugat_marl.field import FieldLoop, TrustLimits
from ugat_marl.field.lights import Lights
from ugat_marl.scenarios import SignalTiming

PHASES = SITE.network.intersections[0].phases
OTHERS = set(SITE.lights) - {LIGHT}


class Disobedient(MadeUpStreet):
    """A street whose first light follows its commands only in some seconds.

    It is safe by itself: it stays as it is, or follows a command late.
    """

    def __init__(self, obeys: Any, blind: bool = False) -> None:
        super().__init__()
        self.obeys, self.blind = obeys, blind
        self.asked = dict(self.states)
        self.told: list[tuple[float, str]] = []

    def shown(self) -> Mapping[str, str]:
        return self.asked if self.blind else self.states

    def show(self, states: Mapping[str, str]) -> None:
        self.asked |= states
        if LIGHT in states:
            self.told.append((self.time_s, states[LIGHT]))
        self._follow()

    def wait(self, until_s: float) -> None:
        while self.time_s < until_s - 1e-9:
            self.by_second.append(dict(self.states))
            self.time_s += 1.0
            self._follow()

    def _follow(self) -> None:
        for light, state in self.asked.items():
            if light != LIGHT or self.obeys(self.time_s):
                self.states[light] = state


def driven(street: MadeUpStreet, seconds: float = 400.0, seed: int = 1) -> list[Any]:
    drawn = random.Random(seed)
    policy = Scripted(lambda asked: {agent: drawn.randrange(n + 1) for agent, n in asked.items()})
    loop, made = FieldLoop(SITE, policy, street, QUICK), []
    loop.drive(seconds, made.append)
    loop.close()
    return made


def kinds(made: list[Any], light: str = LIGHT) -> list[str]:
    return [decision.fallback.get(light, "").partition(":")[0] for decision in made]


def test_a_stuck_light_is_found_at_the_next_decision_and_comes_back() -> None:
    street = Disobedient(lambda now: not 100 <= now < 200)
    made = driven(street)
    found = kinds(made)
    assert {*found[:10]} == {""}
    assert set(found[12:20]) <= {"disobeys", "returning", "beginning"}
    assert found[12:20].count("disobeys") >= 3
    assert {*found[25:]} == {""}
    assert all(not any(kinds(made, light)) for light in OTHERS)
    reasons = [decision.fallback.get(LIGHT, "") for decision in made]
    (first, *_) = [reason for reason in reasons if reason.startswith("disobeys")]
    stuck = street.by_second[150][LIGHT]
    assert first.startswith(f"disobeys: shows {stuck}, was asked for ")
    assert not broken_rules(street.by_second)


@pytest.mark.parametrize("seed", range(6))
def test_a_light_that_is_stuck_at_times_never_becomes_unsafe(seed: int) -> None:
    drawn = random.Random(seed)
    free = [drawn.random() < 0.7 for _ in range(200)]
    street = Disobedient(lambda now: free[int(now // 7) % 200])
    driven(street, 1500.0, seed)
    assert not broken_rules(street.by_second)


def test_a_loop_that_cannot_see_its_lights_makes_such_a_light_unsafe() -> None:
    """Shows that the tests above can fail."""
    street = Disobedient(lambda now: int(now // 7) % 3 > 0, blind=True)
    driven(street, 1500.0)
    assert broken_rules(street.by_second)


def test_a_light_that_shows_neither_state_after_a_command_is_at_fault_at_once() -> None:
    class Flashes(MadeUpStreet):
        """Its first light is yellow everywhere for a moment after a command."""

        flashes = False

        def shown(self) -> Mapping[str, str]:
            yellow = {LIGHT: "y" * len(PHASES[0])}
            return self.states | yellow if self.flashes else self.states

        def show(self, states: Mapping[str, str]) -> None:
            self.flashes = self.time_s == 100.0 and LIGHT in states
            super().show(states)

        def wait(self, until_s: float) -> None:
            self.flashes = False
            super().wait(until_s)

    found = kinds(driven(Flashes()))
    assert "disobeys" in found[10:13] and {*found[:10]} == {""}


@pytest.mark.parametrize("delay_s", [0.5, 1.5])
def test_a_slow_light_is_waited_for_and_is_no_fault(delay_s: float) -> None:
    class Slow(MadeUpStreet):
        """All lights follow after some tenths of a second."""

        def __init__(self) -> None:
            super().__init__()
            self.due: list[tuple[float, Mapping[str, str]]] = []

        def show(self, states: Mapping[str, str]) -> None:
            self.due.append((self.time_s + delay_s, dict(states)))

        def wait(self, until_s: float) -> None:
            while self.time_s < until_s - 1e-9:
                if abs(self.time_s - round(self.time_s)) < 1e-9:
                    self.by_second.append(dict(self.states))
                self.time_s = round(self.time_s + 0.1, 6)
                while self.due and self.due[0][0] <= self.time_s + 1e-9:
                    self.states |= self.due.pop(0)[1]

    street = Slow()
    made = driven(street)
    assert not any(decision.fallback for decision in made)
    assert not broken_rules(street.by_second)
    assert len({states[LIGHT] for states in street.by_second if "y" not in states[LIGHT]}) > 2


def test_a_light_that_follows_its_own_plan_is_followed() -> None:
    own = [PHASES[0].replace("G", "y").replace("g", "y")] * 3 + ["r" * len(PHASES[0])] * 2
    own += [PHASES[1]] * 20

    class Overridden(MadeUpStreet):
        """From second 101 on, the first light runs a plan of its own for a while."""

        def wait(self, until_s: float) -> None:
            while self.time_s < until_s - 1e-9:
                self.by_second.append(dict(self.states))
                self.time_s += 1.0
                if 101 <= self.time_s < 101 + len(own):
                    self.states[LIGHT] = own[int(self.time_s) - 101]

        def show(self, states: Mapping[str, str]) -> None:
            rest = dict(states)
            if 101 <= self.time_s < 101 + len(own):
                rest.pop(LIGHT, None)
            super().show(rest)

    street = Overridden()
    policy = Scripted(lambda asked: dict.fromkeys(asked, 0))
    loop, made = FieldLoop(SITE, policy, street, QUICK), []
    loop.drive(250.0, made.append)
    found = kinds(made)
    assert set(found[:11]) == {""}
    assert "disobeys" in found[11:14]
    assert found[-1] == ""
    assert street.states[LIGHT] == PHASES[0]
    assert not broken_rules(street.by_second)


def test_a_light_that_cannot_be_seen_gets_no_command_and_the_others_go_on() -> None:
    class Gone(Disobedient):
        def shown(self) -> Mapping[str, str]:
            if 100 <= self.time_s < 150:
                return {light: state for light, state in self.states.items() if light != LIGHT}
            return self.states

    street = Gone(lambda now: not 100 <= now < 150)
    made = driven(street)
    assert kinds(made)[11:15] == ["unseen"] * 4
    assert kinds(made)[-1] == ""
    assert all(not any(kinds(made, light)) for light in OTHERS)
    assert not [now for now, _ in street.told if 101 < now < 150]
    assert not broken_rules(street.by_second)


def test_a_street_of_which_nothing_can_be_seen_lets_the_time_pass() -> None:
    class Dark(MadeUpStreet):
        def shown(self) -> Mapping[str, str]:
            return {LIGHT: "nonsense"} if self.time_s >= 50 else self.states

    street = Dark()
    made = driven(street, 100.0)
    assert len(made) == 10
    assert set(made[-1].fallback) == set(SITE.lights)
    assert kinds(made)[-1] == "unseen"


def test_a_light_that_shows_something_else_at_every_look_does_not_hold_up_the_loop() -> None:
    class Noise(MadeUpStreet):
        def shown(self) -> Mapping[str, str]:
            return {**self.states, LIGHT: "".join(drawn.choice("rG") for _ in PHASES[0])}

    drawn = random.Random(3)
    made = driven(Noise(), 100.0)
    assert len(made) == 10
    assert kinds(made)[-1] == "disobeys"
    assert all(not any(kinds(made, light)) for light in OTHERS)


def test_a_street_that_came_back_is_taken_over_from_what_it_shows() -> None:
    before, after = MadeUpStreet(), MadeUpStreet()
    loop = FieldLoop(SITE, Scripted(), before, QUICK)
    loop.drive(30.0)
    after.states[LIGHT] = "y" * len(PHASES[0])
    del after.states[SITE.lights[1]]  # its controller is still starting
    after.states[SITE.lights[2]] = "nonsense"
    after.states["a crossing for people on foot"] = "rG"  # of the street, and not of the site
    loop.take_over(after)
    made: list[Any] = []
    loop.drive(60.0, made.append)
    assert loop.summary.decisions == 9
    assert loop.driven_s == 90.0
    assert kinds(made)[0] == "beginning"
    assert kinds(made, SITE.lights[1]) == kinds(made, SITE.lights[2]) == ["unseen"] * 6
    assert [states[LIGHT][0] for states in after.by_second[1:4]] == ["y"] * 3
    after.states = {}
    with pytest.raises(SimulatorError, match="does not say what"):
        loop.take_over(after)


def test_looks_without_a_pause_are_refused() -> None:
    with pytest.raises(OptionError, match="look_every_s"):
        TrustLimits(look_every_s=0.0)


class SlowCalls:
    """Two lights; every call takes 60 ms, B obeys late, and A goes dark by hand at some time."""

    def __init__(self, late_s: float) -> None:
        self.time_s, self.late_s = 100.0, late_s
        self.states = {"A": TWO[0], "B": TWO[0]}
        self.under_way: list[tuple[float, str, str]] = []
        self.of_b: list[str] = []
        self.dark_s = float("inf")

    def _pass(self, seconds: float) -> None:
        self.time_s += seconds
        for item in [item for item in self.under_way if item[0] <= self.time_s]:
            self.under_way.remove(item)
            _, light, state = item
            if light == "B" and self.states["B"] != state:
                self.of_b.append(state)
            self.states[light] = state
        if self.time_s >= self.dark_s:
            self.states["A"], self.dark_s = "rrrr", float("inf")

    def now_s(self) -> float:
        return self.time_s

    def shown(self) -> dict[str, str]:
        self._pass(0.06)
        return dict(self.states)

    def show(self, states: Mapping[str, str]) -> None:
        self._pass(0.06)
        for light, state in states.items():
            late_s = self.late_s if light == "B" else 0.0
            self.under_way.append((self.time_s + late_s, light, state))
        self._pass(0.0)

    def wait(self, until_s: float) -> None:
        self._pass(max(until_s - self.time_s, 0.0))


TWO = ("GGrr", "rrGG")


@pytest.mark.parametrize("late_s", [1.7 + place / 60 for place in range(9, 14)])
def test_all_red_is_shown_though_another_light_is_taken_over_at_the_end(late_s: float) -> None:
    """B's yellow may end while A is asked for its state, and its all-red is still to come."""
    items = [SimpleNamespace(id=name, phases=TWO) for name in "AB"]
    site: Any = SimpleNamespace(
        network=SimpleNamespace(intersections=items),
        lights=("A", "B"),
        timing=SignalTiming(3.0, 2.0, 5.0),
        decision_interval_s=5.0,
    )
    for dark in range(30):
        street: Any = SlowCalls(late_s)
        lights = Lights(site, street, TrustLimits())
        lights.act(lights.plan({"A": 0, "B": 0}), lambda: None)
        street.dark_s = street.time_s + 3.5 + dark / 10
        for _ in range(2):
            lights.faults()
            lights.act(lights.plan({"A": 0, "B": 1}), lambda: None)
        assert ("yyrr", "rrGG") not in set(itertools.pairwise(street.of_b))


def test_lights_are_looked_at_as_often_as_the_limits_say() -> None:
    """A light that disobeys within a decision is found before the next one."""
    looks: list[float] = []

    class Watched(MadeUpStreet):
        def shown(self) -> Mapping[str, str]:
            looks.append(self.time_s)
            return super().shown()

    loop = FieldLoop(SITE, Scripted(), Watched(), QUICK)
    loop.drive(60.0)
    loop.close()
    assert max(b - a for a, b in itertools.pairwise(looks)) <= QUICK.look_every_s + 1e-6
