"""A policy that is slower than a rule in its own simulation is called not trained yet."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
from rich.console import Console

from ugat_marl.data import Scores
from ugat_marl.experiments import (
    Comparison,
    Evaluation,
    Trial,
    check_run,
    check_table,
)
from ugat_marl.experiments.scores import Result
from ugat_marl.reporting import comparison_page, terminal_tables, transfer_table

BLANK = Scores(0, 0, 100, 0, 0, 0, 0, 110, 105, 0)
FACTS = {
    "command": "ugat-marl paper main", "cpu": "some", "cores": 2, "python": "3.11",
    "versions": {}, "date": "2026-01-02T03:04:05",
}  # fmt: skip


def run(direct_s: float, rule_s: float, sim: str = "sim") -> Evaluation:
    att = {"direct transfer": direct_s, "rule largest-queue:20": rule_s, "rule sotl:1:2": 1.0}
    results = [
        Result(policy, domain, seed, replace(BLANK, att_s=att_s + seed, backlog=5.0))
        for policy, att_s in att.items()
        for domain in (sim, "V4")
        for seed in (0, 1)
    ]
    notes = {"best rule in sim": "largest-queue:20", "best rule in V4": "sotl:1:2"}
    return Evaluation("toy", "0", tuple(results), notes)


def table(direct_s: float, rules_s: dict[str, float]) -> Comparison:
    rows = [
        Trial(setting, target, domain, seed, 1, replace(BLANK, att_s=att_s, backlog=12.0))
        for setting, target, seed, att_s in [
            *(("direct transfer", target, 0, direct_s) for target in {"V1": 0, "V4": 0} | rules_s),
            *(("best rule, tuned there", target, None, rules_s[target]) for target in rules_s),
        ]
        for domain in ("sim", target)
    ]
    return Comparison("toy", "0", "sim", tuple(rows), {})


def printed(renderable: object) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(renderable)
    return " ".join(console.export_text().split())


@pytest.mark.parametrize(("direct_s", "trained"), [(83.5, False), (72.5, False), (71.0, True)])
def test_the_rule_of_the_simulation_decides(direct_s: float, trained: bool) -> None:
    check = check_run(run(direct_s, 70.5))
    assert check is not None and check.trained == trained
    assert (check.policy_s, check.rule_s) == (direct_s + 0.5, 71.0)
    assert check.rule == "rule largest-queue:20"


def test_a_run_says_it_in_words_and_who_never_entered() -> None:
    text = printed(transfer_table(run(83.5, 70.5)))
    assert (
        "Not trained yet: in sim direct transfer needs 84 s, rule largest-queue:20 71 s; train "
        "longer (--pretrain-episodes)." in text
    )
    assert "in V4, vehicles due that never entered: direct transfer 5.0" in text
    assert "Trained: in sim" in printed(transfer_table(run(70.0, 70.5)))


def test_a_run_without_a_rule_in_its_simulation_is_not_judged() -> None:
    assert check_run(run(80.0, 70.0, sim="meso")) is None
    assert check_run(Evaluation("toy", "0", (), {})) is None


def test_a_table_is_judged_by_its_fastest_rule() -> None:
    slow = table(84.0, {"V1": 71.0, "V4": 90.0})
    check = check_table(slow)
    assert check is not None and not check.trained
    assert (check.rule, check.rule_s) == ("the best rule, tuned in V1", 71.0)
    page = comparison_page(slow, "direct transfer", "main", FACTS)
    terminal = printed(terminal_tables(slow, "direct transfer"))
    for text in (" ".join(page.split()), terminal):
        assert "Not trained yet: in sim direct transfer needs 84 s, the best rule, tuned" in text
        assert "ehicles due that never entered" in text
    assert slow.rows()[0]["backlog"] == 12.0


def test_a_table_of_many_domains_loses_no_number() -> None:
    text = printed(
        terminal_tables(table(84.0, {f"V{k}": 100.0 + k for k in range(9)}), "direct transfer")
    )
    assert "…" not in text
    assert all(f" V{k}" in text for k in range(9))


def test_a_table_without_rules_says_so() -> None:
    alone = table(84.0, {})
    assert check_table(alone) is None
    page = comparison_page(alone, "direct transfer", "main", FACTS)
    assert "Not compared with rules in sim" in page
