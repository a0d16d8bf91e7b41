"""More than 3,000 damaged inputs, seeded, in about twenty minutes."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from tests.fuzzing import surfaces

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(1200)]
INPUTS = 180
"""Damaged inputs of a surface whose share is 1."""
FIRST = 1000
ROOT = Path(__file__).parents[2]
PROGRAM = f"import sys; sys.path.append({str(ROOT)!r}); from tests.fuzzing import main; "


def test_there_are_at_least_three_thousand() -> None:
    assert sum(round(INPUTS * surface.share) for surface in surfaces().values()) >= 3000


@pytest.mark.parametrize("name", sorted(surfaces()))
def test_no_traceback_hang_or_crash(name: str, python: list[str]) -> None:
    count = round(INPUTS * surfaces()[name].share)
    call = f"main({name!r}, {FIRST}, {count})"
    done = subprocess.run(
        [*python, "-c", PROGRAM + call], capture_output=True, text=True, timeout=1200, check=False
    )
    rows = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert [row for row in rows if "fault" in row] == []
    # A crash of the interpreter ends the output at the seed that caused it.
    assert rows[-1:] == [{"done": count}], done.stderr[-2000:]
