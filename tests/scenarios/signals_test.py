"""The signal machine against what any traffic light must keep, for every phase set and request."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.scenarios import (
    GREEN,
    LateGreenMemory,
    Segment,
    SignalState,
    SignalTiming,
    green_begins_at_once,
    late_green_log,
    with_late_green,
    withheld_log,
)
from ugat_marl.scenarios.signals import (
    GreenDelays,
    Withheld,
    advance,
    check_phases,
    free_to_change,
    initial_state,
    red_between,
    yellow_between,
)

LINKS = 5
FOES = frozenset({(0, 2), (0, 3), (1, 3), (2, 4)})
"""Links of the drawn intersections whose paths cross."""


def crosses(phase: str) -> bool:
    return any(phase[a] in GREEN and phase[b] in GREEN for a, b in FOES)


phase_states = (
    st.text(alphabet="Ggrs", min_size=LINKS, max_size=LINKS)
    .filter(lambda phase: bool(set(phase) & GREEN))
    .filter(lambda phase: not crosses(phase))
)
phase_lists = st.lists(phase_states, min_size=2, max_size=6, unique=True).map(tuple)
# Half seconds: what a scenario with step length 0.5 s can have.
halves = st.integers(0, 24).map(lambda n: n / 2)
timings = st.builds(SignalTiming, halves, halves, halves)


def seconds_of(shown: Sequence[Segment]) -> float:
    return sum(duration for duration, _ in shown)


def by_half_second(shown: Sequence[Segment]) -> list[str]:
    """The state of every half second."""
    return [state for duration, state in shown for _ in range(round(2 * duration))]


class SignalMachine(RuleBasedStateMachine):
    """Arbitrary requests for arbitrary intervals; everything shown is kept and looked at."""

    @initialize(phases=phase_lists, timing=timings)
    def begin(self, phases: tuple[str, ...], timing: SignalTiming) -> None:
        self.phases, self.timing = phases, timing
        self.state = initial_state(timing)
        self.shown: list[str] = []
        self.ran_s = 0.0

    @rule(choice=st.integers(0, 5), interval=st.integers(1, 50).map(lambda n: n / 2))
    def run(self, choice: int, interval: float) -> None:
        requested = choice % len(self.phases)
        before = self.state
        free = free_to_change(before, self.timing, interval)
        self.state, shown = advance(self.phases, before, requested, interval, self.timing)
        assert all(duration > 0 for duration, _ in shown)
        assert all(a != b for (_, a), (_, b) in pairwise(shown)), "equal neighbours were not merged"
        assert seconds_of(shown) == interval
        if requested != before.phase:
            assert free == (self.state.phase == requested), "the mask and the machine disagree"
        else:
            assert self.state.phase == requested
        self.ran_s += interval
        self.shown += by_half_second(shown)

    @invariant()
    def seconds_are_conserved(self) -> None:
        assert len(self.shown) == round(2 * self.ran_s)

    @invariant()
    def no_green_turns_red_without_yellow(self) -> None:
        if self.timing.yellow_s == 0:
            return
        for before, after in pairwise(self.shown):
            for a, b in zip(before, after, strict=True):
                assert not (a in GREEN and b not in GREEN | {"y"}), f"{before} -> {after}"

    @invariant()
    def yellow_lasts_as_long_as_it_must(self) -> None:
        for link in range(LINKS):
            for state, seconds, whole in runs([shown[link] for shown in self.shown]):
                if state == "y" and whole:
                    assert seconds == self.timing.yellow_s

    @invariant()
    def crossing_links_are_never_green_together(self) -> None:
        for shown in set(self.shown):
            assert not crosses(shown)

    @invariant()
    def only_phases_and_clearances_are_shown(self) -> None:
        for state, seconds, whole in runs(self.shown):
            if state in self.phases and whole and seconds > self.timing.clearance_s:
                assert seconds >= self.timing.min_green_s

    @invariant()
    def a_green_that_ends_was_held(self) -> None:
        for link in range(LINKS):
            lights = ["G" if shown[link] in GREEN else shown[link] for shown in self.shown]
            for state, seconds, whole in runs(lights):
                if state == "G" and whole:
                    assert seconds >= self.timing.min_green_s


def runs(states: Sequence[str]) -> list[tuple[str, float, bool]]:
    """Stretches of one state: the state, seconds, and whether both its ends were seen."""
    found: list[tuple[str, float, bool]] = []
    start = 0
    for end in range(1, len(states) + 1):
        if end == len(states) or states[end] != states[start]:
            found.append((states[start], (end - start) / 2, start > 0 and end < len(states)))
            start = end
    return found


TestSignalMachine = SignalMachine.TestCase
TestSignalMachine.settings = settings(max_examples=60, stateful_step_count=12, deadline=None)


def states_of(phases: tuple[str, ...]) -> st.SearchStrategy[SignalState]:
    number = st.integers(0, len(phases) - 1)
    return st.builds(SignalState, number, number, halves)


@given(st.data(), phase_lists, timings)
def test_splitting_an_interval_shows_the_same(
    data: st.DataObject, phases: tuple[str, ...], timing: SignalTiming
) -> None:
    state = data.draw(states_of(phases))
    requested = data.draw(st.integers(0, len(phases) - 1))
    parts = data.draw(st.lists(st.integers(1, 12).map(lambda n: n / 2), min_size=1, max_size=8))
    after_one, shown_in_one = advance(phases, state, requested, sum(parts), timing)
    shown_in_parts: list[str] = []
    for part in parts:
        state, shown = advance(phases, state, requested, part, timing)
        shown_in_parts += by_half_second(shown)
    assert shown_in_parts == by_half_second(shown_in_one)
    # What follows is the same too, whatever is asked for then.
    other = data.draw(st.integers(0, len(phases) - 1))
    assert (
        advance(phases, state, other, 30.0, timing)[1]
        == advance(phases, after_one, other, 30.0, timing)[1]
    )


@given(phase_states, phase_states)
def test_a_link_green_before_and_after_stays_green(origin: str, target: str) -> None:
    for between in (yellow_between(origin, target), red_between(origin, target)):
        for before, during, after in zip(origin, between, target, strict=True):
            if before in GREEN and after in GREEN:
                assert during == ("G" if before == after == "G" else "g")
            else:
                assert during not in GREEN


@given(phase_states, phase_states)
def test_a_clearance_shows_nothing_green_that_one_phase_forbids(origin: str, target: str) -> None:
    if origin == target:
        return
    yellow, red = yellow_between(origin, target), red_between(origin, target)
    for before, during, then, after in zip(origin, yellow, red, target, strict=True):
        if before in GREEN and after not in GREEN:
            assert (during, then) == ("y", "r")
        if before not in GREEN and after in GREEN:
            assert (during, then) == ("r", "r")
        if before not in GREEN and before == after:
            assert (during, then) == (before, before)


TIMING = SignalTiming(yellow_s=3, all_red_s=2, min_green_s=5)
PHASES = ("GGrr", "rrGG", "GrrG")


@given(timings, halves.filter(bool))
def test_whether_every_green_begins_when_it_is_asked_for(
    timing: SignalTiming, interval_s: float
) -> None:
    """Two phases in turn, decision by decision: a light that falls behind does so soon."""
    state, in_time = initial_state(timing), True
    for decision in range(1, 60):
        state, _ = advance(PHASES, state, decision % 2, interval_s, timing)
        in_time = in_time and (state.phase, state.clearing) == (decision % 2, False)
    assert in_time == green_begins_at_once(timing, interval_s)


def test_a_change_by_hand() -> None:
    state, shown = advance(PHASES, initial_state(TIMING), 1, 10, TIMING)
    assert shown == [(3, "yyrr"), (2, "rrrr"), (5, "rrGG")]
    assert state == SignalState(1, 1, 5)
    assert advance(PHASES, state, 1, 10, TIMING) == (SignalState(1, 1, 15), [(10, "rrGG")])
    # The link green in both phases is green throughout.
    assert advance(PHASES, state, 2, 10, TIMING)[1] == [(3, "rryG"), (2, "rrrG"), (5, "GrrG")]


def test_the_minimum_green_is_held_first() -> None:
    timing = SignalTiming(3, 2, 12)
    state, _ = advance(PHASES, initial_state(timing), 1, 10, timing)
    assert state == SignalState(1, 1, 5)
    state, shown = advance(PHASES, state, 0, 10, timing)
    assert shown == [(7, "rrGG"), (3, "rryy")]
    assert state == SignalState(0, 1, 3)
    # A request made while clearing does not turn the light back.
    state, shown = advance(PHASES, state, 1, 10, timing)
    assert shown == [(2, "rrrr"), (8, "GGrr")]
    assert state == SignalState(0, 0, 8)


def test_intervals_shorter_than_the_clearance() -> None:
    state, seen = initial_state(TIMING), ""
    for requested in (1, 0, 0, 2, 2, 2, 2):
        state, shown = advance(PHASES, state, requested, 1, TIMING)
        seen += " " + " ".join(light for _, light in shown)
    # Five seconds to phase 1 in spite of the other requests, then its minimum green.
    assert seen.split() == ["yyrr"] * 3 + ["rrrr"] * 2 + ["rrGG"] * 2


def test_without_clearance_the_change_is_immediate() -> None:
    timing = SignalTiming(0, 0, 0)
    state, shown = advance(PHASES, initial_state(timing), 1, 10, timing)
    assert shown == [(10, "rrGG")]
    assert state == SignalState(1, 1, 10)


def test_without_yellow_green_turns_red_at_once() -> None:
    shown = advance(PHASES, initial_state(TIMING), 1, 10, SignalTiming(0, 2, 5))[1]
    assert shown == [(2, "rrrr"), (8, "rrGG")]


@pytest.mark.parametrize(
    ("state", "within_s", "free"),
    [
        (SignalState(0, 0, 5), 10, True),
        (SignalState(0, 0, 0), 5, False),  # it could begin in the instant the interval is over
        (SignalState(0, 0, 0), 6, True),
        (SignalState(1, 0, 2), 8, False),  # 3 s of clearance, 5 s of green
        (SignalState(1, 0, 2), 9, True),
    ],
)
def test_free_to_change_by_hand(state: SignalState, within_s: float, free: bool) -> None:
    assert free_to_change(state, TIMING, within_s) is free


@pytest.mark.parametrize("step", [0.1, 0.2, 0.3, 0.7])
def test_fractions_of_a_second_leave_no_slivers(step: float) -> None:
    """Sums of tenths are not exact in binary; no state may be shown for 1e-16 s."""
    timing = SignalTiming(3 * step, step, 7 * step)
    state = initial_state(timing)
    for decision in range(200):
        state, shown = advance(PHASES, state, (decision // 3) % 3, 3 * step, timing)
        assert seconds_of(shown) == pytest.approx(3 * step)
        assert all(duration > step / 2 for duration, _ in shown), shown


@pytest.mark.parametrize("name", ["yellow_s", "all_red_s", "min_green_s"])
def test_negative_times_are_refused(name: str) -> None:
    values = {"yellow_s": 3.0, "all_red_s": 2.0, "min_green_s": 5.0, name: -1.0}
    with pytest.raises(OptionError, match=rf"{name} = -1.0 must not be negative"):
        SignalTiming(**values)


@pytest.mark.parametrize(
    ("phases", "message"),
    [
        (("GGr", "rrGG"), r"phase 0 \('GGr'\) has 3 letters, but .* controls 4 links"),
        (("GGrr", "rrXG"), r"phase 1 \('rrXG'\) has unknown letters \['X'\]; allowed"),
        (("GGrr", "rrrr"), r"phase 1 \('rrrr'\) has no green"),
        (("GGrr", "rrGG", "GGrr"), r"phase 2 \('GGrr'\) is listed twice, as phase 0 before"),
        (("GGrr", "yyGG"), r"phase 1 \('yyGG'\) has yellow"),
    ],
)
def test_phases_that_cannot_be_shown_are_refused(phases: tuple[str, ...], message: str) -> None:
    with pytest.raises(ScenarioError, match=f"here: {message}"):
        check_phases(phases, 4, "here")


def test_good_phases_pass() -> None:
    check_phases(PHASES, 4, "here")
    check_phases(("Gs", "gr"), 2, "here")


# --- late green


def test_late_green_by_hand() -> None:
    before = LateGreenMemory.after("GGrr")
    commanded = [(3.0, "yyrr"), (2.0, "rrrr"), (5.0, "rrGG")]
    after, shown = with_late_green(commanded, 2, 1, before)
    assert shown == [(3, "yyrr"), (4, "rrrr"), (3, "rrGG")]
    assert after.commanded == after.shown == "rrGG"
    # The link green in both phases loses nothing; the other one its two seconds.
    _, shown = with_late_green([(3, "rryG"), (2, "rrrG"), (5, "GrrG")], 2, 1, after)
    assert shown == [(3, "rryG"), (4, "rrrG"), (3, "GrrG")]


def test_a_green_shorter_than_its_delay_is_not_shown_nor_its_yellow() -> None:
    for green in (2.0, 3.0):
        state, shown = with_late_green(
            [(green, "Gr"), (3, "yr"), (5, "rG")], 3, 1, LateGreenMemory.after("rr")
        )
        assert shown == [(green + 6, "rr"), (2, "rG")]
        assert with_late_green([(9, "Gr")], 3, 1, state)[1] == [(3, "rr"), (6, "Gr")]


def test_a_late_green_keeps_the_right_on_red_before_it() -> None:
    _, shown = with_late_green([(10, "GG")], 2, 1, LateGreenMemory.after("sr"))
    assert shown == [(2, "sr"), (8, "GG")]


def test_half_a_second_is_given_to_every_other_green() -> None:
    state, lost = LateGreenMemory.after("G"), []
    for _ in range(6):
        state, shown = with_late_green([(10, "r"), (10, "G")], 1.5, 1, state)
        lost.append(shown[0][0] - 10)
    assert lost == [1, 2, 1, 2, 1, 2]


@given(st.data(), phase_lists, timings, halves.filter(lambda s: s < 8))
def test_late_green_takes_greens_away_and_nothing_else(
    data: st.DataObject, phases: tuple[str, ...], timing: SignalTiming, late: float
) -> None:
    """Seconds are conserved, an interval may be split, and only the start of a green is missing."""
    state, held, whole = initial_state(timing), LateGreenMemory.after(phases[0]), []
    commanded: list[str] = []
    shown: list[str] = []
    for _ in range(data.draw(st.integers(1, 6))):
        requested = data.draw(st.integers(0, len(phases) - 1))
        interval = data.draw(st.integers(1, 40).map(lambda n: n / 2))
        state, plan = advance(phases, state, requested, interval, timing)
        held, part = with_late_green(plan, late, 0.5, held)
        whole += plan
        commanded += by_half_second(plan)
        shown += by_half_second(part)
    assert len(shown) == len(commanded)
    assert (
        by_half_second(with_late_green(whole, late, 0.5, LateGreenMemory.after(phases[0]))[1])
        == shown
    )
    for link in range(LINKS):
        ago = math.inf
        for second, (asked, seen) in enumerate(zip(commanded, shown, strict=True)):
            before = commanded[second - 1][link] if second else phases[0][link]
            if asked[link] in GREEN and before not in GREEN:
                ago = 0
            if asked[link] in GREEN:
                assert seen[link] == (asked[link] if ago >= 2 * late else seen[link])
                assert (seen[link] in GREEN) == (ago >= 2 * late)
                ago += 1
            elif asked[link] != "y":
                assert seen[link] == asked[link]


def test_a_green_is_held_back_always_or_once() -> None:
    first = {"A": [(10.0, "Gr")], "B": [(10.0, "Gr")]}
    then = {"A": [(3.0, "yr"), (7.0, "rG")], "B": [(3.0, "yr"), (7.0, "rG")]}
    back = {"A": [(3.0, "ry"), (7.0, "Gr")], "B": [(3.0, "ry"), (7.0, "Gr")]}
    nothing = GreenDelays({"A": "Gr", "B": "Gr"}, {}, 1)
    assert [nothing.hold(plans) for plans in (first, then)] == [first, then]

    delays = GreenDelays({"A": "Gr", "B": "Gr"}, {"A": 2.0}, 1)
    assert delays.hold(first) == first
    delays.ask({"A": 1.0, "B": 9.0})
    shown = delays.hold(then)
    assert shown["A"] == [(3, "yr"), (3, "rr"), (4, "rG")]
    assert shown["B"] == [(3, "yr"), (7, "rr")]
    shown = delays.hold({"A": [(10.0, "rG")], "B": [(10.0, "rG")]})  # nine seconds reach over
    assert shown == {"A": [(10, "rG")], "B": [(2, "rr"), (8, "rG")]}
    shown = delays.hold(back)  # asked for once: only the late green is left
    assert shown == {"A": [(3, "ry"), (2, "rr"), (5, "Gr")], "B": back["B"]}


def test_fractions_of_a_step_are_paid_with_the_next_green() -> None:
    delays = GreenDelays({"A": "Gr"}, {}, 1)
    delays.ask({"A": 1.5})
    assert delays.hold({"A": [(10.0, "rG")]})["A"] == [(1, "rr"), (9, "rG")]
    delays.hold({"A": [(10.0, "Gr")]})
    delays.ask({"A": 1.5})
    assert delays.hold({"A": [(10.0, "rG")]})["A"] == [(2, "rr"), (8, "rG")]


def test_green_is_withheld_from_single_links_at_its_beginning_and_in_every_decision() -> None:
    """Link 0 loses 2 s at the beginning of its green, link 1 loses 1.5 s in each further decision.

    The half second is paid with the next one: 1 s, then 2 s.
    """
    withheld = {"A": Withheld((2.0, 0.0), (0.0, 1.5))}
    delays = GreenDelays({"A": "rr"}, {}, 1, withheld)
    green = {"A": [(10.0, "GG")]}
    assert delays.hold(green)["A"] == [(2, "rG"), (8, "GG")]
    assert delays.hold(green)["A"] == [(1, "Gr"), (9, "GG")]
    assert delays.hold(green)["A"] == [(2, "Gr"), (8, "GG")]
    assert delays.hold({"A": [(3.0, "yy"), (7.0, "rr")]})["A"] == [(3, "yy"), (7, "rr")]
    assert delays.hold(green)["A"] == [(2, "rG"), (8, "GG")]
    other = {"B": [(10.0, "G")]}
    assert GreenDelays({"B": "r"}, {}, 1, withheld).hold(other) == other


def test_a_log_of_a_street_can_be_late() -> None:
    log = ((0.0, "Gr"), (30.0, "yr"), (33.0, "rG"), (34.0, "ry"), (37.0, "Gr"))
    assert late_green_log(log, 2, 1) == (
        (0.0, "Gr"), (30.0, "yr"), (33.0, "rr"), (39.0, "Gr"),
    )  # fmt: skip
    assert late_green_log(log, 0, 1) == log
    assert late_green_log(log[:1], 2, 1) == log[:1]
    assert late_green_log((), 2, 1) == ()


def test_red_of_single_links_in_a_log() -> None:
    log = [(0.0, "rr"), (10.0, "GG"), (40.0, "yy"), (43.0, "rr")]
    red = Withheld((3.0, 0.0), (2.0, 0.0))
    shown = withheld_log(log, red, 0.0, 1.0, 10.0, 60.0)
    # Green of the first link begins at 13 s, and pauses in the decisions at 20 and 30 s.
    assert shown == (
        (0.0, "rr"), (10.0, "rG"), (13.0, "GG"), (20.0, "rG"), (22.0, "GG"), (30.0, "rG"),
        (32.0, "GG"), (40.0, "yy"), (43.0, "rr"),
    )  # fmt: skip
    nothing = Withheld((0.0, 0.0), (0.0, 0.0))
    assert withheld_log(log, nothing, 0.0, 1.0, 10.0, 60.0) == tuple(log)
    late = withheld_log(log, nothing, 2.0, 1.0, 10.0, 60.0)
    assert late == late_green_log(log, 2.0, 1.0)
    assert withheld_log([], nothing, 0.0, 1.0, 10.0, 60.0) == ()
