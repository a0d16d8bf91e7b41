"""Which detectors a diagnosis compares, over how many days, and what stays in doubt."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import MeasuredData
from ugat_marl.diagnosis import DiagnosisConfig, Study, Tally, diagnose
from ugat_marl.diagnosis import study as module
from ugat_marl.diagnosis.compared_detectors import (
    detectors_to_compare,
    duplicate_detector_findings,
    one_of_each,
)
from ugat_marl.diagnosis.demand_variation import day_to_day_variation, measured_variation
from ugat_marl.diagnosis.engine import Budget, Engine
from ugat_marl.diagnosis.features import BIN_FEATURES, FEATURES, INDEX, DetectorLayout
from ugat_marl.diagnosis.measurement import DetectorError, Measurement
from ugat_marl.diagnosis.replay import Replay
from ugat_marl.diagnosis.sightings import ALONE, Sightings
from ugat_marl.diagnosis.statistics import Pools
from ugat_marl.diagnosis.study import _of_common_windows, effort_for
from ugat_marl.diagnosis.thresholds import Effort, Thresholds
from ugat_marl.diagnosis.unmeasured import Unmeasured
from ugat_marl.effects import (
    DetectorExtension,
    DetectorOffset,
    DetectorPulse,
    DetectorSpeeds,
    DetectorZone,
    Effect,
    Headway,
    load_scenario,
)
from ugat_marl.errors import MeasuredDataError, OptionError, OutputError
from ugat_marl.progress import Silent
from ugat_marl.scenarios import Detector, Network, Passages, Period
from ugat_marl.simulation import standard_detectors

THRESHOLDS = Thresholds()

NAMES = ("one", "two", "three", "four")
DETECTORS = tuple(Detector(name, f"{name}_0", 1.0, 0.0, "stop") for name in NAMES)
SEEN = Passages(np.array([1.0]), np.array([1.5]), np.array([10.0]), np.array([5.0]))


def measured(*days: tuple[str, ...], silent: Passages | None = None) -> MeasuredData:
    """Two days, on each of which these detectors saw a vehicle; others are as `silent`."""
    periods = tuple(
        Period(
            f"day{number}",
            0.0,
            100.0,
            "fit",
            {},
            {
                name: SEEN if name in saw else silent
                for name in NAMES
                if name in saw or silent is not None
            },  # pyright: ignore[reportArgumentType]
        )
        for number, saw in enumerate(days)
    )
    return MeasuredData(DETECTORS, periods)


def names(found: tuple[Detector, ...]) -> tuple[str, ...]:
    return tuple(item.id for item in found)


@pytest.mark.parametrize("silent", [None, Passages.none()])
def test_of_detectors_of_which_half_are_silent_only_the_others_are_compared(
    silent: Passages | None,
) -> None:
    assert names(detectors_to_compare(measured(("one", "three"), silent=silent))) == (
        "one",
        "three",
    )
    assert names(detectors_to_compare(measured(("two",), ("two",), silent=silent))) == ("two",)


def test_a_single_silent_detector_is_compared_like_any_other() -> None:
    assert names(detectors_to_compare(measured(("one", "two", "three")))) == NAMES
    assert names(detectors_to_compare(measured(NAMES))) == NAMES


def test_a_detector_that_saw_something_on_one_day_is_not_silent() -> None:
    assert names(detectors_to_compare(measured(("one", "two"), ("three",)))) == NAMES


def test_where_nobody_saw_anything_all_are_kept() -> None:
    assert names(detectors_to_compare(measured((), (), silent=Passages.none()))) == NAMES


def test_counts_in_intervals_say_nothing_of_silence() -> None:
    counts = pl.DataFrame({"period_id": ["day0"], "detector_id": ["one"], "count": [3]})
    data = MeasuredData(DETECTORS, (Period("day0", 0.0, 100.0, "fit", {}, {}),), counts=counts)
    assert names(detectors_to_compare(data)) == NAMES


def test_of_two_detectors_of_a_kind_on_a_lane_one_is_compared() -> None:
    detectors = (
        *(Detector(name, "in_0", 180.0, 0.0, "stop") for name in ("one", "two")),
        Detector("three", "in_0", 90.0, 0.0, "advance"),
        Detector("four", "in_1", 180.0, 0.0, "stop"),
    )
    both = replace(measured(NAMES), detectors=detectors)
    assert names(one_of_each(both, detectors)) == ("one", "three", "four")
    (finding,) = duplicate_detector_findings(both, one_of_each(both, detectors))
    assert "'two' is not compared; lane 'in_0' has 'one' as stop detector" in finding.text
    oftener = replace(measured(("two",), NAMES), detectors=detectors)
    assert names(one_of_each(oftener, detectors)) == ("two", "three", "four")


def test_a_zone_beside_a_detector_on_one_of_its_lanes_is_not_compared() -> None:
    wide = Detector("wide", "in_0", 180.0, 2.0, "stop", beside=("in_1",))
    detectors = (Detector("one", "in_1", 180.0, 0.0, "stop"), wide)
    both = replace(measured(("one", "wide")), detectors=detectors)
    assert names(one_of_each(both, detectors)) == ("one",)
    (finding,) = duplicate_detector_findings(both, one_of_each(both, detectors))
    assert "'wide' is not compared; lane 'in_1' has 'one' as stop detector" in finding.text


def test_of_two_counting_detectors_the_one_with_vehicles_is_compared() -> None:
    counts = pl.DataFrame(
        {"period_id": ["day0"] * 3, "detector_id": ["one", "one", "two"], "count": [0, 0, 3]}
    )
    detectors = tuple(Detector(name, "in_0", 1.0, 0.0, "stop") for name in ("one", "two"))
    data = MeasuredData(detectors, (Period("day0", 0.0, 9.0, "fit", {}, {}),), counts=counts)
    assert names(one_of_each(data, detectors)) == ("two",)


def test_larger_networks_are_simulated_for_fewer_days() -> None:
    efforts = [effort_for(count) for count in (1, 4, 5, 8, 9, 64)]
    assert efforts[0] == efforts[1] == Effort()
    assert efforts[2] == efforts[3]
    assert efforts[4] == efforts[5]
    for more, fewer in ((efforts[0], efforts[2]), (efforts[2], efforts[4])):
        for name in ("base", "bank", "fit", "test"):
            assert getattr(fewer, name) <= getattr(more, name)
    assert all(effort.test <= effort.base for effort in efforts)


def test_each_stretch_of_the_day_has_some_days() -> None:
    hours = [Period(f"{d} {h}", h, h + 1, "fit", {}, {}) for d in "ab" for h in range(10)]
    assert effort_for(1, hours[:1]) == effort_for(1, [*hours[:3], *hours[10:13]]) == Effort()
    assert (effort_for(9, hours).base, effort_for(9, hours).test) == (60, 60)
    assert effort_for(9, hours).fit == effort_for(9).fit


def test_an_effort_of_too_few_days_for_the_times_of_day_is_refused() -> None:
    """With a day of each stretch in each half of a test, nothing is ever unusual."""
    hours = [Period(f"{d} {h}", h, h + 1, "fit", {}, {}) for d in "ab" for h in range(4)]
    few, enough = Effort(base=24, test=8), Effort(base=24, test=24)
    assert effort_for(1, hours[:1], few) == few
    assert effort_for(1, hours, enough) == enough
    told = "base = 24 and test = 8 are too few days for periods at 4 times of day; give at least 24"
    with pytest.raises(OptionError, match=told):
        effort_for(1, hours, few)


@pytest.mark.parametrize(
    ("lights", "mornings", "evenings"), [(9, 9, 1), (4, 19, 1), (9, 24, 6), (9, 5, 5)]
)
def test_days_go_round_the_stretches_whatever_periods_there_are(
    data: Path, lights: int, mornings: int, evenings: int
) -> None:
    times = [*[(25200.0, 28800.0)] * mornings, *[(61200.0, 64800.0)] * evenings]
    periods = [Period(str(k), *time, "fit", {}, {}) for k, time in enumerate(times)]
    scenario = load_scenario(data / "crossing")
    network = Network.read(scenario)
    detectors = standard_detectors(network)
    layout = DetectorLayout.of(network, detectors)
    replay = Replay(scenario, network, detectors, layout.owner, THRESHOLDS)
    engine = Engine(
        scenario, layout, replay, periods, 0, THRESHOLDS, budget=Budget(), unmeasured=Unmeasured()
    )
    effort = effort_for(lights, periods)
    for days in (effort.base, effort.test):
        runs = Counter(engine.place_of(number) for number in range(days))
        of_stretch = Counter(periods[place].window for place in runs.elements())
        assert min(of_stretch.values()) >= 6 and len(of_stretch) == 2
        for own in (range(mornings), range(mornings, len(periods))):
            assert max(runs[place] for place in own) - min(runs[place] for place in own) <= 1
    assert [engine.place_of(k) for k in range(2)] == [0, mornings]


@dataclass
class Days:
    """Simulated days by hand.

    Attributes:
        counts: Vehicles a minute at the one stop line, with effects and without.
        aside: Days on which traffic stood still.
        asked: How often days were asked for.
    """

    counts: dict[bool, float]
    aside: tuple[int, ...] = ()
    asked: list[tuple[Effect, ...]] = field(default_factory=list)

    def ordinary(self, effects: Sequence[Effect], numbers: Sequence[int]) -> dict[int, Any]:
        self.asked.append(tuple(effects))
        found: dict[int, Any] = {}
        for number in numbers:
            sums = np.zeros((len(FEATURES), 1, 2))
            # What is set aside would show: on those days there was ten times as much.
            much = 10.0 if number in (2, 3) else 1.0
            sums[INDEX["count_stop"], 0] = 60.0 * much * self.counts[bool(effects)], 60.0
            if number not in self.aside:
                tally = Tally(sums, np.zeros((len(BIN_FEATURES), 1, 2)))
                found[number] = cast(Any, type("Replicate", (), {"tally": tally}))
        return found


def study(own: Days, other: Days | None) -> Study:
    blank = cast(Any, None)
    pools = Pools({"lane": np.eye(1)}, THRESHOLDS)
    engines = [cast(Engine, cast(object, days)) for days in (own, other)]
    return Study(
        blank, blank, blank, DiagnosisConfig(), blank, engine=engines[0], pools=pools,
        allowed=frozenset(), hypotheses=(), effort=Effort(base=6), fit=(), heldout=(),
        other_days=engines[1],
    )  # fmt: skip


def test_what_measured_arrivals_leave_open_is_a_matter_of_the_model() -> None:
    own = Days({False: 8.0, True: 6.0}, aside=(2,))
    other = Days({False: 8.0, True: 9.0}, aside=(3,))
    found = study(own, other)
    place = 0, INDEX["count_stop"]
    without, within = found.doubt(), found.doubt((Headway(1.5),))
    assert without is not None and within is not None
    assert without["lane"][place] == 0.0
    assert within["lane"][place] == pytest.approx((THRESHOLDS.arrivals_error_share * 3.0) ** 2)
    found.doubt((Headway(1.5),))
    assert own.asked == other.asked == [(), (Headway(1.5),)]


@dataclass
class Positions(Days):
    """The same days as detectors 10 m upstream see them, within 2 m."""

    metres: float = -10.0

    def first(self, count: int) -> list[int]:
        return [n for n in range(count + len(self.aside)) if n not in self.aside]

    def detecting(self, errors: Sequence[Any]) -> Positions:
        (error,) = errors
        return replace(self, metres=error.metres)

    def replicates(self, effects: Sequence[Effect], numbers: Sequence[int]) -> list[Any]:
        stands_on_it = self.metres < -11.0  # only farther upstream a vehicle stands over the loop
        counts = {key: value + stands_on_it for key, value in self.counts.items()}
        return list(replace(self, counts=counts).ordinary(effects, numbers).values())


def test_what_the_position_of_a_detector_leaves_open_is_a_matter_of_the_model() -> None:
    own = Positions({False: 8.0, True: 6.0}, aside=(2, 3))
    offset = DetectorOffset("advance", metres=-10.0)
    found = replace(study(own, None), detection=(DetectorError(offset, 2.0),))
    for effects in ((), (Headway(1.5),)):
        doubt = found.doubt(effects)
        assert doubt is not None
        assert doubt["lane"][0, INDEX["count_stop"]] == pytest.approx(1.0**2 / 2)
    certain = replace(found, detection=(DetectorError(DetectorPulse("advance", 0.5)),))
    assert certain.doubt() is None


def test_the_ends_of_an_error_of_detectors_are_plausible() -> None:
    zone = DetectorError(DetectorZone("stop", metres=-29.5), 1.0)
    assert zone.ends == [DetectorZone("stop", metres=-30.0), DetectorZone("stop", metres=-28.5)]
    assert DetectorError(DetectorSpeeds("stop", "rear")).ends == []


def test_where_signals_answered_nobody_nothing_is_left_open() -> None:
    assert study(Days({False: 8.0}), None).doubt() is None


def test_what_was_seen_on_held_out_days_alone_is_compared_with_like_days() -> None:
    """A vehicle in twenty is on a second lane, twice as fast; on the fitted days none was seen."""
    generator = np.random.default_rng(11)

    def day(fast: int) -> Tally:
        sums = np.zeros((len(FEATURES), 2, 2))
        speeds = generator.normal(10.0, 0.5, 40)
        sums[INDEX["speed2"]] = (speeds.sum(), 40.0), (20.0 * fast, float(fast))
        return Tally(sums, np.zeros((len(BIN_FEATURES), 2, 2)))

    found = replace(
        study(Days({}), None),
        measured=cast(Any, SimpleNamespace(has_speeds=True)),
        pools=Pools({"network": np.ones((1, 2)), "lane": np.eye(2)}, THRESHOLDS),
        fit=tuple(day(0) for _ in range(3)),
        heldout=tuple(day(2) for _ in range(2)),
    )
    vars(found)["place_finder"] = SimpleNamespace(directed=lambda _: {})
    model = [day(int(n)) for n in generator.poisson(2.0, 40)]
    for data in (found.fit, found.heldout):
        assert found.null(model, data).test(data).p > 0.05
    assert found.null(model, found.fit).test(found.heldout).p < 0.01  # other vehicles


def counts(generator: np.random.Generator, mean: float, share: float, days: int) -> np.ndarray:
    level = generator.gamma(share**-2.0, share**2.0, days) if share else np.ones(days)
    return generator.poisson(mean * level)[None].astype(np.float64)


def test_an_interval_that_was_not_reported_is_no_quieter_day() -> None:
    # 100 vehicles in each of four bins on both days; one bin of the second day is missing.
    bins = np.full((len(BIN_FEATURES), 1, 4), 100.0)
    known = np.ones_like(bins)
    known[:, :, 2] = 0.0
    sums = np.zeros((len(FEATURES), 1, 2))
    days = [Tally(sums, bins), Tally(sums, bins * known, known=known)]
    layout = SimpleNamespace(
        lanes=(SimpleNamespace(intersection=0),), exits=(), intersections=("C",)
    )
    given = SimpleNamespace(periods=measured(NAMES, NAMES).periods)
    found = measured_variation(cast(Any, layout), cast(Any, given), (days, ()), THRESHOLDS)
    assert found == 0.0


def test_exit_detectors_alone_tell_how_days_vary() -> None:
    layout = SimpleNamespace(
        lanes=(SimpleNamespace(intersection=0),), exits=((0, "C_N_0", "out"),), intersections=("C",)
    )
    days = []
    for level in (0.6, 0.8, 0.9, 1.1, 1.3, 1.3):
        bins = np.zeros((len(BIN_FEATURES), 2, 4))
        bins[BIN_FEATURES.index("count_exit"), 1] = 500.0 * level
        days.append(Tally(np.zeros((len(FEATURES), 2, 2)), bins))
    given = SimpleNamespace(periods=measured(NAMES, NAMES).periods)
    found = measured_variation(cast(Any, layout), cast(Any, given), (days, ()), THRESHOLDS)
    assert found == pytest.approx(0.27, abs=0.08)


def test_windows_that_nearly_agree_are_one_time_of_day() -> None:
    day = measured(NAMES, NAMES).periods[0]
    begin_s, end_s = day.window
    ends = (end_s, end_s - 0.2, end_s, end_s - 100.0)
    found = _of_common_windows(tuple(replace(day, end_s=end) for end in ends))
    assert [period.window for period in found] == [
        *[(begin_s, end_s - 0.2)] * 3, (begin_s, end_s - 100.0)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("windows", "common"),
    [
        # a chain is no single time of day
        ([(0.0, 3600.0), (0.4, 3600.4), (0.8, 3600.8)], {(0.4, 3600.0), (0.8, 3600.8)}),
        # the second and the third differ by more than either from the first
        ([(0.0, 3600.0), (0.2, 3600.5), (0.3, 3599.9)], {(0.3, 3599.9)}),
        # the second is another time of day; the third is that of the first all the same
        ([(0.0, 3600.0), (0.1, 3600.8), (0.2, 3600.1)], {(0.2, 3600.0), (0.1, 3600.8)}),
    ],
)
def test_windows_are_compared_with_the_first_of_their_time_of_day(
    windows: list[tuple[float, float]], common: set[tuple[float, float]]
) -> None:
    day = measured(NAMES, NAMES).periods[0]
    moved = tuple(replace(day, begin_s=begin_s, end_s=end_s) for begin_s, end_s in windows)
    assert {period.window for period in _of_common_windows(moved)} == common


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        ((1, 1, 2, 4), "effort base = 1"),
        ((8, 0, 2, 8), "effort bank = 0"),
        ((8, 1, 1, 6), "effort fit = 1"),  # one day has no spread
    ],
)
def test_an_effort_of_too_few_days_is_refused(numbers: tuple[int, ...], told: str) -> None:
    with pytest.raises(OptionError, match=told):
        Effort(*numbers)


@pytest.mark.parametrize(
    ("first", "begin_s", "noted"),
    [(80.0, 0.0, True), (62.0, 0.0, False), (80.0, -900.0, False)],
)
def test_a_street_that_is_fuller_than_an_empty_beginning_is_noted(
    first: float, begin_s: float, noted: bool
) -> None:
    generator = np.random.default_rng(3)

    def day(beginning: float) -> Tally:
        bins = np.zeros((len(BIN_FEATURES), 1, 4))
        bins[0] = generator.poisson((beginning, 100.0, 100.0, 100.0))
        return Tally(np.zeros((len(FEATURES), 1, 2)), bins, window=(0.0, 100.0))

    settings = SimpleNamespace(settings=SimpleNamespace(begin_s=begin_s))
    base = SimpleNamespace(model=SimpleNamespace(tallies=[day(60.0) for _ in range(40)]))
    here = replace(
        study(Days({False: 8.0}), None),
        scenario=cast(Any, settings),
        measured=measured(NAMES, NAMES),
        fit=tuple(day(first) for _ in range(8)),
    )
    found = here.with_empty_start_finding(cast(Any, base), Silent()).measured.findings
    assert ["begin empty with period 'day0'" in each.text for each in found] == [True] * noted


def test_periods_of_different_lengths_are_refused_by_name() -> None:
    periods = measured(NAMES, NAMES).periods
    longer = replace(periods[1], end_s=160.0)
    with pytest.raises(MeasuredDataError, match="'day1' is 160 s long, and 'day0' only 100 s"):
        module._refuse_lengths(*[(periods[0], longer)] * 2, Thresholds())
    ends = (0.4999, 0.5001)  # of a bin more: nearly one length, and another number of bins
    bin_s = Thresholds().bin_s
    near = tuple(replace(periods[0], id=str(x), end_s=(3 + x) * bin_s) for x in ends)
    with pytest.raises(MeasuredDataError, match="periods of one length"):
        module._refuse_lengths(near, near, Thresholds())


def test_a_place_that_cannot_be_written_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    nothing = cast(Any, None)
    with pytest.raises(OutputError, match="cannot be written"):
        diagnose(load_scenario("single-v1"), nothing, tmp_path / "file")


def test_the_folder_of_the_cache_may_be_a_text() -> None:
    folder: Any = "cached"
    assert DiagnosisConfig(cache=folder).cache == Path("cached")


def test_lengths_are_compared_before_windows_are_joined() -> None:
    day = measured(NAMES, NAMES).periods[0]
    windows = ((0.0, 3600.0), (0.5, 3600.2), (0.3, 3599.5), (7200.0, 10800.0))
    given = tuple(
        replace(day, id=str(window), begin_s=window[0], end_s=window[1]) for window in windows
    )
    common = _of_common_windows(given)
    assert [period.length_s for period in common] == [3599.0, 3599.0, 3599.0, 3600.0]
    module._refuse_lengths(given, common, THRESHOLDS)
    longer = replace(day, id="longer", begin_s=7200.0, end_s=10801.0)
    told = r"'longer' is 3601 s long, and '\(0.3, 3599.5\)' only 3599.2 s"
    with pytest.raises(MeasuredDataError, match=told):
        module._refuse_lengths((*given, longer), (*common, longer), THRESHOLDS)


@pytest.mark.parametrize(
    ("other", "refused"),
    [
        ((0.0, 3599.4), True),
        ((0.8, 3600.8), True),
        ((250.0, 3850.0), True),
        ((0.3, 3600.3), False),  # the same
        ((900.0, 4500.0), False),  # another time of day
        ((3600.0, 7200.0), False),
    ],
)
def test_periods_of_nearly_one_time_of_day_are_refused(
    other: tuple[float, float], refused: bool
) -> None:
    windows = {"first": (0.0, 3600.0), "again": (0.0, 3600.0), "other": other}
    periods = tuple(
        Period(name, *window, "fit", {}, {"one": SEEN}) for name, window in windows.items()
    )
    given = MeasuredData(DETECTORS, _of_common_windows(periods))
    if not refused:
        assert module._fitted_periods(given, periods, THRESHOLDS) == given.periods
        return
    told = rf"(?=.*'other' from {other[0]} to {other[1]} s).* are nearly the same time of day"
    with pytest.raises(MeasuredDataError, match=told):
        module._fitted_periods(given, periods, THRESHOLDS)


def test_near_periods_are_refused_by_the_times_of_their_file() -> None:
    windows = {"first": (0.0, 3600.0), "second": (0.4, 3600.4), "third": (0.8, 3600.8)}
    periods = tuple(
        Period(name, *window, "fit", {}, {"one": SEEN}) for name, window in windows.items()
    )
    told = r"'first' from 0.0 to 3600.0 s and 'third' from 0.8 to 3600.8 s are nearly"
    with pytest.raises(MeasuredDataError, match=told):
        module._refuse_near_windows(periods, _of_common_windows(periods), THRESHOLDS)
    short = tuple(
        Period(str(begin_s), begin_s, begin_s + 300.0, "fit", {}, {}) for begin_s in (0.0, 250.0)
    )
    module._refuse_near_windows(short, short, THRESHOLDS)


def test_demand_that_varies_from_day_to_day_is_told_from_chance() -> None:
    generator = np.random.default_rng(4)

    def estimates(share: float, days: int) -> np.ndarray:
        draws = (counts(generator, 1500.0, share, days) for _ in range(200))
        return np.array([day_to_day_variation(draw, Thresholds()) for draw in draws])

    assert (estimates(0.0, 5) == 0.0).mean() > 0.85
    assert estimates(0.0, 60).max() < 0.03
    for share in (0.05, 0.1):
        assert estimates(share, 60).mean() == pytest.approx(share, rel=0.1)
        assert estimates(share, 5).mean() == pytest.approx(share, rel=0.3)
    assert (estimates(0.1, 5) == 0.0).mean() < 0.1


def test_a_day_alone_and_a_street_without_vehicles_do_not_vary() -> None:
    assert day_to_day_variation(np.array([[90.0]]), Thresholds()) == 0.0
    assert day_to_day_variation(np.zeros((2, 5)), Thresholds()) == 0.0
    assert day_to_day_variation(np.empty((0, 5)), Thresholds()) == 0.0


def test_a_change_between_fitted_and_held_out_days_is_no_variation() -> None:
    days = np.array([[2000.0, 2030.0, 1980.0, 2500.0, 2480.0]])
    assert day_to_day_variation(days, Thresholds()) > 0.1
    assert day_to_day_variation(days, Thresholds(), [0, 0, 0, 1, 1]) == 0.0
    varied = np.array([[2000.0, 2600.0, 1500.0, 2500.0, 1600.0]])
    assert day_to_day_variation(varied, Thresholds(), [0, 0, 0, 1, 1]) > 0.1
    alone = np.array([[2000.0, 2500.0]])  # nothing tells a change from a variation
    of_two = day_to_day_variation(alone, Thresholds())
    assert day_to_day_variation(alone, Thresholds(), [0, 1]) == of_two > 0.0


def test_of_several_places_the_busiest_one_counts() -> None:
    steady, varied = np.full(5, 900.0), np.array([50.0, 100.0, 150.0, 200.0, 250.0])
    assert day_to_day_variation(np.array([varied, steady]), Thresholds()) == 0.0
    assert day_to_day_variation(np.array([varied * 9, steady]), Thresholds()) > 0.2


def test_every_task_of_a_diagnosis_is_part_of_the_whole() -> None:
    rooms = Path(module.__file__).parent
    source = "".join(
        (rooms / name).read_text()
        for name in ("study.py", "select.py", "workflow.py", "detection_limits.py")
    )
    shown = re.findall(r"task\(\s*f?\"([^\"]+)\"", source)
    shown += re.findall(r"f\"(round [^\"]+)\"", source)
    assert len(set(shown)) >= 8
    study: Any = object.__new__(Study)
    given = {
        "effort": Effort(), "config": DiagnosisConfig(), "hypotheses": (), "other_days": None,
        "layout": SimpleNamespace(lanes=()), "fit": (),
    }  # fmt: skip
    for name, value in given.items():
        object.__setattr__(study, name, value)
    for title in shown:
        for number in ("1", "2"):
            name = title.replace("{number + 1}", number).replace("{what}", "library")
            assert any(name.startswith(share) for share in study.work()), name


@pytest.mark.parametrize(("grain_s", "said"), [(0.1, False), (0.5, True), (1.0, True)])
def test_stamps_that_are_too_coarse_for_errors_of_detectors_are_noted(
    monkeypatch: pytest.MonkeyPatch, grain_s: float, said: bool
) -> None:
    passages = np.array([(0.0, ALONE, steps * grain_s, 10.0, 5.0) for steps in (1, 2, 3)])
    pairs, nothing = np.empty((0, 4)), np.zeros((len(NAMES), 2))
    seen = Sightings(passages, pairs, nothing, nothing, nothing, nothing[:, 0])
    compared = Measurement(DETECTORS, seen, seen, THRESHOLDS)
    monkeypatch.setattr(Study, "_measurement", lambda *_: compared)
    before = replace(study(Days({}), None), measured=measured(NAMES))
    found = before.detectors_as_they_are(Silent()).measured.findings
    text = f"grain of {grain_s:g} s: errors of the detectors"
    assert [text in finding.text for finding in found] == [True] * said


@pytest.mark.parametrize(
    ("effect", "upstream"),
    [
        (DetectorPulse("advance", 0.1), True),
        (DetectorPulse("*", 0.1), True),
        (DetectorPulse("stop", 0.1), False),
        (DetectorExtension("advance", 0.3, "split"), False),
    ],
)
def test_pulses_upstream_are_told_from_others(effect: Any, upstream: bool) -> None:
    """From pulses without speeds nobody sees who queued on a detector."""
    study: Any = object.__new__(Study)
    ahead = Detector("ahead", "one_0", 0.5, 0.0, "advance")
    object.__setattr__(study, "layout", SimpleNamespace(detectors=(ahead, *DETECTORS)))
    assert study._pulses_upstream([DetectorError(effect)]) is upstream
