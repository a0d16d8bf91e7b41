"""Small versions of the paper's tables: does each show the direction its effect has?

`make test-all` runs them; three quarters of an hour of two cores. All share their trainings, in a
folder that is kept between runs of this file in one session.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from statistics import fmean

import pytest

from ugat_marl.data import METRICS_FILE, Metrics
from ugat_marl.experiments import (
    CONTROL,
    DIRECT,
    ORACLE,
    RULE,
    TIMED,
    Comparison,
    PaperConfig,
    compare,
)
from ugat_marl.experiments.paper import Planner, constant_name
from ugat_marl.progress import Silent

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(3600)]

DOMAIN = "V4"
CONFIG = PaperConfig(
    domains=(DOMAIN,), seeds=2, first_seed=20, episodes=20, iterations=2, grounded_episodes=6,
    sim_rollouts=3, real_rollouts=2, evaluation_seeds=2, rule_budget=11,
)  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


def table(name: str, runs: Path) -> Comparison:
    config = replace(CONFIG, constants=(3,)) if name == "main" else CONFIG
    return compare(name, "single-v1", config, runs, None, Silent())


def att(found: Comparison, setting: str, domain: str | None = None) -> float:
    return found.estimate(setting, DOMAIN, "att_s", domain).mean


def accepted(table_name: str, setting: str, runs: Path) -> float:
    """Share of the grounded actions that the gate let pass, over seeds and iterations."""
    (row,) = [own for own in CONFIG.settings(table_name) if own.name == setting]
    values = [
        value
        for job in Planner(table_name, "single-v1", CONFIG).jobs(row)
        for _, _, name, value in Metrics.read(runs / job.name / METRICS_FILE).rows
        if name == "gate/acceptance"
    ]
    assert len(values) == CONFIG.seeds * CONFIG.iterations
    return fmean(values)


def test_main(runs: Path) -> None:
    found = table("main", runs)
    assert att(found, DIRECT) > 1.3 * att(found, DIRECT, "sim")  # there is a gap
    assert att(found, ORACLE) < att(found, DIRECT)  # and something to win
    assert att(found, constant_name(3)) < att(found, DIRECT)
    assert att(found, TIMED) < att(found, DIRECT)
    assert found.won_back(TIMED, DOMAIN, DIRECT) >= 0.7
    assert att(found, TIMED, "sim") <= 1.05 * att(found, DIRECT, "sim")  # at no cost in sim
    assert att(found, TIMED) < att(found, CONTROL)
    assert att(found, RULE) < att(found, DIRECT)
    assert found.test(TIMED, DIRECT, DOMAIN).better == CONFIG.seeds
    assert found.won_back(f"{TIMED}: rewards matched", DOMAIN, DIRECT) >= 0.7


def test_ablation(runs: Path) -> None:
    found = table("ablation", runs)
    for part in ("α = 0.5", "no gate", "no uncertainty (GAT)", "lost times without h"):
        # a rejection falls back to the best constant: every variant wins most of it back
        assert found.reduction(f"{TIMED}: {part}", DOMAIN, DIRECT) > 0.3
    # phase grounding that obeys h from the start is no better than timed grounding
    assert att(found, "phase: no gate") > att(found, TIMED)


def test_alpha(runs: Path) -> None:
    found = table("alpha", runs)
    for grounding in ("phase", TIMED):  # the higher the threshold, the more passes
        shares = [accepted("alpha", f"{grounding}: α = {a}", runs) for a in (0.2, 0.5, 0.8)]
        assert shares[0] <= shares[1] <= shares[2] and shares[0] < shares[2], shares
    assert found.reduction(f"{TIMED}: α = 0.2", DOMAIN, DIRECT) > 0.3


def test_uncertainty(runs: Path) -> None:
    found = table("uncertainty", runs)
    for method in ("evidential", "Concrete Dropout", "Deep Ensembles", "none (GAT)"):
        assert found.reduction(f"{TIMED}: {method}", DOMAIN, DIRECT) > 0.3


def test_gap(runs: Path) -> None:
    found = table("gap", runs)
    for measure, worse in (("att_s", 1), ("queue", 1), ("delay", 1), ("throughput", -1)):
        assert worse * found.gaps(DIRECT, DOMAIN, measure).mean() > 0
