"""Phases: those of a programme, or sets of links derived from their conflicts.

The conflicts come from the junction's own right-of-way matrix (``<request foes=...>``).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from ugat_marl.errors import ScenarioError, counted
from ugat_marl.files import read_xml
from ugat_marl.scenarios.junctions import (
    Link,
    Matrix,
    crossings_of,
    foes_of,
    has_bit,
    links_of,
    right_on_red_of,
    yields_of,
)
from ugat_marl.scenarios.signals import GREEN, YELLOW

MOST_PHASES = 64
"""Most derived phases of a junction. With more, its phases must be listed."""


Movement = tuple[str, str]
"""Approach (edge) and direction."""

Clash = Callable[[Link, Link], bool]
"""Function that is True if two links must not be green together."""


def programme_phases(programme: Sequence[tuple[float, str]]) -> tuple[str, ...]:
    """Return the green phases of a programme: states with green and without yellow, each once."""
    return tuple(
        dict.fromkeys(
            state for _, state in programme if set(state) & GREEN and not set(state) & YELLOW
        )
    )


def are_foes(a: Link, b: Link, foes: Matrix) -> bool:
    """Return True if the paths of two links cross or merge, by their junction's matrix."""
    return has_bit(a, b, foes) or has_bit(b, a, foes)


def conflicting_greens(phase: str, links: Sequence[Link], foes: Matrix) -> tuple[int, int] | None:
    """Return the indices of two links with protected green whose paths cross, or None.

    Conflicts with a through movement count, and those of turns whose through movements conflict as
    well. In many networks left turns of opposite approaches are drawn so tightly that the matrix
    calls them foes, and merging right turns are always green.
    """
    green = [link for link in links if phase[link.index] == "G"]
    crossing = _crossing_approaches(links, foes)
    for position, a in enumerate(green):
        for b in green[position + 1 :]:
            if (
                a.from_edge != b.from_edge
                and a.to_edge != b.to_edge
                and are_foes(a, b, foes)
                and ("s" in (a.direction, b.direction) or (a.from_edge, b.from_edge) in crossing)
            ):
                return a.index, b.index
    return None


def _crossing_approaches(links: Sequence[Link], foes: Matrix) -> set[tuple[str, str]]:
    """Return the pairs of approaches, in both orders, whose ways straight on cross."""
    through = [link for link in links if link.direction == "s"]
    return {(a.from_edge, b.from_edge) for a in through for b in through if are_foes(a, b, foes)}


def yielding(state: str, links: Sequence[Link], rules: RightOfWay) -> str:
    """Return a state whose protected greens do not cross: who must yield by right of way gets g.

    If the junction's rules let neither of two links wait, both get g.
    """
    while pair := conflicting_greens(state, links, rules.foes):
        a, b = ([link for link in links if link.index == index] for index in pair)
        waiting = [
            index
            for index, own, others in ((pair[0], a, b), (pair[1], b, a))
            if any(rules.waits(link, other) for link in own for other in others)
        ]
        letters = list(state)
        for index in waiting or pair:
            letters[index] = "g"
        state = "".join(letters)
    return state


@dataclass(frozen=True)
class RightOfWay:
    """Right of way at the junctions of a network: conflicts and priorities.

    Attributes:
        foes: Rows that cross or merge with each row.
        yields: Rows that each row gives way to; empty if not needed.
        right_on_red: Junctions where vehicles may turn right on red after a stop.
    """

    foes: Matrix
    yields: Matrix = field(default_factory=dict[str, Sequence[int]])
    right_on_red: frozenset[str] = frozenset()

    @classmethod
    def of(cls, root: ET.Element) -> RightOfWay:
        """Read the right of way of a ``<net>``."""
        return cls(foes_of(root), yields_of(root), right_on_red_of(root))

    def waits(self, a: Link, b: Link) -> bool:
        """Return True if `a` must let `b` go first."""
        return bool(self.yields) and has_bit(a, b, self.yields)


def conflict_free_phases(
    links: Sequence[Link],
    rules: RightOfWay,
    width: int,
    source: str,
    *,
    crossings: Sequence[Link] = (),
    permitted: bool = False,
) -> tuple[str, ...]:
    """Return all maximal sets of compatible movements, as SUMO states.

    A movement is a group of links with one approach and one direction. Movements that share a
    letter of the state count as one. Right turns are added to every phase that they do not conflict
    with; if they share a lane with another movement, one of these must be green as well. On a
    junction with four arms and left lanes this gives the eight phases of the UGAT paper. Where
    traffic keeps to the left, left and right change places.

    A crossing is green in every phase in which only turning vehicles cross it; these wait (``g``).
    Phases with right turns only are preferred, else left turns count too. Crossings that no phase
    can serve get green in a phase for pedestrians alone.

    Args:
        links: Links of one traffic light.
        rules: Right of way at its junctions.
        width: Number of letters of a state.
        source: Name of the traffic light in errors.
        crossings: Links for pedestrians.
        permitted: True if left turns may go together with opposite traffic, to which they give way
            (``g``).

    Returns:
        Distinct states in a fixed order, through movements before left turns.

    Raises:
        ScenarioError: The network has no right-of-way matrix, or there are too many sets.
    """
    if any(link.request < 0 for link in links):
        raise ScenarioError(
            f"{source}: the network has no internal lanes, so conflicts are unknown; "
            'use phases = "programme" or list the phases'
        )
    clash = permitted_clash(links, rules) if permitted else partial(are_foes, foes=rules.foes)
    groups = _movements(links)
    following = {name for name in groups if name[1] == "r"}
    while True:
        phases = _maximal_phases(groups, following, clash, source)
        never = [name for name in sorted(following) if not any(name in chosen for chosen in phases)]
        if not never:
            break
        following -= set(never)
    chosen = [[link for name in phase for link in groups[name]] for phase in phases]
    letters = {link.index for link in links}
    walks = [crossing for crossing in crossings if crossing.index not in letters]
    together = _with_crossings(chosen, walks, rules.foes)
    return tuple(dict.fromkeys(state_of(green, links, rules, width) for green in together))


def permitted_clash(links: Sequence[Link], rules: RightOfWay) -> Clash:
    """Return a conflict test that allows left turns that wait for opposite traffic."""
    opposite = opposite_approaches(links, rules)

    def clash(a: Link, b: Link) -> bool:
        if not are_foes(a, b, rules.foes):
            return False
        return not opposite(a, b) or not any(
            kerb_turn_of(x) == "l" and rules.waits(x, y) for x, y in ((a, b), (b, a))
        )

    return clash


def opposite_approaches(links: Sequence[Link], rules: RightOfWay) -> Clash:
    """Return a test if links have opposite approaches: both go straight on and do not cross."""
    crossing = _crossing_approaches(links, rules.foes)
    straight = {link.from_edge for link in links if link.direction == "s"}

    def opposite(a: Link, b: Link) -> bool:
        approaches = (a.from_edge, b.from_edge)
        return set(approaches) <= straight and approaches not in crossing

    return opposite


def _with_crossings(
    phases: list[list[Link]], crossings: Sequence[Link], foes: Matrix
) -> list[list[Link]]:
    """Add to each phase the crossings it can serve, and a phase for the crossings left over."""
    alone: list[Link] = []
    letters = [list(phase) for phase in phases]
    for crossing in crossings:
        possible: list[int] = []
        for turning in ("r", "rl"):
            possible = [
                number
                for number, phase in enumerate(phases)
                if all(
                    kerb_turn_of(link) in turning
                    for link in phase
                    if are_foes(link, crossing, foes)
                )
            ]
            if possible:
                break
        for number in possible:
            letters[number].append(crossing)
        if not possible:
            alone.append(crossing)
    return [*letters, alone] if alone else letters


def state_of(green: Sequence[Link], links: Sequence[Link], rules: RightOfWay, width: int) -> str:
    """Return the state with green for links: ``G``, or ``g`` if a link must wait for another."""
    letters = ["r"] * width
    for link in links:
        if link.junction in rules.right_on_red and kerb_turn_of(link) == "r":
            letters[link.index] = "s"
    for link in green:
        letters[link.index] = "G"
    for link in green:
        # lanes of one road too: who turns across a bicycle lane beside waits for those on it
        if any(link.from_lane != b.from_lane and rules.waits(link, b) for b in green):
            letters[link.index] = "g"
    return "".join(letters)


def _maximal_phases(
    groups: Mapping[Movement, Sequence[Link]],
    following: set[Movement],
    clash: Clash,
    source: str,
) -> list[set[Movement]]:
    """Return maximal sets of compatible movements, with the right turns that fit each set."""
    main = [name for name in groups if name not in following]
    compatible = {
        a: {b for b in main if b != a and not _groups_conflict(groups[a], groups[b], clash)}
        for a in main
    }

    def through_first(chosen: frozenset[Movement]) -> tuple[int, list[int]]:
        return sum(name[1] == "l" for name in chosen), sorted(map(main.index, chosen))

    phases: list[set[Movement]] = []
    for leading in sorted(_maximal_cliques(compatible, source), key=through_first):
        chosen = set(leading)
        for name in groups:
            if name in following and _right_may_go(name, chosen, groups, clash):
                chosen.add(name)
        phases.append(chosen)
    return phases


def _movements(links: Sequence[Link]) -> dict[Movement, list[Link]]:
    """Group links by approach and turn; links that share a letter are one group."""
    groups: dict[Movement, list[Link]] = {}
    for link in links:
        groups.setdefault((link.from_edge, kerb_turn_of(link)), []).append(link)
    # Right turns come last, so that they join the movement they share a letter with.
    for name in sorted(groups, key=lambda name: name[1] == "r"):
        letters = {link.index for link in groups.get(name, ())}
        while joined := [
            other
            for other, members in groups.items()
            if other != name and letters & {link.index for link in members}
        ]:
            for other in joined:
                groups[name] += groups.pop(other)
            letters = {link.index for link in groups[name]}
    return groups


def turn_of(link: Link) -> str:
    """Return s, l or r; partial turns and U-turns count as the turn they resemble."""
    around = "r" if link.left_hand else "l"
    return {"L": "l", "t": around, "T": around, "R": "r"}.get(link.direction, link.direction)


def kerb_turn_of(link: Link) -> str:
    """Return the turn that has the same conflicts where traffic keeps to the right.

    A turn along the kerb is ``r`` and a turn across the opposite traffic is ``l``, so the turns of
    left-hand traffic are mirrored.
    """
    turn = turn_of(link)
    return {"l": "r", "r": "l"}.get(turn, turn) if link.left_hand else turn


def _groups_conflict(a: Sequence[Link], b: Sequence[Link], clash: Clash) -> bool:
    return any(x.from_edge != y.from_edge and clash(x, y) for x in a for y in b)


def _right_may_go(
    name: Movement,
    chosen: Set[Movement],
    groups: Mapping[Movement, Sequence[Link]],
    clash: Clash,
) -> bool:
    if any(_groups_conflict(groups[name], groups[other], clash) for other in chosen):
        return False
    lanes = {link.from_lane for link in groups[name]}
    sharing = [
        other
        for other, links in groups.items()
        if other != name and lanes & {link.from_lane for link in links}
    ]
    return not sharing or any(other in chosen for other in sharing)


def _maximal_cliques(
    compatible: Mapping[Movement, set[Movement]], source: str
) -> Iterator[frozenset[Movement]]:
    """Yield all maximal cliques (Bron and Kerbosch 1973, with the pivot of Tomita et al. 2006)."""
    count = 0
    stack = [(frozenset[Movement](), set(compatible), set[Movement]())]
    while stack:
        clique, candidates, excluded = stack.pop()
        if not candidates and not excluded:
            count += 1
            if count > MOST_PHASES:
                raise ScenarioError(
                    f"{source}: more than {MOST_PHASES} conflict-free phases; "
                    'use phases = "programme" or list the phases'
                )
            yield clique
            continue
        pivot = max(
            sorted(candidates | excluded), key=lambda name: len(compatible[name] & candidates)
        )
        for name in sorted(candidates - compatible[pivot]):
            near = compatible[name]
            stack.append((clique | {name}, candidates & near, excluded & near))
            candidates = candidates - {name}
            excluded = excluded | {name}


def suited(network: Path) -> tuple[dict[str, str], list[str]]:
    """Find the lights for which conflict-free phases do not fit, and a better source of phases.

    If a lane serves both straight on and turns across opposite traffic, a vehicle that waits for
    one of them blocks a phase for the other. At such lights these turns are permitted. Lights with
    fewer than two derived phases keep the phases of their programme, if it has at least two.

    Args:
        network: The ``.net.xml``.

    Returns:
        Light to the source of its phases, and notes for the user.
    """
    root = read_xml(network)
    rules = RightOfWay.of(root)
    crossings = crossings_of(root)
    programmes = _programmes_of(root)
    sources: dict[str, str] = {}
    for tls, links in sorted(links_of(root).items()):
        walks = crossings.get(tls, [])
        usual = "permitted" if _shared(links) else "conflict-free"
        if len(_derived(tls, links, rules, walks, usual)) < 2 <= len(programmes.get(tls, ())):
            sources[tls] = "programme"
        elif usual != "conflict-free":
            sources[tls] = usual
    notes: list[str] = []
    across = "lanes for straight on and turns across opposite traffic: these turns are permitted"
    for source, why in (
        ("permitted", across),
        ("programme", "no phases that can be derived: they keep their programme's"),
    ):
        if count := sum(kind == source for kind in sources.values()):
            notes.append(f"{counted(count, 'light')} {'has' if count == 1 else 'have'} {why}")
    return sources, notes


def _derived(
    tls: str, links: Sequence[Link], rules: RightOfWay, walks: Sequence[Link], source: str
) -> tuple[str, ...]:
    width = max(link.index for link in (*links, *walks)) + 1
    permitted = source == "permitted"
    try:
        return conflict_free_phases(links, rules, width, tls, crossings=walks, permitted=permitted)
    except ScenarioError:
        return ()


def _shared(links: Sequence[Link]) -> bool:
    """Return True if some lane leads both straight on and to the left."""
    turns: dict[str, set[str]] = defaultdict(set)
    for link in links:
        if link.direction not in "tT":
            turns[link.from_lane].add(kerb_turn_of(link))
    return any({"s", "l"} <= lane_turns for lane_turns in turns.values())


def _programmes_of(root: ET.Element) -> dict[str, tuple[str, ...]]:
    return {
        logic.get("id", ""): programme_phases(
            [(0.0, phase.get("state", "")) for phase in logic.iter("phase")]
        )
        for logic in root.iter("tlLogic")
    }
