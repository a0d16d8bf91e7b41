"""Progress bars at the widths people have."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from ugat_marl import progress
from ugat_marl.progress import Bars, Share, loudness


def test_brackets_in_names_and_notes_are_no_markup() -> None:
    written = io.StringIO()
    bars = Bars(Console(file=written, width=160, force_terminal=True, color_system=None))
    with bars.task("town[north]", 1) as advance:
        advance(note="detector [/a] [bold]")
    assert "town[north]" in written.getvalue()
    assert "detector [/a] [bold]" in written.getvalue()


@pytest.mark.parametrize("width", [80, 100, 160])
def test_a_note_is_whole_or_left_out(width: int) -> None:
    written = io.StringIO()
    bars = Bars(Console(file=written, width=width, force_terminal=True, color_system=None))
    with bars.task("round 1: candidates", 2) as advance:
        advance(note="acceleration+deceleration+emergency_deceleration+startup_delay")
        advance()
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.getvalue())
    lines = re.split(r"[\r\n]+", plain)
    last = [line for line in lines if "candidates" in line][-1]
    assert "━" * 10 in last
    assert "2/2" in last
    assert "left" in last
    assert max(map(len, lines)) <= width
    assert ("startup_delay" in last) == (width == 160), "left out where there is no room"
    assert "…" not in plain


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


@pytest.mark.parametrize("width", [80, 120])
def test_a_long_name_is_not_cut(width: int) -> None:
    written = io.StringIO()
    with Bars(Console(file=written, width=width)).task("roll-outs in the street, iteration 1", 2):
        pass
    assert "roll-outs in the street, iteration 1" in written.getvalue()
    assert "2/2" in written.getvalue()


def test_the_whole_counts_tasks_by_their_weight() -> None:
    written = io.StringIO()
    bars = Bars(Console(file=written, width=80, force_terminal=True, color_system=None))
    shares = {"training": Share(6), "fitting": Share(20, 0.1), "judging": Share(2)}
    with bars.whole("whole run", shares):
        whole = bars._whole
        assert whole is not None

        def done() -> float:
            (task,) = whole.progress.tasks
            return task.completed / float(task.total or 0)

        with bars.task("training: first", 3) as advance:
            advance()
            assert done() == pytest.approx(0.1)
            advance()
        assert done() == pytest.approx(0.3), "a task that ends early is done"
        with bars.task("fitting, iteration 1", 20) as advance:
            for _ in range(10):
                advance()
            assert done() == pytest.approx(0.4)
        with bars.task("something else", 5) as advance:
            advance()
        assert done() == pytest.approx(0.5)
        for _ in range(2):
            with bars.task("judging", 2) as advance:
                advance()
        assert done() == pytest.approx(0.7), "more than was expected counts nothing"
    assert "whole run" in written.getvalue()


def test_a_log_says_once_a_minute_how_far_the_whole_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short tasks, none of which lasts a minute."""
    now = [0.0]
    monkeypatch.setattr("ugat_marl.progress.time.monotonic", lambda: now[0])
    written = io.StringIO()
    bars = Bars(Console(file=written, width=80))
    with bars.whole("whole run", {"step": Share(10)}):
        for number in range(5):
            with bars.task(f"step {number}", 2) as advance:
                for _ in range(2):
                    now[0] += 20.0
                    advance()
    lines = [line.split() for line in written.getvalue().splitlines() if "whole run" in line]
    assert [line[3] for line in lines] == ["30%", "60%", "90%"]  # of 200 s


def test_quiet_says_nothing_and_verbose_all() -> None:
    written = io.StringIO()
    console = Console(file=written, width=80)
    with loudness("quiet"):
        bars = Bars(console)
        with bars.whole("whole run", {}), bars.task("training", 1) as advance:
            advance(note="here")
        bars.say("a line")
        assert not bars.verbose
    assert written.getvalue() == ""
    with loudness("verbose"):
        assert Bars(console).verbose
    assert not Bars(console).verbose


@pytest.mark.parametrize("terminal", [True, False])
def test_a_task_inside_of_another_leaves_its_line_too(terminal: bool) -> None:
    out = io.StringIO()
    bars = Bars(Console(file=out, force_terminal=terminal, width=80, color_system=None))
    with bars.task("other parts", 1) as outer, bars.task("training", 2) as inner:
        for _ in range(2):
            inner()
        outer()
    for line in ("training", "other parts"):
        assert any(text.count(line) and "left 00:00" in text for text in out.getvalue().split("\n"))
