"""The numbers of ours on the page beside the paper's are those of the committed tables."""

from __future__ import annotations

import csv
import hashlib
import re
from pathlib import Path

import pytest

from ugat_marl.reporting import number_text

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "how-to" / "reproduce-ugat.md").read_text(encoding="utf-8")
Rows = dict[tuple[str, str], dict[str, str]]


def rows(name: str) -> Rows:
    with (ROOT / "results" / name / "table.csv").open(encoding="utf-8", newline="") as file:
        return {(row["setting"], row["domain"]): row for row in csv.DictReader(file)}


def cells(start: str) -> list[list[str]]:
    """Cells of all rows of the page that begin with a text."""
    lines = [line for line in PAGE.splitlines() if line.startswith(f"| {start} |")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def with_gap(row: dict[str, str]) -> str:
    return f"{number_text(float(row['att_s']))} ({number_text(float(row['att_s_gap']))})"


def gone(row: dict[str, str], direct: dict[str, str]) -> str:
    return f"{100 * (1 - float(row['att_s_gap']) / float(direct['att_s_gap'])):.0f} %"


@pytest.mark.parametrize("domain", ["V1", "V2", "V3", "V4"])
def test_transfer_is_that_of_the_tables(domain: str) -> None:
    published, here = rows("hangzhou_1x1/preset-paper"), rows("hangzhou_1x1/main")
    single = rows("single-v1/main")
    first, table, other = cells(domain)
    settings = ["direct transfer", "phase (the paper's UGAT)", "more plain sim"]
    direct, phase, more = (published[setting, domain] for setting in settings)
    assert (first[4], first[5], first[7]) == tuple(map(with_gap, (direct, phase, more)))
    assert (first[6], first[8]) == (gone(phase, direct), gone(more, direct))
    direct, timed = here["direct transfer", domain], here["timed", domain]
    assert (table[1], table[2]) == (with_gap(direct), with_gap(timed))
    assert table[3] == gone(timed, direct)
    phase = single["phase (the paper's UGAT)", domain]
    ends = "–".join(number_text(float(phase[f"att_s_{end}"])) for end in ("low", "high"))
    assert other[1] == number_text(float(single["direct transfer", domain]["att_s"]))
    assert other[2] == f"{number_text(float(phase['att_s']))} ({ends})"


def test_the_papers_shares_are_those_of_its_own_numbers() -> None:
    for domain in ("V1", "V2", "V3", "V4"):
        row = cells(domain)[0]
        direct, ugat = (float(re.findall(r"\(([\d.]+)\)", cell)[0]) for cell in row[1:3])
        assert row[3] == f"{100 * (1 - ugat / direct):.0f} %"


def test_the_ablations_are_those_of_the_tables() -> None:
    ablation, alpha = rows("single-v1/ablation"), rows("single-v1/alpha")
    names = {
        "UGAT": "phase (the paper's UGAT)",
        "static α = 0.5": "phase: α = 0.5",
        "no uncertainty (GAT)": "phase: no uncertainty (GAT)",
        "no grounding: direct transfer": "direct transfer",
    }
    for shown, setting in names.items():
        ((_, _, ours),) = cells(shown)
        assert ours == number_text(float(ablation[setting, "V1"]["att_s_gap"])), shown
    ((_, *ours),) = cells("ours")
    settings = [*(f"phase: α = {a}" for a in (0.2, 0.4, 0.5, 0.6, 0.8)), "phase (the paper's UGAT)"]
    assert ours == [number_text(float(alpha[name, "V1"]["att_s_gap"])) for name in settings]


def test_the_hashes_are_those_of_the_files(hangzhou: Path) -> None:
    named = dict(re.findall(r"^\| `([\w.-]+)` \| `([0-9a-f]{64})` \|", PAGE, flags=re.MULTILINE))
    assert len(named) == 4
    for name, digest in named.items():
        content = (hangzhou / "hangzhou_1x1" / name).read_bytes()
        assert hashlib.sha256(content).hexdigest() == digest
