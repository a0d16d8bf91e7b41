"""Zones on several lanes: one event for vehicles side by side, in data and in simulations."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import CSV_HASHES, read_measured, write_measured
from ugat_marl.data.measured.counts import counts_of
from ugat_marl.data.measured.passages import passages_as_written
from ugat_marl.data.measured.tables import ROW
from ugat_marl.data.measured.values import Finding
from ugat_marl.data.measured.writing import require_replaceable
from ugat_marl.diagnosis.features import DetectorLayout
from ugat_marl.effects import load_scenario
from ugat_marl.errors import MeasuredDataError, OutputError
from ugat_marl.experiments import policy_factory, record
from ugat_marl.scenarios import Detector, Network, Passages, Period, Scenario
from ugat_marl.simulation import detectors_document, read_passages

NAN = np.nan
FLOATS = {"occupancy": pl.Float64, "mean_speed_mps": pl.Float64}


def seen(*rows: tuple[float, float, float, float]) -> Passages:
    return Passages(*np.array(rows, dtype=np.float64).T)


ZONE = Detector("wide", "a_0", 20.0, 4.0, "stop", None, "signals", ("a_1",))


def event(loop: str, time: float, state: str, vehicle: str) -> str:
    return (
        f'<instantOut id="{loop}" time="{time:.2f}" state="{state}" vehID="{vehicle}" '
        'speed="5.00" length="5.00" type="car"/>'
    )


def over_the_zone(folder: Path, rows: list[str]) -> Passages:
    """What is read of events at the loops of `ZONE`."""
    (folder / "loops.xml").write_text("\n".join(rows))
    return read_passages(folder / "loops.xml", [ZONE], 0.0, 100.0, 0.0)["wide"]


def test_vehicles_side_by_side_are_one_passage() -> None:
    left = seen((NAN, 3.0, 4.0, 5.0), (10.0, 12.0, 8.0, 5.0), (30.0, 31.0, 9.0, 6.0))
    right = seen((11.0, 14.0, 12.0, 4.0), (14.0, 15.0, NAN, 4.0), (40.0, NAN, 7.0, 4.0))
    both = Passages.together([left, right])
    np.testing.assert_array_equal(both.on_s, [NAN, 10.0, 14.0, 30.0, 40.0])
    np.testing.assert_array_equal(both.off_s, [3.0, 14.0, 15.0, 31.0, NAN])
    np.testing.assert_array_equal(both.speed_mps, [4.0, 10.0, NAN, 9.0, 7.0])
    np.testing.assert_array_equal(both.length_m, [5.0, NAN, 4.0, 6.0, 4.0])


def test_a_zone_on_two_lanes_counts_twice_as_many_vehicles_as_one() -> None:
    day = Period("day", 0.0, 100.0, "fit", {}, {})
    row = {"period_id": "day", "begin_s": 0.0, "end_s": 100.0, "detector_id": "wide"}
    cells = row | {"occupancy": None, "mean_speed_mps": None, ROW: 1}

    def findings(zone: Detector, count: float) -> list[Finding]:
        found: list[Finding] = []
        frame = pl.DataFrame([cells | {"count": count}], schema_overrides=FLOATS)
        counts_of(Path("counts.csv"), frame, [day], [zone], found)
        return found

    assert not findings(ZONE, 120.0)
    assert "more than a lane serves" in findings(ZONE, 150.0)[0].text
    with pytest.raises(MeasuredDataError, match="more than one vehicle per second and lane"):
        findings(replace(ZONE, beside=()), 150.0)


def test_a_vehicle_that_stays_until_the_end_hides_all_behind_it() -> None:
    both = Passages.together([seen((5.0, np.inf, 1.0, 5.0)), seen((7.0, 8.0, 3.0, 5.0))])
    np.testing.assert_array_equal(both.on_s, [5.0])
    np.testing.assert_array_equal(both.off_s, [np.inf])
    assert not len(Passages.together([Passages.none(), Passages.none()]))


def test_a_vehicle_that_changes_lanes_over_a_zone_hides_nobody() -> None:
    """One leaves unseen, another comes unseen; the rest is as it was."""
    times = np.arange(10.0, 610.0, 10.0)
    lane = seen(*((t, t + 0.5, 9.0, 5.0) for t in times))
    left, came = seen((203.0, NAN, 9.0, 5.0)), seen((-np.inf, 405.0, 9.0, NAN))
    both = Passages.together([lane, left, came])
    assert len(both) == 62
    assert both.on_s[[20, 41]].tolist() == [203.0, -np.inf]
    assert np.isnan(both.off_s[20]) and both.off_s[41] == 405.0
    inside = Passages.together([lane, seen((200.2, NAN, 9.0, 5.0))])
    assert len(inside) == 60, "within another's time it is the same event"


def test_loops_know_who_left_unseen_and_who_is_still_there(tmp_path: Path) -> None:
    rows = [
        event("wide", 10.0, "enter", "leaves its lane"),
        event("wide@1@end", 12.0, "leave", "leaves its lane"),
        event("wide@1", 20.0, "enter", "b"), event("wide@1@end", 21.0, "leave", "b"),
        event("wide", 30.0, "enter", "stays"), event("wide", 31.0, "leave", "stays"),
        event("wide@1", 40.0, "enter", "c"), event("wide@1@end", 41.0, "leave", "c"),
    ]  # fmt: skip
    found = over_the_zone(tmp_path, rows)
    np.testing.assert_array_equal(found.on_s, [10.0, NAN, 20.0, 30.0])
    np.testing.assert_array_equal(found.off_s, [NAN, 12.0, 21.0, NAN])


@pytest.mark.parametrize("name", ["", ".."])
def test_the_folder_in_use_is_not_replaced(name: str) -> None:
    with pytest.raises(OutputError, match="is a folder in use"):
        require_replaceable(Path(name))


def test_a_zone_has_loops_on_each_of_its_lanes(tmp_path: Path) -> None:
    loops = ET.fromstring(detectors_document([ZONE], None, tmp_path / "x").read())
    assert [(x.get("id"), x.get("lane"), float(x.get("pos", 0))) for x in loops] == [
        ("wide", "a_0", 20.0), ("wide@end", "a_0", 24.0),
        ("wide@1", "a_1", 20.0), ("wide@1@end", "a_1", 24.0),
    ]  # fmt: skip


def test_events_of_both_lanes_are_one_stream(tmp_path: Path) -> None:
    rows = [
        event("wide", 10.0, "enter", "a"), event("wide@end", 12.0, "leave", "a"),
        event("wide@1", 11.0, "enter", "b"), event("wide@1@end", 13.0, "leave", "b"),
        event("wide@1", 20.0, "enter", "c"), event("wide@1@end", 21.0, "leave", "c"),
    ]  # fmt: skip
    found = over_the_zone(tmp_path, rows)
    assert found.on_s.tolist() == [10.0, 20.0]
    assert found.off_s.tolist() == [13.0, 21.0]


@pytest.fixture(scope="module")
def wide() -> Scenario:
    return load_scenario("single-v1").with_duration(300)


def test_a_zone_is_written_read_and_simulated(wide: Scenario, tmp_path: Path) -> None:
    network = Network.read(wide)
    measured = record(wide, "sim", policy_factory("fixed-time:30"), periods=1, seed=3)
    by_lane = {d.lane: d for d in measured.detectors if d.kind == "stop"}
    edge = network.intersections[0].incoming_lanes[0].rpartition("_")[0]
    lanes = sorted(lane for lane in by_lane if lane.startswith(f"{edge}_"))
    assert len(lanes) > 1
    first = by_lane[lanes[0]]
    zone = replace(first, id="zone", beside=tuple(lanes[1:]))
    (day,) = measured.periods
    union = Passages.together(
        [day.passages[by_lane[x].id] for x in lanes if by_lane[x].id in day.passages]
    )
    union = passages_as_written(union, *day.window)
    others = tuple(d for d in measured.detectors if d.lane not in lanes or d.kind != "stop")
    passages = {d.id: day.passages[d.id] for d in others if d.id in day.passages}
    given = replace(
        measured,
        detectors=(*others, zone),
        periods=(replace(day, passages={**passages, "zone": union}),),
    )
    written = write_measured(given, tmp_path / "street", csv=True)
    read = read_measured(written, wide, network)
    assert read.detectors[-1].lanes == tuple(lanes)
    assert read.hash == given.hash != replace(given, detectors=(*others, first)).hash
    assert len(read.periods[0].passages["zone"]) > 0.8 * len(union)
    layout = DetectorLayout.of(network, read.detectors)
    assert all(layout.lanes[i].edge != edge for lanes_of in layout.approaches for i in lanes_of)
    (written / CSV_HASHES).unlink()
    table = (written / "detectors.csv").read_text()
    for wrong, message in (
        (f"{lanes[0]} {lanes[0]}", "names each lane of one road once"),
        (f"{lanes[0]} {others[0].lane if edge not in others[0].lane else others[-1].lane}", "road"),
        (f"{lanes[0]} nowhere_7", "'nowhere_7', which the network does not have"),
    ):
        (written / "detectors.csv").write_text(table.replace(" ".join(lanes), wrong))
        with pytest.raises(MeasuredDataError, match=message):
            read_measured(written, wide, network)
