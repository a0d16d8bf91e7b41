"""Scenario files with random damage: each is read, or refused in one line, never a traceback."""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from ugat_marl.errors import UgatMarlError
from ugat_marl.scenarios import Network, read_scenario

Crossing = Callable[..., Path]

INPUTS = 40
"""Damaged files per kind; a seed draws each of them."""
VALUES = (
    b"", b"-5", b"0", b"inf", b"nan", b"1_000", b"true", b"\xd9\xa1", b"1e999", b"9" * 30,
    b"x" * 300, b"../../x", b"/etc/passwd", b" ", b"a,b", b"NUL", b"400000000",
)  # fmt: skip


def damaged(content: bytes, draw: random.Random) -> bytes:
    """Return the content with one kind of damage."""
    kind = draw.randrange(4)
    place = draw.randrange(len(content))
    if kind == 0:
        return content[:place]
    if kind == 1:
        flipped = bytes([content[place] ^ 1 << draw.randrange(8)])
        return content[:place] + flipped + content[place + 1 :]
    if kind == 2:
        lines = content.splitlines(keepends=True)
        lines.insert(draw.randrange(len(lines)), draw.choice(lines))
        return b"".join(lines)
    value = draw.choice([*re.finditer(rb'"([^"\n]*)"', content)])
    return content[: value.start(1)] + draw.choice(VALUES) + content[value.end(1) :]


@pytest.mark.parametrize("file", ["scenario.toml", "network.net.xml", "demand.rou.xml"])
def test_damaged_scenarios_are_read_or_refused(file: str, crossing: Crossing) -> None:
    directory = crossing(vehicles='<vehicle id="a" depart="0" route="east"/>')
    content = (directory / file).read_bytes()
    for seed in range(INPUTS):
        (directory / file).write_bytes(damaged(content, random.Random(f"{file} {seed}")))
        try:
            Network.read(read_scenario(directory))
        except UgatMarlError as error:
            said = str(error)
        else:
            said = ""
        assert "\n" not in said, seed
