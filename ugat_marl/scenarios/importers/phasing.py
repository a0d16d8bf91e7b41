"""Which green phases suit each traffic light of a network that was made elsewhere."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from ugat_marl.errors import ScenarioError
from ugat_marl.files import parse_xml, read_bytes
from ugat_marl.scenarios.junctions import Link, crossings_of, foes_of, links_of, yields_of
from ugat_marl.scenarios.phases import RightOfWay, conflict_free_phases, programme_phases, turn_of

USUAL = "conflict-free"


def suited(network: Path) -> tuple[dict[str, str], list[str]]:
    """The lights that conflict-free phases do not suit, and what suits them.

    Where a lane serves straight on and left turns, a phase for one of them alone lets whoever waits
    for the other block the lane: there left turns are permitted. A light with too many conflicts to
    derive phases, or with one phase only by them, keeps its programme's.

    Args:
        network: The ``.net.xml``.

    Returns:
        Source of the phases by light, and notes.
    """
    root = parse_xml(read_bytes(network), str(network))
    rules = RightOfWay(foes_of(root), yields_of(root))
    crossings = crossings_of(root)
    programmes = _programmes(root)
    found: dict[str, str] = {}
    for tls, links in sorted(links_of(root).items()):
        walks = crossings.get(tls, [])
        usual = "permitted" if _shared(links) else USUAL
        if len(_derived(tls, links, rules, walks, usual)) < 2 <= len(programmes.get(tls, ())):
            found[tls] = "programme"
        elif usual != USUAL:
            found[tls] = usual
    notes: list[str] = []
    for source, why in (
        ("permitted", "lanes for straight on and left turns: their left turns are permitted"),
        ("programme", "no phases that can be derived: they keep their programme's"),
    ):
        if count := sum(kind == source for kind in found.values()):
            notes.append(f"{count} lights have {why}")
    return found, notes


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
    """Whether a lane leads both straight on and to the left."""
    turns: dict[str, set[str]] = defaultdict(set)
    for link in links:
        if link.direction not in "tT":
            turns[link.from_lane].add(turn_of(link))
    return any({"s", "l"} <= own for own in turns.values())


def _programmes(root: ET.Element) -> dict[str, tuple[str, ...]]:
    return {
        logic.get("id", ""): programme_phases(
            [(0.0, phase.get("state", "")) for phase in logic.iter("phase")]
        )
        for logic in root.iter("tlLogic")
    }
