"""The overview of the committed results says what the tables beside it say."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from typing import Any

import pytest

FILE = Path(__file__).parents[2] / "results" / "overview.py"
if not FILE.is_file():
    pytest.skip("results/ is not part of the package", allow_module_level=True)
spec = importlib.util.spec_from_file_location("results_overview", FILE)
assert spec is not None and spec.loader is not None
script: Any = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = script  # dataclasses look their module up
spec.loader.exec_module(script)

TABLE = """setting,domain,att_s,att_s_gap
direct transfer,V1,100,40
direct transfer,V4,200,140
"timed",V1,80,20
"timed",V4,110,28
constant delay 2 s,V1,75,14
constant delay 2 s,V4,120,46
constant delay 3 s,V1,84,22
constant delay 3 s,V4,115,41
"best rule, tuned there",V1,90,12
"best rule, tuned there",V4,100,21
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "grid2x2-v1" / "main-short"
    place.mkdir(parents=True)
    (place / "table.csv").write_text(TABLE)
    (place / "table.md").write_text("# grid2x2-v1: main, short\n\nText.\n")
    return tmp_path


def test_the_page_is_that_of_the_tables() -> None:
    page = (FILE.parent / "README.md").read_text(encoding="utf-8")
    assert page == script.with_overview(page), "run python results/overview.py"
    assert page.count("](single-v1/main/table.md), dqn | V1 |") == 1


def test_by_hand(folder: Path) -> None:
    first, second, mean = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in script.overview(folder).splitlines()[2:]
    ]
    link = "[grid2x2-v1: main, short](grid2x2-v1/main-short/table.md), universal"
    # Of 25 s to the best constant timed grounding has 20; in V4 90 of 100 s to the rule.
    timed = "**80.0** −50 %, 0.80"
    assert first == [link, "V1", "100 (25.0)", timed, "", "", "", "75.0", "", "90.0"]
    assert second == ["", "V4", "200 (100)", "**110** −80 %, 0.90", "", "", "", "115", "", "100"]
    assert mean == ["", "*mean*", "", "*−65 %, 0.85*", "", "", "", "", "", ""]


def test_where_direct_transfer_is_best_there_is_nothing_to_win_back(folder: Path) -> None:
    (folder / "grid2x2-v1" / "main-short" / "table.csv").write_text(
        TABLE.replace("direct transfer,V1,100", "direct transfer,V1,70")
    )
    first, second, mean = script.overview(folder).splitlines()[2:]
    assert "**80.0** −50 %, – |" in first and "0.90" in second and "*−65 %, –*" in mean


def test_a_gap_that_is_none_cannot_become_smaller(folder: Path) -> None:
    table = folder / "grid2x2-v1" / "main-short" / "table.csv"
    table.write_text(TABLE.replace("direct transfer,V1,100,40", "direct transfer,V1,100,-8"))
    first, _, mean = script.overview(folder).splitlines()[2:]
    assert "**80.0** –, 0.80" in first and "*–, 0.85*" in mean


def test_what_all_domains_of_a_table_share_is_left_out(folder: Path) -> None:
    table = folder / "grid2x2-v1" / "main-short" / "table.csv"
    plain = script.overview(folder)
    table.write_text(TABLE.replace(",V1,", ",V1+headway=2,").replace(",V4,", ",V4+headway=2,"))
    assert script.overview(folder) == plain
    table.write_text(TABLE.replace(",V4,", ",V4+headway=2,"))
    assert "| V4+headway=2 |" in script.overview(folder)


@pytest.mark.parametrize("name", ["there", "matched"])
def test_what_else_is_known_there_counts_as_well(folder: Path, name: str) -> None:
    there = folder / "grid2x2-v1" / name
    there.mkdir()
    (there / "table.csv").write_text(
        "setting,domain,att_s,att_s_gap\ndirect transfer,V1,100,40\ntrained in real,V1,60,1\n"
        "direct transfer,V4,201,140\ntrained in real,V4,90,1\n"
    )
    first, second, _ = script.overview(folder).splitlines()[2:]
    assert "**80.0** −50 %, 0.50 |" in first and "| 60.0 | 90.0 |" in first
    assert "0.90 |" in second and "|  | 100 |" in second  # another direct transfer: another table


def test_what_stands_around_it_stays(folder: Path) -> None:
    page = f"# Results\n\n{script.BEGIN}old\n{script.END}\nWords.\n"
    found = script.with_overview(page, folder)
    assert found.startswith("# Results\n\n") and found.endswith("\nWords.\n")
    assert "old" not in found and script.overview(folder) in found
    assert script.with_overview(found, folder) == found
    with pytest.raises(ValueError, match="overview"):
        script.with_overview("# Results\n", folder)


def test_every_table_is_named_on_the_page() -> None:
    page = (FILE.parent / "README.md").read_text(encoding="utf-8").partition("## All tables")[2]
    made = {str(path.relative_to(FILE.parent)) for path in FILE.parent.glob("*/*/table.md")}
    assert made == set(re.findall(r"^\| .*?\]\(([\w/.-]+table\.md)\) \|", page, flags=re.MULTILINE))
