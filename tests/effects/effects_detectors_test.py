"""Effects on what is measured, on periods made by hand; and how effects are spelled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ugat_marl.effects import (
    ClockDrift,
    DemandLevel,
    DetectorEffect,
    Dropout,
    LaneClosure,
    LateGreen,
    SignalClock,
    StartupDelay,
    Stuck,
    Swapped,
    Undercount,
    apply_detector_effects,
    apply_effects,
    controller_effects,
    detector_effects,
    detector_lights,
    load_scenario,
    network_places,
    parse_domain,
    scenario_in_domain,
)
from ugat_marl.envs import parallel_env, vector_env
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.scenarios import Detector, Passages, Period

NAN = float("nan")
DETECTORS = tuple(Detector(name, f"{name}_0", 10, 2, "stop") for name in "abcd")
OWNER = {"a": "A", "b": "A", "c": "C"}


def passages(on: list[float], off: list[float] | None = None) -> Passages:
    start = np.array(on, dtype=np.float64)
    return Passages(
        start,
        start + 1 if off is None else np.array(off),
        np.arange(len(on), dtype=np.float64),
        np.full(len(on), 5.0),
    )


def period(**at: Passages) -> Period:
    return Period("day", 1000, 4600, "fit", {"A": ((1000, "Gr"),)}, at)


DAY = period(
    a=passages([1001, 1010, 2000, 4599], [1002, 1012, 2050, NAN]),
    b=passages([1500]),
    c=passages([NAN, 3000], [1003, 3001]),
)


def times(day: Period, name: str) -> list[tuple[float, float]]:
    found = day.passages.get(name, Passages.none())
    return list(zip(found.on_s.tolist(), found.off_s.tolist(), strict=True))


def seen(effect: DetectorEffect, day: Period = DAY) -> Period:
    before = {name: (x.on_s.copy(), x.off_s.copy()) for name, x in day.passages.items()}
    after = effect.observe(day, DETECTORS, OWNER)
    for name, (on, off) in before.items():  # what was measured does not change
        np.testing.assert_array_equal(day.passages[name].on_s, on)
        np.testing.assert_array_equal(day.passages[name].off_s, off)
    assert (after.signals, after.begin_s, after.end_s) == (day.signals, day.begin_s, day.end_s)
    return after


def same(one: list[tuple[float, float]], two: list[tuple[float, float]]) -> bool:
    return bool(np.allclose(np.array(one), np.array(two), equal_nan=True))


def test_a_clock_is_ahead() -> None:
    after = seen(SignalClock("A", 1.5))
    assert same(
        times(after, "a"), [(1002.5, 1003.5), (1011.5, 1013.5), (2001.5, 2051.5), (4600.5, NAN)]
    )
    assert times(after, "b") == [(1501.5, 1502.5)]
    assert after.passages["c"] is DAY.passages["c"]
    assert same(times(seen(SignalClock("*", -1)), "c"), [(NAN, 1002), (2999, 3000)])
    np.testing.assert_array_equal(after.passages["a"].speed_mps, DAY.passages["a"].speed_mps)


def test_a_clock_drifts() -> None:
    after = seen(ClockDrift("C", 7.2))  # 0.2 % fast
    assert same(times(after, "c"), [(NAN, 1003 + 0.006), (3004, 3001 + 4.002)])
    assert after.passages["a"] is DAY.passages["a"]


def test_a_detector_drops_out() -> None:
    after = seen(Dropout("a", 1011, 2010))
    assert same(times(after, "a"), [(1001, 1002), (4599, NAN)])  # 1010-1012 was under way
    assert "b" not in seen(Dropout("b", 0, 5000)).passages
    assert "d" not in seen(Dropout("d", 0, 5000)).passages


def test_a_detector_is_stuck() -> None:
    after = seen(Stuck("a", 1005, 2010))
    assert same(times(after, "a"), [(1001, 1002), (1005, 2010), (4599, NAN)])
    assert np.isnan(after.passages["a"].speed_mps[1])
    assert times(seen(Stuck("d", 0, 9000)), "d") == [(1000, 4600)]
    assert seen(Stuck("a", 0, 1000)) is DAY


def test_two_detectors_are_swapped() -> None:
    after = seen(Swapped("a", "b"))
    assert after.passages["b"] is DAY.passages["a"]
    assert after.passages["a"] is DAY.passages["b"]
    moved = seen(Swapped("a", "d"))
    assert moved.passages["d"] is DAY.passages["a"]
    assert "a" not in moved.passages


def test_passages_are_missed_at_random_and_nested() -> None:
    many = period(a=passages([1000 + 0.7 * n for n in range(4000)]), b=passages([1500.0] * 500))
    kept = [set(times(seen(Undercount("a", share), many), "a")) for share in (0, 0.1, 0.3, 0.8, 1)]
    for share, names in zip((0, 0.1, 0.3, 0.8, 1), kept, strict=True):
        left = 4000 * (1 - share)
        assert len(names) == pytest.approx(left, abs=4 * (left * share) ** 0.5)
    assert all(a > b for a, b in zip(kept, kept[1:], strict=False))
    assert len(times(seen(Undercount("a", 0.5), many), "b")) == 500
    everywhere = seen(Undercount("*", 0.5), many)
    assert 200 < len(times(everywhere, "b")) < 300
    assert times(everywhere, "a") == times(seen(Undercount("a", 0.5), many), "a")


def test_each_detector_misses_vehicles_of_its_own() -> None:
    both = passages([1000 + 0.7 * n for n in range(4000)])
    after = seen(Undercount("*", 0.5), period(a=both, b=both))
    common = set(times(after, "a")) & set(times(after, "b"))
    assert len(common) == pytest.approx(1000, abs=120)


def test_effects_on_detectors_are_picked_from_all() -> None:
    effects = [StartupDelay(1), SignalClock("A", 1), Dropout("b", 0, 5000)]
    after = apply_detector_effects(DAY, effects, DETECTORS, OWNER)
    assert times(after, "a")[0] == (1002, 1003)
    assert "b" not in after.passages
    assert apply_detector_effects(DAY, effects[:1], DETECTORS, OWNER) is DAY


@pytest.mark.parametrize(
    "effect", [Undercount("x", 0.1), Stuck("x", 0, 1), Dropout("x", 0, 1), Swapped("a", "x")]
)
def test_unknown_detectors(effect: DetectorEffect) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown detector 'x'.*Known: a, b, c, d"):
        effect.observe(DAY, DETECTORS, OWNER)


def test_the_files_of_a_scenario_are_left_alone() -> None:
    scenario = load_scenario("single-v1")
    after = Undercount("*", 0.1).apply(scenario)
    assert after.documents == scenario.documents
    assert after.applied == ("undercount=*,0.1",)


def test_effects_on_detectors_are_written_and_read_with_the_scenario(tmp_path: Path) -> None:
    effects = parse_domain("signal_clock=A1,3+undercount=*,0.1+counting_error=3+dropout=b,0,50")
    street = apply_effects(load_scenario("single-v1"), effects)
    read = load_scenario(street.write(tmp_path / "street-v1"))
    on_detectors = [effect for effect in effects if effect.on_detectors]
    assert len(on_detectors) == 3
    assert sorted(map(str, detector_effects(read))) == sorted(map(str, on_detectors))
    assert detector_effects(load_scenario(read)) == detector_effects(read)
    assert [effect.name for effect in controller_effects(read)] == ["counting_error"]


def test_effects_on_detectors_are_no_domain_of_agents() -> None:
    with pytest.raises(OptionError, match="'undercount' changes the reports of detectors, which"):
        parallel_env("single-v1", "V4+undercount=*,0.2")
    with pytest.raises(OptionError, match="'undercount'"):
        vector_env("single-v1", 2, domains=["sim", "undercount=*,0.2"])


def test_a_directory_whose_detectors_err_is_a_domain_of_agents(tmp_path: Path) -> None:
    street = apply_effects(load_scenario("single-v1"), [Undercount("*", 0.2)])
    street.write(tmp_path / "street")
    base = load_scenario(tmp_path / "street")
    apply_effects(base, parse_domain("V4")).write(tmp_path / "corrected")
    for name in ("street", "corrected"):
        domain = str(tmp_path / name)
        assert detector_effects(scenario_in_domain(base, domain)) == detector_effects(base)
        assert parallel_env(base, domain).scenario == scenario_in_domain(base, domain)


def test_detectors_belong_to_the_light_they_lead_to_or_stand_behind() -> None:
    scenario = load_scenario("grid2x2-v1")
    places = network_places(scenario)
    between = next(lane for lane in places.lanes if lane in places.ends and lane in places.begins)
    made = [Detector(kind, between, 1, 1, kind) for kind in ("advance", "stop", "exit")]
    found = detector_lights(scenario, made)
    assert found["advance"] == found["stop"] == places.ends[between]
    assert found["exit"] == places.begins[between] != found["stop"]
    assert not detector_lights(scenario, [Detector("far", "x_0", 1, 1, "stop")])


# --- spelling


def test_places_keep_their_spelling_and_may_hold_a_plus() -> None:
    assert parse_domain("LATE_GREEN = clusterJ1_J2 , 2") == (LateGreen("clusterJ1_J2", 2),)
    assert parse_domain("demand_level=-28#1+2,0.5+v1+lane_closure=a+b_0,0,10+startup_delay=1") == (
        DemandLevel("-28#1+2", 0.5),
        *parse_domain("V1"),
        LaneClosure("a+b_0", 0, 10),
        StartupDelay(1),
    )
    assert parse_domain("swapped=a+b,c+d+snow") == (Swapped("a+b", "c+d"), *parse_domain("snow"))
    with pytest.raises(UnknownNameError, match="unknown effect 'startup_dely'"):
        parse_domain("lane_closure=a,0,10+startup_dely=1")


def test_numbers_are_not_cut_short() -> None:
    effect = LaneClosure("a", 25812.125, 57612.0625)
    assert str(effect) == "lane_closure=a,25812.125,57612.0625"
    assert parse_domain(str(effect)) == (effect,)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lane_closure=*,0,10", r"'lane_closure': lane must be one lane, not '\*'"),
        ("lane_closure=,0,10", "'lane_closure': lane = '' is not the name of a lane"),
        ("lane_closure=a b,0,10", "lane = 'a b' is not the name of a lane"),
        ("lane_closure=a,10,10", "begin_s = 10 is not before end_s = 10"),
        ("lane_closure=a,10", r"takes 3 value\(s\), lane, begin_s, end_s; got 'a,10'"),
        ("lane_closure=a,x,10", "effect 'lane_closure': 'x' is not a number"),
        ("demand_level=a,-1", r"factor = -1.0 is outside \[0, 20\]"),
        ("swapped=a,*", r"other must be one detector, not '\*'"),
    ],
)
def test_impossible_places_and_windows(text: str, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        parse_domain(text)


def test_detectors_may_have_names_with_spaces() -> None:
    """Tables of a street have such names, and an effect that a diagnosis tries must take them."""
    (effect,) = parse_domain("undercount=stop north,0.2")
    assert str(effect) == "undercount=stop north,0.2"
    (moved,) = parse_domain("detector_offset=stop north,3")
    assert parse_domain(str(moved)) == (moved,)
    with pytest.raises(OptionError, match="is not the name of a detector"):
        Undercount(" a", 0.2)


@pytest.mark.parametrize("value", [1, None, "", "a,b", "<x>"])
def test_what_is_no_place(value: Any) -> None:
    with pytest.raises(OptionError, match="is not the name of a traffic light"):
        LateGreen(value, 1)
