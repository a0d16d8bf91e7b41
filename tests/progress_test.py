"""Progress bars at the widths people have."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from ugat_marl import progress
from ugat_marl.progress import Bars


@pytest.mark.parametrize("width", [80, 100, 160])
def test_a_long_note_does_not_squeeze_the_bar(width: int) -> None:
    written = io.StringIO()
    bars = Bars(Console(file=written, width=width, force_terminal=True, color_system=None))
    with bars.task("round 1: candidates", 2) as advance:
        advance(note="acceleration+deceleration+emergency_deceleration+startup_delay")
        advance()
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.getvalue())
    lines = re.split(r"[\r\n]+", plain)
    last = [line for line in lines if "candidates" in line][-1]
    assert "━" * 18 in last
    assert "2/2" in last
    assert "left" in last
    assert max(map(len, lines)) <= width
    assert ("startup_delay" in last) == (width == 160), "shortened where there is no room"


def test_a_log_shows_once_a_minute_how_far_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    written = io.StringIO()
    with Bars(Console(file=written, width=80)).task("paper main", 8) as advance:
        for _ in range(6):
            now[0] += 25.0
            advance(note="V1")
    done = re.findall(r"^paper main +━+╸? +(\d)/8 .* V1$", written.getvalue(), flags=re.MULTILINE)
    assert done == ["3", "6", "8"], "after 75 s, after 150 s, and at the end"
