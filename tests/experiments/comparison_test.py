"""Intervals, paired tests and shares of regret, against tables and sums done by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import polars as pl
import pytest

from ugat_marl.cli.paper import _write
from ugat_marl.data import Scores
from ugat_marl.experiments import Comparison, Judging, Trial, all_standings, read_standings
from ugat_marl.reporting import comparison_csv, comparison_page, gap_picture

BLANK = Scores(0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
FACTS = {
    "command": "ugat-marl paper main", "cpu": "some", "cores": 2, "python": "3.11",
    "versions": {"torch": "2"}, "date": "2026-01-02T03:04:05",
}  # fmt: skip


def trials(setting: str, by_seed: dict[int | None, tuple[float, float]]) -> list[Trial]:
    """Two episodes per domain whose mean is the ATT asked for, as (sim, V4)."""
    return [
        Trial(setting, "V4", domain, training, seed, replace(BLANK, att_s=att + off))
        for training, both in by_seed.items()
        for domain, att in zip(("sim", "V4"), both, strict=True)
        for seed, off in ((1, -1.0), (2, 1.0))
    ]


@pytest.fixture
def found() -> Comparison:
    rows = [
        *trials("direct transfer", {0: (70.0, 200.0), 1: (72.0, 240.0)}),
        *trials("phase (the paper's UGAT)", {1: (71.0, 150.0), 0: (71.0, 130.0)}),
        *trials("constant delay 2 s", {0: (70.0, 120.0), 1: (70.0, 160.0)}),
        *trials("best rule, tuned there", {None: (80.0, 120.0)}),
    ]
    kinds = {"constants": ("constant delay 2 s",), "grounded": ("phase (the paper's UGAT)",)}
    return Comparison("toy", "0" * 8, "sim", tuple(rows), {}, **kinds)


def test_values_are_in_the_order_of_the_training_seeds(found: Comparison) -> None:
    assert found.training_seeds == [0, 1]
    assert found.values("phase (the paper's UGAT)", "V4", "att_s").tolist() == [130.0, 150.0]
    assert found.values("best rule, tuned there", "V4", "att_s").tolist() == [120.0, 120.0]
    assert found.gaps("direct transfer", "V4", "att_s").tolist() == [130.0, 168.0]


def test_regret_won_back_by_hand(found: Comparison) -> None:
    assert found.best("V4") == "best rule, tuned there"
    assert found.won_back("phase (the paper's UGAT)", "V4", "direct transfer") == pytest.approx(
        (220 - 140) / 100
    )
    assert found.won_back("direct transfer", "V4", "direct transfer") == 0.0
    assert found.won_back("best rule, tuned there", "V4", "direct transfer") == 1.0
    assert found.regret_s("phase (the paper's UGAT)", "V4").tolist() == [10.0, 30.0]
    # the gap: 149 s before, (130 - 71 + 150 - 71) / 2 = 69 after
    assert found.reduction("phase (the paper's UGAT)", "V4", "direct transfer") == pytest.approx(
        1 - 69 / 149
    )


def test_a_table_with_an_unknown_travel_time_is_written(found: Comparison, tmp_path: Path) -> None:
    """No vehicle was due in a domain: the other results of hours are kept all the same."""
    unknown = [
        replace(
            trial,
            target="late-demand",
            domain="late-demand" if trial.domain == "V4" else "sim",
            scores=trial.scores if trial.domain == "sim" else replace(BLANK, att_s=math.nan),
        )
        for trial in found.trials
    ]
    table = replace(found, trials=(*found.trials, *unknown))
    with pytest.warns(UserWarning, match="for 8 rows, such as 'direct transfer' in late-demand"):
        _write(table, Judging("toy", 2, 100.0), "title", tmp_path)
    assert set(read_standings(tmp_path / "seeds.csv")["domain"]) == {"V4"}
    assert "late-demand" in (tmp_path / "table.md").read_text()


def test_settings_are_compared_by_the_seeds_that_both_have(found: Comparison) -> None:
    """Tables are looked at while their trainings are under way."""
    rows = [*found.trials, *trials("fitted street", {1: (71.0, 100.0)})]
    begun = replace(found, trials=tuple(rows))
    assert begun.best("V4") == "fitted street"
    assert begun.regret_s("direct transfer", "V4").tolist() == [240.0 - 100.0]
    assert begun.regret_s("best rule, tuned there", "V4").tolist() == [20.0]
    test = begun.test("fitted street", "direct transfer", "V4")
    assert (test.difference.mean, test.count) == (-140.0, 1)
    row = next(r for r in begun.rows() if r["setting"] == "direct transfer")
    assert math.isnan(row["regret_s_low"])
    apart = replace(begun, trials=(*trials("one", {0: (1.0, 2.0)}), *trials("two", {1: (1, 3)})))
    assert apart.regret_s("two", "V4").size == 0
    assert math.isnan(apart.won_back("two", "V4", "two"))


def test_a_setting_of_an_easy_seed_alone_is_not_the_best_one() -> None:
    """Of the seed that both have, the other one is faster."""
    easy_seed_only = trials("trained in real", {0: (80.0, 140.0)})
    both = trials("fitted street", {0: (70.0, 100.0), 1: (70.0, 300.0)})
    direct = trials("direct transfer", {0: (70.0, 150.0), 1: (70.0, 400.0)})
    found = Comparison("toy", "0" * 8, "sim", (*direct, *both, *easy_seed_only), {})
    assert found.best("V4") == "fitted street"
    assert found.regret_s("trained in real", "V4").tolist() == [40.0]
    assert found.won_back("fitted street", "V4", "direct transfer") == 1.0
    without_common = trials("trained in real", {2: (80.0, 140.0)})
    assert Comparison("toy", "0" * 8, "sim", (*both, *without_common), {}).best("V4") == (
        "trained in real"
    )


def test_nothing_to_win_has_no_share() -> None:
    rows = trials("direct transfer", {0: (70.0, 80.0)}) + trials(
        "phase (the paper's UGAT)", {0: (70.0, 90.0)}
    )
    found = Comparison("toy", "0", "sim", tuple(rows), {})
    assert math.isnan(found.won_back("phase (the paper's UGAT)", "V4", "direct transfer"))


def test_what_loses_nothing_on_the_way_has_no_gap_to_make_smaller() -> None:
    rows = trials("direct transfer", {0: (90.0, 80.0)}) + trials(
        "phase (the paper's UGAT)", {0: (70.0, 290.0)}
    )
    found = Comparison("toy", "0", "sim", tuple(rows), {})
    assert math.isnan(found.reduction("phase (the paper's UGAT)", "V4", "direct transfer"))


def test_episodes_that_broke_down_are_counted_one_by_one() -> None:
    def episode(target: str, training: int | None, att_s: float, arrived: float) -> Trial:
        scores = replace(BLANK, att_s=att_s, throughput=arrived, due=200.0)
        return Trial("direct transfer", "V4", target, training, 1, scores)

    rows = [
        episode("V4", 0, 100.0, 190.0), episode("V4", 0, 120.0, 180.0),
        episode("V4", 1, 700.0, 179.0), episode("sim", 1, 60.0, 0.0),
    ]  # fmt: skip
    found = Comparison("toy", "0" * 8, "sim", tuple(rows), {})
    assert found.median_s("direct transfer", "V4") == 120.0
    assert found.unserved("direct transfer", "V4") == pytest.approx(1 / 3)
    assert "| direct transfer | 120, 33 % |" in comparison_page(
        found, "direct transfer", "main", FACTS
    )


@pytest.mark.parametrize("shared", ["", "+blocker_patience=60+reach=100", "+reach=100" * 6])
def test_bars_are_told_apart_within_the_picture(shared: str, tmp_path: Path) -> None:
    rows = [
        Trial("direct transfer", domain, domain, 0, 1, replace(BLANK, att_s=100.0))
        for domain in (f"V{number}{shared}" for number in (1, 2, 3, 4))
    ]
    rows += [replace(row, domain="sim") for row in rows]
    found = Comparison("toy", "0" * 8, "sim", tuple(rows), {})
    path = tmp_path / "gaps.png"
    gap_picture(found.rows(), path)
    pixels = matplotlib.image.imread(path)[-130:, :, :3]
    edges = np.concatenate((pixels[:, :3], pixels[:, -3:]), axis=1)
    assert pixels.min() < 0.5 and edges.min() == 1.0  # a legend, and none of it cut off


def test_pages_hold_the_numbers(found: Comparison) -> None:
    page = comparison_page(found, "direct transfer", "main", FACTS)
    assert "# toy: main" in page
    assert "| phase (the paper's UGAT) | −54 % |" in page
    assert "| phase (the paper's UGAT) | 0.80 |" in page
    assert "| direct transfer | 100 (-154 to 354) |" in page  # t = 12.71, 20 s apart from the mean
    assert "| best constant | constant delay 2 s |" in page
    assert "| phase (the paper's UGAT) | -80.0 (" in page
    table = comparison_csv(found).splitlines()
    assert len(table) == 5
    assert table[0].startswith("scenario,setting,domain,training_seeds,att_s,")
    rows = all_standings(found).write_csv().splitlines()
    assert rows[0] == "setting,domain,training_seed,att_s,att_s_sim,throughput"
    assert "phase (the paper's UGAT),V4,0,130.0,71.0,0.0" in rows
    assert '"best rule, tuned there",V4,1,120.0,80.0,0.0' in rows


def test_a_page_of_one_training_seed_speaks_of_no_test(found: Comparison) -> None:
    one = replace(found, trials=tuple(t for t in found.trials if t.training_seed != 1))
    page, usual = (
        " ".join(comparison_page(table, "direct transfer", "main", FACTS).split())
        for table in (one, found)
    )
    assert "With one training seed no setting can be tested against direct transfer. Low" in page
    assert "No setting is better" not in page and "by chance" not in page
    assert "Each of 3 is tested by itself" in usual


def test_a_setting_without_a_training_has_no_row_for_it() -> None:
    rows = [
        *trials("direct transfer", {0: (70.0, 200.0), 1: (72.0, 240.0)}),
        *trials("phase (the paper's UGAT)", {1: (71.0, 150.0)}),
    ]
    found = all_standings(Comparison("toy", "0" * 8, "sim", tuple(rows), {}))
    phase = found.filter(pl.col("setting") == "phase (the paper's UGAT)")
    assert phase.rows() == [("phase (the paper's UGAT)", "V4", 1, 150.0, 71.0, 0.0)]
