"""The studies as a user of a checkout calls them: help, wrong calls, a program of its own."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import studies.bench.__main__ as bench
import studies.blind.__main__ as blind
from studies import behaviour_digests
from studies.behaviour_digests import parts
from ugat_marl.cli import CommandLine, guarded, run

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


@pytest.mark.parametrize("fails", [KeyboardInterrupt, behaviour_digests.NotInstalled("no resco")])
def test_digests_are_kept_until_a_part_was_played_again(
    fails: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "digests.json"
    part = {"sha256": "a" * 64, "values": {"one": 1.0}, "names": {"two": "x"}}
    names = sorted(parts())[:2]
    behaviour_digests.save(file, dict.fromkeys(names, part))
    before = file.read_bytes()

    def played(_: str) -> None:
        raise fails

    monkeypatch.setattr(behaviour_digests, "played", played)
    with contextlib.suppress(KeyboardInterrupt):
        assert behaviour_digests.write(file, names) == 0
    assert file.read_bytes() == before


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


@pytest.mark.parametrize(
    ("study", "words", "reason"),
    [
        ("unseen", "out --seed 1 --networks 0", "networks = 0"),
        ("unseen", "out --seed 1 --pbf a.osm.pbf --extracts 0", "extracts = 0"),
        ("unseen", "out --seed 1 --seeds 0", "seeds = 0"),
        ("unseen", "out --seed 1 --pbf none.osm.pbf", "none.osm.pbf: not an OpenStreetMap extract"),
        ("osm_extracts", "a.osm.pbf --seed 1 --out out --count 0", "count = 0"),
        ("osm_extracts", "none.osm --seed 1 --out out", "No such file"),
        ("osm_extracts", "broken.json --seed 1 --out out", "give an .osm.pbf or .osm"),
        ("paid_for_blocking", "single-v1 --seeds 0", "seeds = 0"),
        ("posterior_coverage", "single-v1 --out out --streets 0", "streets = 0"),
        ("pretraining", "out --networks 0", "networks = 0"),
        ("pretraining", "out --episodes 0", "episodes = 0"),
        ("pretraining", "out --every 0", "every = 0"),
        ("pretraining", "out --updates -1", "updates = -1"),
        ("pretraining", "held", "start.pt: holds weights already"),
        ("behaviour_digests", "check broken.json", "not valid JSON"),
        ("behaviour_digests", "check other.json", "holds no digests"),
        ("behaviour_digests", "write other.json --only scenarios", "holds no digests"),
    ],
)
def test_a_study_refuses_in_one_line_and_leaves_nothing(
    study: str,
    words: str,
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if study in ("unseen", "osm_extracts"):
        pytest.importorskip("osmium")
    (tmp_path / "broken.json").write_text("{")
    (tmp_path / "other.json").write_text("[]")
    (tmp_path / "held").mkdir()
    (tmp_path / "held" / "start.pt").write_bytes(b"weights")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [study, *words.split()])
    main = importlib.import_module(f"studies.{study}").main
    assert guarded(f"python -m studies.{study}", main) == 2
    said = capsys.readouterr().err
    assert reason in said and said.count("\n") == 1
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before
    assert not (tmp_path / "out").exists()


def test_every_part_of_the_digests_is_written_down() -> None:
    file = CHECKOUT / "studies" / "behaviour_digests.json"
    written = set(json.loads(file.read_text(encoding="utf-8"))["parts"])
    assert set(parts()) == written


def test_the_bench_of_devices_refuses_a_missing_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert run(bench.LINE, ["device", "--device", "cuda"]) == 2
    assert "--device cuda: torch" in capsys.readouterr().err
    assert run(bench.LINE, ["device", "--device", "gpu"]) == 2
    assert "must be cpu, cuda, or cuda:N" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
