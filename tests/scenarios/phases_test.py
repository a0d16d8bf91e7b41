"""Phases from conflicts against brute force over all sets of movements, and from programmes."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain, combinations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ugat_marl.errors import ScenarioError
from ugat_marl.scenarios import Link, conflicting_greens
from ugat_marl.scenarios.phases import (
    MOST_PHASES,
    RightOfWay,
    _shared,
    are_foes,
    conflict_free_phases,
    programme_phases,
)

Foes = dict[str, list[int]]


def link(index: int, approach: str, direction: str, lane: int = 0, to: str = "") -> Link:
    return Link(index, f"{approach}_{lane}", f"{to or f'out{index}'}_0", direction, "J", index)


def matrix(links: int, pairs: set[tuple[int, int]]) -> Foes:
    """Bit masks as in a network file; a pair stands in one row only, as SUMO may have it."""
    return {"J": [sum(1 << b for b in range(links) if (a, b) in pairs) for a in range(links)]}


@st.composite
def junctions(draw: st.DrawFn, directions: str) -> tuple[list[Link], Foes]:
    """Random movements with random conflicts; movements of one approach never conflict."""
    movements = draw(
        st.lists(
            st.tuples(st.sampled_from("abcde"), st.sampled_from(directions)),
            min_size=1,
            max_size=7,
            unique=True,
        )
    )
    links = [
        link(index, approach, direction, lane=index)
        for index, (approach, direction) in enumerate(movements)
    ]
    possible = [
        (a.index, b.index)
        for a in links
        for b in links
        if a.index != b.index and a.from_edge != b.from_edge
    ]
    pairs = draw(st.sets(st.sampled_from(possible))) if possible else set[tuple[int, int]]()
    return links, matrix(len(links), pairs)


def free_of_conflict(links: list[Link], foes: Foes) -> bool:
    return not any(are_foes(a, b, foes) for a, b in combinations(links, 2))


def all_sets(links: list[Link]) -> list[frozenset[int]]:
    subsets = chain.from_iterable(combinations(links, n) for n in range(len(links) + 1))
    return [frozenset(item.index for item in chosen) for chosen in subsets]


def greens(phase: str) -> frozenset[int]:
    return frozenset(index for index, letter in enumerate(phase) if letter == "G")


@given(junctions("sl"))
def test_phases_are_all_maximal_sets_without_conflict(junction: tuple[list[Link], Foes]) -> None:
    links, foes = junction
    free = [s for s in all_sets(links) if free_of_conflict([links[i] for i in s], foes)]
    maximal = {s for s in free if not any(s < other for other in free)}
    phases = conflict_free_phases(links, RightOfWay(foes), len(links), "here")
    assert {greens(phase) for phase in phases} == maximal
    assert len(phases) == len(maximal)
    assert set("".join(phases)) <= {"G", "r"}


@given(junctions("slr"))
@settings(max_examples=300)
def test_right_turns_follow_without_conflict(junction: tuple[list[Link], Foes]) -> None:
    links, foes = junction
    phases = conflict_free_phases(links, RightOfWay(foes), len(links), "here")
    chosen = [greens(phase) for phase in phases]
    for green in chosen:
        assert free_of_conflict([links[i] for i in green], foes)
        addable = [
            item
            for item in links
            if item.index not in green
            and free_of_conflict([item, *(links[i] for i in green)], foes)
        ]
        assert not addable, f"{addable} could be green with {sorted(green)}"
    assert frozenset().union(*chosen) == {item.index for item in links}, "a link is never green"
    assert len(set(phases)) == len(phases)


ARMS = ("north", "east", "south", "west")  # clockwise, traffic keeps to the right


def four_arms() -> tuple[list[Link], Foes]:
    """Each arm: a lane for straight on and right, a lane for left; conflicts from geometry."""
    links: list[Link] = []
    for a, arm in enumerate(ARMS):
        for lane, direction, turn in ((0, "r", 3), (0, "s", 2), (1, "l", 1)):
            links.append(link(len(links), arm, direction, lane, to=f"to_{ARMS[(a + turn) % 4]}"))
    pairs: set[tuple[int, int]] = set()
    for a in range(4):
        right, through, left = 3 * a, 3 * a + 1, 3 * a + 2
        for quarter in (1, 3):  # the crossing road
            other = 3 * ((a + quarter) % 4)
            pairs |= {(through, other + 1), (through, other + 2), (left, other + 2)}
        opposite = 3 * ((a + 2) % 4)
        pairs |= {(left, opposite + 1), (left, opposite)}  # the left turn crosses and merges
        pairs |= {(right, 3 * ((a + 1) % 4) + 1)}  # merges with traffic from the left
    return links, matrix(12, pairs | {(b, a) for a, b in pairs})


def test_the_eight_phases_of_four_arms() -> None:
    links, foes = four_arms()
    phases = conflict_free_phases(links, RightOfWay(foes), 12, "here")
    n, e, s, w = (f"{arm}_" for arm in ARMS)
    leading = [
        frozenset(f"{item.from_edge}_{item.direction}" for item in links if phase[item.index] == "G"
                  and item.direction != "r")
        for phase in phases
    ]  # fmt: skip
    assert set(leading) == {
        frozenset({n + "s", s + "s"}), frozenset({e + "s", w + "s"}),
        frozenset({n + "l", s + "l"}), frozenset({e + "l", w + "l"}),
        *(frozenset({arm + "s", arm + "l"}) for arm in (n, e, s, w)),
    }  # fmt: skip
    assert len(phases) == 8
    # Through phases come first, the two protected left pairs last.
    assert [sum(name.endswith("l") for name in green) for green in leading] == [0] * 2 + [1] * 4 + [
        2
    ] * 2
    # A right turn shares the lane of its through movement: green with it and never without it.
    for phase in phases:
        for arm in range(4):
            assert phase[3 * arm] == phase[3 * arm + 1]


def test_a_right_turn_with_its_own_lane_is_green_whenever_nothing_crosses_it() -> None:
    # East's through movement merges with north's right turn, which has a lane to itself.
    links = [link(0, "n", "r", 0), link(1, "n", "s", 1), link(2, "e", "s"), link(3, "e", "l", 1)]
    foes = matrix(4, {(1, 2), (1, 3), (0, 2)})
    assert set(conflict_free_phases(links, RightOfWay(foes), 4, "here")) == {"GGrr", "rrGG"}
    foes = matrix(4, {(1, 2), (1, 3)})
    assert set(conflict_free_phases(links, RightOfWay(foes), 4, "here")) == {"GGrr", "GrGG"}


def test_a_right_turn_that_never_could_follow_gets_a_phase() -> None:
    links = [link(0, "a", "r"), link(1, "b", "s"), link(2, "c", "s")]
    foes = matrix(3, {(0, 1), (0, 2), (1, 2)})
    assert set(conflict_free_phases(links, RightOfWay(foes), 3, "here")) == {"Grr", "rGr", "rrG"}


def test_right_turns_that_merge_into_each_other_are_not_green_together() -> None:
    links = [link(0, "a", "r"), link(1, "b", "r"), link(2, "c", "s")]
    phases = conflict_free_phases(links, RightOfWay(matrix(3, {(0, 1)})), 3, "here")
    assert "GGG" not in phases
    assert {index for phase in phases for index in greens(phase)} == {0, 1, 2}


def test_movements_that_share_a_letter_are_green_together() -> None:
    """Some networks give several links of an approach one letter of the state."""
    links = [
        Link(0, "a_0", "x_0", "s", "J", 0),
        Link(0, "a_1", "y_0", "l", "J", 1),
        Link(1, "b_0", "z_0", "s", "J", 2),
        Link(2, "c_0", "w_0", "s", "J", 3),
    ]
    foes = matrix(4, {(1, 2), (0, 3), (2, 3)})  # b crosses a's left turn only, c its through
    phases = conflict_free_phases(links, RightOfWay(foes), 3, "here")
    assert set(phases) == {"Grr", "rGr", "rrG"}


@pytest.mark.parametrize(
    ("partial", "whole", "left_hand"),
    [("L", "l", False), ("t", "l", False), ("R", "r", False), ("t", "r", True), ("T", "r", True)],
)
def test_a_partial_turn_belongs_to_the_turn_it_resembles(
    partial: str, whole: str, left_hand: bool
) -> None:
    """Both are one movement: what crosses one of them stops both."""
    links = [link(0, "a", whole), link(1, "a", partial, 1), link(2, "b", "s"), link(3, "c", "s")]
    links = [replace(one, left_hand=left_hand) for one in links]
    foes = matrix(4, {(1, 2), (0, 3), (2, 3)})
    assert set(conflict_free_phases(links, RightOfWay(foes), 4, "here")) == {"GGrr", "rrGr", "rrrG"}


def test_letters_beyond_the_links_stay_red() -> None:
    links = [link(0, "a", "s"), link(1, "b", "s")]
    rules = RightOfWay(matrix(2, {(0, 1)}))
    assert conflict_free_phases(links, rules, 4, "here") == ("Grrr", "rGrr")


def test_many_movements_that_agree_are_one_phase_at_once() -> None:
    """Without a pivot the time doubles with each of them."""
    count = 60
    links = [link(i, f"a{i}", "s") for i in range(count)]
    rules = RightOfWay(matrix(count, set()))
    assert conflict_free_phases(links, rules, count, "here") == ("G" * count,)


def test_too_many_phases_are_refused() -> None:
    pairs = 7  # 2 ** 7 maximal sets
    links = [link(i, f"a{i}", "s") for i in range(2 * pairs)]
    foes = matrix(2 * pairs, {(2 * i, 2 * i + 1) for i in range(pairs)})
    with pytest.raises(ScenarioError, match=rf"here: more than {MOST_PHASES} conflict-free phases"):
        conflict_free_phases(links, RightOfWay(foes), 2 * pairs, "here")


def test_a_network_without_internal_lanes_says_what_to_do() -> None:
    links = [Link(0, "a_0", "b_0", "s")]
    with pytest.raises(ScenarioError, match='no internal lanes.*use phases = "programme"'):
        conflict_free_phases(links, RightOfWay({}), 1, "here")


def test_programme_phases_are_its_greens_each_once() -> None:
    programme = (
        (30.0, "GGrr"), (3.0, "yyrr"), (2.0, "rrrr"), (30.0, "rrGg"), (3.0, "rryy"),
        (5.0, "GGrr"), (1.0, "uurr"), (1.0, "GYrr"), (1.0, "ssss"),
    )  # fmt: skip
    assert programme_phases(programme) == ("GGrr", "rrGg")
    assert programme_phases(()) == ()


CROSS = [link(0, "a", "s"), link(1, "b", "s"), link(2, "c", "l"), link(3, "d", "l")]


@pytest.mark.parametrize(
    ("phase", "pair"),
    [
        ("GGrr", (0, 1)),
        ("Ggrr", None),  # one of them yields
        ("GrGr", (0, 2)),
        ("rrGG", None),  # two left turns: matrices call even those foes that pass each other
        ("Grrr", None),
    ],
)
def test_conflicting_greens(phase: str, pair: tuple[int, int] | None) -> None:
    assert conflicting_greens(phase, CROSS, matrix(4, {(0, 1), (2, 0), (2, 3)})) == pair


def test_left_turns_conflict_where_their_roads_cross() -> None:
    """Those of opposite approaches may touch, as networks draw them; those across never go."""
    links = [link(k, approach, "l") for k, approach in enumerate("nes")]
    links += [link(3 + k, approach, "s") for k, approach in enumerate("nes")]
    foes = matrix(6, {(0, 1), (0, 2), (3, 4), (4, 5)})  # n and s go straight at the same time
    assert conflicting_greens("GrGrrr", links, foes) is None
    assert conflicting_greens("GGrrrr", links, foes) == (0, 1)
    assert conflicting_greens("GGr", links[:3], foes) is None  # nothing tells who is opposite


def test_greens_that_merge_do_not_conflict() -> None:
    links = [link(0, "a", "s", to="x"), link(1, "b", "r", to="x")]
    assert conflicting_greens("GG", links, matrix(2, {(0, 1)})) is None


@pytest.mark.parametrize(("turn", "shares"), [("l", True), ("r", False), ("t", False)])
def test_a_lane_for_straight_on_is_shared_with_turns_across_opposite_traffic(
    turn: str, shares: bool
) -> None:
    """U-turns are too rare to make the turns of a whole light permitted."""
    assert _shared([link(0, "a", "s"), link(1, "a", turn)]) == shares
    assert not _shared([link(0, "a", "s"), link(1, "a", turn, lane=1)])


def test_links_of_different_junctions_are_no_foes() -> None:
    a, b = Link(0, "a_0", "x_0", "s", "J", 0), Link(1, "b_0", "y_0", "s", "K", 0)
    assert not are_foes(a, b, {"J": [1], "K": [1]})
