"""The policy gap against worlds whose truth is known, and the command that measures it."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from ugat_marl.__main__ import main
from ugat_marl.diagnosis import Diagnosis, PolicyGap, TravelTimeEstimate
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.experiments import policy_gap, read_diagnosis, rule_factory, write_policy_gap
from ugat_marl.reporting import commands_on_page, policy_gap_table, write_diagnosis_page
from ugat_marl.scenarios import Network

SCENARIO = load_scenario("single-v1")
RULE = {"fixed-time:30": rule_factory("fixed-time:30")}
LENGTH_S = 400.0


def gap_of(corrected: Any, real: str = "V4", seeds: tuple[int, ...] = (1, 2, 3)) -> PolicyGap:
    gaps = policy_gap(SCENARIO, corrected, real, RULE, seeds, duration_s=LENGTH_S)
    return gaps["fixed-time:30"]


def test_a_perfect_correction_leaves_no_gap() -> None:
    row = gap_of(scenario_in_domain(SCENARIO, "V4"))
    assert row.real == row.corrected
    assert row.before == pytest.approx(abs(row.real.mean - row.sim.mean))
    assert row.before > 5
    assert (row.after, row.shrink) == (0.0, 1.0)
    assert row.sim.low is not None
    assert row.sim.high is not None
    assert row.sim.low <= row.sim.mean <= row.sim.high


def test_a_correction_of_nothing_shrinks_nothing() -> None:
    row = gap_of("sim")
    assert row.after == row.before
    assert row.shrink == 0.0


def test_a_wrong_correction_makes_it_worse() -> None:
    row = gap_of("acceleration=0.5+headway=2.5", "acceleration=2.2")
    assert row.after > row.before
    assert row.shrink is None or row.shrink < 0


def test_one_seed_has_no_interval() -> None:
    row = gap_of("V4", seeds=(3,))
    assert row.sim.low is None
    assert row.shrink == 1.0


def test_a_gap_that_is_not_there_cannot_shrink() -> None:
    row = gap_of("V4", "emergency_deceleration=8.9")
    assert row.before == pytest.approx(0.0, abs=0.5)
    assert row.shrink is None


def test_the_simulation_is_no_real_world() -> None:
    with pytest.raises(OptionError, match="the simulation itself"):
        gap_of("V4", "sim")
    with pytest.raises(OptionError, match="the simulation itself"):
        gap_of("V4", "undercount=*,0.2")  # nobody drives otherwise
    with pytest.raises(OptionError, match="at least one policy"):
        policy_gap(SCENARIO, "V4", "V4", {}, [1])


def diagnosed(directory: Path, corrected: str | None = "V4", **changes: Any) -> Path:
    """Write a diagnosis as `diagnose` does, with nothing in it but verdict and correction."""
    nothing: tuple[str, ...] = (
        "left_out", "ruled_out", "findings", "effects", "where", "left", "alternatives",
        "statistics", "lanes", "untried", "approaches", "patterns", "unnamed", "limits",
    )  # fmt: skip
    none = (
        "best", "heldout", "evidence", "criteria", "travel_time", "next_measurement",
        "traffic_check", "not_corrected", "ended_by",
    )  # fmt: skip
    record = {
        "schema": "ugat-marl/diagnosis/7",
        "scenario": SCENARIO.id,
        "seed": 0,
        "alpha": 0.05,
        "budget_h": None,
        "budget_s": 600.0,
        "verdict": "explained" if corrected else "unknown",
        "sentence": "It is so.",
        "complete": True,
        "periods": {"fit": ["day1"], "heldout": []},
        "verified_on_fitted_periods": True,
        "hashes": {"scenario": SCENARIO.hash},
        "versions": {},
        "policy_gap": None,
        "corrected": corrected and "corrected",
        **{name: [] for name in nothing},
        **dict.fromkeys(none),
        **changes,
    }
    directory.mkdir()
    if corrected:
        scenario_in_domain(SCENARIO, corrected).write(directory / "corrected")
    (directory / "diagnosis.json").write_text(json.dumps(record))
    return directory


def test_the_command_writes_the_gap_and_keeps_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    folder = diagnosed(tmp_path / "headway=1.4")
    call = ["policy-gap", "single-v1", str(folder), "--real", "V4", "--policies", "fixed-time:30"]
    call += ["largest-queue:20", "--seeds", "3", "--duration-s", "400"]
    before = json.loads((folder / "diagnosis.json").read_text())
    assert main(call) == 0
    written = (folder / "diagnosis.json").read_text()
    after = json.loads(written)
    gap = after["policy_gap"]
    assert {**after, "policy_gap": None} == before
    assert list(gap) == ["fixed-time:30", "largest-queue:20"]
    assert set(gap["fixed-time:30"]) == {"sim", "corrected", "real", "before", "after", "shrink"}
    assert [row["shrink"] for row in gap.values()] == [1.0, 1.0]
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    for word in ("fixed-time:30", "largest-queue:20", "100 %", "real: V4", "shrink"):
        assert word in text
    assert main(call) == 0
    assert (folder / "diagnosis.json").read_text() == written, "not the same file from the same"


def test_the_page_shows_the_gap_and_keeps_its_commands(tmp_path: Path) -> None:
    folder = diagnosed(tmp_path / "found")
    call = ["policy-gap", "single-v1", str(folder), "--real", "V4", "--policies", "fixed-time:30"]
    call += ["--seeds", "1", "--duration-s", "60"]
    assert main(call) == 0
    page = folder / "report.html"
    assert not page.exists(), "none was wanted"
    diagnosis = replace(Diagnosis.read(folder), policy_gap=None)
    commands = ["ugat-marl diagnose single-v1 'my data' --out found"]
    write_diagnosis_page(diagnosis, Network.read(SCENARIO), page, commands)
    assert "Policy gap" not in page.read_text()
    assert main(call) == 0
    assert "Policy gap" in page.read_text()
    assert commands_on_page(page) == commands


def test_what_is_no_diagnosis_of_this_scenario_is_refused(tmp_path: Path) -> None:
    def refused(name: str, says: str, **changes: Any) -> None:
        folder = diagnosed(tmp_path / name, **changes)
        with pytest.raises(OptionError, match=says):
            read_diagnosis(folder, SCENARIO)

    refused("schema", "not a diagnosis", schema="table")
    refused("other", "of another scenario", hashes={"scenario": "0"})
    refused("nothing", "'unknown'", corrected=None)
    with pytest.raises(OptionError, match="cannot be read"):
        read_diagnosis(tmp_path / "nowhere", SCENARIO)
    folder = diagnosed(tmp_path / "cut")
    (folder / "corrected" / "scenario.toml").unlink()
    with pytest.raises(ScenarioError, match="diagnose again"):
        read_diagnosis(folder, SCENARIO)
    (folder / "diagnosis.json").write_text('{"schema": ')
    with pytest.raises(OptionError, match="not valid JSON"):
        read_diagnosis(folder, SCENARIO)


def test_the_correction_is_read_back(tmp_path: Path) -> None:
    diagnosis, corrected = read_diagnosis(diagnosed(tmp_path / "out"), SCENARIO)
    assert corrected.hash == scenario_in_domain(SCENARIO, "V4").hash
    time = TravelTimeEstimate(100.0, None, None)
    gap = PolicyGap(time, time, time, before=1 / 3, after=0.0, shrink=None)
    write_policy_gap(tmp_path / "out", diagnosis, {"a": gap})
    again, _ = read_diagnosis(tmp_path / "out", SCENARIO)
    assert again.policy_gap == {"a": replace(gap, before=0.333333333)}


def test_the_table_fits_a_terminal() -> None:
    time = TravelTimeEstimate(1234.5, 1201.2, 1299.9)
    gap = PolicyGap(time, time, time, before=812.3, after=7.71, shrink=None)
    gaps = {
        "runs/corrected-v4/policies/direct-transfer.pt": replace(gap, shrink=0.9905),
        "max-pressure:20": gap,
        "one": replace(gap, real=TravelTimeEstimate(80.0, None, None), shrink=-0.5),
    }
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(policy_gap_table("single-v1: average travel time in s, real: V4", gaps, 5))
    text = console.export_text()
    assert max(map(len, text.splitlines())) <= 80
    for cell in ("99 %", "−50 %", "812", "7.7", "80.0", "max-pressure:20"):
        assert cell in text
    assert "…" not in text
    assert "1201–1300" in text
