"""Networks nobody has seen: what counts, what is harm, and which are run."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from studies import unseen
from studies.osm_extracts import Extract
from studies.unseen import Outcome, scenarios, summary
from ugat_marl.errors import OutputError, ScenarioError, UnknownNameError
from ugat_marl.scenarios import NetworkRanges


def outcome(network: str, direct: float, street: float, rule: float, sim: float = 50.0) -> Outcome:
    att_s = {"direct transfer": direct, "fitted street": street, unseen.RULE: rule}
    return Outcome(network, "V4", att_s, {"direct transfer": sim, unseen.RULE: 60.0})


def test_the_worst_comes_first_and_cases_without_headroom_count_in_no_mean() -> None:
    half, harmed = outcome("half", 100.0, 90.0, 80.0), outcome("harmed", 100.0, 104.0, 90.0)
    nothing = outcome("nothing", 100.0, 99.0, 96.0, sim=61.0)
    assert [x.counts for x in (half, harmed, nothing)] == [True, True, False]
    assert half.won_back("fitted street") == 0.5 and harmed.won_back("fitted street") == -0.4
    lines = summary([nothing, half, harmed]).splitlines()
    rows = [line.split(" | ")[0].strip("| ") for line in lines[4:7]]
    assert rows == ["harmed", "half", "nothing"]
    assert "no headroom" in lines[6] and "not trained yet" in lines[6]
    assert "Road networks and domains: 3, with headroom: 2." in lines[0]
    assert "Harmed by more than 3%: 1 of 3." in lines
    assert "Regret won back by fitted street, mean: 0.05." in lines
    assert lines[-1].endswith("2 of 3 networks.")


def test_some_of_the_drawn_networks_are_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []

    def draw(folder: Path, seed: int, ranges: NetworkRanges) -> None:
        assert ranges.intersections == (1, 2) and ranges.load == (0.8, 1.1)
        folder.mkdir(parents=True)
        drawn.append(seed)

    monkeypatch.setattr(unseen, "draw_scenario", draw)
    given = argparse.Namespace(
        out=tmp_path, seed=1, networks=3, largest=2, load=[0.8, 1.1], pbf=None, only=None
    )
    assert [folder.name for folder in scenarios(given)] == ["drawn-0", "drawn-1", "drawn-2"]
    given.only = ["drawn-2"]
    assert [folder.name for folder in scenarios(given)] == ["drawn-2"]
    given.only = ["drawn-3"]
    with pytest.raises(UnknownNameError, match="drawn-3"):
        scenarios(given)
    given.only, given.seed = None, 2
    with pytest.raises(OutputError, match="made with seed = 1, not 2"):
        scenarios(given)
    given.seed, given.load = 1, [0.3, 1.1]
    with pytest.raises(OutputError, match=r"made with load = \[0.8, 1.1\], not \[0.3, 1.1\]"):
        scenarios(given)
    assert len(set(drawn)) == len(drawn) == 3  # those that exist are kept


def test_a_mistake_before_there_are_results_can_be_corrected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make_all(extract: Extract, _: int, out: Path, count: int) -> int:
        made = count if extract.path.name == "city.osm" else 0
        for number in range(made):
            (out / f"city-{number + 1}").mkdir(parents=True)
        return made

    def refused(*_: object) -> None:
        raise ScenarioError("too little")

    monkeypatch.setattr(unseen, "make_all", make_all)
    monkeypatch.setattr(unseen, "read_extract", lambda path: Extract(path, {}, (), 0))
    given = argparse.Namespace(
        out=tmp_path, seed=1, networks=1, largest=2, load=[0.8, 1.1], only=None,
        pbf=Path("village.osm"), extracts=2,
    )  # fmt: skip
    monkeypatch.setattr(unseen, "draw_scenario", refused)
    with pytest.raises(ScenarioError, match="too little"):
        scenarios(given)
    monkeypatch.setattr(unseen, "draw_scenario", lambda folder, *_: folder.mkdir(parents=True))
    given.load = [0.3, 1.1]
    with pytest.raises(ScenarioError, match="village.osm: has 0 places that fit, not 2"):
        scenarios(given)
    given.pbf = Path("city.osm")
    assert [folder.name for folder in scenarios(given)] == ["drawn-0", "city-1", "city-2"]
    given.extracts = 3
    with pytest.raises(OutputError, match="made with extracts = 2, not 3"):
        scenarios(given)


def test_the_note_counts_what_the_numbers_hold() -> None:
    """Table of all draws, against the travel times of each row."""
    results = Path(__file__).parents[2] / "results"
    if not results.is_dir():
        pytest.skip("results/ is not part of the package")
    cases: dict[tuple[str, str, str], dict[str, float]] = {}
    for row in pl.read_csv(results / "unseen" / "seeds.csv").iter_rows(named=True):
        case = cases.setdefault((str(row["draw"]), row["network"], row["domain"]), {})
        case[row["setting"]] = row["att_s"]
    page = results / "notes" / "what-is-won-on-networks-nobody-tuned-on.md"
    told = re.findall(r"^\| (\d{8}) \| (.*) \|$", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert {draw for draw, _ in told} == {draw for draw, _, _ in cases}
    rows = ("fitted street", "constant delay 3 s", "constant delay 5 s", unseen.RULE)
    for draw, cells in told:
        outcomes = [Outcome(c[1], c[2], att_s, {}) for c, att_s in cases.items() if c[0] == draw]
        counted = [x for x in outcomes if x.counts]
        ahead = sum(
            x.att_s["fitted street"] > 1.02 * min(x.att_s[constant] for constant in rows[1:3])
            for x in outcomes
        )
        cases_told, *won, ahead_told = cells.replace("−", "-").split(" | ")[2:]
        assert cases_told == f"{len(outcomes)}, {len(counted)}" and ahead_told == str(ahead)
        # the newest draw's travel times have one decimal
        shares = [float(np.mean([x.won_back(row) for x in counted])) for row in rows]
        assert [float(x) for x in won] == pytest.approx(shares, abs=0.011)
