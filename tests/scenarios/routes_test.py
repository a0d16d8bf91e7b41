"""Route files of single vehicles told from all others, tag after tag."""

from __future__ import annotations

import pytest

from ugat_marl.files import Tag
from ugat_marl.scenarios.routes import OwnEdges

OWN = ("vehicle", "route")


def read(*names: str) -> OwnEdges:
    found = OwnEdges()
    for name in names:
        name, _, attribute = name.partition("@")
        found.read(Tag(name, {attribute: "x"} if attribute else {}, 1))
    return found


@pytest.mark.parametrize(
    ("names", "lost", "holds"),
    [
        ((), False, True),
        (OWN, False, True),
        ((*OWN, *OWN), False, True),
        (("vType", "vehicle", "param", "route"), False, True),
        (("vehicle",), False, False),
        (("vehicle", "vehicle", "route"), True, False),
        (("vehicle@route",), True, False),
        ((*OWN, "trip"), True, False),
        (("flow", *OWN), True, False),
        ((*OWN, "routeDistribution"), True, False),
    ],
)
def test_single_vehicles_with_their_own_edges(
    names: tuple[str, ...], lost: bool, holds: bool
) -> None:
    found = read(*names)
    assert found.lost is lost
    assert found.ended() is holds
