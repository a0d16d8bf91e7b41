"""Sheets of turning counts: names against the map, counts that come back, nothing that is lost."""

from __future__ import annotations

import csv
import gzip
import math
import shlex
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from ugat_marl.__main__ import main
from ugat_marl.effects import load_scenario
from ugat_marl.files import parse_xml
from ugat_marl.scenarios import (
    Lane,
    Link,
    approach_directions,
    geh_of,
    intersection_name,
    read_scenario,
)
from ugat_marl.scenarios.importers.count_sheet import is_filled, write_template
from ugat_marl.scenarios.street_names import heading_rad

TOWN = Path(__file__).parents[1] / "fixtures" / "town.osm"
COUNTS = {"left": 40, "through": 200, "right": 60}


def made(target: Path, *words: str | Path) -> int:
    return main(["scenario", "new", str(target), "--osm", str(TOWN), *map(str, words)])


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        return list(csv.DictReader(file))


def fill_in(path: Path, **changes: str) -> None:
    """Write the count of each turn, or of `changes`, as a spreadsheet of a German would."""
    rows = rows_of(path)
    for row in rows:
        row["count"] = changes.get(row["turn"], str(COUNTS[row["turn"]]))
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), delimiter=";")
        writer.writeheader()
        writer.writerows(rows)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("sheet") / "town"
    assert made(target) == 0
    return target


@pytest.fixture
def draft(original: Path, tmp_path: Path) -> Path:
    return shutil.copytree(original, tmp_path / "town")


def test_a_sheet_names_every_turn_as_on_the_map(draft: Path) -> None:
    rows = rows_of(draft / "counts.csv")
    assert len(rows) == 2 * 4 * 3  # two crossroads; the light at a crossing has no turns
    assert all(row["count"] == row["begin_s"] == row["end_s"] == "" for row in rows)
    names = {
        (row["light"], row["street"], row["approach"], row["turn"]): row["to_street"]
        for row in rows
    }
    assert len(names) == len(rows)
    # Long Road runs from west to east and Cross Street from south to north, by their coordinates.
    assert names["cluster_2_5", "Long Road", "eastbound", "left"] == "Cross Street"
    assert names["cluster_2_5", "Cross Street", "southbound", "left"] == "Long Road"
    assert names["9", "Upper Street", "westbound", "through"] == "Upper Street"
    ways = {(row["approach"], row["turn"]): row for row in rows if row["light"] == "cluster_2_5"}
    assert ways["eastbound", "left"]["from"] == "1000#0"  # the carriageway to the east
    assert ways["eastbound", "left"]["to"] == ways["northbound", "through"]["to"] == "1002#2"
    assert ways["westbound", "right"]["to"] == "1002#2"
    assert {row["intersection"] for row in rows} == {
        "Long Road / Cross Street", "Cross Street / Upper Street",
    }  # fmt: skip


def test_the_lights_are_drawn(original: Path) -> None:
    assert {path.name for path in (original / "pictures").iterdir()} == {
        f"{name}.{end}" for name in ("network", "9", "cluster_2_5") for end in ("png", "svg")
    }
    text = (original / "README.md").read_text()
    assert "no vehicles yet" in text
    assert f"--counts {original}/counts.csv" in text


def test_counts_come_back_with_their_geh(draft: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fill_in(draft / "counts.csv", right="0")
    filled = (draft / "counts.csv").read_bytes()
    assert made(draft, "--counts", draft / "counts.csv") == 0
    assert "24 of 24 counts of counts.csv are met" in capsys.readouterr().out
    passed: Counter[tuple[str, str]] = Counter()
    for route in read_scenario(draft).routes[0].parse().iter("route"):
        edges = route.get("edges", "").split()
        passed.update(zip(edges, edges[1:], strict=False))
    fits = rows_of(draft / "counts-fit.csv")
    assert len(fits) == 24
    for fit in fits:
        c, m = float(fit["counted"]), float(fit["driven"])
        assert c == {"left": 40, "through": 200, "right": 0}[fit["turn"]]
        assert m == passed[fit["from"], fit["to"]]
        wanted = math.sqrt(2 * (m - c) ** 2 / (m + c)) if m + c else 0.0
        assert float(fit["geh"]) == pytest.approx(wanted, abs=0.005)
    assert (draft / "counts.csv").read_bytes() == filled
    assert len([*(draft / "pictures").iterdir()]) > 0, "the lights are drawn again"
    assert made(draft, "--counts", draft / "counts.csv", "--force") == 0
    assert (draft / "pictures").is_dir(), "also where vehicles are made once more"


def test_drawings_show_the_phases_of_the_scenario(draft: Path, tmp_path: Path) -> None:
    before = (draft / "pictures" / "9.png").read_bytes()
    fill_in(draft / "counts.csv", right="0")
    words = ["--counts", draft / "counts.csv", "--duration-s", "600", "--phases", "conflict-free"]
    assert made(draft, *words) == 0
    assert main(["scenario", "draw", str(draft), "--out", str(tmp_path / "afresh")]) == 0
    for drawing in (tmp_path / "afresh").glob("*.png"):
        assert (draft / "pictures" / drawing.name).read_bytes() == drawing.read_bytes()
    assert (draft / "pictures" / "9.png").read_bytes() != before


def test_counts_that_cannot_all_be_met_come_first(
    draft: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What leaves the lower crossroads to the north has to arrive at the upper one."""
    monkeypatch.setenv("COLUMNS", "100")
    rows = rows_of(draft / "counts.csv")
    wanted = {("1002#0", "1002#2"): 900, ("1002#3", "1002#4"): 100}
    text = "from,to,count\n" + "".join(
        f"{row['from']},{row['to']},{wanted.get((row['from'], row['to']), '')}\n" for row in rows
    )
    text += "1002#3,-1003#0,0\n1002#3,1003#1,0\n1002#2,1002#3,100\n"
    (draft / "counts.csv").write_text(text)
    assert made(draft, "--counts", draft / "counts.csv") == 0
    out = capsys.readouterr().out
    shown = [line for line in out.splitlines() if "Cross Street, northbound" in line]
    assert "900" in shown[0] and "through" in shown[0]
    assert "4 of 5 counts" in out or "3 of 5 counts" in out


def test_blank_rows_are_not_counted(draft: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sheet = draft / "counts.csv"
    assert made(draft, "--counts", sheet) == 2
    assert "no row counts a vehicle; fill in the column count" in capsys.readouterr().err
    fill_in(sheet, left="", right=" ")
    assert made(draft, "--counts", sheet) == 0
    assert len(rows_of(draft / "counts-fit.csv")) == 8


def test_filled_sheets_are_never_lost(draft: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fill_in(draft / "counts.csv")
    before = (draft / "counts.csv").read_bytes()
    for words in ((), ("--vph", "300"), ("--vph", "300", "--force")):
        assert made(draft, *words) == 2
        assert f"{draft / 'counts.csv'} would be lost" in capsys.readouterr().err
        assert (draft / "counts.csv").read_bytes() == before
    (draft / "survey.xlsx").write_text("other work")
    assert made(draft, "--counts", draft / "counts.csv") == 2
    assert "survey.xlsx was not made with the sheet of counts" in capsys.readouterr().err
    (draft / "survey.xlsx").unlink()
    assert made(draft, "--counts", draft / "counts.csv") == 0
    assert made(draft, "--vph", "300", "--force") == 2
    assert "would be lost" in capsys.readouterr().err
    assert made(draft, "--force") == 2, "a blank sheet in place of a filled one"
    assert "would be lost" in capsys.readouterr().err
    another = draft.parent / "another.csv"
    another.write_bytes(before.replace(b"200", b"210"))
    for number in (1, 2):
        held = (draft / "counts.csv").read_bytes()
        assert made(draft, "--counts", another, "--force") == 0
        assert (draft / "counts.csv").read_bytes() == another.read_bytes()
        assert (draft / f"counts-before-{number}.csv").read_bytes() == held
        another.write_bytes(held.replace(b"200", b"190"))
    assert (draft / "counts-before-1.csv").read_bytes() == before


@pytest.mark.parametrize(
    "name",
    [".git/HEAD", ".notes.md", "counts-before.csv", "old/counts-before-1.csv", "old/README.md",
     "pictures/crossing.png", "pictures/9.jpg", "pictures/old/9.png", "network.net.xml.gz"],
)  # fmt: skip
def test_files_beside_a_draft_are_never_lost(
    name: str, draft: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fill_in(draft / "counts.csv")
    (draft / name).parent.mkdir(exist_ok=True)
    (draft / name).write_text("other work")
    assert made(draft, "--counts", draft / "counts.csv") == 2
    assert "was not made with the sheet of counts, and would be lost" in capsys.readouterr().err
    assert (draft / name).read_text() == "other work"


def test_a_folder_with_counts_of_its_own_is_no_draft(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ("README.md", "counts.csv", "pictures/crossing.jpg")
    (tmp_path / "own" / "pictures").mkdir(parents=True)
    for name in names:
        (tmp_path / "own" / name).write_text("street,count\n")
    assert made(tmp_path / "own", "--vph", "300") == 2
    assert "exists and is not a scenario" in capsys.readouterr().err
    assert all((tmp_path / "own" / name).is_file() for name in names)


def test_replaced_sheets_and_what_a_file_manager_leaves_are_no_obstacle(draft: Path) -> None:
    """The name of a sheet that was replaced is a new one, even if earlier ones were deleted."""
    fill_in(draft / "counts.csv")
    assert made(draft, "--counts", draft / "counts.csv") == 0
    (draft / "pictures" / ".DS_Store").touch()
    (draft / "counts-before-2.csv").write_text("an earlier one")
    before = (draft / "counts.csv").read_bytes()
    another = draft.parent / "another.csv"
    for number, counted in ((1, b"210"), (3, b"190")):
        held = (draft / "counts.csv").read_bytes()
        another.write_bytes(before.replace(b"200", counted))
        assert made(draft, "--counts", another, "--force") == 0
        assert (draft / f"counts-before-{number}.csv").read_bytes() == held
    assert (draft / "counts-before-2.csv").read_text() == "an earlier one"


@pytest.mark.parametrize(
    ("name", "words"),
    [("x.net.xml", []), ("x.net.xml.gz", []), ("x.net.xml", ["--link"])],
)
def test_the_printed_command_makes_the_scenario(
    name: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = load_scenario("single-v1").network.read()
    packed = gzip.compress(content) if name.endswith(".gz") else content
    (tmp_path / name).write_bytes(packed)
    town = tmp_path / "town"
    given = ["scenario", "new", str(town), "--sumo", str(tmp_path / name), *words]
    assert main(given) == 0
    printed = capsys.readouterr().out.partition("next: ugat-marl ")[2].partition(" (or")[0]
    assert main(["scenario", "check", str(town)]) == 2
    assert f"no vehicles yet; fill in {town / 'counts.csv'}" in capsys.readouterr().err
    drawn = {path.name for path in (town / "pictures").iterdir()}
    fill_in(town / "counts.csv")
    assert main(shlex.split(printed)) == 0
    scenario = read_scenario(town)
    assert (scenario.network.name, scenario.network.read()) == (name, content)
    assert {path.name for path in (town / "pictures").iterdir()} == drawn
    assert (town / name).exists() is not bool(words)
    assert (tmp_path / name).read_bytes() == packed


def test_a_draft_whose_linked_network_has_moved_is_made_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Which pictures are of its lights cannot be told then."""
    network = tmp_path / "x.net.xml"
    network.write_bytes(load_scenario("single-v1").network.read())
    words = ["scenario", "new", str(tmp_path / "town"), "--link", "--sumo"]
    assert main([*words, str(network)]) == 0
    moved = network.rename(tmp_path / "moved.net.xml")
    assert main([*words, str(moved)]) == 2
    assert "pictures/A1.png was not made with" in capsys.readouterr().err
    (tmp_path / "town" / "pictures").rename(tmp_path / "pictures")
    assert main([*words, str(moved)]) == 0


@pytest.mark.parametrize("head", ["sep=,\n", " ", "my "])
def test_sheets_with_another_head_are_never_lost(
    head: str, draft: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sheet = draft / "counts.csv"
    fill_in(sheet)
    text = sheet.read_text(encoding="utf-8-sig")
    sheet.write_text(
        head + text if head.startswith("sep") else text.replace("count", f"{head}count")
    )
    assert made(draft, "--force") == 2
    assert f"{sheet} would be lost" in capsys.readouterr().err


def test_a_draft_replaces_a_scenario_if_asked(
    draft: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert made(draft, "--vph", "300") == 0
    assert made(draft) == 2
    assert "--force replaces it" in capsys.readouterr().err
    assert made(draft, "--force") == 0
    assert not (draft / "scenario.toml").exists()


def test_a_folder_without_vehicles_says_what_is_missing(
    draft: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["scenario", "check", str(draft)]) == 2
    assert f"no vehicles yet; fill in {draft / 'counts.csv'}" in capsys.readouterr().err


def test_errors_name_files_that_exist(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "c.csv").write_text("edge,count\n1002#00,1\n")
    assert made(tmp_path / "a", "--counts", tmp_path / "c.csv") == 2
    text = capsys.readouterr().err
    assert f"'1002#00' is not a road for cars of {TOWN}; did you mean '1002#0'?" in text
    words = ["--grid", "1x1", "--counts", str(tmp_path / "c.csv")]
    assert main(["scenario", "new", str(tmp_path / "a"), *words]) == 2
    assert "not a road for cars of this network; scenario new without" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


def test_a_grid_has_a_sheet_too(tmp_path: Path) -> None:
    assert main(["scenario", "new", str(tmp_path / "g"), "--grid", "1x1"]) == 0
    rows = rows_of(tmp_path / "g" / "counts.csv")
    ways = {(row["approach"], row["turn"]): row["to"] for row in rows}
    assert ways["eastbound", "through"] == "A1_east1"
    assert ways["southbound", "left"] == "A1_east1"
    assert {row["street"] for row in rows} == {""}


def test_names_that_a_spreadsheet_would_run_are_texts(tmp_path: Path) -> None:
    text = TOWN.read_text().replace("Long Road", '=HYPERLINK("http://x")'.replace('"', "&quot;"))
    (tmp_path / "t.osm").write_text(text)
    assert main(["scenario", "new", str(tmp_path / "a"), "--osm", str(tmp_path / "t.osm")]) == 0
    rows = rows_of(tmp_path / "a" / "counts.csv")
    streets = {row[key] for row in rows for key in ("street", "to_street", "intersection")}
    assert any("=HYPERLINK" in street for street in streets)
    assert not any(street.startswith("=") for street in streets)


# --- directions ----------------------------------------------------------------------------------


def arms(*degrees: float) -> tuple[list[Link], dict[str, Lane]]:
    """Roads that end at the origin, by the compass direction of travel."""
    lanes = {
        f"e{n}_0": Lane(
            f"e{n}_0", f"e{n}", 100, 10,
            ((-100 * math.sin(math.radians(d)), -100 * math.cos(math.radians(d))), (0.0, 0.0)),
        )
        for n, d in enumerate(degrees)
    }  # fmt: skip
    return [Link(n, f"e{n}_0", "out_0", "s") for n in range(len(degrees))], lanes


@pytest.mark.parametrize(
    ("degrees", "names"),
    [
        ((0, 90, 180, 270), ("northbound", "eastbound", "southbound", "westbound")),
        ((30, 120, 210, 300), ("northbound", "eastbound", "southbound", "westbound")),
        ((350, 170, 80), ("northbound", "southbound", "eastbound")),
        ((0, 40, 180), ("northbound", "eastbound", "southbound")),  # no name twice
        (  # southbound would not be northbound for a fourth
            (90, 140, 180, 230),
            ("eastbound", "southeastbound", "southbound", "southwestbound"),
        ),
        (
            (0, 90, 180, 270, 45),
            ("northbound", "eastbound", "southbound", "westbound", "northeastbound"),
        ),
        (tuple(range(0, 360, 36)), None),
    ],
)
def test_approaches_are_named_together(degrees: tuple[float, ...], names: object) -> None:
    links, lanes = arms(*degrees)
    found = tuple(approach_directions(links, lanes).values())
    if names is None:  # more roads than names
        assert len(found) == 10 and len(set(found)) == 8
    else:
        assert found == names


def test_names_do_not_depend_on_the_order_of_links() -> None:
    """The sheet reads links as the file has them, and plans in the order of their indices."""
    links, lanes = arms(90, 90, 0, 180, 270)
    for order in (links, links[::-1]):
        named = approach_directions(order, lanes)
        assert named["e0"] == approach_directions(links, lanes)["e0"]
        assert len(set(named.values())) == 5


def test_the_last_metres_of_a_road_count() -> None:
    assert heading_rad(((0, 0), (100, 0), (100, 29), (101, 40))) == pytest.approx(0, abs=0.05)
    assert math.degrees(heading_rad(((0, 0), (5, 0)))) == pytest.approx(90)


@pytest.mark.parametrize("between", [(), ((295, 0),), ((290, 0), (299, 0))])
def test_points_within_a_straight_part_change_no_direction(
    between: tuple[tuple[float, float], ...],
) -> None:
    """The last 30 m are 5 m to the east and 25 m to the north."""
    heading = heading_rad(((0, 0), *between, (300, 0), (300, 25)))
    assert heading == pytest.approx(math.atan2(5, 25))


def test_an_intersection_is_named_by_its_streets() -> None:
    links = [Link(0, "a_0", "b_0", "s"), Link(1, "c_0", "b_0", "r")]
    assert intersection_name(links, {"a": "Mill Lane", "b": "High Street"}) == (
        "High Street / Mill Lane"
    )
    assert intersection_name(links, {}) == ""


def test_geh_is_that_of_the_handbook() -> None:
    """TAG unit M3.1: GEH = sqrt((m - c)^2 / ((m + c) / 2))."""
    c, m = np.array([1000.0, 0.0, 50.0]), np.array([1100.0, 0.0, 50.0])
    assert geh_of(c, m) == pytest.approx([math.sqrt(100**2 / 1050), 0.0, 0.0])


def test_a_light_without_turns_needs_no_row(tmp_path: Path) -> None:
    root = parse_xml(
        b'<net><edge id="a" from="x" to="y"><lane id="a_0" length="9" speed="9" '
        b'shape="0,0 0,9"/></edge><edge id="b" from="y" to="z"><lane id="b_0" length="9" '
        b'speed="9" shape="0,9 0,18"/></edge>'
        b'<connection from="a" to="b" fromLane="0" toLane="0" tl="y" linkIndex="0" dir="s"/></net>',
        "net",
    )
    assert write_template(tmp_path / "t.csv", root) == 0


def test_a_street_name_with_a_semicolon_hides_no_count(tmp_path: Path) -> None:
    sheet = tmp_path / "counts.csv"
    sheet.write_text("street,count,from,to\nMain St;Route 5,12,a,b\n")
    assert is_filled(sheet)
    sheet.write_text("street,count,from,to\nMain St;Route 5,,a,b\n")
    assert not is_filled(sheet)
    sheet.write_text("street;count;from;to\nMain St;7;a;b\n")
    assert is_filled(sheet)


def test_roads_inside_a_light_leave_the_main_directions_to_those_that_lead_to_it() -> None:
    """A wide dual carriageway: two roads lie between junctions of one light."""
    east, north, west = (100.0, 0.0), (0.0, 100.0), (-100.0, 0.0)
    lanes = {
        f"{edge}_0": Lane(f"{edge}_0", edge, 100, 10, ((-x, -y), (0.0, 0.0)))
        for edge, (x, y) in {"in_e": east, "in_n": north, "mid_e": east, "mid_w": west}.items()
    }
    ways = ("in_e", "mid_e"), ("mid_e", "out_e"), ("in_n", "mid_w"), ("mid_w", "out_w")
    links = [Link(n, f"{a}_0", f"{b}_0", "s") for n, (a, b) in enumerate(ways)]
    named = approach_directions(links, lanes)
    assert [named[edge] for edge in ("in_e", "in_n", "mid_w")] == [
        "eastbound",
        "northbound",
        "westbound",
    ]
    assert len(set(named.values())) == 4


def test_a_sheet_asks_for_no_turns_that_cars_cannot_make(tmp_path: Path) -> None:
    root = load_scenario("single-v1").network.parse()
    before = write_template(tmp_path / "all.csv", root)
    for lane in root.iter("lane"):
        if lane.get("id") == "east1_A1_2":  # the lane of left turns
            lane.set("allow", "bus")
    assert write_template(tmp_path / "cars.csv", root) == before - 1
    assert "east1_A1,A1_southA" not in (tmp_path / "cars.csv").read_text(encoding="utf-8-sig")
