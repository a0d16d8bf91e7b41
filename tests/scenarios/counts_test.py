"""Demand from counts and from origins and destinations, against hand counts."""

from __future__ import annotations

import csv
import functools
import subprocess
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest

from ugat_marl.__main__ import main
from ugat_marl.errors import ScenarioError
from ugat_marl.progress import Silent
from ugat_marl.scenarios import read_scenario, sumo_program
from ugat_marl.scenarios.importers import counts
from ugat_marl.scenarios.importers.counts import Row, _about_ends, _closed, _outside, read_rows


def made(target: Path, *words: str | Path) -> int:
    return main(["scenario", "new", str(target), "--grid", "1x2", *map(str, words)])


def drives(target: Path) -> list[tuple[float, tuple[str, ...]]]:
    root = read_scenario(target).routes[0].parse()
    return [
        (float(item.get("depart", "")), tuple(item[0].get("edges", "").split()))
        for item in root.iter("vehicle")
    ]


def test_counts_on_roads_are_met(tmp_path: Path) -> None:
    counts = {"west1_A1": 300, "A1_B1": 280, "B1_east1": 260}
    text = "edge,count\n" + "".join(f"{edge},{count}\n" for edge, count in counts.items())
    (tmp_path / "counts.csv").write_text(text)
    assert made(tmp_path / "city", "--counts", tmp_path / "counts.csv") == 0
    found = Counter(road for _, route in drives(tmp_path / "city") for road in route)
    assert {edge: found[edge] for edge in counts} == pytest.approx(counts, rel=0.02)
    assert "3 of 3 counts of counts.csv are met" in (tmp_path / "city" / "README.md").read_text()


def test_fractions_of_vehicles_are_driven_on_average(tmp_path: Path) -> None:
    """In 100 intervals of 1.5 vehicles 150 are due: 100 surely and 100 / 2 +- 5 by chance."""
    rows = "".join(f"west1_A1,1.5,{36 * i},{36 * (i + 1)}\n" for i in range(100))
    (tmp_path / "c.csv").write_text(f"edge,count,begin_s,end_s\n{rows}")
    assert made(tmp_path / "city", "--counts", tmp_path / "c.csv") == 0
    assert len(drives(tmp_path / "city")) == pytest.approx(150, abs=20)
    fits = (tmp_path / "city" / "counts-fit.csv").read_text(encoding="utf-8-sig").splitlines()
    column = fits[0].split(",").index("counted")
    assert {line.split(",")[column] for line in fits[1:]} == {"1.5"}


def test_counts_of_turns_in_parts_of_the_day(tmp_path: Path) -> None:
    (tmp_path / "c ü.csv").write_text(
        "from;to;count;begin_s;end_s\nwest1_A1;A1_B1;100;0;900\nwest1_A1;A1_northA;40;900;1800\n",
        encoding="utf-8-sig",
    )
    words = ["--counts", tmp_path / "c ü.csv", "--duration-s", "1800"]
    assert made(tmp_path / "city", *words) == 0
    found = drives(tmp_path / "city")
    early = [route[:2] for depart, route in found if depart < 900]
    late = [route[:2] for depart, route in found if depart >= 900]
    assert early.count(("west1_A1", "A1_B1")) == pytest.approx(100, abs=2)
    assert late.count(("west1_A1", "A1_northA")) == pytest.approx(40, abs=2)
    assert early.count(("west1_A1", "A1_northA")) == 0


def test_a_long_way_to_a_counted_road_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for end_s, told in ((100, True), (3600, False)):
        table = f"edge,count,begin_s,end_s\nA1_B1,20,0,{end_s}\n"
        (tmp_path / "t.csv").write_text(table)
        assert made(tmp_path / f"city{end_s}", "--counts", tmp_path / "t.csv") == 0
        said = capsys.readouterr().out
        assert ("intervals are of departures at the edge of the network" in said) == told


@pytest.mark.parametrize(
    ("columns", "first", "second"),
    [
        ("begin,end", ("23:30", "23:45:00"), ("23:45", "0:00")),
        ("begin,end", ("11:30 PM", "11:45pm"), ("11:45 PM", "12:00 AM")),
        ("start_street,begin,end", ("x,23:30", "23:45"), ("x,23:45", "24:00")),
        ("begin_s,end_s", ("4.3.2024 23:30", "4.3.2024 23:45"), ("4.3.2024 23:45", "86400")),
    ],
)
def test_times_of_day_count_from_midnight(
    tmp_path: Path, columns: str, first: tuple[str, str], second: tuple[str, str]
) -> None:
    table = f"edge,count,{columns}\nA1_B1,20,{','.join(first)}\nA1_northA,9,{','.join(second)}\n"
    (tmp_path / "t.csv").write_text(table)
    rows = read_rows(tmp_path / "t.csv", 84600, 86400, Silent(), pairs=False)
    assert [(row.begin_s, row.end_s) for row in rows] == [(84600, 85500), (85500, 86400)]


@pytest.mark.parametrize("day", ["", "2024-03-05 "])
def test_an_interval_may_go_past_midnight(day: str, tmp_path: Path) -> None:
    after = "2024-03-06 " if day else ""
    (tmp_path / "t.csv").write_text(f"edge,count,begin,end\nA1_B1,9,{day}23:45,{after}00:15\n")
    (row,) = read_rows(tmp_path / "t.csv", 84600, 90000, Silent(), pairs=False)
    assert (row.begin_s, row.end_s) == (85500, 87300)
    (tmp_path / "t.csv").write_text("edge,count,begin,end\nA1_B1,9,08:00,07:00\n")
    with pytest.raises(ScenarioError, match="line 2: end = 07:00 is not after begin = 08:00"):
        read_rows(tmp_path / "t.csv", 0, 90000, Silent(), pairs=False)


def test_origins_and_destinations(tmp_path: Path) -> None:
    (tmp_path / "od.csv").write_text(
        "from,to,count\nwest1_A1,B1_east1,50\nnorthA_A1,A1_southA,20\nnorthA_A1,A1_west1,0\n"
    )
    assert made(tmp_path / "city", "--od", tmp_path / "od.csv", "--duration-s", "600") == 0
    found = drives(tmp_path / "city")
    ways = Counter(route for _, route in found)
    assert ways == {("west1_A1", "A1_B1", "B1_east1"): 50, ("northA_A1", "A1_southA"): 20}
    assert all(0 <= depart < 600 for depart, _ in found)
    departs = [depart for depart, _ in found]
    assert departs == sorted(departs)
    assert made(tmp_path / "again", "--od", tmp_path / "od.csv", "--duration-s", "600") == 0
    assert read_scenario(tmp_path / "again").hash == read_scenario(tmp_path / "city").hash


def test_what_is_ambiguous_in_origins_and_destinations_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    reporter = Silent()
    monkeypatch.setattr(reporter, "say", said.append)
    quarters = ["0,900", "900,1800", "0,1800"]
    rows = "".join(f"west1_A1,B1_east1,1.250,{times}\n" for times in quarters)
    (tmp_path / "t.csv").write_text(f"from,to,count,begin_s,end_s\n{rows}")
    assert len(read_rows(tmp_path / "t.csv", 0, 3600, reporter, pairs=True)) == 3
    (tmp_path / "t.csv").write_text("from,to,count\na,b,1.25\na,c,5\na,c,2\na,c,3\nb,c,4\n")
    read_rows(tmp_path / "t.csv", 0, 3600, reporter, pairs=True)
    overlap = "note: t.csv: rows that overlap an earlier one of the same origin and destination"
    assert said == [
        "note: t.csv: counts such as 1.250 were read as 1.25 vehicles",
        f"{overlap}, and add up: 2 (the first: line 4, with line 2)",
        f"{overlap}, and add up: 2 (the first: line 4, with line 3)",
    ]


@pytest.mark.parametrize(
    ("option", "text", "says"),
    [
        ("--counts", "road,count\na,1\n", "t.csv, line 1: the columns count and edge, or"),
        ("--counts", f"edge,count\n{'x' * 200_000},1\n", "line 2: not CSV (field larger than"),
        ("--counts", "edge,count\nwest1_A1,6e6\n", "line 2: more than 5000000 vehicles; keep"),
        ("--od", "from,to,count\nwest1_A1,B1_east1,1e18\n", "line 2: more than 5000000 veh"),
        ("--od", "edge,count\na,1\n", "t.csv, line 1: the columns from, to and count are needed"),
        (
            "--od",
            "from,to,count,begin,until\nwest1_A1,B1_east1,5,00:00,00:15\n"
            "west1_A1,B1_east1,5,00:15,00:30\n",
            "line 3: west1_A1 -> B1_east1 is counted in line 2 as well, and there is no column end",
        ),
        ("--counts", "sep=;\nedge;count\nwest1_A1;5\n", "line 1: 'sep=' is for a spreadsheet; del"),
        ("--counts", "edge,count\nwest1_A1,many\n", "line 2: count = 'many' is not a number"),
        (
            "--counts",
            "edge,count,begin,end\nwest1_A1,5,07:00,8:00:00\n",
            "the first begins at 25200 s (line 2); --begin-s 25200 lets the episode begin there",
        ),
        (
            "--counts",
            "edge,count,begin_s,end_s\nwest1_A1,5,4.3.2024 7:30,4.3.2024 8:00\n"
            "west1_A1,5,5.3.2024 7:30,5.3.2024 8:00\n",
            "line 3: begin_s is on 5.3.2024, and rows before it on 4.3.2024; a scenario has the",
        ),
        (
            "--counts",
            "edge,count,begin,end\nwest1_A1,5,7:00,25:10\n",
            "end = '25:10' is not a time",
        ),
        (
            "--counts",
            "edge,count,begin,begin_s\nwest1_A1,5,7:00,9\n",
            "begin and begin_s; keep one",
        ),
        ("--counts", "edge,count\nwest1_A1,n/a\n", "of at least 0; leave it blank where nobody"),
        ("--counts", "edge,count\nwest1_A1,-1\n", "line 2: count = '-1' is not a number of at"),
        ("--counts", "edge,count\nwest1_A1,1_000\n", "line 2: count = '1_000' is not a number"),
        ("--counts", "edge,count\nwest1_A1,١٢\n", "line 2: count = '١٢' is not a number"),
        ("--counts", "edge,count\nwest1_A1,true\n", "line 2: count = 'true' is not a number"),
        (
            "--counts",
            "edge,count,begin,end\nwest1_A1,5,0,60\n",
            "begin = '0' is not a time of day such as",
        ),
        ("--counts", "edge,count,begin_sec,end_sec\nwest1_A1,5,0,60\n", "'begin_sec' is not known"),
        (
            "--od",
            "from,to,count,Start\nwest1_A1,B1_east1,5,0\n",
            "to end_s, in seconds, or begin to",
        ),
        ("--counts", "edge,count\nwest1_A1,inf\n", "line 2: count = 'inf' is not a number"),
        ("--counts", "edge,count\nwest1_A1\n", "line 2: count = None is not a number"),
        ("--counts", "edge,count\nwest1_A1,5\nhere,5\n", "line 3: 'here' is not a road for cars"),
        ("--counts", "edge,count\nwest1_A1,0\n", "no row counts a vehicle"),
        (
            "--counts",
            "from,to,count\nwest1_A1,B1_east1,5\n",
            "no turn leads from west1_A1 to B1_east1",
        ),
        (
            "--counts",
            "edge,count,begin_s,end_s\nwest1_A1,5,9,9\n",
            "end_s = 9 is not after begin_s = 9",
        ),
        (
            "--counts",
            "edge,count\nwest1_A1,5\nA1_B1,5\nwest1_A1,7\n",
            "line 4: west1_A1 is counted in line 2 as well, and there is no column begin; name",
        ),
        (
            "--counts",
            "from,to,count,Von,Bis\nwest1_A1,A1_B1,5,6:50,7:05\nwest1_A1,A1_B1,6,7:05,7:20\n",
            "line 3: west1_A1 -> A1_B1 is counted in line 2 as well, and there is no column begin "
            "(is it 'von', 'bis'?); name the interval's columns begin and end for times of day",
        ),
        (
            "--counts",
            "edge,count,begin_s,Bis\nwest1_A1,5,0,900\nwest1_A1,6,900,1800\n",
            "line 3: west1_A1 is counted in line 2 as well, and there is no column end (is it "
            "'bis'?)",
        ),
        (
            "--counts",
            "from,to,count,begin_s,end_s\nwest1_A1,A1_B1,5,600,1200\nwest1_A1,A1_B1,5,0,900\n",
            "line 2: begin_s = 600 is before the end of an earlier interval of west1_A1 -> A1_B1",
        ),
        (
            "--counts",
            "edge,count,begin,end\nwest1_A1,5,0:00,0:30\nwest1_A1,5,0:15,0:45\n",
            "line 3: begin = 0:15 is before the end of an earlier interval of west1_A1, end = 0:30",
        ),
        ("--counts", "edge,count\nwest1_A1,5\n,5\n", "line 3: a count without its road"),
        ("--counts", "edge;count\nwest1_A1;1.250\n", "'1.250' can be 1250 or a little more than 1"),
        ("--counts", "edge;count\nwest1_A1;1,250\n", "'1.250' can be 1250 or a little more than 1"),
        (
            "--counts",
            "edge,count,begin_s,end_s\nwest1_A1,5,25200,28800\n",
            "the first begins at 25200 s (line 2); --begin-s 25200",
        ),
        ("--counts", "Counts of May\nedge,count\nwest1_A1,5\n", "are needed in the first line"),
        ("--od", "from,to,count\nA1_west1,west1_A1,5\n", "line 2: there is no way from 'A1_west1'"),
        ("--od", "from,to,count\nwest1_A1,up,5\n", "line 2: 'up' is not a road for cars"),
    ],
)
def test_tables_that_are_wrong(
    option: str, text: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "t.csv").write_text(text)
    assert made(tmp_path / "city", option, tmp_path / "t.csv") == 2
    assert says in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["t.csv"]


def test_a_table_that_is_no_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "t.csv").write_bytes(b"edge,count\n\xff\xfe,1\n")
    assert made(tmp_path / "city", "--counts", tmp_path / "t.csv") == 2
    assert "t.csv: is not UTF-8" in capsys.readouterr().err
    assert made(tmp_path / "city", "--counts", tmp_path / "gone.csv") == 2
    assert "gone.csv: no such file" in capsys.readouterr().err


def test_long_tables_are_read_row_by_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ugat_marl.files._PIECE", 7)
    text = "edge,count\r\n" + "".join(f'"ä {i}",{i}\r\n' for i in range(40)) + "\r\nz,1"
    (tmp_path / "t.csv").write_bytes(text.encode())
    rows = read_rows(tmp_path / "t.csv", 0, 60, Silent(), pairs=False)
    assert [(row.roads, row.count) for row in rows[:-1]] == [((f"ä {i}",), i) for i in range(40)]
    assert (rows[-1].roads, rows[-1].count, rows[-1].line) == (("z",), 1, 43)
    monkeypatch.setattr("ugat_marl.scenarios.importers.counts._MOST_ROWS", 9)
    with pytest.raises(ScenarioError, match=r"t\.csv, line 11: more than 9 rows"):
        read_rows(tmp_path / "t.csv", 0, 60, Silent(), pairs=False)
    monkeypatch.setattr("ugat_marl.scenarios.importers.long_files._MOST", 100)
    (tmp_path / "t.csv").write_bytes(b"edge,count\n" + b"x" * 200)
    with pytest.raises(ScenarioError, match=r"t\.csv, line 2: is longer than a line of a table"):
        read_rows(tmp_path / "t.csv", 0, 60, Silent(), pairs=False)


def test_counts_may_have_three_decimals_and_large_heads(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("Edge,Count\na,12.345\nb,98.5\n")
    rows = read_rows(tmp_path / "t.csv", 0, 60, Silent(), pairs=False)
    assert [row.count for row in rows] == [12.345, 98.5]


def test_a_decimal_comma_is_a_point_between_semicolons(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text('edge;count;begin_s;end_s\na;30,5;0,5;60;\nb;2;"100";200\n')
    rows = read_rows(path, 0, 660, Silent(), pairs=False)
    assert [(r.count, r.begin_s, r.end_s) for r in rows] == [(30.5, 0.5, 60), (2, 100, 200)]
    for text in ("edge;count\na;1,234,5\n", 'edge,count\na,"30,5"\n', "edge;count\na;1.234,5\n"):
        path.write_text(text)
        with pytest.raises(ScenarioError, match=r"line 2: count = .* is not a number"):
            read_rows(path, 0, 660, Silent(), pairs=False)


@pytest.mark.parametrize(
    "text",
    [
        'edge,count,"seen; in m"\na,5,x\n',
        "edge\tcount\tend_s\na\t5\t60,5\n",
        'edge;count;"x,y,z,u,v"\na;5;x\n',
        "edge;count;begin_s;end_s\na;5; ;  \n",
    ],
)
def test_what_separates_cells_is_counted_outside_of_quotes(text: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(text)
    (row,) = read_rows(tmp_path / "t.csv", 0, 660, Silent(), pairs=False)
    assert (row.roads, row.count, row.begin_s) == (("a",), 5, 0)
    assert row.end_s == (60.5 if "\t" in text else 660)


def test_rows_are_for_the_episode_unless_they_say_more(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("edge,count,begin_s,end_s\na,1,,\nb,2,100,200\n")
    rows = read_rows(tmp_path / "t.csv", 60, 660, Silent(), pairs=False)
    assert [(r.roads, r.begin_s, r.end_s, r.line) for r in rows] == [
        (("a",), 60, 660, 2),
        (("b",), 100, 200, 3),
    ]


@pytest.mark.parametrize("kind", ["--counts", "--od"])
@pytest.mark.parametrize(
    ("intervals", "inside", "lost"),
    [
        (("25200,27000", "27000,28800"), 160, 0),
        (("23400,25200", "25200,27000"), 60, 100),
        (("24300,26100", "27000,30600"), 80, 80),
    ],
)
def test_intervals_are_on_the_clock_of_the_begin(
    tmp_path: Path, kind: str, intervals: tuple[str, str], inside: int, lost: int
) -> None:
    ends = "west1_A1,A1_B1" if kind == "--counts" else "west1_A1,B1_east1"
    rows = "".join(f"{ends},{n},{x}\n" for n, x in zip((100, 60), intervals, strict=True))
    (tmp_path / "c.csv").write_text("from,to,count,begin_s,end_s\n" + rows)
    assert made(tmp_path / "city", kind, tmp_path / "c.csv", "--begin-s", "25200") == 0
    found = [depart for depart, _ in drives(tmp_path / "city")]
    assert len(found) == pytest.approx(160, abs=2)
    within = sum(25200 <= depart < 28800 for depart in found)
    # of an interval that lies half inside, about half of the vehicles drive
    assert within == pytest.approx(inside, abs=2 if lost in (0, 100) else 20)
    note = f"{lost} of the 160 vehicles of c.csv are outside of the episode (25200 to 28800 s)"
    assert (note in (tmp_path / "city" / "README.md").read_text()) is (lost > 0)
    if kind == "--counts":  # what never drives meets no count
        with (tmp_path / "city" / "counts-fit.csv").open(encoding="utf-8-sig") as file:
            fits = list(csv.DictReader(file))
        assert sum(float(row["driven"]) for row in fits) == within
        # and of a count, the part within the episode is to be met
        assert sum(float(row["counted"]) for row in fits) == pytest.approx(inside)
        assert all(25200 <= float(row["begin_s"]) < float(row["end_s"]) <= 28800 for row in fits)
        assert all(float(row["geh"]) < 5 for row in fits)


def test_a_sliver_of_an_interval_has_no_fit(tmp_path: Path) -> None:
    rows = (
        "west1_A1,60,3420,3480",  # a whole interval, though a short one
        "west1_A1,100,3540,4440",  # a minute of a quarter of an hour
        "southA_A1,100,3120,4020",  # more than half of one
        "northA_A1,400,2700,6300",  # a quarter of an hour is enough of every interval
    )
    (tmp_path / "c.csv").write_text("\n".join(["edge,count,begin_s,end_s", *rows, ""]))
    assert made(tmp_path / "city", "--counts", tmp_path / "c.csv") == 0
    with (tmp_path / "city" / "counts-fit.csv").open(encoding="utf-8-sig") as file:
        fits = [(row["from"], row["begin_s"], row["end_s"]) for row in csv.DictReader(file)]
    assert fits == [
        ("west1_A1", "3420", "3480"),
        ("southA_A1", "3120", "3600"),
        ("northA_A1", "2700", "3600"),
    ]


def test_counts_of_which_slivers_lie_in_the_episode_have_no_fit(tmp_path: Path) -> None:
    (tmp_path / "c.csv").write_text("edge,count,begin_s,end_s\nwest1_A1,100,3540,4440\n")
    assert made(tmp_path / "city", "--counts", tmp_path / "c.csv") == 0
    said = "too little of every interval of c.csv is within the episode for a GEH"
    assert said in (tmp_path / "city" / "README.md").read_text()


@pytest.mark.parametrize(
    ("rows", "length_s"),
    [
        (["west1_A1,400,0,3600", "southA_A1,600,,"], 5400),
        (["west1_A1,100,0,900", "southA_A1,360,,"], 3000),
        (["west1_A1,40,0,600", "west1_A1,60,1000,1900", "southA_A1,80,0,1800"], 1900),
    ],
)
def test_intervals_that_do_not_divide_each_other_lose_no_vehicle(
    rows: list[str], length_s: int, tmp_path: Path
) -> None:
    (tmp_path / "t.csv").write_text("\n".join(["edge,count,begin_s,end_s", *rows, ""]))
    words = ["--grid", "1x1", "--counts", tmp_path / "t.csv", "--duration-s", str(length_s)]
    assert main(["scenario", "new", str(tmp_path / "city"), *map(str, words)]) == 0
    driven = drives(tmp_path / "city")
    assert max(depart for depart, _ in driven) < length_s
    for road in {row.split(",")[0] for row in rows}:
        wanted = sum(int(row.split(",")[1]) for row in rows if row.startswith(road))
        assert sum(edges[0] == road for _, edges in driven) == pytest.approx(wanted, rel=0.03)


def test_counted_u_turns_are_driven(tmp_path: Path) -> None:
    """The sheet lists them, so that their counts are no mistake."""
    net = tmp_path / "u.net.xml"
    words = ["--grid", "--grid.number", "2", "--grid.length", "200", "--grid.attach-length", "100"]
    subprocess.run(
        [str(sumo_program("netgenerate")), *words, "--tls.set", "A0", "-o", str(net)],
        check=True, capture_output=True,
    )  # fmt: skip
    table = "from,to,count\nbottom0A0,A0A1,50\nbottom0A0,A0bottom0,20\n"
    (tmp_path / "t.csv").write_text(table)
    words = ["--sumo", str(net), "--counts", str(tmp_path / "t.csv")]
    assert main(["scenario", "new", str(tmp_path / "city"), *words]) == 0
    turned = [edges for _, edges in drives(tmp_path / "city") if "A0bottom0" in edges]
    back = [edges for edges in turned if ("bottom0A0", "A0bottom0") in pairwise(edges)]
    assert len(back) == pytest.approx(20, abs=1)


def test_turns_that_no_random_route_takes_are_driven(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At two vehicles an hour at each entry few turns are taken."""
    monkeypatch.setattr(counts, "_CANDIDATES_VPH", 2.0)
    turns = ["B2_B3,B3_C3", "C3_C2,C2_B2", "B2_A2,A2_A1"]
    (tmp_path / "t.csv").write_text("\n".join(["from,to,count", *(f"{x},20" for x in turns), ""]))
    words = ["--grid", "3x3", "--counts", str(tmp_path / "t.csv")]
    assert main(["scenario", "new", str(tmp_path / "city"), *words]) == 0
    passed = Counter(pair for _, edges in drives(tmp_path / "city") for pair in pairwise(edges))
    for turn in turns:
        assert passed[tuple(turn.split(","))] == pytest.approx(20, abs=2)


def test_intervals_with_inclusive_ends_touch() -> None:
    def rows(*spans: tuple[float, float], end: str = "") -> list[Row]:
        return [
            Row(("a",), 5.0, first, last, line, end=end)
            for line, (first, last) in enumerate(spans, 2)
        ]

    assert _closed(rows((0, 899), (900, 1799), (0, 899))) == rows((0, 900), (900, 1800), (0, 900))
    for spans in (((0, 900), (900, 1800)), ((0, 600), (900, 1800)), ((0, 3600),)):
        assert _closed(rows(*spans)) == rows(*spans)
    day = functools.partial(rows, end="end = 7:14")
    given, closed = day((0, 840), (900, 1740)), day((0, 900), (900, 1800))
    assert _closed(given) == closed
    (note,) = _about_ends(given, closed)
    assert note.startswith("2 intervals end a minute before the next one begins (the first: end")
    assert _closed(rows((0, 840), (900, 1740))) == rows((0, 840), (900, 1740)), "are in seconds"
    for spans in (
        ((0, 840), (900, 1800)),  # of two lengths
        ((0, 60), (120, 180)),  # every second minute
        ((0, 3600), (3660, 7260)),
        ((0, 840), (960, 1800)),
    ):
        assert _closed(day(*spans)) == day(*spans)
    # a count of the whole episode beside them keeps its end
    assert _closed(rows((0, 899), (900, 1799), (0, 1800))) == rows((0, 900), (900, 1800), (0, 1800))


def test_intervals_with_a_common_step_of_less_than_seconds_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "c.csv").write_text(
        "edge,count,begin_s,end_s\nwest1_A1,100,0,900\nwest1_A1,60,900.5,1800\n"
    )
    words = ["--grid", "1x1", "--counts", str(tmp_path / "c.csv"), "--duration-s", "1800"]
    assert main(["scenario", "new", str(tmp_path / "city"), *words]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "c.csv, line 3: the interval 900.5 to 1800 s" in said
    assert "no common step longer than 0.5 s" in said


def test_a_part_of_a_vehicle_outside_of_the_episode_is_not_told() -> None:
    rows = [Row(("a",), 10.0, 0.0, 3650.0, 2)]
    assert list(_outside(rows, Path("c.csv"), 0.0, 3600.0)) == []
    assert len(list(_outside(rows, Path("c.csv"), 0.0, 3000.0))) == 1


def test_columns_that_differ_in_case_are_one(tmp_path: Path) -> None:
    (tmp_path / "c.csv").write_text("edge,count,Count\na,5,700\n")
    with pytest.raises(ScenarioError, match="the column count is there twice"):
        read_rows(tmp_path / "c.csv", 0, 3600, Silent(), pairs=False)


@pytest.mark.parametrize("mark", ["\u2028", "\x85", "\x0c"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_names_may_hold_marks_that_end_lines_elsewhere(tmp_path: Path, mark: str, end: str) -> None:
    lines = ("street,edge,count", f"High{mark}Street,a,5", "Other,b,7", "")
    (tmp_path / "c.csv").write_bytes(end.join(lines).encode())
    rows = read_rows(tmp_path / "c.csv", 0, 3600, Silent(), pairs=False)
    assert [(row.roads, row.count, row.line) for row in rows] == [(("a",), 5, 2), (("b",), 7, 3)]


@pytest.mark.parametrize("kind", ["--counts", "--od"])
def test_the_flow_of_the_first_interval_fills_the_roads_before_it(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    ends = ("west1_A1", "A1_B1") if kind == "--counts" else ("west1_A1", "B1_east1")
    lines = [f"{','.join(ends)},600,25200,28800", f"{','.join(ends)},300,28800,32400"]
    (tmp_path / "c.csv").write_text("from,to,count,begin_s,end_s\n" + "\n".join(lines) + "\n")
    words = [kind, tmp_path / "c.csv", "--duration-s", "7800", "--begin-s"]
    assert made(tmp_path / "city", *words, "24600") == 0
    departs = [depart for depart, _ in drives(tmp_path / "city")]
    assert sum(depart < 25200 for depart in departs) == pytest.approx(100, abs=3)
    assert sum(25200 <= depart < 28800 for depart in departs) == pytest.approx(600, abs=12)
    assert len({depart // 60 for depart in departs if depart < 25200}) > 5  # not at once
    assert "fill the roads from 24600 to 25200 s" in capsys.readouterr().out
    if kind == "--counts":
        fits = (tmp_path / "city" / "counts-fit.csv").read_text(encoding="utf-8-sig")
        assert len(fits.splitlines()) == 3  # those vehicles are no counts
    assert made(tmp_path / "long", *words, "10000", "--duration-s", "30000") == 0
    assert "no vehicle drives before 25200 s" in capsys.readouterr().out
    assert min(depart for depart, _ in drives(tmp_path / "long")) >= 25200


def test_small_counts_are_spread_over_their_interval(tmp_path: Path) -> None:
    """Twelve turns with five vehicles each in an hour that is parted into sixths."""
    arms = ("west1", "east1", "northA", "southA")
    turns = [f"{here}_A1,A1_{there}" for here in arms for there in arms if here != there]
    rows = "".join(f"{turn},5,25200,28800\n" for turn in turns)
    (tmp_path / "c.csv").write_text(f"from,to,count,begin_s,end_s\n{rows}")
    words = ["--grid", "1x1", "--counts", str(tmp_path / "c.csv"), "--duration-s", "4200"]
    assert main(["scenario", "new", str(tmp_path / "city"), *words, "--begin-s", "24600"]) == 0
    found = Counter((depart - 25200) // 600 for depart, _ in drives(tmp_path / "city"))
    assert sum(found[part] for part in range(6)) == 60
    assert [found[part] for part in range(6)] == pytest.approx([10] * 6, abs=6)


def test_counts_that_are_spread_over_an_odd_time_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "c.csv").write_text("edge,count\nwest1_A1,60\n")
    assert made(tmp_path / "odd", "--counts", tmp_path / "c.csv", "--duration-s", "4200") == 0
    assert "are of the whole episode, 4200 s" in capsys.readouterr().out
    assert made(tmp_path / "hour", "--counts", tmp_path / "c.csv") == 0
    assert "whole episode" not in capsys.readouterr().out


@pytest.mark.parametrize("road", [False, True])
def test_turns_without_a_count_are_counted(
    road: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A filter in the spreadsheet may have dropped them; counts of roads alone have none."""
    rows = "edge,count\nwest1_A1,60\n" if road else "from,to,count\nwest1_A1,A1_B1,60\n"
    (tmp_path / "t.csv").write_text(rows)
    assert made(tmp_path / "city", "--counts", tmp_path / "t.csv", "--duration-s", "600") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert ("23 of 24 turns at lights have no count in t.csv" in said) is not road


def test_columns_that_are_not_read_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "t.csv").write_text("edge,count,Von,Bis\nA1_B1,20,07:00,08:00\n")
    assert made(tmp_path / "city", "--counts", tmp_path / "t.csv", "--duration-s", "600") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "note: t.csv: 2 columns ('von', 'bis') not read" in said
