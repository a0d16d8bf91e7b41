"""The one guard of the command line: an error of the system is one line with a way out."""

from __future__ import annotations

import errno
import os
import signal
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from ugat_marl.__main__ import main
from ugat_marl.cli import CommandLine, baseline_command, frame, run
from ugat_marl.errors import OptionError
from ugat_marl.experiments import BaselineArgs, BaselineResult
from ugat_marl.parallel import DEADLINE_VARIABLE, usual_deadline_s


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/full/a"), "/full/a: No space left on"),
        (OSError(errno.EMFILE, os.strerror(errno.EMFILE)), "Too many open files; raise the limit"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "x" * 999), "long; give a shorter name"),
        (OSError("odd"), "error: odd"),
        (RecursionError(), "nested too deeply"),
        (MemoryError(), "out of memory"),
    ],
)
def test_errors_of_the_system_are_one_line(
    error: BaseException, said: str, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    def fail(line: CommandLine, words: list[str], console: Console) -> int:
        raise error

    monkeypatch.setattr(frame, "_dispatch", fail)
    assert run(CommandLine("prog", "", {}), []) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("prog: error: ")
    assert err.count("\n") == 1
    assert said in err
    assert len(err) < 400


def test_a_terminated_command_ends_in_order(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cleared: list[str] = []

    def work(line: CommandLine, words: list[str], console: Console) -> int:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10)
        except KeyboardInterrupt as interrupt:
            cleared.append("folder")
            os.kill(os.getpid(), signal.SIGTERM)  # impatient, and in vain
            raise type(interrupt)("go on with: prog") from None
        return 0

    monkeypatch.setattr(frame, "_dispatch", work)
    before = signal.getsignal(signal.SIGTERM)
    assert run(CommandLine("prog", "", {}), []) == 143
    assert capsys.readouterr().err == "prog: terminated; go on with: prog\n"
    assert cleared == ["folder"]
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize("words", [["--deadline-s", "7.5", "go"], ["go", "--deadline-s=7.5", "x"]])
def test_the_deadline_holds_for_all_that_a_command_starts(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[list[str], float]] = []

    def work(line: CommandLine, words: list[str], console: Console) -> int:
        seen.append((words, usual_deadline_s()))
        return 0

    monkeypatch.setattr(frame, "_dispatch", work)
    monkeypatch.setenv(DEADLINE_VARIABLE, "60")
    assert run(CommandLine("prog", "", {}), words) == 0
    assert seen == [([w for w in words if "7.5" not in w and w != "--deadline-s"], 7.5)]
    assert usual_deadline_s() == 60


@pytest.mark.parametrize("seconds", ["soon", "0", "-5", "3e6", "inf", "1_000", ""])
def test_an_impossible_deadline_of_a_command(
    seconds: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(CommandLine("prog", "", {}), ["go", "--deadline-s", seconds]) == 2
    said = f"prog: error: --deadline-s {seconds}".rstrip()
    assert capsys.readouterr().err == f"{said}: give a number of seconds above 0, up to 2,000,000\n"


def test_a_warning_of_the_suite_is_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "c.csv").write_text("edge,count,begin_s,end_s\nwest1_A1,5,3000,3600\n")
    made = ["scenario", "new", str(tmp_path / "late"), "--grid", "1x1", "--counts"]
    assert main([*made, str(tmp_path / "c.csv")]) == 0
    assert main(["scenario", "check", str(tmp_path / "late")]) in (0, 1)
    said = capsys.readouterr().err
    assert "note: scenario 'late': no vehicle has entered the network in the first" in said
    assert "UserWarning" not in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--episodes", "many"], "--episodes 'many': not a whole number; see mine.py --help"),
        (["--epochs", "3"], "unknown option '--epochs' of mine.py. "),
        (["--episodes", "0"], "episodes = 0: must be at least 1"),
        ([], "steep"),
    ],
)
def test_errors_and_warnings_of_a_baseline_are_one_line(
    words: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def train(*_: Any) -> BaselineResult:
        warnings.warn("steep", stacklevel=1)
        raise OptionError("steep")

    monkeypatch.setattr(sys, "argv", ["baselines/mine.py", *words])
    with pytest.raises(SystemExit) as ended:
        baseline_command(BaselineArgs, train)
    assert ended.value.code == 2
    *notes, error = capsys.readouterr().err.splitlines()
    assert error.startswith(f"mine.py: error: {said}")
    assert notes == ([] if words else ["note: steep"])


def test_the_help_of_a_baseline_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["baselines/mine.py", "--help"])
    with pytest.raises(SystemExit) as ended:
        baseline_command(BaselineArgs, lambda *_: pytest.fail("it was trained"))
    assert not ended.value.code
    assert capsys.readouterr().out.startswith("usage: mine.py")
