"""Vehicles at two places: loops on every lane, and journeys read from events by hand."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from ugat_marl.errors import SimulatorError
from ugat_marl.scenarios import Network, read_scenario
from ugat_marl.simulation import Place, places_document, read_between

HERE, THERE, BEYOND = Place("S_C", math.inf), Place("C_N", 0.0), Place("C_N", 120.0)


def event(place: int, time: float, vehicle: str, state: str = "enter") -> str:
    return (
        f'<instantOut id="place{place}:x_0" time="{time:.2f}" state="{state}" vehID="{vehicle}" '
        'speed="5.00" length="5.00" type="car"/>'
    )


def test_vehicles_are_paired_by_name_and_in_order(tmp_path: Path) -> None:
    events = [
        event(0, 10.0, "a"), event(0, 11.0, "a", "leave"), event(1, 13.5, "a"),
        event(0, 20.0, "b"),  # never comes out
        event(1, 30.0, "c"),  # comes from elsewhere
        event(0, 40.0, "d"), event(1, 49.0, "d"), event(0, 400.0, "d"), event(1, 403.0, "d"),
        event(0, 3.0, "e"), event(1, 8.0, "e"),
        event(0, 895.0, "f"), event(1, 901.0, "f"),
    ]  # fmt: skip
    file = tmp_path / "places.xml"
    file.write_text("\n".join(events))
    (seen,) = read_between(file, [(HERE, THERE)], 5.0, 900.0)
    assert seen.tolist() == [[10.0, 3.5], [40.0, 9.0], [400.0, 3.0]]


def test_a_vehicle_that_stands_on_the_first_place_leaves_it_once(tmp_path: Path) -> None:
    events = [event(0, 10.0, "a"), event(0, 55.0, "a", "leave"), event(1, 60.0, "a")]
    file = tmp_path / "places.xml"
    file.write_text("\n".join(events))
    (seen,) = read_between(file, [(HERE, THERE)], 0.0, 900.0)
    assert seen.tolist() == [[10.0, 50.0]]


def test_a_vehicle_that_comes_round_is_timed_from_its_last_visit(tmp_path: Path) -> None:
    events = [event(0, 10.0, "a"), event(0, 200.0, "a"), event(1, 205.0, "a")]
    file = tmp_path / "places.xml"
    file.write_text("\n".join(events))
    (seen,) = read_between(file, [(HERE, THERE)], 0.0, 900.0)
    assert seen.tolist() == [[200.0, 5.0]]


def test_no_vehicles_are_no_rows(tmp_path: Path) -> None:
    file = tmp_path / "places.xml"
    file.write_text("<instantE1/>")
    assert [x.shape for x in read_between(file, [(HERE, THERE), (HERE, BEYOND)], 0, 9)] == [
        (0, 2),
        (0, 2),
    ]
    with pytest.raises(SimulatorError, match="places cannot be read"):
        read_between(tmp_path / "none.xml", [(HERE, THERE)], 0.0, 9.0)


def test_a_place_has_a_loop_on_every_lane_within_its_ends(data: Path, tmp_path: Path) -> None:
    lanes = Network.read(read_scenario(data / "crossing")).lanes
    document = places_document([(HERE, THERE), (HERE, BEYOND)], lanes, tmp_path / "places.xml")
    loops = {x.get("id"): x for x in ET.fromstring(document.read())}
    assert set(loops) == {"place0:S_C_0", "place1:C_N_0", "place2:C_N_0"}
    positions = {name: float(x.get("pos", "nan")) for name, x in loops.items()}
    assert positions["place0:S_C_0"] == pytest.approx(lanes["S_C_0"].length_m - 0.1, abs=1e-3)
    assert positions["place1:C_N_0"] == pytest.approx(0.1)
    assert positions["place2:C_N_0"] == pytest.approx(120.0)
