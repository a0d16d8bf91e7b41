"""Which links may be green together: phases from a programme, or derived from the conflicts.

The conflicts are those of the junction's own right-of-way matrix (``<request foes=...>``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass

from ugat_marl.errors import ScenarioError
from ugat_marl.signals import GREEN, YELLOW

MOST_PHASES = 64
"""More maximal conflict-free sets than this mean a junction that needs an explicit list."""


Movement = tuple[str, str]
"""Approach (edge) and direction."""


@dataclass(frozen=True)
class Link:
    """A way across an intersection, controlled by one letter of the signal state.

    Attributes:
        index: Position of its letter; several links may share one.
        from_lane: Incoming lane.
        to_lane: Outgoing lane.
        direction: SUMO's letter: s straight, l/L left, r/R right, t turn-around.
        junction: Junction it crosses.
        request: Its row in that junction's right-of-way matrix, or -1 if the network has none.
    """

    index: int
    from_lane: str
    to_lane: str
    direction: str
    junction: str = ""
    request: int = -1

    @property
    def from_edge(self) -> str:
        """Edge of the incoming lane."""
        return self.from_lane.rsplit("_", 1)[0]


def programme_phases(programme: Sequence[tuple[float, str]]) -> tuple[str, ...]:
    """The green phases of a signal programme: states with green and without yellow, each once."""
    return tuple(
        dict.fromkeys(
            state for _, state in programme if set(state) & GREEN and not set(state) & YELLOW
        )
    )


def are_foes(a: Link, b: Link, foes: Mapping[str, Sequence[int]]) -> bool:
    """Whether the paths of two links cross or merge, by their junction's matrix."""
    if a.junction != b.junction or a.request < 0 or b.request < 0:
        return False
    rows = foes[a.junction]
    return bool(rows[a.request] >> b.request & 1 or rows[b.request] >> a.request & 1)


def conflicting_greens(
    phase: str, links: Sequence[Link], foes: Mapping[str, Sequence[int]]
) -> tuple[int, int] | None:
    """Two links that both have protected green though their paths cross, or None.

    Only crossings that involve a through movement count: many networks draw opposing left turns so
    tightly that the matrix calls them foes, and give a merging right turn a standing green.
    """
    green = [link for link in links if phase[link.index] == "G"]
    for position, a in enumerate(green):
        for b in green[position + 1 :]:
            if (
                a.from_edge != b.from_edge
                and a.to_lane.rsplit("_", 1)[0] != b.to_lane.rsplit("_", 1)[0]
                and "s" in (a.direction, b.direction)
                and are_foes(a, b, foes)
            ):
                return a.index, b.index
    return None


def conflict_free_phases(
    links: Sequence[Link],
    foes: Mapping[str, Sequence[int]],
    width: int,
    source: str,
) -> tuple[str, ...]:
    """All maximal sets of compatible movements, as SUMO states.

    A movement is a group of links with one approach and one direction; movements that share a
    letter of the state count as one. Right turns follow: they are green with every phase that gives
    green to a lane they share or that they do not conflict with.
    On a 4-arm junction with left lanes this gives the eight phases of the UGAT paper.

    Args:
        links: Links of one traffic light.
        foes: Right-of-way matrices by junction.
        width: Letters of a state.
        source: What to call the traffic light in errors.

    Returns:
        Distinct states, through movements before left turns, in a fixed order.

    Raises:
        ScenarioError: The network has no right-of-way matrix, or there are too many sets.
    """
    if any(link.request < 0 for link in links):
        raise ScenarioError(
            f"{source}: the network has no internal lanes, so conflicts are unknown; "
            'use phases = "programme" or list the phases'
        )
    groups = _movements(links)
    following = {name for name in groups if name[1] == "r"}
    while True:
        phases = _maximal_phases(groups, following, foes, source)
        never = [name for name in sorted(following) if not any(name in chosen for chosen in phases)]
        if not never:
            break
        following -= set(never)
    states = (
        "".join(
            "G" if index in {link.index for name in chosen for link in groups[name]} else "r"
            for index in range(width)
        )
        for chosen in phases
    )
    return tuple(dict.fromkeys(states))


def _maximal_phases(
    groups: Mapping[Movement, Sequence[Link]],
    following: set[Movement],
    foes: Mapping[str, Sequence[int]],
    source: str,
) -> list[set[Movement]]:
    """Maximal sets of the movements that lead, each with the right turns that may follow it."""
    main = [name for name in groups if name not in following]
    compatible = {
        a: {b for b in main if b != a and not _groups_conflict(groups[a], groups[b], foes)}
        for a in main
    }

    def through_first(chosen: frozenset[Movement]) -> tuple[int, list[int]]:
        return sum(name[1] == "l" for name in chosen), sorted(map(main.index, chosen))

    phases: list[set[Movement]] = []
    for leading in sorted(_maximal_cliques(compatible, source), key=through_first):
        chosen = set(leading)
        for name in groups:
            if name in following and _right_may_go(name, chosen, groups, foes):
                chosen.add(name)
        phases.append(chosen)
    return phases


def _movements(links: Sequence[Link]) -> dict[Movement, list[Link]]:
    """Links by approach and turn; those that share a letter can only be green together."""
    groups: dict[Movement, list[Link]] = {}
    for link in links:
        groups.setdefault((link.from_edge, _turn(link.direction)), []).append(link)
    # A right turn joins the movement it shares a letter with, not the other way round.
    for name in sorted(groups, key=lambda name: name[1] == "r"):
        letters = {link.index for link in groups.get(name, ())}
        while joined := [
            other
            for other, own in groups.items()
            if other != name and letters & {link.index for link in own}
        ]:
            for other in joined:
                groups[name] += groups.pop(other)
            letters = {link.index for link in groups[name]}
    return groups


def _turn(direction: str) -> str:
    """Through, left or right; partial turns and turn-arounds count as the turn they resemble."""
    return {"L": "l", "t": "l", "T": "l", "R": "r"}.get(direction, direction)


def _groups_conflict(
    a: Sequence[Link], b: Sequence[Link], foes: Mapping[str, Sequence[int]]
) -> bool:
    return any(x.from_edge != y.from_edge and are_foes(x, y, foes) for x in a for y in b)


def _right_may_go(
    name: Movement,
    chosen: Set[Movement],
    groups: Mapping[Movement, Sequence[Link]],
    foes: Mapping[str, Sequence[int]],
) -> bool:
    if any(_groups_conflict(groups[name], groups[other], foes) for other in chosen):
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
    """Bron-Kerbosch without pivoting: the graphs have a dozen nodes."""
    found = 0
    stack = [(frozenset[Movement](), set(compatible), set[Movement]())]
    while stack:
        clique, candidates, excluded = stack.pop()
        if not candidates and not excluded:
            found += 1
            if found > MOST_PHASES:
                raise ScenarioError(
                    f"{source}: more than {MOST_PHASES} conflict-free phases; "
                    'use phases = "programme" or list the phases'
                )
            yield clique
            continue
        for name in sorted(candidates):
            near = compatible[name]
            stack.append((clique | {name}, candidates & near, excluded & near))
            candidates = candidates - {name}
            excluded = excluded | {name}
