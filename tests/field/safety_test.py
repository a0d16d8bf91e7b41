"""What the field's lights keep whatever is asked for, and from whatever they show at first."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import initialize, invariant, rule, run_state_machine_as_test

from tests.scenarios import signals_test
from ugat_marl.effects import load_scenario
from ugat_marl.errors import OptionError
from ugat_marl.field import LaneCount, TrustLimits
from ugat_marl.field.answering import Answering, Late
from ugat_marl.field.safety import Light, PolicyTrust, fixed_time
from ugat_marl.field.watchdog import Watchdog
from ugat_marl.scenarios import GREEN, Network, Segment, SignalTiming

LINKS = signals_test.LINKS
STATES = st.text(alphabet="GgrsyYuoO", min_size=LINKS, max_size=LINKS).filter(
    lambda state: not signals_test.crosses(state)
)


class FieldLight(signals_test.SignalMachine):
    """The properties of the signal machine, for a light that begins in any state."""

    kind: type[Light] = Light

    @initialize(phases=signals_test.phase_lists, timing=signals_test.timings, shown=STATES)
    def begin(self, phases: tuple[str, ...], timing: SignalTiming, shown: str) -> None:
        self.phases, self.timing = phases, timing
        self.light = self.kind(phases, timing, shown)
        self.at_first = shown
        self.shown = [shown]  # half a second before the loop begins
        self.ran_s = 0.5

    @rule(choice=st.integers(0, 5), interval=st.integers(1, 50).map(lambda n: n / 2))
    def run(self, choice: int, interval: float) -> None:
        requested = choice % len(self.phases)
        known, before, free = self.light.taken_over, self.light.phase, self.light.free(interval)
        shown = self.light.advance(requested, interval)
        assert signals_test.seconds_of(shown) == interval
        if known and requested != before:
            assert bool(free[requested]) == (self.light.phase == requested)
        self.ran_s += interval
        self.shown += signals_test.by_half_second(shown)

    @invariant()
    def yellow_at_first_is_shown_in_full(self) -> None:
        halves = self.shown[1 : 1 + round(2 * self.timing.yellow_s)]
        for link, letter in enumerate(self.at_first):
            if letter in "yYoO":
                assert all(state[link] == "y" for state in halves)

    @invariant()
    def green_at_first_is_held(self) -> None:
        halves = self.shown[1 : 1 + round(2 * self.timing.min_green_s)]
        for link, letter in enumerate(self.at_first):
            if letter in GREEN:
                assert all(state[link] in GREEN for state in halves)


TestFieldLight = FieldLight.TestCase
TestFieldLight.settings = settings(max_examples=50, stateful_step_count=8, deadline=None)


class Hasty(Light):
    """Shows what it is asked for at once."""

    def advance(self, requested: int, seconds: float) -> list[Segment]:
        super().advance(requested, seconds)
        return [(seconds, self.phases[requested])]


class Forgetful(Light):
    """Takes a light over as if it had been green in its first phase for long."""

    def __init__(self, phases: Sequence[str], timing: SignalTiming, shown: str) -> None:
        super().__init__(phases, timing, phases[0])


class Blind(Light):
    """Does not see that a yellow is under way."""

    def __init__(self, phases: Sequence[str], timing: SignalTiming, shown: str) -> None:
        super().__init__(phases, timing, shown)
        self._ending_s = 0.0


@pytest.mark.parametrize("broken", [Hasty, Forgetful, Blind])
def test_a_broken_light_is_caught(broken: type[Light]) -> None:
    machine = type(broken.__name__, (FieldLight,), {"kind": broken})
    few = settings(
        max_examples=60,
        stateful_step_count=5,
        phases=[Phase.generate],
        report_multiple_bugs=False,
    )
    with pytest.raises(AssertionError):
        run_state_machine_as_test(machine, settings=few)


TIMING = SignalTiming(yellow_s=3, all_red_s=2, min_green_s=5)
PHASES = ("GGrr", "rrGG")


def test_a_foreign_green_is_held_and_cleared_by_hand() -> None:
    light = Light(PHASES, TIMING, "rGGr")
    assert not light.taken_over
    assert light.advance(1, 10) == [(5, "rGGr"), (3, "ryGr"), (2, "rrGr")]
    assert light.taken_over
    assert light.advance(1, 10) == [(10, "rrGG")]


def test_a_yellow_of_somebody_else_is_shown_in_full_by_hand() -> None:
    light = Light(PHASES, TIMING, "GYrr")
    shown = light.advance(1, 12)
    # the yellow, the green that goes on, its minimum, its own yellow, and part of the all-red
    assert shown == [(3, "Gyrr"), (5, "Grrr"), (3, "yrrr"), (1, "rrrr")]


def test_a_mask_reckons_with_the_yellow_of_somebody_else() -> None:
    light = Light(PHASES, TIMING, "GGyy")
    assert light.taken_over
    assert light.phase == 0
    assert light.free(8.0).tolist() == [1, 0]  # 3 s of yellow, 5 s of minimum green
    assert light.free(9.0).tolist() == [1, 1]
    assert light.advance(1, 10) == [(3, "GGyy"), (5, "GGrr"), (2, "yyrr")]


def test_a_light_of_another_network_is_refused() -> None:
    with pytest.raises(OptionError, match="'GGrrr'.*'GGrr'"):
        Light(PHASES, TIMING, "GGrrr")
    with pytest.raises(OptionError, match="own network"):
        Light(PHASES, TIMING, "GGxx")


def test_a_fault_is_told_and_trust_comes_back_after_good_decisions() -> None:
    trust = PolicyTrust(["A", "B"], 2)
    assert trust.judge({}) == {}
    assert trust.judge({"A": "stale: x"}) == {"A": "stale: x"}
    assert trust.judge({}) == {"A": "returning: 1 of 2 good decisions after stale: x"}
    assert trust.judge({"A": "absurd: y", "B": "late: z"}) == {"A": "absurd: y", "B": "late: z"}
    assert set(trust.judge({})) == {"A", "B"}
    assert trust.judge({})["A"] == "returning: 2 of 2 good decisions after absurd: y"
    assert trust.judge({}) == {}


def test_the_plan_serves_every_link_of_every_light() -> None:
    network = Network.read(load_scenario("grid2x2-v1"))
    plan = fixed_time(network, 10.0, SignalTiming(3.0, 2.0, 5.0), 30.0)
    asked = [plan.act({}, {}) for _ in range(40)]
    for item in network.intersections:
        green = {
            index
            for phase in {actions[item.id] for actions in asked}
            for index, letter in enumerate(item.phases[phase])
            if letter in GREEN
        }
        servable = {i for phase in item.phases for i, letter in enumerate(phase) if letter in GREEN}
        assert green == servable
        assert all(actions[item.id] == asked[0][item.id] for actions in asked[:3])
        assert asked[3][item.id] != asked[0][item.id]


def test_a_function_that_a_signal_interrupted_answers_nobody_else() -> None:
    asked = Answering()
    release = threading.Event()

    class Interrupted(queue.SimpleQueue):  # type: ignore[type-arg]
        def get(self, block: bool = True, timeout: float | None = None) -> Any:
            raise KeyboardInterrupt

    answers = asked._answers
    asked._answers = Interrupted()
    with pytest.raises(KeyboardInterrupt):
        asked.ask(release.wait, within_s=1.0)
    asked._answers = answers
    release.set()
    deadline = time.monotonic() + 10.0
    while asked._owed and time.monotonic() < deadline:
        with contextlib.suppress(Late):
            assert asked.ask(lambda: "mine", within_s=5.0) == "mine"
    assert asked.ask(lambda: "mine", within_s=5.0) == "mine"
    asked.close()


def test_a_gap_without_any_count_is_no_green_with_an_unchanged_count() -> None:
    watchdog = Watchdog({"a": 10.0}, False, TrustLimits())
    watchdog.check({"a": LaneCount(1000.0, 1.0)}, 1000.0)
    watchdog.check({}, 1190.0)  # as the loop does while nothing can be read
    assert watchdog.check({"a": LaneCount(1200.0, 1.0)}, 1200.0)[1] == {}
