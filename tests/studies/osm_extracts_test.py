"""Boxes of an extract: what a cut keeps, and scenarios of a seed."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

pytest.importorskip("osmium")

from studies.osm_extracts import Box, Extract, cut, main, read_extract
from ugat_marl.errors import OutputError, ScenarioError
from ugat_marl.scenarios import degrees_of_saturation, read_scenario

TOWN = Path(__file__).parents[1] / "fixtures" / "town.osm"
PLAN = """<osm version="0.6">
<node id="1" lon="0.001" lat="0.001"/><node id="2" lon="0.002" lat="0.001"/>
<node id="3" lon="0.009" lat="0.001"/><node id="4" lon="0.002" lat="0.002"/>
<node id="5" lon="0.001" lat="0.002"><tag k="highway" v="traffic_signals"/></node>
<way id="7"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="4"/><nd ref="5"/></way>
<way id="8"><nd ref="2"/><nd ref="3"/></way>
<way id="9"><nd ref="1"/><nd ref="5"/></way>
<relation id="1"><member type="way" ref="7" role="from"/><member type="way" ref="9" role="to"/>
<tag k="type" v="restriction"/></relation>
<relation id="2"><member type="way" ref="8" role="from"/><tag k="type" v="restriction"/></relation>
</osm>"""


def written(folder: Path) -> Extract:
    path = folder / "plan.osm"
    path.write_text(PLAN)
    return read_extract(path)


def test_a_cut_keeps_what_is_inside(tmp_path: Path) -> None:
    extract = written(tmp_path)
    assert extract.signals == ((0.001, 0.002),)
    cut(extract, Box(0.0, 0.0, 0.005, 0.005), tmp_path / "cut.osm")
    root = ET.parse(tmp_path / "cut.osm").getroot()
    assert [node.get("id") for node in root.iter("node")] == ["1", "2", "4", "5"]
    ways = {w.get("id"): [nd.get("ref") for nd in w.iter("nd")] for w in root.iter("way")}
    assert ways == {"7": ["1", "2"], "10": ["4", "5"], "9": ["1", "5"]}
    assert [relation.get("id") for relation in root.iter("relation")] == ["1"]


def test_a_box_is_as_large_as_asked_for_at_any_latitude() -> None:
    box = Box.around((25.0, 60.0), 400)
    assert (box.north - box.south) * 111_320 == pytest.approx(400)
    assert (box.east - box.west) * 111_320 * math.cos(math.radians(60)) == pytest.approx(400)
    assert box.overlaps(Box.around((25.002, 60.0), 400))
    assert not box.overlaps(Box.around((25.01, 60.0), 400))


@pytest.mark.slow
def test_the_same_seed_makes_the_same_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("studies.osm_extracts.INTERSECTIONS", (1, 10))
    monkeypatch.setattr("studies.osm_extracts.SIDES_M", (1500.0, 2000.0))
    monkeypatch.setattr("studies.osm_extracts.MOST_BOXES", 3)
    for part in "ab":
        words = [str(TOWN), "--seed", "2", "--out", str(tmp_path / part / "towns")]
        assert main([*words, "--count", "1"]) == 0
    folders = [tmp_path / part / "towns" / "town-1" for part in "ab"]
    first, second = ({f.name: f.read_bytes() for f in folder.iterdir()} for folder in folders)
    assert first == second
    assert 0.2 < max(degrees_of_saturation(read_scenario(folders[0])).values()) < 1.3


def test_boxes_that_do_not_fit_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("studies.osm_extracts.MOST_BOXES", 2)
    monkeypatch.setattr("studies.osm_extracts.INTERSECTIONS", (50, 60))
    words = [str(TOWN), "--seed", "2", "--out", str(tmp_path / "towns"), "--count", "1"]
    assert main(words) == 1
    out, err = capsys.readouterr()
    assert "box 0 is left out" in out
    assert "only 0 of 1 boxes" in err
    assert not (tmp_path / "towns").exists() or not list((tmp_path / "towns").iterdir())
    (tmp_path / "towns").mkdir(exist_ok=True)
    (tmp_path / "towns" / "notes.txt").touch()
    with pytest.raises(OutputError, match="holds something already"):
        main(words)


@pytest.mark.parametrize("place", ["", 'lat="500" lon="1"', 'lat="'])
def test_an_extract_that_is_damaged_is_an_error(tmp_path: Path, place: str) -> None:
    path = tmp_path / "damaged.osm"
    path.write_text(f'<osm version="0.6"><node id="1" {place}/></osm>')
    with pytest.raises(ScenarioError, match=r"damaged\.osm: not an OpenStreetMap extract"):
        read_extract(path)


def test_an_extract_without_lights_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "dark.osm"
    path.write_text(PLAN.replace("traffic_signals", "crossing"))
    with pytest.raises(ScenarioError, match="no node is a traffic light"):
        read_extract(path)
