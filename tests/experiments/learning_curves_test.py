"""Trainings that are judged as they go: taken up again, refused, and told of on a page."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.experiments import Curve, Training, found, perform, word
from ugat_marl.experiments import learning_curves as module
from ugat_marl.reporting.learning_curves import curves_as_csv, curves_page

PLAN = Training("single-v1", "ippo", 3, 4, 2, 2)
MADE = {"library": "wonder 1.0"}
FACTS = {
    "command": "results.py --seeds 2",
    "cpu": "abacus",
    "python": "3.11",
    "versions": {"torch": "2"},
    "date": "2026-01-02T03:04",
}


def curve(*att_s: list[float], speed: float = 10.0) -> Curve:
    marks = dict(zip(PLAN.marks, att_s, strict=True))
    return Curve(MADE, marks, decisions=100, seconds=100 / speed, own_seconds=0.5)


def test_it_is_judged_every_few_episodes_and_at_the_end() -> None:
    assert PLAN.marks == (2, 4)
    assert replace(PLAN, episodes=5).marks == (2, 4, 5)
    assert replace(PLAN, evaluate_every=9).marks == (4,)
    assert PLAN.name == "single-v1-ippo-s3"
    assert word("resco:cologne3") == "resco-cologne3"
    assert word("/there/mine.sumocfg") == "mine"


def test_a_training_is_whole_when_it_has_all_its_evaluations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "made_now", lambda scenario, learner: MADE)
    folder = tmp_path / PLAN.name
    assert found(PLAN, tmp_path) is None
    curve([1.0, 2.0], [3.0, 4.0]).write(folder)
    assert found(PLAN, tmp_path) == curve([1.0, 2.0], [3.0, 4.0])
    assert found(replace(PLAN, evaluation_seeds=3), tmp_path) is None
    assert found(replace(PLAN, episodes=6), tmp_path) is None
    own = found(replace(PLAN, evaluation_seeds=1, episodes=2), tmp_path)
    assert own is not None and own.means(replace(PLAN, evaluation_seeds=1)) == [1.0, 3.0]
    monkeypatch.setattr(module, "made_now", lambda scenario, learner: {"library": "wonder 2.0"})
    with pytest.raises(OptionError, match=r"was made with library wonder 1\.0 \(now wonder 2\.0\)"):
        found(PLAN, tmp_path)
    monkeypatch.setattr(module, "is_installed", lambda name: False)
    assert found(PLAN, tmp_path) is not None
    (folder / "curve.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"curve\.json: broken"):
        found(PLAN, tmp_path)


def test_the_page_by_hand() -> None:
    curves = {
        PLAN: curve([300.0, 300.0], [110.0, 130.0], speed=10),
        replace(PLAN, seed=4): curve([90.0, 90.0], [140.0, 140.0], speed=30),
        replace(PLAN, learner="dqn"): curve([500.0, 500.0], [400.0, 400.0]),
    }
    rules = {"programme": [210.0, 190.0], "fixed-time:30": [150.0, 150.0], "sotl": [125.0, 125.0]}
    lines = curves_page("single-v1", curves, rules, "sotl", FACTS).splitlines()
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if "| " in line]
    # seeds 3 and 4 end with 120 and 140, 150 is fixed time; their best are 120 and 90
    half = 12.706 * np.std([120, 140], ddof=1) / np.sqrt(2)
    assert cells[1][:5] == ["ippo", "wonder 1.0", "2", "20", "5.0"]
    assert (
        cells[1][5].startswith("105 (")
        and cells[1][6] == f"130 ({130 - half:.1f}–{130 + half:.0f})"
    )
    assert cells[1][7:] == ["-20.0", "2 of 2", "1 of 2"]
    assert cells[2][5:] == ["400", "400", "250", "0 of 1", "0 of 1"]
    assert [row[0] for row in cells[3:]] == [
        "*programme*",
        "*fixed-time:30*",
        "*sotl* (best tuned rule)",
    ]
    assert [row[6] for row in cells[3:]] == ["200", "150", "125"]
    assert "    results.py --seeds 2" in lines
    rows = curves_as_csv(curves).splitlines()
    assert len(rows) == 1 + 3 * 2 and rows[2] == "ippo,wonder 1.0,3,4,120.0,10.0,5.0"


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes of two minutes."""
    load = module.load
    monkeypatch.setattr(module, "load", lambda name: load(name).with_duration(120))


def att_of(folder: Path) -> Any:
    return json.loads((folder / "curve.json").read_text())["att_s"]


@pytest.mark.usefixtures("short")
def test_a_training_that_was_interrupted_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    perform(PLAN, whole)
    assert list(att_of(whole)) == ["2", "4"] and len(att_of(whole)["4"]) == 2
    perform(replace(PLAN, episodes=2), parts)
    assert sorted(path.name for path in parts.glob("learner*")) == ["learner-2.pt"]
    perform(PLAN, parts)
    assert att_of(parts) == att_of(whole)
    assert sorted(path.name for path in parts.glob("learner*")) == ["learner-4.pt"]
    curve = Curve.read(whole)
    assert (
        curve is not None
        and curve.decisions == 4 * 12
        and curve.seconds > 0
        and curve.own_seconds > 0
    )
    with pytest.raises(OptionError, match="is beyond it"):
        perform(replace(PLAN, episodes=3), parts)
    monkeypatch.setattr(module, "versions_of", lambda *names: {})
    with pytest.raises(OptionError, match=r"was made with versions .*; remove it"):
        perform(replace(PLAN, episodes=6), parts)
