"""The workflow around the answer: the same again, from cold, in a hurry, and with poor data."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import Finding, MeasuredData, recording_holes
from ugat_marl.diagnosis import DiagnosisConfig, Study
from ugat_marl.diagnosis.engine import OutOfTime
from ugat_marl.diagnosis.statistics import sum_of
from ugat_marl.diagnosis.thresholds import Effort
from ugat_marl.diagnosis.unmeasured import without_holes
from ugat_marl.errors import MeasuredDataError, OptionError, UnknownNameError
from ugat_marl.progress import Silent
from ugat_marl.scenarios import Passages

FEW = Effort(base=24, bank=2, fit=5, test=16)
DETECTORS = {"undercount", "dropout", "swapped"}
"""Faults of detectors cost no simulation beyond that of plain days."""


@pytest.fixture(scope="module")
def measured(street) -> MeasuredData:
    return street.measure("undercount=stop:S_C_0,0.3")


def run(street, measured: MeasuredData, out: Path, **options: Any) -> dict[str, Any]:
    return street.diagnose(measured, out, **{"among": DETECTORS, "effort": FEW, **options})


@pytest.mark.slow
def test_the_same_inputs_give_the_same_file(street, measured: MeasuredData, tmp_path: Path) -> None:
    def once(name: str, **options: Any) -> bytes:
        run(street, measured, tmp_path / name, **options)
        return (tmp_path / name / "diagnosis.json").read_bytes()

    cold = once("cold", cache=tmp_path / "days", workers=2)
    assert once("warm", cache=tmp_path / "days", workers=1) == cold
    assert once("other", workers=3) == cold


def test_the_answer_is_the_file(street, measured: MeasuredData, tmp_path: Path) -> None:
    found = run(street, measured, tmp_path)
    assert json.loads((tmp_path / "diagnosis.json").read_text()) == found
    assert found["schema"] == "ugat-marl/diagnosis/7"
    assert found["hashes"] == {"scenario": street.scenario.hash, "measured": measured.hash}
    assert found["periods"] == {"fit": ["day1", "day2", "day3"], "heldout": ["day4", "day5"]}
    assert not found["verified_on_fitted_periods"]
    (effect,) = found["effects"]
    share = effect["parameters"]["share"]
    assert share["low"] < share["value"] < share["high"]
    assert found["seed"] == 0
    assert "NaN" not in (tmp_path / "diagnosis.json").read_text()


def test_a_hole_in_the_recording_is_no_effect(
    street, measured: MeasuredData, tmp_path: Path
) -> None:
    """For 300 s of a day nothing is recorded, and a vehicle seems to stand there all the while."""
    hole = (400.0, 700.0)
    days = list(measured.periods)
    day = without_holes(days[3], (hole,))
    seen = day.passages["advance:W_C_0"]
    stuck = Passages(np.array([399.9]), np.array([700.1]), np.full(1, 5.0), np.full(1, 5.0))
    whole = Passages.concatenated([seen, stuck])
    order = np.argsort(whole.on_s)
    whole = Passages(
        whole.on_s[order], whole.off_s[order], whole.speed_mps[order], whole.length_m[order]
    )
    days[3] = replace(day, passages={**day.passages, "advance:W_C_0": whole})
    spoilt = replace(measured, periods=tuple(days))
    ((begin, end),) = recording_holes(spoilt.periods)
    assert begin <= hole[0] and hole[1] <= end
    found = run(street, spoilt, tmp_path)
    assert found["hashes"]["measured"] == spoilt.hash
    assert found["verdict"] == "explained"
    assert not any("differs from day to day" in text for text in found["findings"])
    (effect,) = found["effects"]
    assert (effect["name"], effect["place"]) == ("undercount", "stop:S_C_0")
    assert effect["parameters"]["share"]["value"] == pytest.approx(0.3, abs=0.06)


def test_a_count_that_is_missing_is_missing_in_simulated_days_too(street) -> None:
    """Else means over lanes would be of other lanes in the data than in the simulation."""
    counted = counts_of(street.measure("sim"), 300.0)
    row = (pl.col("detector_id") == "stop:S_C_0") & (pl.col("period_id") == "day2")
    late = counted.counts.filter(~(row & (pl.col("begin_s") == 300.0)))
    assert len(late) == len(counted.counts) - 1
    config = DiagnosisConfig(cache=street.cache, effort=FEW)
    held = {}
    for name, counts in (("whole", counted.counts), ("late", late)):
        study = Study.of(street.scenario, replace(counted, counts=counts), config)
        (day,) = study.engine.replicates([], [0])
        held[name] = day.tally.sums[..., 1] > 0
        assert np.array_equal(held[name], sum_of((*study.fit, *study.heldout)).sums[..., 1] > 0)
    assert held["whole"].sum() > held["late"].sum()


def test_travel_times_that_cannot_be_compared_are_noted(street, measured: MeasuredData) -> None:
    days = [period.id for period in measured.periods]
    columns = ("period_id", "time_s", "from_edge", "from_m", "to_edge", "to_m", "travel_s")
    rows = [(day, 60.0 * k, "C_N", 20.0, "S_C", 20.0, 40.0) for day in days for k in range(9)]
    rows += [("day1", 60.0 * k, "S_C", 10.0 + k, "C_N", 20.0, 40.0) for k in range(9)]
    probes = pl.DataFrame(rows, schema=columns, orient="row")
    config = DiagnosisConfig(cache=street.cache, effort=Effort(base=4, bank=1, fit=2, test=4))
    study = Study.of(street.scenario, replace(measured, travel_times=probes), config)
    found = study.with_findings_on_travel_times(study.base(Silent()), Silent()).measured.findings
    texts = [finding.text for finding in found if finding.text.startswith("travel_times")]
    assert len(texts) == 2
    assert "9 of 10 pairs of places with less than a vehicle a period" in texts[0]
    assert "1 of 10 pairs of places that no simulated vehicle passes in this order" in texts[1]


def test_without_held_out_periods_it_is_said(
    street, measured: MeasuredData, tmp_path: Path
) -> None:
    alone = replace(measured, periods=(replace(measured.periods[0], split="fit"),))
    found = run(street, alone, tmp_path)
    assert found["verified_on_fitted_periods"]
    assert found["periods"]["heldout"] == []


def test_a_budget_that_is_too_small_for_anything_says_so(
    street, measured: MeasuredData, tmp_path: Path
) -> None:
    found = run(street, measured, tmp_path, budget_s=1e-6, cache=tmp_path / "days", seed=1)
    assert found["verdict"] == "provisional"
    assert not found["complete"]
    assert found["effects"] == []
    assert found["corrected"] is None
    assert found["untried"] == sorted(DETECTORS)
    assert "budget" in found["sentence"]


def test_when_the_budget_ends_half_way_the_answer_says_so(
    street, measured: MeasuredData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ugat_marl.diagnosis.engine import Engine

    whole = Engine.replicates

    def short(self: Engine, effects: Any, *rest: Any) -> Any:
        if effects:
            raise OutOfTime("the budget of time is spent")
        return whole(self, effects, *rest)

    monkeypatch.setattr(Engine, "replicates", short)
    found = run(street, measured, tmp_path)
    assert found["verdict"] == "provisional"
    assert found["effects"] == []
    assert not found["complete"]
    assert found["where"], "what is known is said"
    assert found["untried"] == ["dropout", "swapped"], "and what is not"
    monkeypatch.undo()
    whole_search = run(street, measured, tmp_path)
    assert whole_search["heldout"]["before"] == found["heldout"]["before"]
    assert whole_search["verdict"] == "explained"
    assert whole_search["untried"] == []


def test_what_data_rule_out_is_not_examined(street, measured: MeasuredData, tmp_path: Path) -> None:
    finding = Finding("counts cannot be trusted", rules_out=("undercount", "dropout"))
    found = run(street, replace(measured, findings=(finding,)), tmp_path)
    assert found["ruled_out"] == ["dropout", "undercount"]
    assert found["findings"] == ["counts cannot be trusted"]
    assert found["verdict"] != "explained"
    assert all(effect["name"] == "swapped" for effect in found["effects"])


def counts_of(measured: MeasuredData, every_s: float) -> MeasuredData:
    """The same data as counts of all detectors, and nothing else."""
    rows = [
        (
            period.id,
            begin,
            begin + every_s,
            name,
            int(((on >= begin) & (on < begin + every_s)).sum()),
        )
        for period in measured.periods
        for begin in np.arange(period.begin_s, period.end_s, every_s)
        for name, on in ((name, item.on_s) for name, item in period.passages.items())
    ]
    schema = ("period_id", "begin_s", "end_s", "detector_id", "count")
    return replace(
        measured,
        periods=tuple(replace(period, passages={}) for period in measured.periods),
        counts=pl.DataFrame(rows, schema=schema, orient="row"),
    )


@pytest.mark.parametrize("every_s", [300.0, pytest.param(600.0, marks=pytest.mark.slow)])
def test_counts_alone_can_show_a_detector_that_misses_vehicles(
    every_s: float, street, tmp_path: Path
) -> None:
    alone = counts_of(street.measure("undercount=stop:S_C_0,0.6"), every_s)
    found = run(street, alone, tmp_path)
    assert [(e["name"], e["place"]) for e in found["effects"]] == [("undercount", "stop:S_C_0")]


@pytest.mark.parametrize("every_s", [300.0, 600.0])
def test_counts_of_the_scenario_itself_do_not_contradict_it(
    every_s: float, street, tmp_path: Path
) -> None:
    alone = counts_of(street.measure("sim"), every_s)
    assert run(street, alone, tmp_path / "all")["verdict"] == "no_discrepancy"
    assert alone.counts is not None
    some = alone.counts.filter(
        (pl.col("begin_s") != 300.0) | (pl.col("detector_id") != "stop:S_C_0")
    )
    gap = replace(alone, counts=some)
    assert run(street, gap, tmp_path / "gap")["verdict"] == "no_discrepancy"


@pytest.mark.slow
def test_counts_alone_can_show_a_surge(street, tmp_path: Path) -> None:
    alone = counts_of(street.measure("demand_surge=S_C,300,900,0.3"), 300.0)
    found = run(street, alone, tmp_path, among={"demand_level", "demand_surge", "dropout"})
    (surge,) = found["effects"]
    assert (surge["name"], surge["place"]) == ("demand_surge", "S_C")
    assert surge["window"] == pytest.approx([300.0, 900.0], abs=150.0)


def test_data_without_a_single_vehicle_are_refused_or_named(
    street, measured: MeasuredData, tmp_path: Path
) -> None:
    empty = replace(
        measured, periods=tuple(replace(period, passages={}) for period in measured.periods)
    )
    found = run(street, empty, tmp_path)
    assert found["verdict"] != "no_discrepancy"


def test_data_without_a_period_to_fit_are_refused(
    street, measured: MeasuredData, tmp_path: Path
) -> None:
    held = tuple(replace(period, split="heldout") for period in measured.periods)
    with pytest.raises(MeasuredDataError, match="fit"):
        run(street, replace(measured, periods=held), tmp_path)


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"budget_s": 0.0}, OptionError),
        ({"alpha": 0.0}, OptionError),
        ({"alpha": 0.5}, OptionError),
        ({"seed": -1}, OptionError),
        ({"leave_out": ("nonsense",)}, UnknownNameError),
    ],
)
def test_impossible_settings_are_refused(wrong: dict[str, Any], error: type[Exception]) -> None:
    with pytest.raises(error):
        DiagnosisConfig(**wrong)


def test_a_search_without_time_for_a_test_keeps_its_nearest_explanation(
    street, measured: MeasuredData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ugat_marl.diagnosis.engine import Engine

    whole = Engine.replicates

    def short(self: Engine, effects: Any, numbers: Any, *rest: Any) -> Any:
        if effects and len(numbers) > FEW.fit:
            raise OutOfTime("the budget is spent")
        return whole(self, effects, numbers, *rest)

    monkeypatch.setattr(Engine, "replicates", short)
    found = run(street, measured, tmp_path)
    assert (found["verdict"], found["complete"]) == ("provisional", False)
    (effect,) = found["effects"]
    assert (effect["name"], effect["place"]) == ("undercount", "stop:S_C_0")
    assert effect["parameters"]["share"]["low"] is None, "an interval needs a test"
    assert "not verified" in found["sentence"]
    untested = (found["heldout"]["after"], found["heldout"]["p_after"])
    assert (*untested, found["evidence"]["p_fit_after"]) == (None, None, None)
    assert (tmp_path / found["corrected"] / "scenario.toml").is_file()
    monkeypatch.undo()
    whole_search = run(street, measured, tmp_path)
    assert whole_search["verdict"] == "explained"
    assert whole_search["heldout"]["before"] == found["heldout"]["before"]


def test_limits_say_which_effects_the_data_would_have_shown(street, tmp_path: Path) -> None:
    """No vehicle gives way on this crossing, so how drivers accept gaps changes nothing at all."""
    found = run(
        street,
        street.measure("sim", seed=6),
        tmp_path,
        among={"headway", "gap_acceptance"},
        limits=True,
    )
    assert found["verdict"] == "no_discrepancy"
    limits = {(one["name"], one["hidden"] < one["usual"]): one for one in found["limits"]}
    assert limits["gap_acceptance", True]["hidden"] == pytest.approx(0.4)
    assert limits["gap_acceptance", True]["shown"] is None
    assert limits["gap_acceptance", False]["shown"] is None
    headway = limits["headway", False]
    assert 1.0 <= headway["hidden"] < headway["shown"] < 1.7
    assert headway["unit"] == "s"
