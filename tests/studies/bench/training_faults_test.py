"""Trainings with faults: what the comparison sees, and one round of all kinds but the slow ones."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

from studies.bench.training_faults import TrainingFaultsBench
from studies.bench.training_faults_program import KINDS, Steps, digests
from ugat_marl.errors import OptionError


def test_files_are_compared_by_their_content(tmp_path: Path) -> None:
    def written(name: str, weight: float, text: str) -> dict[str, str]:
        folder = tmp_path / name
        folder.mkdir()
        (folder / ".lock").write_text(name)
        (folder / "table.json").write_text(text)
        torch.save({"w": torch.tensor([weight, 2.0])}, folder / f"{name}.pt")
        (folder / f"{name}.pt").rename(folder / "policy.pt")
        return digests(folder)

    one = written("one", 1.0, "a")
    assert set(one) == {"table.json", "policy.pt"}
    assert written("two", 1.0, "a") == one
    assert written("three", 1.5, "a")["policy.pt"] != one["policy.pt"]
    assert written("four", 1.0, "b")["table.json"] != one["table.json"]


def test_steps_are_counted_across_processes() -> None:
    steps = Steps()
    with steps.task("any", 3) as advance:
        advance()
        advance(note="two")
    assert steps.count == 3
    steps.clear()
    assert steps.count == 0


def test_no_faults_are_refused() -> None:
    with pytest.raises(OptionError, match="faults"):
        TrainingFaultsBench(faults=0)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits other processes' files")
def test_a_training_with_a_fault_has_the_numbers_of_an_unbroken_one() -> None:
    report = TrainingFaultsBench(faults=2, seed=9).run()
    assert report.met, report.notes
    assert [row["fault"] for row in report.rows] == sorted(KINDS[:2])
    assert all(row["equal after resume"] == row["trainings"] for row in report.rows)


@pytest.mark.skipif(sys.platform != "linux", reason="limits other processes' files")
def test_another_number_after_resume_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    def found(*_: object, **__: object) -> dict[str, object]:
        row = {"kind": "kill -9", "at": 3, "first": "signal 9", "resumed": "done", "wrong": ["t"]}
        rude = {**row, "first": "traceback: ...", "wrong": []}
        return {"steps": 9, "files": 2, "rows": [row, rude]}

    monkeypatch.setattr("studies.bench.training_faults.in_fresh_process", found)
    report = TrainingFaultsBench(faults=2).run()
    assert [target.measured for target in report.targets] == [1.0, 1.0]
    assert "differing: t" in report.notes[1]
