"""Races between settings: who stays, what it costs, what is remembered."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from tests.runs import play_nothing
from ugat_marl.__main__ import main
from ugat_marl.data import Scores
from ugat_marl.effects import load_scenario
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.experiments import (
    TUNING_SEED,
    Evaluation,
    TransferConfig,
    Tuned,
    best_rule,
    evaluation,
    jobs,
    tune,
    tuned_rule,
    tuning,
)
from ugat_marl.experiments.evaluation import race_rules
from ugat_marl.experiments.jobs import EVALUATION_SEED, RULE_FILE, Job, perform
from ugat_marl.experiments.row_names import RULE
from ugat_marl.experiments.scores import Result, RuleTrial
from ugat_marl.experiments.settings import Setting
from ugat_marl.experiments.tuning import rungs
from ugat_marl.policies import RULES, format_rule, parse_rule, rule_settings
from ugat_marl.progress import Silent
from ugat_marl.reporting import tuning_table

BASE = Scores(100.0, 90.0, 500.0, -3.0, 3.0, 0.4, 50.0, 520.0, 515.0, 5.0)
SEED = TUNING_SEED


class Streets:
    """In place of simulations: the ATT of a rule is as far from 50 s as its first number.

    In its own first episodes a rule may look better or worse than it is.
    """

    def __init__(self) -> None:
        self.played: list[tuple[str, str, int]] = []
        self.luck: dict[tuple[str, int], float] = {}

    def evaluate(
        self, scenario: Any, policies: Any, domains: Any, seeds: Sequence[int], **_: Any
    ) -> Evaluation:
        results: list[Result] = []
        for spec in policies:
            for seed in seeds:
                self.played.append((spec, domains[0], seed))
                values = parse_rule(spec)[1]
                best = 50.0 if domains[0] == "sim" else 20.0
                att_s = 100 + abs((values or (35.0,))[0] - best) + self.luck.get((spec, seed), 0.0)
                results.append(Result(spec, domains[0], seed, replace(BASE, att_s=att_s)))
        return Evaluation("toy", "0", tuple(results), {})


@pytest.fixture
def streets(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Streets:
    made = Streets()
    monkeypatch.setattr(evaluation, "evaluation_of", made.evaluate)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return made


FIVE = [f"fixed-time:{s}" for s in (10, 20, 30, 40, 50)]


def test_the_worse_half_is_left_behind_after_each_rung(streets: Streets) -> None:
    found = race_rules(load_scenario("single-v1"), "sim", FIVE, [[1], [2, 3], [4]])
    assert found == (
        RuleTrial("fixed-time:50", 100.0, 4),
        RuleTrial("fixed-time:40", 110.0, 4),
        RuleTrial("fixed-time:30", 120.0, 3),  # behind after the second rung
        RuleTrial("fixed-time:20", 130.0, 1),
        RuleTrial("fixed-time:10", 140.0, 1),
    )
    assert streets.played[:5] == [(spec, "sim", 1) for spec in FIVE]
    assert len(streets.played) == 5 + 2 * 3 + 2


def test_a_lucky_first_episode_does_not_win(streets: Streets) -> None:
    streets.luck[("fixed-time:30", 1)] = -25.0  # 95 s where it is 120 s
    found = race_rules(load_scenario("single-v1"), "sim", FIVE, [[1], [2], [3]])
    assert found[0].spec == "fixed-time:50"
    assert race_rules(load_scenario("single-v1"), "sim", FIVE, [[1]])[0].spec == "fixed-time:30"


def test_the_best_rule_is_searched_in_each_domain_by_itself(streets: Streets) -> None:
    rules = ("fixed-time:20", "fixed-time:50", "largest-queue:30", "max-pressure:40")
    seeds, expected = [SEED, SEED + 1], {"sim": "fixed-time:50", "V4": "fixed-time:20"}
    for domain, best in expected.items():
        assert best_rule(load_scenario("single-v1"), domain, rules=rules, seeds=seeds) == best
    assert len(streets.played) == 2 * (4 + 2)


@pytest.mark.usefixtures("streets")
@pytest.mark.parametrize(("rules", "seeds"), [(FIVE, []), ([], [SEED])])
def test_a_search_among_nothing_or_without_a_seed_is_refused(
    rules: list[str], seeds: list[int]
) -> None:
    with pytest.raises(OptionError, match="needs at least one rule and one seed"):
        best_rule(load_scenario("single-v1"), "sim", rules=rules, seeds=seeds)


@pytest.mark.parametrize("settings", [2, 3, 5, 6, 12, 18])
@pytest.mark.parametrize("extra", [0, 1, 7, 40])
def test_a_race_stays_within_its_budget(settings: int, extra: int) -> None:
    fields = [settings]
    while fields[-1] > 2:
        fields.append((fields[-1] + 1) // 2)
    budget = sum(fields) + extra
    seeds = rungs(settings, budget)
    assert len(seeds) == len(fields)
    spent = sum(n * len(own) for n, own in zip(fields, seeds, strict=True))
    assert budget - max(2, settings) < spent <= budget
    flat = [seed for own in seeds for seed in own]
    assert flat == [SEED + k for k in range(len(flat))]
    # a reported episode never has one of these
    assert max(flat) < 100 * SEED and not set(flat) & set(range(EVALUATION_SEED, 2000))


def test_a_small_budget_thins_the_settings_out_evenly() -> None:
    assert rule_settings("fixed-time", 100) == [f"fixed-time:{s}" for s in (10, 20, 30, 40, 50, 60)]
    assert rule_settings("fixed-time", 5) == ["fixed-time:30", "fixed-time:40", "fixed-time:60"]
    assert rule_settings("fixed-time", 2) == ["fixed-time:30", "fixed-time:50"]
    for name, rule in RULES.items():  # the usual setting is never thinned out
        usual = format_rule(name, [parameter.default for parameter in rule.parameters])
        assert all(usual in rule_settings(name, budget) for budget in (2, 5, 8, 16, 24, 100))
    both = len(RULES["actuated"].parameters[0].choices) * len(
        RULES["actuated"].parameters[1].choices
    )
    assert len(rule_settings("actuated", 1000)) == both
    assert rule_settings("programme", 2) == ["programme"]


def test_tuning_finds_the_setting_and_remembers_it(streets: Streets, tmp_path: Path) -> None:
    scenario = load_scenario("single-v1")
    found = tune("fixed-time", scenario, "sim", 24)
    assert found.best == RuleTrial("fixed-time:50", 100.0, found.best.episodes)
    assert found.episodes == len(streets.played) <= 24
    assert {seed for _, _, seed in streets.played} == set(range(SEED, SEED + found.best.episodes))
    again = tune("fixed-time", scenario, "sim", 24)
    assert again == found
    assert len(streets.played) == found.episodes  # nothing was played for it
    usual: dict[str, Any] = {"domain": "sim", "budget": 24}
    for name, value in (("domain", "V4"), ("budget", 12), ("duration_s", 600), ("fresh", True)):
        before = len(streets.played)
        options: dict[str, Any] = {**usual, name: value}
        tune("fixed-time", scenario, **options)
        assert len(streets.played) > before, name
    before = len(streets.played)
    tune("fixed-time", load_scenario("grid2x2-v1"), "sim", 24)
    assert len(streets.played) > before


@pytest.mark.parametrize(
    "content",
    [
        b"", b"[", b"7", b"[]", b"null", b"\xff\xfe", b'[{"spec": "fixed-time:50"}]',
        b'[{"spec": "random", "att_s": 1.0, "episodes": 3}]',
    ],
)  # fmt: skip
def test_a_broken_memory_is_replaced(streets: Streets, tmp_path: Path, content: bytes) -> None:
    scenario = load_scenario("single-v1")
    found = tune("fixed-time", scenario, "sim", 24)
    (file,) = (tmp_path / "ugat_marl" / "tuned").iterdir()
    file.write_bytes(content)
    assert tune("fixed-time", scenario, "sim", 24) == found
    assert len(streets.played) == 2 * found.episodes
    assert json.loads(file.read_text())["trials"][0]["spec"] == "fixed-time:50"


def test_a_memory_with_a_flipped_digit_is_replaced(streets: Streets, tmp_path: Path) -> None:
    found = tune("fixed-time", load_scenario("single-v1"), "sim", 24)
    (file,) = (tmp_path / "ugat_marl" / "tuned").iterdir()
    file.write_text(file.read_text().replace("100.0", "108.0", 1))
    assert tune("fixed-time", load_scenario("single-v1"), "sim", 24) == found
    assert len(streets.played) == 2 * found.episodes


def test_a_memory_that_is_not_finite_is_replaced(streets: Streets, tmp_path: Path) -> None:
    found = tune("fixed-time", load_scenario("single-v1"), "sim", 24)
    (file,) = (tmp_path / "ugat_marl" / "tuned").iterdir()
    file.write_text(file.read_text().replace("100.0", "NaN"))
    assert tune("fixed-time", load_scenario("single-v1"), "sim", 24) == found


def test_tuned_rules_are_better_than_their_defaults(streets: Streets) -> None:
    names = ("largest-queue", "programme")
    for domain, best in {"sim": "largest-queue:50", "V4": "largest-queue:20"}.items():
        assert tuned_rule(load_scenario("single-v1"), domain, 24, names=names) == best


@pytest.mark.parametrize(
    ("rule_budget", "best"),
    [
        (None, {"sim": "largest-queue:40", "V4": "largest-queue:20"}),
        (24, {"sim": "fixed-time:50", "V4": "actuated:20:2"}),
    ],
)
def test_a_run_is_judged_beside_tuned_rules_where_asked(
    streets: Streets,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    rule_budget: int | None,
    best: dict[str, str],
) -> None:
    play_nothing(monkeypatch)
    monkeypatch.setattr(jobs, "best_rule", best_rule)
    config = TransferConfig("single-v1", rule_budget=rule_budget)
    for domain, spec in best.items():
        job = Job(Setting(RULE, "rule"), "single-v1", target=domain, domains=(domain,))
        job = replace(job, rule_budget=config.rule_budget, evaluation_seeds=(1,))
        folder = tmp_path / domain
        folder.mkdir()
        record = perform(job, folder, Silent())
        assert record.is_whole(job)
        assert (folder / RULE_FILE).read_text() == spec
    assert streets.played


def test_what_cannot_be_tuned_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="fixed-time"):
        tune("fixed-tim", load_scenario("single-v1"))
    with pytest.raises(OptionError, match="at least 2"):
        tune("fixed-time", load_scenario("single-v1"), "sim", 1)
    with pytest.raises(OptionError, match="rule_budget = 1"):
        TransferConfig("single-v1", rule_budget=1)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (["--rules", "webstr"], "Did you mean 'webster'"),
        (["--rules", "webster", "webster"], "holds one twice"),
        (["--budget", "1"], "must be at least 2"),
        (["--domain", "V44"], "V4"),
    ],
)
def test_the_command_refuses(call: list[str], said: str, capsys: Any) -> None:
    assert main(["tune", "single-v1", *call]) == 2
    assert said in capsys.readouterr().err


def test_the_table_fits_80_columns_and_begins_with_the_best() -> None:
    found = [
        Tuned(
            "slow", "V4", (RuleTrial("longest-waiting:60", 1234.5, 9), RuleTrial("x", 2000.0, 1))
        ),
        Tuned("fast", "V4", (RuleTrial("delay-actuated:120:40", 61.27, 3),)),
    ]
    page = io.StringIO()
    Console(file=page, width=80).print(tuning_table("single-v1 in V4", found))
    lines = [line for line in page.getvalue().splitlines() if ":" in line]
    assert lines[1].split() == ["delay-actuated:120:40", "61.3", "-", "1", "3"]
    assert lines[2].split() == ["longest-waiting:60", "1234", "2000", "2", "10"]
    assert max(len(line.rstrip()) for line in page.getvalue().splitlines()) <= 80
    assert "different numbers of seeds" in " ".join(page.getvalue().split())
    equal = io.StringIO()
    Console(file=equal, width=80).print(tuning_table("single-v1 in V4", found[:1]))
    assert "different numbers of seeds" not in " ".join(equal.getvalue().split())


def test_a_rule_is_tuned_in_real_episodes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Any
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    out = tmp_path / "tuned.json"
    call = ["tune", "single-v1", "--domain", "V4", "--rules", "fixed-time", "--budget", "2"]
    call += ["--duration-s", "300", "--out", str(out)]
    assert main(call) == 0
    assert "fixed-time:" in capsys.readouterr().out
    (row,) = json.loads(out.read_text())
    assert [trial["episodes"] for trial in row["trials"]] == [1, 1]
    assert row["trials"][0]["att_s"] <= row["trials"][1]["att_s"]
    assert tuning.BUDGET >= 24


def test_a_rule_of_whose_episodes_nothing_is_known_has_null(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    tuned = Tuned("fixed-time", "sim", (RuleTrial("fixed-time:20", math.nan, 2),))
    monkeypatch.setattr("ugat_marl.cli.tune.tune", lambda *_, **__: tuned)
    out = tmp_path / "tuned.json"
    for _ in range(2):  # it replaces its own table
        assert main(["tune", "single-v1", "--rules", "fixed-time", "--out", str(out)]) == 0
    (row,) = json.loads(out.read_text())
    assert row["trials"] == [{"spec": "fixed-time:20", "att_s": None, "episodes": 2}]


def test_a_result_that_cannot_be_kept_is_there_all_the_same(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Any
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    call = ["tune", "single-v1", "--rules", "fixed-time", "--budget", "2", "--duration-s", "60"]
    assert main(call) == 0
    said = capsys.readouterr()
    assert "fixed-time:" in said.out
    assert "fixed-time are not kept for other runs" in " ".join((said.out + said.err).split())
