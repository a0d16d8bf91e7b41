"""The studies as a user of a checkout calls them: help, wrong calls, a program of its own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import studies.bench.__main__ as bench
import studies.blind.__main__ as blind
from ugat_marl.cli import CommandLine, run

CHECKOUT = Path(__file__).resolve().parents[2]
COMMANDS = [(line, name) for line in (bench.LINE, blind.LINE) for name in line.commands]


@pytest.mark.parametrize(("line", "command"), COMMANDS, ids=[name for _, name in COMMANDS])
def test_every_command_explains_itself(
    line: CommandLine,
    command: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as end:
        run(line, [command, "--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: {line.program} {command}" in text
    assert f"    {line.program} {command}" in text, "no example"


def test_examples_of_other_programs_stay_commands(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        run(blind.LINE, ["generate", "--help"])
    text = capsys.readouterr().out
    commands = re.findall(r"^ +(python -m studies\.blind generate .*)$", text, flags=re.MULTILINE)
    assert len(commands) == 2 and commands[1].endswith("\\"), "the second goes on in the next line"
    assert "--quiet" in text


def test_a_long_purpose_goes_on_beside_its_name(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run(bench.LINE, ["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    first = next(place for place, line in enumerate(lines) if line.startswith("  field-soak"))
    start = lines[first].index("drive")
    assert lines[first + 1].startswith(" " * start) and lines[first + 1].strip()


@pytest.mark.parametrize("study", ["bench", "blind"])
def test_a_wrong_command_is_one_line(study: str) -> None:
    """Run as in the Makefile: the checkout on the path, the safe path off."""
    variables = {**os.environ, "PYTHONPATH": ".", "PYTHONSAFEPATH": ""}
    call = [sys.executable, "-m", f"studies.{study}", "nonsense"]
    done = subprocess.run(
        call, cwd=CHECKOUT, env=variables, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.startswith(f"python -m studies.{study}: error: unknown command 'nonsense'")


def test_the_bench_of_devices_refuses_a_missing_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert run(bench.LINE, ["device", "--device", "cuda"]) == 2
    assert "device = 'cuda': torch" in capsys.readouterr().err
    assert run(bench.LINE, ["device", "--device", "gpu"]) == 2
    assert "must be cpu, cuda, or cuda:N" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
