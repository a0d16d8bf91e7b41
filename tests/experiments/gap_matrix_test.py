"""Controllers x gaps, from planted scores."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from ugat_marl.__main__ import main
from ugat_marl.cli.evaluate import Evaluate
from ugat_marl.data import Scores
from ugat_marl.effects import NAMED_DOMAINS, load_scenario
from ugat_marl.envs import OBJECTIVE_MEASURES
from ugat_marl.experiments import Evaluation, domains_by_gap, gap_matrix
from ugat_marl.experiments.scores import Result
from ugat_marl.reporting import gap_matrix_table, objective_tables
from ugat_marl.scenarios import validate_settings

BASE = Scores(100.0, 90.0, 500.0, -3.0, 3.0, 0.4, 50.0, 520.0, 515.0, 5.0)


def scores(att_s: float, cost: float | None = None) -> Scores:
    hidden = {} if cost is None else dict.fromkeys(OBJECTIVE_MEASURES, 1.0) | {"cost": cost}
    return replace(BASE, att_s=att_s, hidden=hidden)


def planted() -> Evaluation:
    """Two controllers, two seeds, and domains of three gaps."""
    table = {
        ("a", "sim"): ((60, None), (70, None)),
        ("a", "V1"): ((70, None), (80, None)),
        ("a", "V4"): ((100, None), (90, None)),
        ("a", "zone-50"): ((60, None), (70, None)),
        ("a", "want-safety"): ((60, 2.0), (70, 4.0)),
        ("b", "sim"): ((50, None), (50, None)),
        ("b", "V1"): ((51, None), (51, None)),
        ("b", "V4"): ((53, None), (53, None)),
        ("b", "zone-50"): ((40, None), (40, None)),
        ("b", "want-safety"): ((50, 1.0), (50, 1.0)),
    }
    results = tuple(
        Result(policy, domain, seed, scores(*told))
        for (policy, domain), both in table.items()
        for seed, told in enumerate(both)
    )
    return Evaluation("here", "0", results, {})


def shown(*tables: object) -> str:
    console = Console(width=80)
    with console.capture() as capture:
        for table in tables:
            console.print(table)
    return capture.get()


def test_a_percentage_of_no_cost_is_not_told() -> None:
    nothing = {("a", "want-safety"): 3.0, ("b", "want-safety"): 0.0}
    results = tuple(
        replace(r, scores=scores(50.0, nothing[r.policy, r.domain]))
        if (r.policy, r.domain) in nothing
        else r
        for r in planted().results
    )
    cells = gap_matrix(Evaluation("here", "0", results, {}))
    by_policy = {policy: cells[policy]["reward"] for policy in ("a", "b")}
    assert math.isnan(by_policy["a"].cost.mean)
    assert by_policy["b"].cost.mean == 0.0


def test_each_cell_is_the_mean_over_domains_and_seeds() -> None:
    found = planted()
    assert domains_by_gap(found) == {
        "observation": ["zone-50"], "transition": ["V1", "V4"], "reward": ["want-safety"],
    }  # fmt: skip
    matrix = gap_matrix(found)
    cell = matrix["a"]["transition"]
    assert (cell.cost.mean, cell.worst, cell.worst_cost) == (20.0, "V4", 30.0)
    half = 12.7062 * 5  # over seeds 25 and 15: t of one degree of freedom, the error of the mean
    assert (cell.cost.low, cell.cost.high) == pytest.approx((20 - half, 20 + half), abs=1e-3)
    assert matrix["b"]["transition"].cost.mean == 2.0
    assert matrix["b"]["observation"].cost.mean == -10.0
    assert matrix["a"]["observation"].cost.mean == 0.0
    assert matrix["a"]["reward"].cost.mean == 200.0, "twice and four times the best one's cost"
    assert matrix["b"]["reward"].cost.mean == 0.0


def test_the_tables_fit_a_terminal() -> None:
    text = shown(gap_matrix_table(planted()), *objective_tables(planted()))
    assert max(map(len, text.splitlines())) <= 80
    assert "+30" in text and "+200.0" in text and "zone-50" in text
    assert "3.0" in text and "measured in want-safety" in text
    assert not objective_tables(Evaluation("x", "0", (Result("a", "sim", 0, scores(1)),), {}))


def test_a_table_survives_writing(tmp_path: Path) -> None:
    planted().write(tmp_path / "table.json")
    assert Evaluation.read(tmp_path / "table.json") == planted()


@pytest.mark.parametrize(
    ("domains", "words"),
    [
        (["sim", "reward"], ["cost of what is wanted", "measured in want-efficiency, want-emis"]),
        pytest.param(
            ["sim", "action"],
            ["what each gap costs", "(12) s", "barrier-both"],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_evaluate_plays_whole_gaps(
    domains: list[str], words: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    arguments = ["--policies", "max-pressure", "--domains", *domains]
    out = tmp_path / "table.json"
    short = ["--seeds", "1", "--duration-s", "60", "--workers", "1", "--out", str(out)]
    assert main(["evaluate", "single-v1", *arguments, *short]) == 0
    text = capsys.readouterr().out
    assert all(word in text for word in words)
    assert set(Evaluation.read(out).domains) >= {"sim"}


def test_domains_a_network_does_not_allow_are_left_out(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """A light whose phases all serve one street has no barrier."""
    scenario = tmp_path / "one-street"
    found = load_scenario("single-v1")
    phases = ["GGGGrrrrrrGGGGrrrrrr", "GGGGGGrrrrGrrrrrrrrr"]
    given = found.settings.model_dump() | {"intersections": {"A1": {"phases": phases}}}
    replace(found, settings=validate_settings(given, "here")).write(scenario)
    console = Console(width=200)
    with console.capture() as capture:
        left = Evaluate(str(scenario), domains=("sim", "action"))._domains(
            load_scenario(scenario), console
        )
    assert {name for name in NAMED_DOMAINS if NAMED_DOMAINS[name].gap == "action"} - set(left) == {
        "barrier-leading", "barrier-lagging", "barrier-both",
    }  # fmt: skip
    assert "barrier-both is left out: phase order" in capture.get()
    command = Evaluate("single-v1", domains=("sim", "transition"), duration_s=300)
    with console.capture() as capture:
        left = command._domains(load_scenario("single-v1"), console)
    late = {name for name, item in NAMED_DOMAINS.items() if "demand_timing=*,300" in item.effects}
    transitions = {name for name, named in NAMED_DOMAINS.items() if named.gap == "transition"}
    assert late and transitions - set(left) == {
        *late, "incident", "meso",
    }  # fmt: skip
    assert all(f"{name} is left out: " in capture.get() for name in late)
    assert "no vehicle departs between 0 s and 300 s" in capture.get()
    given["control"] = given.get("control", {}) | {"decision_interval_s": 60}
    slow = tmp_path / "slow"
    replace(found, settings=validate_settings(given, "here")).write(slow)
    with console.capture() as capture:
        left = Evaluate(str(slow), domains=("sim", "action"))._domains(load_scenario(slow), console)
    assert "flexible is left out: " in capture.get() and "flexible" not in left
    named = ["--domains", "sim", "barrier-both", "--seeds", "1", "--policies", "max-pressure"]
    assert main(["evaluate", str(scenario), *named]) == 2, "what one names has to fit"
    assert "have no barrier" in capsys.readouterr().err


def test_a_domain_without_a_number_does_not_hide_the_worst_of_the_others() -> None:
    table = {"sim": 60.0, "V1": math.nan, "V4": 860.0}
    results = tuple(
        Result("a", domain, seed, scores(att_s))
        for domain, att_s in table.items()
        for seed in (0, 1)
    )
    (cell,) = gap_matrix(Evaluation("here", "0", results, {}))["a"].values()
    assert (cell.worst, cell.worst_cost) == ("V4", 800.0)
