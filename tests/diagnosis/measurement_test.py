"""Errors of measurement, from equations solved by hand and from vehicles that were made up."""

from __future__ import annotations

import inspect
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ugat_marl.diagnosis import sightings
from ugat_marl.diagnosis.features import DetectorLayout, Greens, IncomingLane
from ugat_marl.diagnosis.measurement import Measurement, _grain_s
from ugat_marl.diagnosis.sightings import (
    ALONE,
    FOURTH,
    SECOND,
    SIXTH,
    THIRD,
    Sightings,
    _regimes_at_stop,
    _Track,
    together,
)
from ugat_marl.diagnosis.splash import Splash
from ugat_marl.diagnosis.thresholds import OF_SIGHTINGS, Thresholds
from ugat_marl.diagnosis.verdict import describe_errors
from ugat_marl.effects import DetectorSplash
from ugat_marl.scenarios import Detector, Passages, Period

THRESHOLDS = Thresholds()
CAR_M, GAP_M = 5.0, 50.0
"""Length of every vehicle, and stated distance of the detectors."""
DETECTORS = (
    Detector("far", "in_0", 100.0, 0.0, "advance"),
    Detector("far left", "in_1", 100.0, 0.0, "advance"),
    Detector("line", "in_0", 150.0, 0.0, "stop"),
    Detector("line left", "in_1", 150.0, 0.0, "stop"),
)
LANES = tuple(
    IncomingLane(f"in_{n}", "in", 0, (n,), 14.0, {"advance": f"far{name}", "stop": f"line{name}"})
    for n, name in enumerate(("", " left"))
)
LAYOUT = DetectorLayout(("A",), LANES, (), DETECTORS, {})
GREEN = Greens(
    np.array([0.0]), np.array([3600.0]), np.array([3603.0]), np.array([3604.0]), np.array([True])
)


def crossings(times: np.ndarray, speeds: np.ndarray, extension_s: float = 0.0) -> Passages:
    return Passages(times, times + CAR_M / speeds + extension_s, speeds, np.full(len(times), CAR_M))


def day(
    seed: int,
    *,
    extension_s: float = 0.0,
    distance_m: float = GAP_M,
    zone_m: float = 0.0,
    twins: float = 0.0,
    speeds: bool = True,
) -> Sightings:
    """One period of steady vehicles that drive by themselves."""
    generator = np.random.default_rng(seed)
    passages: dict[str, Passages] = {}
    for name in ("", " left"):
        times = 10.0 + np.cumsum(generator.uniform(12.0, 20.0, 150))
        pace = generator.uniform(8.0, 15.0, 150)
        more = extension_s + zone_m / pace
        for place, at in ((f"far{name}", times), (f"line{name}", times + distance_m / pace)):
            seen = crossings(at, pace)
            passages[place] = Passages(seen.on_s, seen.off_s + more, pace, seen.length_m)
    chosen = generator.random(150) < twins
    whole = passages["far"]
    passages["far left"] = Passages.concatenated([passages["far left"], whole.at(chosen)])
    if not speeds:
        none = np.full(len(whole), np.nan)
        passages = {
            name: Passages(x.on_s, x.off_s, none[: len(x)], none[: len(x)])
            for name, x in passages.items()
            if name != "far left"
        }
    period = Period("day", 0.0, 3600.0, "fit", {}, passages)
    return Sightings.of(LAYOUT, period, [GREEN, GREEN], THRESHOLDS)


def named(measured: Sightings, simulated: Sightings) -> list[str]:
    errors = Measurement(DETECTORS, measured, simulated, THRESHOLDS).errors()
    return [str(error.effect) for error in errors]


@pytest.mark.parametrize(
    ("hidden", "place", "value"),
    [
        ({"extension_s": 1.0}, "detector_extension=*", 1.0),
        ({"zone_m": 3.0}, "detector_zone=*", 3.0),
        ({"distance_m": GAP_M + 18.0}, "detector_offset=advance", -18.0),
        ({"distance_m": GAP_M - 10.0}, "detector_offset=advance", 10.0),
        ({"twins": 0.15}, "detector_splash=advance", 0.15),
    ],
)
def test_what_is_wrong_is_named_and_nothing_else(
    hidden: dict[str, Any], place: str, value: float
) -> None:
    usual = together([day(seed) for seed in range(3)])
    (only,) = named(together([day(seed, **hidden) for seed in range(7, 11)]), usual)
    assert only.startswith(f"{place},")
    # of lone vehicles half have a splash, since the other lane reports none of theirs
    share = 0.5 if "twins" in hidden else 1.0
    assert float(only.split(",")[1]) == pytest.approx(share * value, rel=0.3 if share < 1 else 0.03)


@pytest.mark.parametrize("pace", [None, 10.0])
def test_an_extension_looks_like_a_zone_where_all_drive_at_one_speed(pace: float | None) -> None:
    """At 10 m/s an extension of 0.3 s is a zone of 3 m; at 8 to 15 m/s it is none."""
    days = [day(seed, extension_s=0.3 * (seed > 2)) for seed in (0, 1, 2, 7, 8)]
    if pace is not None:
        for one, extension_s in zip(days, (0.0, 0.0, 0.0, 0.3, 0.3), strict=True):
            one.passages[:, 3] = np.random.default_rng(4).normal(pace, 0.05, len(one.passages))
            one.passages[:, 2] = CAR_M / one.passages[:, 3] + extension_s
    usual, street = together(days[:3]), together(days[3:])
    (error,) = Measurement(DETECTORS, street, usual, THRESHOLDS).errors()
    assert str(error.effect).startswith("detector_extension=*,0.3")
    said = describe_errors([error])
    if pace is None:
        assert error.rival is None
        assert "or have zones" not in said
    else:
        assert str(error.rival) == "detector_zone=*,3"
        assert said.endswith(", or have zones 3 m longer than stated (here both look the same)")
        both = Measurement(DETECTORS, street, usual, THRESHOLDS)
        (other,) = both.errors(("detector_extension",))
        assert (str(other.effect), other.rival) == ("detector_zone=*,3", None)
        (alone,) = both.errors(("detector_zone",))
        assert (alone.effect, alone.rival) == (error.effect, None)


@pytest.mark.parametrize("earlier", [(), (20.0, 60.0), (97.0,)])
def test_vehicles_before_the_first_whole_green_are_no_part_of_its_queue(
    earlier: tuple[float, ...],
) -> None:
    starts, ends = np.array([100.0, 200.0]), np.array([130.0, 230.0])
    greens = Greens(starts, ends, ends + 3, np.array([200.0, 300.0]), np.ones(2, np.bool_))
    off = np.array([*earlier, *(at + n for at in starts for n in (2, 4, 6, 8, 10))])
    on = off - 1.0
    on[[len(earlier), len(earlier) + 5]] = starts - 2.0  # the first one waits
    five = np.full(len(on), 5.0)
    track = _Track.of(
        Passages(on, off, five, five), Detector("line", "in_0", 150.0, 0.0, "stop"), THRESHOLDS
    )
    queues = _regimes_at_stop(track, greens, THRESHOLDS)[len(earlier) :].tolist()
    assert queues[:5] == queues[5:] == [-1, SECOND, THIRD, FOURTH, FOURTH]


def test_nothing_is_named_where_nothing_is_wrong() -> None:
    usual = together([day(seed) for seed in range(3)])
    assert named(together([day(seed) for seed in (7, 8)]), usual) == []


def test_slower_drivers_are_no_error_of_detectors() -> None:
    usual = together([day(seed) for seed in range(3)])
    slow = day(9)
    slow.passages[:, 3] *= 0.8
    slow.passages[:, 2] /= 0.8
    slow.pairs[:, 1] /= 0.8
    slow.pairs[:, 2] *= 0.8
    assert named(slow, usual) == []


@pytest.mark.parametrize(("share", "names"), [(1.0, True), (0.6, False)])
def test_the_end_of_a_slower_road_is_no_extension(share: float, names: bool) -> None:
    """Vehicles that leave a slowed lane gain speed over the stop detector, all in the same way.

    From the front over the line to the rear they are at 2.6 m/s^2, and reach the speed v, so that
    ``CAR_M = v d - 1.3 d^2``. It looks like an extension of 0.18 s. Where the lane is as quick as
    ever, the same times over the detector are one.
    """
    usual = together([day(seed) for seed in range(3)])
    slow = day(9)
    line = slow.passages[:, 0] >= 2
    usual.passages[usual.passages[:, 0] >= 2, 3] = 6.5 / share
    usual.passages[usual.passages[:, 0] >= 2, 2] = CAR_M / (6.5 / share)
    slow.passages[line, 3] = speed = np.random.default_rng(1).normal(6.5, 0.1, line.sum())
    slow.passages[line, 2] = (speed - np.sqrt(speed**2 - 2.0 * 2.6 * CAR_M)) / 2.6
    found = [text for text in named(slow, usual) if "offset" not in text]
    assert len(found) == names


@pytest.mark.parametrize(("spread", "names"), [(0.02, True), (0.3, False)])
def test_drivers_who_speed_up_and_slow_down_over_the_loops_make_no_zone(
    spread: float, names: bool
) -> None:
    """G is 1.18 in the median at all exits, with vehicles far from alike or nearly so."""
    detectors = tuple(Detector(f"exit {x}", f"{x}_0", 10.0, 0.0, "exit") for x in "abcd")
    generator = np.random.default_rng(5)
    index = np.repeat(np.arange(4), 150)
    speed = generator.uniform(9.0, 13.0, len(index))

    def seen(ratio: np.ndarray) -> Sightings:
        over = ratio * CAR_M / speed
        rows = np.column_stack((index, np.full(600, ALONE), over, speed, np.full(600, CAR_M)))
        return replace(nothing_seen(4), passages=rows)

    usual = seen(generator.normal(1.0, 0.02, 600))
    street = seen(1.18 + generator.normal(0.0, spread, 600))
    assert bool(Measurement(detectors, street, usual, THRESHOLDS).errors()) == names


@pytest.mark.parametrize(
    ("zone_m", "extension_s", "found"),
    [
        (1.9, -0.15, []),  # drivers who start otherwise, as seen with reaction steps of 2 s
        (4.1, -0.17, ["detector_zone=stop"]),  # the same beside a longer zone
        (4.0, -1.0, ["detector_extension=stop", "detector_zone=stop"]),
        (1.9, 0.3, ["detector_extension=stop", "detector_zone=stop"]),
    ],
)
def test_numbers_that_change_slow_vehicles_alone_are_no_error(
    zone_m: float, extension_s: float, found: list[str]
) -> None:
    """Vehicles of a queue pass the line at 6 to 11 m/s, lone ones at 13 m/s."""
    generator = np.random.default_rng(5)
    regimes = np.tile(np.repeat([ALONE, SECOND, THIRD, FOURTH, SIXTH], 150), 2)
    index = np.repeat([2, 3], len(regimes) // 2)
    usual_mps = np.array([13.0, 6.0, 7.6, 9.0, 10.8])[regimes]
    speed = usual_mps + generator.normal(0.0, 0.3, len(regimes))

    def seen(more_m: float, more_s: float) -> Sightings:
        over = (CAR_M + more_m) / speed + more_s
        rows = np.column_stack((index, regimes, over, speed, np.full(len(index), CAR_M)))
        return replace(nothing_seen(4), passages=rows)

    errors = Measurement(DETECTORS, seen(zone_m, extension_s), seen(0.0, 0.0), THRESHOLDS).errors()
    assert sorted(f"{one.effect.name}={one.effect.place}" for one in errors) == found


@pytest.mark.parametrize(
    ("extension_s", "pace", "found"),
    [(1.2, 1.0, ["detector_extension=advance"]), (0.0, 0.9, []), (0.0, 1.0, [])],
)
def test_where_queues_never_end_those_in_them_show_an_extension(
    extension_s: float, pace: float, found: list[str]
) -> None:
    generator = np.random.default_rng(5)

    def seen(more_s: float, pace: float) -> Sightings:
        period_passages: dict[str, Passages] = {}
        for name in ("far", "far left"):
            times = np.cumsum(generator.uniform(3.0, 4.5, 300))
            speeds = pace * generator.uniform(3.0, 7.0, 300)
            period_passages[name] = crossings(times, speeds, more_s)
        period = Period("day", 0.0, 1500.0, "fit", {}, period_passages)
        return Sightings.of(LAYOUT, period, [GREEN, GREEN], THRESHOLDS)

    errors = Measurement(DETECTORS, seen(extension_s, pace), seen(0.0, 1.0), THRESHOLDS).errors()
    assert [f"{one.effect.name}={one.effect.place}" for one in errors] == found


def test_extensions_are_seen_without_speeds() -> None:
    usual = together([day(seed, speeds=False) for seed in range(3)])
    found = named(day(7, extension_s=1.0, speeds=False), usual)
    (only,) = found
    assert only.startswith("detector_extension=*,")
    assert float(only.split(",")[1]) == pytest.approx(1.0, abs=0.05)
    assert named(day(7, speeds=False), usual) == []


@pytest.mark.parametrize("seconds", [0.1, 1.0])
def test_pulses_are_seen(seconds: float) -> None:
    usual = together([day(seed) for seed in range(3)])
    pulses = day(7)
    pulses.passages[:, 2] = seconds
    assert named(pulses, usual) == [f"detector_pulse=*,{seconds:g}"]
    one_kind = day(7)
    advance = one_kind.passages[:, 0] < 2
    one_kind.passages[advance, 2] = seconds
    assert named(one_kind, usual) == [f"detector_pulse=advance,{seconds:g}"]


@pytest.mark.parametrize(("seconds", "nearest"), [(0.0, "0.01"), (2.5, "2")])
def test_pulses_of_impossible_lengths_are_the_nearest_possible(
    seconds: float, nearest: str
) -> None:
    pulses = day(7)
    pulses.passages[:, 2] = seconds
    found = named(pulses, together([day(seed) for seed in range(3)]))
    assert {one.split(",")[-1] for one in found} == {nearest}


def pairs_only(*distances_m: float) -> Sightings:
    """One period in which vehicles at 10 m/s show these distances, at the first detector."""
    rows = [(0, m / 10.0, 10.0, 10.0) for m in distances_m]
    return replace(day(0), passages=np.empty((0, 5)), pairs=np.array(rows))


@pytest.mark.parametrize(
    ("seen", "place"),
    [((56.0, 56.2, 55.8, 56.1, 56.3), "detector_offset=advance,-6.1"), ((56.0,) * 4, None)],
)
def test_five_vehicles_move_a_detector_and_four_do_not(
    seen: tuple[float, ...], place: str | None
) -> None:
    usual = pairs_only(*np.linspace(49.5, 50.5, 30).tolist())
    assert named(pairs_only(*seen), usual) == ([] if place is None else [place])


def test_a_distance_beyond_all_streets_is_no_position() -> None:
    """Lone vehicles of other lanes can look like one; an effect of 65 m could not even be made."""
    usual = pairs_only(*np.linspace(4.5, 5.5, 30).tolist())
    assert named(pairs_only(*np.linspace(69.0, 71.0, 9).tolist()), usual) == []


def close(seed: int, *, extension_s: float = 0.0, merged: bool = False, least: float) -> Sightings:
    """One period in which every third vehicle follows within `least` to `least` + 1 s."""
    generator = np.random.default_rng(seed)
    gaps = np.where(np.arange(300) % 3, 12.0, generator.uniform(least, least + 1.0, 300))
    times = 10.0 + np.cumsum(gaps)
    pace = np.full(300, 12.0)
    passages: dict[str, Passages] = {}
    for name in ("", " left"):
        for place, at in ((f"far{name}", times), (f"line{name}", times + GAP_M / pace)):
            seen = crossings(at, pace, extension_s)
            touching = np.append(seen.off_s[:-1] > seen.on_s[1:], False)
            if merged:
                first = np.append(True, ~touching[:-1])
                last = np.append(~touching[:-1], True)
                cut = Passages(
                    seen.on_s[first], seen.off_s[last], pace[first], seen.length_m[first]
                )
            else:
                ends = np.where(touching, np.append(seen.on_s[1:], 0.0), seen.off_s)
                cut = Passages(seen.on_s, ends, pace, seen.length_m)
            passages[place] = cut
    period = Period("day", 0.0, 3600.0, "fit", {}, passages)
    return Sightings.of(LAYOUT, period, [GREEN, GREEN], THRESHOLDS)


@pytest.mark.parametrize(
    ("merged", "least", "form"),
    [(True, 0.6, "merged"), (False, 0.6, "split"), (True, 3.0, "unknown"), (False, 3.0, "unknown")],
)
def test_close_vehicles_tell_whether_they_are_merged(merged: bool, least: float, form: str) -> None:
    usual = together([close(seed, least=least) for seed in range(3)])
    found = named(close(7, extension_s=0.8, merged=merged, least=least), usual)
    assert found == [f"detector_extension=*,0.8,{form}"]


def nothing_seen(detectors: int) -> Sightings:
    """Sightings of as many detectors without a vehicle."""
    return Sightings(
        np.empty((0, 5)),
        np.empty((0, 4)),
        np.zeros((detectors, 101)),
        np.zeros((detectors, 2)),
        np.zeros((detectors, 2)),
        np.zeros(detectors),
    )


def test_splash_onto_three_lanes_by_hand() -> None:
    """Of 1000, 500 and 100 vehicles 0.8, 0.8 * 0.8 and 0.8 are reported once, at a share of 0.2."""
    detectors = [Detector(f"far{n}", f"in_{n}", 100.0, 0.0, "advance") for n in range(3)]
    empty = nothing_seen(3)
    usual = replace(empty, twins=np.array([(0.0, 1000.0), (0.0, 500.0), (0.0, 100.0)]))
    twins = np.array([(1600 - 800 - 320 - 80, 800), (0, 320), (0, 80)], float)
    (error,) = Measurement(detectors, replace(empty, twins=twins), usual, THRESHOLDS).errors()
    assert str(error.effect) == "detector_splash=advance,0.2"


def test_a_quiet_lane_beside_platoons_hides_no_splash() -> None:
    """Three of four vehicles on the busy lane drive 2 s behind another one."""
    detectors = [Detector(f"far{n}", f"in_{n}", 100.0, 0.0, "advance") for n in range(3)]
    layout = DetectorLayout(("A",), (), (), tuple(detectors), {})
    platoons = (10.0 + 30.0 * np.arange(400))[:, None] + 2.0 * np.arange(4)
    lone = 30.0 + 30.0 * np.arange(400)
    busy = np.sort(np.concatenate((platoons.ravel(), lone)))
    passages = {
        name: crossings(times, np.full(len(times), 12.0))
        for name, times in {"far0": busy, "far2": 20.0 + 150.0 * np.arange(80)}.items()
    }
    without = Period("day", 0.0, 13000.0, "fit", {}, passages)
    days = (without, DetectorSplash("advance", 0.2).observe(without, detectors, {}))
    usual, street = (Sightings.of(layout, one, [], THRESHOLDS) for one in days)
    (error,) = Measurement(detectors, street, usual, THRESHOLDS).errors()
    assert str(error.effect).startswith("detector_splash=advance,")
    assert error.effect.share == pytest.approx(0.2, abs=0.04)


@pytest.mark.parametrize(
    ("counts", "share", "margin"),
    [
        ((0.0, 0.0, 0.0, 0.0), 0.148, 0.05),  # by lone vehicles alone
        ((2000.0, 2000.0, 2400.0, 2400.0), 0.199, 0.024),
        ((1999.0, 2001.0, 2000.0, 2000.0), 0.148, 0.05),  # counts that contradict them
    ],
)
def test_counts_tell_how_large_splash_is(
    counts: tuple[float, ...], share: float, margin: float
) -> None:
    """Two lanes side by side; stop detectors count a fifth more than advance detectors."""
    nothing = nothing_seen(4)
    alone = np.array([(0.0, 300.0)] * 4)
    twins = np.array([(0.0, 300.0), (0.0, 300.0), (45.0, 127.5), (0.0, 127.5)])
    usual = replace(nothing, twins=alone, counts=np.full(4, 1000.0))
    coincidences = np.zeros((4, 2))
    coincidences[2, 0] = 0.15 * sum(counts[2:])
    street = replace(nothing, twins=twins, coincidences=coincidences, counts=np.array(counts))
    (error,) = Measurement(DETECTORS, street, usual, THRESHOLDS).errors()
    assert isinstance(error.effect, DetectorSplash) and error.effect.place == "stop"
    assert error.effect.share == pytest.approx(share, abs=0.002)
    assert error.margin == pytest.approx(margin, abs=0.004)


@pytest.mark.parametrize(
    ("together_s", "counted", "found"),
    [
        (0.0, True, ["detector_splash=stop,0.2"]),
        (0.0, False, []),  # drivers who start side by side alike
        (0.5, True, []),  # advance detectors that miss vehicles
    ],
)
def test_where_nobody_is_alone_coincidences_and_counts_tell_splash(
    together_s: float, counted: bool, found: list[str]
) -> None:
    """Platoons on both lanes at all times; a fifth of the vehicles also beside them at the line."""
    layout = DetectorLayout(("A",), (), (), DETECTORS, {})
    rng = np.random.default_rng(5)

    def days(share: float) -> Sightings:
        passages: dict[str, Passages] = {}
        for lane in ("", " left"):
            times = np.cumsum(rng.uniform(1.5, 4.0, 2000))
            speeds = rng.uniform(6.0, 14.0, 2000)
            passages[f"far{lane}"] = crossings(times, speeds)
            passages[f"line{lane}"] = crossings(times + 5.0, speeds)
        copied = {}
        for lane, other in (("", " left"), (" left", "")):
            seen = passages[f"line{other}"].at(rng.random(2000) < share)
            late = crossings(seen.on_s + together_s, seen.speed_mps)
            copied[f"line{lane}"] = Passages.concatenated([passages[f"line{lane}"], late])
            if not counted:  # as many vehicles over the advance detectors
                times = np.linspace(0.0, 5500.0, len(copied[f"line{lane}"]))
                copied[f"far{lane}"] = crossings(times, np.full(len(times), 10.0))
        period = Period("day", 0.0, 9000.0, "fit", {}, passages | copied)
        return Sightings.of(layout, period, [], THRESHOLDS)

    errors = Measurement(DETECTORS, days(0.2), days(0.0), THRESHOLDS).errors()
    splashes = [one.effect for one in errors if isinstance(one.effect, DetectorSplash)]
    assert [f"{one.name}={one.place},{one.share:.1f}" for one in splashes] == found


@pytest.mark.parametrize(("grain_s", "told"), [(0.0, True), (0.1, True), (0.2, False)])
def test_coincidences_need_a_clock_that_tells_them_from_chance(grain_s: float, told: bool) -> None:
    seen = replace(nothing_seen(2), counts=np.full(2, 1000.0))
    street = replace(seen, coincidences=np.array([(300.0, 0.0), (0.0, 0.0)]))
    lanes = [Detector(f"line{n}", f"in_{n}", 150.0, 0.0, "stop") for n in range(2)]
    others = [Detector(f"far{n}", f"in_{n}", 100.0, 0.0, "advance") for n in range(2)]
    groups = {("stop", "in"): [0, 1], ("advance", "in"): [2, 3]}

    def four(two: Sightings, count: float) -> Sightings:
        more = replace(nothing_seen(2), counts=np.full(2, count)).arrays()
        joined = {name: np.concatenate((own, more[name])) for name, own in two.arrays().items()}
        return Sightings.from_arrays(joined)

    def shares(usual: Sightings, grain_s: float) -> dict[Any, Any]:
        days = four(street, 820.0), four(usual, 1000.0)
        return Splash([*lanes, *others], groups, *days, THRESHOLDS, grain_s).shares()

    found = shares(seen, grain_s)
    assert (("stop", "in") in found) == told
    assert not told or found["stop", "in"].counted
    assert not shares(nothing_seen(2), 0.0), "simulated days without a vehicle there tell nothing"


def test_coincidences_by_hand() -> None:
    """Of four pairs of equal length two begin together and one 0.3 s apart, which halves chance."""
    layout = DetectorLayout(("A",), (), (), DETECTORS[:2], {})
    first = np.array([10.0, 20.0, 30.0, 40.0])
    second = np.array([10.1, 19.9, 30.3, 40.5])
    speeds = np.full(4, 10.0)
    passages = {"far": crossings(first, speeds), "far left": crossings(second, speeds)}
    seen = Sightings.of(layout, Period("day", 0.0, 99.0, "fit", {}, passages), [], THRESHOLDS)
    assert seen.coincidences.tolist() == [[2.0, 0.5], [0.0, 0.0]]


def test_positions_are_not_examined_where_there_is_splash() -> None:
    usual = together([day(seed) for seed in range(3)])
    both = together([day(seed, twins=0.3, distance_m=GAP_M + 18.0) for seed in (7, 8)])
    (only,) = named(both, usual)
    assert only.startswith("detector_splash=advance,")


def test_positions_are_not_examined_where_simulated_pairs_go_astray() -> None:
    """Where the distance is not found on simulated days, pairs are not of one vehicle each."""
    usual = together([day(seed, distance_m=GAP_M + 5.0) for seed in range(3)])
    assert named(day(7, distance_m=GAP_M - 12.0), usual) == []


def test_single_pairs_without_speeds_hide_no_position() -> None:
    usual = together([day(seed) for seed in range(3)])
    street = together([day(seed, distance_m=GAP_M + 18.0) for seed in (7, 8)])
    street.pairs[:3, 2] = np.nan
    (only,) = named(street, usual)
    assert only.startswith("detector_offset=advance,-18")


def test_detectors_farther_upstream_hide_no_position() -> None:
    """Pairs are of the first advance detector of a lane; another one is 20 m before the line."""
    second = (
        Detector("near", "in_0", 130.0, 0.0, "advance"),
        Detector("near left", "in_1", 130.0, 0.0, "advance"),
    )
    usual = together([day(seed) for seed in range(3)])
    street = together([day(seed, distance_m=GAP_M + 18.0) for seed in (7, 8)])
    none = nothing_seen(2)
    more = {
        name: np.concatenate((getattr(usual, name), getattr(none, name)))
        for name in ("gaps", "twins", "coincidences", "counts")
    }
    days = (replace(x, **more) for x in (street, usual))
    (error,) = Measurement((*DETECTORS, *second), *days, THRESHOLDS).errors()
    assert str(error.effect).startswith("detector_offset=advance,-18")


def test_cached_sightings_depend_on_every_number_they_are_made_with() -> None:
    """Those of a day are in the key of the day already."""
    source = inspect.getsource(sightings)
    used = set(re.findall(r"(?:thresholds|limit)\.(\w+)", source))
    of_a_day = {name for name, _ in THRESHOLDS.of_a_day()}
    assert used - of_a_day == set(OF_SIGHTINGS)
    other = replace(THRESHOLDS, twin_s=0.3)
    assert other.of_sightings() != THRESHOLDS.of_sightings()


def test_no_detector_lies_before_its_lane() -> None:
    """The advance detectors are 8 m after the start of the lane, so none lies 18 m upstream."""
    short = [replace(one, position_m=one.position_m - 92.0) for one in DETECTORS]
    usual = together([day(seed) for seed in range(3)])
    for metres, count in ((18.0, 0), (8.0, 1)):
        street = together([day(seed, distance_m=GAP_M + metres) for seed in (7, 8)])
        assert len(Measurement(short, street, usual, THRESHOLDS).errors()) == count


def test_pulses_of_a_kind_leave_no_zone_where_vehicles_are_alike() -> None:
    """On a quick road times are nearly as alike as pulses, so the road is judged with its kind."""
    detectors = tuple(
        Detector(f"exit {edge}", f"{edge}_0", 10.0, 0.0, "exit") for edge in ("a", "b")
    )
    generator = np.random.default_rng(3)
    speed = np.concatenate([generator.uniform(8.0, 15.0, 150), generator.normal(14.0, 0.8, 150)])
    index = np.repeat([0, 1], 150)
    over = CAR_M / speed
    none = np.full(300, ALONE)
    usual, street = (
        replace(
            nothing_seen(2),
            passages=np.column_stack((index, none, times, speed, np.full(300, CAR_M))),
            counts=np.full(2, 150.0),
        )
        for times in (over, np.full(300, 0.1))
    )
    errors = Measurement(detectors, street, usual, THRESHOLDS).errors()
    assert [str(error.effect) for error in errors] == ["detector_pulse=exit,0.1"]


def test_sightings_are_stored_and_read() -> None:
    one = day(1)
    again = Sightings.from_arrays(one.arrays())
    for key, values in one.arrays().items():
        np.testing.assert_array_equal(again.arrays()[key], values)
    assert (one.passages[:, 1] == ALONE).all()
    assert len((one + again).pairs) == 2 * len(one.pairs) > 0


@pytest.mark.parametrize("grain_s", [0.1, 0.2, 0.25, 0.3, 0.4, 0.5, 1.0])
def test_the_grain_of_a_clock(grain_s: float) -> None:
    stamps = np.round(grain_s * np.array([2, 3, 5, 8, 13, 40]), 3)
    assert _grain_s(stamps) == grain_s
    assert _grain_s(stamps + np.array([0.0, 0.01, 0.0, 0.03, 0.0, 0.0])) == 0.0


@pytest.mark.parametrize(("grain_s", "seen"), [(0.1, True), (0.3, False), (1.0, False)])
def test_coarse_clocks(grain_s: float, seen: bool) -> None:
    usual = together([day(seed) for seed in range(3)])

    def rounded(sightings: Sightings) -> Sightings:
        sightings.passages[:, 2] = grain_s * np.round(sightings.passages[:, 2] / grain_s)
        return sightings

    assert named(rounded(day(7)), usual) == []
    found = named(rounded(day(7, extension_s=1.0)), usual)
    assert [text.startswith("detector_extension=*") for text in found] == ([True] if seen else [])


def test_the_error_of_times_over_a_zone_holds_that_of_simulated_days() -> None:
    exact = replace(THRESHOLDS, speed_doubt=0.0, queue_doubt=0.0)
    generator, one = np.random.default_rng(6), day(1, speeds=False)
    compared = Measurement(DETECTORS, one, one, exact)

    def passages(count: int) -> np.ndarray:
        rows = np.tile([0.0, ALONE, 0.0, np.nan, CAR_M], (count, 1))
        rows[:, 2] = generator.normal(0.5, 0.05, count)
        return rows

    equations = [compared._of_time(passages(400), passages(40)) for _ in range(400)]
    chance = np.std([equation.value for equation in equations])
    assert np.mean([equation.error for equation in equations]) == pytest.approx(chance, rel=0.15)


def accelerating(seed: int, ratio: float) -> Sightings:
    """One period in which G of queued vehicles at the stop detectors is `ratio`."""
    generator, one = np.random.default_rng(seed), day(seed)
    rows = [
        (index, regime, ratio * generator.normal(1.0, 0.01), CAR_M, CAR_M)
        for index, detector in enumerate(DETECTORS)
        for regime in (SECOND, THIRD, FOURTH)
        for _ in range(60)
        if detector.kind == "stop"
    ]
    return replace(one, passages=np.concatenate([one.passages, np.array(rows)]))


@pytest.mark.parametrize(
    ("stated", "measured", "told"),
    [
        ("front", 0.8, None),
        ("front", 1.2, ("front", "rear")),
        ("rear", 1.25, ("rear", "front")),
        ("rear", 0.8, None),
        ("mean", 1.2, None),
        (None, 1.2, None),
    ],
)
def test_a_stated_point_of_speed_measurement_is_contradicted(
    stated: Any, measured: float, told: tuple[str, str] | None
) -> None:
    # Simulated days measure where it is stated: G is 0.8 there, so it is 1.2 at the other end.
    detectors = [replace(detector, speed_at=stated) for detector in DETECTORS]
    usual = together([accelerating(seed, 0.8) for seed in range(3)])
    seen = Measurement(detectors, accelerating(7, measured), usual, THRESHOLDS)
    assert seen.contradicted_point() == told


def test_a_point_that_only_some_detectors_state_is_not_contradicted() -> None:
    some = [replace(DETECTORS[0], speed_at="front"), *DETECTORS[1:]]
    usual = together([accelerating(seed, 0.8) for seed in range(3)])
    assert Measurement(some, accelerating(7, 1.2), usual, THRESHOLDS).contradicted_point() is None
