"""Errors of measurement on periods made by hand: times, zones, pulses, splash, and their places."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ugat_marl.effects import (
    DetectorExtension,
    DetectorOffset,
    DetectorPulse,
    DetectorSpeeds,
    DetectorSplash,
    DetectorZone,
    detectors_at,
    installed_detectors,
    load_scenario,
    measurement_effects,
    next_detectors,
    parse_domain,
)
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.scenarios import Detector, Passages, Period
from ugat_marl.simulation import read_passages

NAN = float("nan")
DETECTORS = (
    Detector("far", "in_0", 50.0, 2.0, "advance"),
    Detector("far left", "in_1", 50.0, 2.0, "advance"),
    Detector("line", "in_0", 95.0, 2.0, "stop"),
    Detector("other", "side_0", 40.0, 0.0, "advance"),
)


def passages(on: list[float], off: list[float]) -> Passages:
    numbers = np.arange(len(on), dtype=np.float64)
    return Passages(np.array(on), np.array(off), numbers, 4.0 + numbers)


def period(**at: Passages) -> Period:
    return Period("day", 0, 3600, "fit", {}, {name.replace("_", " "): x for name, x in at.items()})


def times(day: Period, name: str) -> list[tuple[float, float]]:
    found = day.passages.get(name, Passages.none())
    return list(zip(found.on_s.tolist(), found.off_s.tolist(), strict=True))


@pytest.mark.parametrize(
    ("place", "names"),
    [
        ("*", {"far", "far left", "line", "other"}),
        ("advance", {"far", "far left", "other"}),
        ("advance@in", {"far", "far left"}),
        ("line", {"line"}),
    ],
)
def test_places(place: str, names: set[str]) -> None:
    assert detectors_at(place, DETECTORS) == names


def test_an_unknown_place_is_an_error_that_lists_the_places() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown detectors 'exit'.*Known: .*advance@in"):
        DetectorOffset("exit", 3).installed(DETECTORS)


def test_the_zones_lie_elsewhere() -> None:
    effects = [DetectorOffset("advance@in", -18), DetectorZone("far", 4), DetectorZone("*", -3)]
    true = installed_detectors(effects, DETECTORS)
    assert [(x.position_m, x.length_m) for x in true] == [(32, 3), (32, 0), (95, 0), (40, 0)]
    assert DetectorOffset("other", -60).installed(DETECTORS)[3].position_m == 0  # the lane begins


def test_speeds_are_measured_elsewhere() -> None:
    true = installed_detectors([DetectorSpeeds("stop", "front")], DETECTORS)
    assert [x.speed_at for x in true] == [None, None, "front", None]


@pytest.mark.parametrize(("point", "speed"), [("rear", 8.0), ("front", 4.0), ("mean", 6.0)])
def test_loops_report_the_speed_at_a_point(tmp_path: Path, point: str, speed: float) -> None:
    file = tmp_path / "loops.xml"
    row = '<instantOut id="a" time="{}" state="{}" vehID="v" speed="{}" length="5.00" />\n'
    file.write_text(row.format("1.00", "enter", "4.00") + row.format("2.00", "leave", "8.00"))
    detector = Detector("a", "in_0", 5.0, 0.0, "stop")
    effect = DetectorSpeeds("a", point)  # pyright: ignore[reportArgumentType]
    seen = read_passages(file, effect.installed([detector]), 0.0, 10.0, 1.0)["a"]
    assert seen.speed_mps.tolist() == [speed]


def test_an_extension_moves_ends_alone() -> None:
    day = period(far=passages([10, 20, NAN], [11, NAN, 3.0]))
    after = DetectorExtension("far", 1.5, "split").observe(day, DETECTORS, {})
    assert np.allclose(
        np.array(times(after, "far")), [(10, 12.5), (20, NAN), (NAN, 4.5)], equal_nan=True
    )


def test_an_extension_merges_vehicles_that_follow_closely() -> None:
    day = period(far=passages([10, 12, 14.5, 20], [11, 13, 15, 21]))
    split = DetectorExtension("far", 1.0, "split").observe(day, DETECTORS, {})
    merged = DetectorExtension("far", 1.0, "merged").observe(day, DETECTORS, {})
    assert times(split, "far") == [(10, 12), (12, 14), (14.5, 16), (20, 22)]
    assert times(merged, "far") == [(10, 14), (14.5, 16), (20, 22)]
    assert merged.passages["far"].length_m.tolist() == [4, 6, 7]
    whole = DetectorExtension("far", 9.0, "merged").observe(day, DETECTORS, {})
    assert times(whole, "far") == [(10, 30)]
    stands = period(far=passages([10, 12, 17], [19, 13, 18]))
    merged = DetectorExtension("far", 1.0, "merged").observe(stands, DETECTORS, {})
    assert times(merged, "far") == [(10, 20)], "who came before the others and leaves after them"


def test_an_extension_is_taken_off_again() -> None:
    day = period(far=passages([10, 20, NAN], [11, NAN, 3.0]))
    longer = DetectorExtension("far", 1.5, "split")
    again = longer.undone(longer.observe(day, DETECTORS, {}), DETECTORS)
    assert np.allclose(np.array(times(again, "far")), np.array(times(day, "far")), equal_nan=True)
    short = period(far=passages([10], [10.5]))
    assert times(longer.undone(short, DETECTORS), "far") == [(10, 10)]


def test_a_delay_moves_begins_and_hides_short_passages() -> None:
    day = period(far=passages([10, 20], [10.4, 23]))
    after = DetectorExtension("far", -0.5, "split").observe(day, DETECTORS, {})
    assert times(after, "far") == [(20.5, 23)]


def test_pulses() -> None:
    day = period(far=passages([NAN, 10, 20], [3, 14, NAN]))
    after = DetectorPulse("far", 0.1).observe(day, DETECTORS, {})
    assert times(after, "far") == [(10, 10.1), (20, 20.1)]


def test_splash_reports_a_share_of_the_next_lane() -> None:
    many = passages([10.0 * n for n in range(300)], [10.0 * n + 1 for n in range(300)])
    day = period(far=passages([5], [6]), far_left=many)
    after = DetectorSplash("far", 0.2).observe(day, DETECTORS, {})
    added = set(times(after, "far")) - {(5, 6)}
    assert added <= set(times(day, "far left"))
    assert len(added) == pytest.approx(60, abs=4 * (300 * 0.2 * 0.8) ** 0.5)
    assert times(after, "far left") == times(day, "far left")
    on = after.passages["far"].on_s
    assert (np.diff(on) >= 0).all()


def test_a_second_splash_chooses_independently_of_the_first() -> None:
    many = passages([10.0 * n for n in range(1000)], [10.0 * n + 1 for n in range(1000)])
    day = period(far_left=many)
    for _ in range(2):
        day = DetectorSplash("far", 0.3).observe(day, DETECTORS, {})
    reports = Counter(times(day, "far"))
    twice = sum(count == 2 for count in reports.values())
    assert twice == pytest.approx(1000 * 0.3**2, abs=4 * (1000 * 0.09 * 0.91) ** 0.5)
    assert len(reports) == pytest.approx(1000 * (1 - 0.7**2), abs=4 * (1000 * 0.51 * 0.49) ** 0.5)


def test_splash_of_every_vehicle_can_be_taken_off() -> None:
    on = np.arange(0.0, 100.0, 10.0)
    street = period(far=Passages(on, on + 0.4, on, on), far_left=Passages.none())
    splash = DetectorSplash("advance", 1.0)
    again = splash.undone(splash.observe(street, DETECTORS, {}), DETECTORS)
    assert sum(len(again.passages[name]) for name in ("far", "far left")) == len(on)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_as_many_twins_are_taken_off_as_splash_adds(share: float) -> None:
    """Arrivals are read off detectors, and a twin is no vehicle."""
    generator = np.random.default_rng(5)

    def vehicles(count: int) -> Passages:
        on = np.sort(generator.uniform(0.0, 3600.0, count))
        return Passages(on, on + 0.4, np.full(count, 10.0), np.full(count, 5.0))

    street = period(far=vehicles(600), far_left=vehicles(300), other=vehicles(50))
    splash = DetectorSplash("advance", share)
    seen = splash.observe(street, DETECTORS, {})
    assert len(seen.passages["far left"]) == pytest.approx(300 + share * 600, abs=40)
    again = splash.undone(seen, DETECTORS)
    for name, count in (("far", 600), ("far left", 300)):
        assert len(again.passages[name]) == pytest.approx(count, abs=40)
        known = set(street.passages[name].on_s.tolist())
        kept = [time in known for time in again.passages[name].on_s.tolist()]
        assert np.mean(kept) > 0.75  # which of two twins is the vehicle nobody knows
    assert times(again, "other") == times(street, "other")


def test_the_lanes_beside() -> None:
    beside = next_detectors(DETECTORS)
    assert beside == {"far": ("far left",), "far left": ("far",), "line": (), "other": ()}
    farther = (Detector("farther left", "in_1", 20.0, 2.0, "advance"), *DETECTORS)
    assert next_detectors(farther)["far"] == ("far left",)
    assert next_detectors(farther)["farther left"] == ("far",)


def test_what_is_stated_does_not_change() -> None:
    scenario = load_scenario("single-v1")
    for text in (
        "detector_extension=*,1,split", "detector_offset=advance,-18", "detector_zone=*,2",
        "detector_speeds=*,front", "detector_pulse=*,0.1", "detector_splash=*,0.05",
    ):  # fmt: skip
        (effect,) = parse_domain(text)
        assert (effect.name in measurement_effects(), str(effect)) == (True, text)
        assert effect.apply(scenario).documents == scenario.documents
        assert effect.in_words() != text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("detector_extension=*,99,split", "seconds = 99"),
        ("detector_extension=*,1,both", "both"),
        ("detector_speeds=*,side", "side"),
        ("detector_splash=*,2", "share = 2"),
    ],
)
def test_impossible_errors(text: str, message: str) -> None:
    with pytest.raises((OptionError, UnknownNameError), match=message):
        parse_domain(text)


def test_a_detector_keeps_what_is_not_moved() -> None:
    one = DETECTORS[0]
    assert DetectorOffset("far", 5).installed(DETECTORS)[0] == replace(one, position_m=55.0)
