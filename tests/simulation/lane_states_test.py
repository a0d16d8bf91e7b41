"""States of lanes, read from SUMO's means by hand."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from ugat_marl.errors import SimulatorError
from ugat_marl.simulation import lane_states_document, read_lane_states


def test_seconds_and_metres_of_each_lane(tmp_path: Path) -> None:
    (tmp_path / "lanes.xml").write_text(
        '<meandata><interval begin="0" end="900" id="lanes"><edge id="a">'
        '<lane id="a_0" sampledSeconds="200.00" waitingTime="40.00" speed="3.00"/>'
        '<lane id="a_1" sampledSeconds="10.00" waitingTime="0.00" speed="12.00"/>'
        "</edge></interval></meandata>"
    )
    states = read_lane_states(tmp_path / "lanes.xml", ("b_0", "a_0"))
    assert states.tolist() == [[0.0, 0.0, 0.0], [200.0, 40.0, 600.0]]


def test_a_file_that_is_not_there_or_cut_short_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SimulatorError, match="states of lanes cannot be read"):
        read_lane_states(tmp_path / "none.xml", ("a_0",))
    (tmp_path / "cut.xml").write_text("<meandata><inter")
    with pytest.raises(SimulatorError, match="states of lanes cannot be read"):
        read_lane_states(tmp_path / "cut.xml", ("a_0",))


def test_the_whole_period_is_asked_for(tmp_path: Path) -> None:
    (asked,) = ET.fromstring(lane_states_document(600.0, 1500.0, tmp_path / "x").read())
    assert (asked.tag, asked.get("begin"), asked.get("end")) == ("laneData", "600.0", "1500.0")
