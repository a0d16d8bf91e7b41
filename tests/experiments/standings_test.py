"""Standings: tables that are read, joined and ranked, against values counted by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import scipy.stats

from ugat_marl.__main__ import main
from ugat_marl.cli.compare import Compare
from ugat_marl.data import write_csv
from ugat_marl.errors import CheckpointError, OptionError, OutputError
from ugat_marl.experiments import ranked, read_standings, require_kept, with_standings
from ugat_marl.experiments.standings import SCHEMA, Judging, judged_in
from ugat_marl.policies import shipped

HEAD = ",".join(SCHEMA)
TABLE = f"""{HEAD}
direct transfer,V4,0,100,60,900
direct transfer,V4,1,120,62,890
direct transfer,V4,2,140,64,880
fast,V4,0,80,60,950
fast,V4,1,81,61,951
fast,V4,2,85,62,952
"""


def written(folder: Path, text: str = TABLE) -> Path:
    file = folder / "seeds.csv"
    file.write_text(text)
    return file


def row(table: pl.DataFrame, setting: str) -> dict[str, float]:
    return ranked(table).filter(pl.col("setting") == setting).to_dicts()[0]


def test_settings_are_ranked_with_intervals_and_regret(tmp_path: Path) -> None:
    table = read_standings(written(tmp_path))
    assert ranked(table)["setting"].to_list() == ["fast", "direct transfer"]
    fast, direct = row(table, "fast"), row(table, "direct transfer")
    assert fast["att_s"] == 82 and fast["gap_s"] == 21 and fast["regret_s"] == 0
    assert direct["regret_s"] == 38 and direct["won_back"] == 0 and fast["won_back"] == 1
    half = scipy.stats.t.ppf(0.975, 2) * np.std([80, 81, 85], ddof=1) / math.sqrt(3)
    assert fast["low_s"] == pytest.approx(82 - half) and fast["high_s"] == pytest.approx(82 + half)
    known = scipy.stats.ttest_ind([80, 81, 85], [100, 120, 140], equal_var=False)
    assert fast["p"] == pytest.approx(known.pvalue)
    assert direct["p"] is None


def test_a_row_is_added_and_an_own_row_replaced(tmp_path: Path) -> None:
    table = read_standings(written(tmp_path))
    own = pl.DataFrame([("mine", "V4", 0, 110.0, 61.0, 900.0)], schema=SCHEMA, orient="row")
    whole = with_standings(table, own)
    mine = row(whole, "mine")
    assert mine["regret_s"] == 28 and mine["low_s"] is None and mine["p"] is None
    assert mine["won_back"] == pytest.approx(1 - 28 / 38)
    better = own.with_columns(att_s=pl.lit(70.0))
    again = with_standings(whole, better)
    assert again.height == whole.height and row(again, "mine")["regret_s"] == 0
    assert row(again, "fast")["regret_s"] == 12
    elsewhere = own.with_columns(domain=pl.lit("V1"))
    with pytest.raises(OptionError, match="V4"):
        with_standings(whole, elsewhere)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (TABLE.replace("att_s_sim", "att"), "'att_s_sim'"),
        (TABLE.replace("V4,2,140", "V4,two,140"), "row 4: training_seed = 'two'"),
        (TABLE.replace("140", "nan"), "row 4: att_s = 'nan'"),
        (TABLE + "fast,V4,2,84,62,952\n", "training_seed 2 of 'fast' in V4 is there twice"),
        ("", "not a table"),
    ],
)  # fmt: skip
def test_damaged_tables_are_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(CheckpointError, match=said):
        read_standings(written(tmp_path, text))
    with pytest.raises(CheckpointError, match="No such file"):
        read_standings(tmp_path / "missing.csv")


def test_a_table_is_not_replaced_by_one_that_lacks_its_trainings(tmp_path: Path) -> None:
    folder = tmp_path / "single-v1" / "main"
    folder.mkdir(parents=True)
    file = written(folder)
    for kept in (TABLE, TABLE + "fast,V1,0,70,60,960\n"):
        require_kept(file, read_standings(written(tmp_path, kept)), "")
    for fewer in (TABLE.replace("fast,V4,2,85,62,952\n", ""), TABLE.replace("85", "86")):
        with pytest.raises(OutputError, match="'fast' in V4 with seed 2"):
            require_kept(file, read_standings(written(tmp_path, fewer)), "give another")
    assert file.read_text() == TABLE
    other = tmp_path / "other.csv"
    other.write_text("a,b\n1,2\n")
    with pytest.raises(OutputError, match="no table that could be replaced; give another"):
        require_kept(other, read_standings(file), "give another")
    require_kept(tmp_path / "none.csv", read_standings(file), "")


def test_a_number_of_episodes_without_end_tells_nothing(tmp_path: Path) -> None:
    lines = [f"{line},inf" for line in TABLE.splitlines()]
    lines[0] = f"{HEAD},episodes"
    assert judged_in(written(tmp_path, "\n".join(lines))) == {}


def test_two_calls_at_once_keep_both_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = written(tmp_path)
    own = [
        read_standings(table).filter(pl.col("setting") == "fast").with_columns(setting=pl.lit(name))
        for name in ("first", "second")
    ]

    def judged(*_: object) -> pl.DataFrame:
        """The other call writes its row while this one judges."""
        if len(own) == 2:
            write_csv(table, pl.concat([read_standings(table), own.pop()]).write_csv())
        return own[0]

    monkeypatch.setattr(Compare, "_judged", judged)
    words = ["--policies", "random", "--table", str(table), "--out", str(table)]
    assert main(["compare", "single-v1", "--name", "first", *words]) == 0
    assert {"first", "second", "fast"} < {*read_standings(table)["setting"]}


def test_a_row_of_the_same_name_is_replaced_in_its_own_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = written(tmp_path)
    fast = read_standings(table).filter(pl.col("setting") == "fast")
    words = ["--policies", "random", "--table", str(table), "--out", str(table)]
    for att_s in (70.0, 90.0):
        own = fast.with_columns(setting=pl.lit("mine"), att_s=pl.lit(att_s))
        monkeypatch.setattr(Compare, "_judged", lambda *_, own=own: own)
        assert main(["compare", "single-v1", "--name", "mine", *words]) == 0
        whole = read_standings(table)
        assert whole.height == 9 and row(whole, "mine")["att_s"] == att_s


def test_a_length_is_compared_as_a_number(tmp_path: Path) -> None:
    """A spreadsheet writes 3600 for 3600.0."""
    lines = [f"{line},single-v1,5,3600" for line in TABLE.splitlines()]
    lines[0] = f"{HEAD},scenario,episodes,duration_s"
    file = written(tmp_path, "\n".join(lines))
    assert Judging("single-v1", 5, 3600.0).require_in(file)
    with pytest.raises(OptionError, match="duration_s = 3600, not 1800; give --duration-s 3600"):
        Judging("single-v1", 5, 1800.0).require_in(file)


def test_a_table_of_another_network_of_the_same_name_is_refused(tmp_path: Path) -> None:
    own = Judging("town", 5, 3600.0, scenario_hash="one")
    table = own.written_to(read_standings(written(tmp_path)))
    file = written(tmp_path, table.write_csv())
    assert own.require_in(file)
    with pytest.raises(OptionError, match="judged with other files of town"):
        replace(own, scenario_hash="other").require_in(file)


@pytest.mark.parametrize("other", ["./own.pt", "folder/../own.pt"])
def test_a_file_by_two_paths_is_one_training(
    other: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.pt").write_bytes(b"")
    Path("folder").mkdir()
    words = ["compare", "single-v1", "--name", "mine", "--policies", "own.pt", other]
    assert main(words) == 2
    assert "it would count as two trainings" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("max-pressure", "max-pressure:10"),
        ("single-v1/direct-transfer-s0", "single-v1/./direct-transfer-s0.pt"),
        ("mine.py:Mine@kept.pt", "./mine.py:Mine@./kept.pt"),
    ],
)
def test_one_policy_in_two_spellings_is_one_training(
    one: str, other: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(shipped.FOLDER)
    assert main(["compare", "single-v1", "--name", "mine", "--policies", one, other]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert f"--policies has {other} twice as {one} and {other}: it would count as two" in said


def test_every_committed_table_can_be_read() -> None:
    results = Path(__file__).resolve().parents[2] / "results"
    tables = sorted(results.glob("*/main*/seeds.csv"))
    assert tables
    for path in tables:
        table = read_standings(path)
        assert "direct transfer" in table["setting"].to_list()
        assert ranked(table)["regret_s"].min() == 0


def test_rules_are_put_into_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Counted against `evaluate`: the same episodes, so the same travel times."""
    out = tmp_path / "mine.csv"
    words = ["--duration-s", "300", "--evaluation-seeds", "2", "--workers", "2"]
    call = ["compare", "single-v1", "--name", "mine", "--policies", "largest-queue:20", "random"]
    table = written(tmp_path)
    assert main([*call, *words, "--table", str(table), "--out", str(out)]) == 0
    assert "mine" in capsys.readouterr().out
    whole = read_standings(out)
    own = whole.filter(pl.col("setting") == "mine")
    assert own["training_seed"].to_list() == [0, 1] and own["domain"].to_list() == ["V4", "V4"]
    assert whole.height == 8
    import ugat_marl

    played = ugat_marl.evaluate(
        "single-v1", ["largest-queue:20", "random"], ["sim", "V4"], seeds=2, duration_s=300
    )
    for domain, column in (("V4", "att_s"), ("sim", "att_s_sim")):
        known = played.filter(pl.col("domain") == domain)["att_s"].to_numpy()
        assert own[column].to_numpy() == pytest.approx(known, abs=1e-3)
    for wrong in ([], ["--policies", "random", "--learner", "dqn"]):
        assert main(["compare", "single-v1", "--name", "mine", *wrong]) == 2
        assert "one of the two" in capsys.readouterr().err
    for option, value in (("--seeds", "4"), ("--learner-settings", "a=1")):
        assert main([*call, option, value]) == 2
        assert f"trained already; leave out {option}" in capsys.readouterr().err
    assert main([*call, "random", "--table", str(table)]) == 2
    assert "--policies has random twice" in capsys.readouterr().err
    table.with_name("table.csv").write_text("scenario,setting\ngrid4x4-v1,fast\n")
    assert main([*call, "--table", str(table)]) == 2
    assert "a table of grid4x4-v1, not of single-v1" in capsys.readouterr().err
    table.with_name("table.csv").write_text("scenario,setting\nsingle-v1,fast\n")
    # The table that was written says how the new rows were judged, and nothing of the others.
    assert main([*call, "--table", str(out), "--out", str(out)]) == 0
    assert "does not say in which episodes" in capsys.readouterr().out
    cells = pl.read_csv(out).select("setting", "episodes", "scenario").unique()
    assert {*cells.iter_rows()} == {
        ("mine", 2, "single-v1"), ("fast", None, None), ("direct transfer", None, None)
    }  # fmt: skip
    for changed, said in (
        (["--duration-s", "240"], "duration_s = 300.0, not 240; give --duration-s 300.0"),
        (["--evaluation-seeds", "1"], "episodes = 2, not 1; give --evaluation-seeds 2"),
    ):
        assert main([*call, *words, *changed, "--table", str(out)]) == 2
        assert said in capsys.readouterr().err
    assert main(["compare", "grid2x2-v1", *call[2:], *words, "--table", str(out)]) == 2
    assert "a table of single-v1, not of grid2x2-v1" in capsys.readouterr().err
    # A row that would be lost is refused before any episode is played.
    lost = [*call[:3], "direct transfer", *call[4:], "--domains", "V1", "--table", str(table)]
    monkeypatch.setattr("ugat_marl.cli.compare.standings_of", None)
    assert main(lost) == 2
    assert "results in V4, which would be lost" in capsys.readouterr().err
    # So is a table whose rows the new one would not have.
    assert main([*call, *words, "--table", str(table), "--out", str(out)]) == 2
    assert (
        f"would be lost, such as 'mine' in V4 with seed 0; --table {out}" in capsys.readouterr().err
    )


def test_episodes_without_a_vehicle_spoil_no_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    table = written(tmp_path)
    before = read_standings(table)
    row = before.head(1).with_columns(setting=pl.lit("mine"), att_s=pl.lit(math.nan))
    monkeypatch.setattr("ugat_marl.cli.compare.standings_of", lambda *_, **__: row)
    call = ["compare", "single-v1", "--name", "mine", "--policies", "random", "--duration-s", "60"]
    assert main([*call, "--domains", "V4", "--table", str(table), "--out", str(table)]) == 2
    assert "no vehicle was due in some episode" in capsys.readouterr().err
    assert read_standings(table).equals(before)
    order = ranked(pl.concat([row, before])).filter(pl.col("domain") == row["domain"][0])
    assert order["setting"][-1] == "mine" and order["regret_s"][0] == 0.0


def test_a_file_of_another_kind_is_kept_and_a_row_has_a_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call = ["compare", "single-v1", "--name", "mine", "--policies", "largest-queue:20", "random"]
    other = tmp_path / "other.csv"
    other.write_text("a,b\n1,2\n")
    assert main([*call, "--table", str(written(tmp_path)), "--out", str(other)]) == 2
    assert "no table that could be replaced; give" in capsys.readouterr().err
    assert main([*call[:3], " ", *call[4:]]) == 2
    assert "give the new row a name" in capsys.readouterr().err
