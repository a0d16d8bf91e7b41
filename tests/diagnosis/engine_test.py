"""Simulated days: remembered, shared, refused when time is up. A stand-in plays SUMO."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from ugat_marl.diagnosis import Tally, default_cache
from ugat_marl.diagnosis import engine as module
from ugat_marl.diagnosis.engine import (
    Budget,
    Engine,
    OutOfTime,
    Replicate,
    _signals_hash,
    locked_up,
)
from ugat_marl.diagnosis.features import BIN_FEATURES, FEATURES, DetectorLayout, tally
from ugat_marl.diagnosis.replay import Day, Replay
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.diagnosis.unmeasured import Unmeasured
from ugat_marl.effects import Effect, apply_detector_effects, load_scenario, parse_domain
from ugat_marl.errors import SimulatorError
from ugat_marl.scenarios import Network, Passages, Period, Scenario
from ugat_marl.simulation import standard_detectors

THRESHOLDS = Thresholds()

LOG = ((0.0, "Gr"), (30.0, "rG"), (60.0, "Gr"), (90.0, "rG"), (120.0, "Gr"))
PERIODS = (
    Period("day1", 0.0, 200.0, "fit", {"C": LOG}, {}),
    Period("day2", 0.0, 200.0, "fit", {"C": LOG[:-1]}, {}),
)


class Streets(Replay):
    """Vehicles at random times that depend on the day and on the effects; counts its calls."""

    def __init__(self, layout: DetectorLayout) -> None:
        self.calls: list[tuple[tuple[str, ...], str, int]] = []
        self.answering, self.day_to_day = False, 0.0
        self._layout = layout
        self._calls = threading.Lock()

    def shown(self, period: Period) -> Period:
        return period

    def simulate(self, effects: Sequence[Effect], period: Period, seed: int) -> Day:
        names = tuple(map(str, effects))
        with self._calls:
            self.calls.append((names, period.id, seed))
        generator = np.random.default_rng([seed, *"".join(names).encode()])
        seen: dict[str, Passages] = {}
        for item in self._layout.detectors:
            on = np.sort(generator.uniform(period.begin_s, period.end_s - 1, 20))
            seen[item.id] = Passages(on, on + generator.uniform(0.1, 0.9, 20), on % 14, on % 7)
        return Day(replace(period, passages=seen), float(generator.uniform(50, 60)))

    def observed(self, effects: Sequence[Effect], period: Period) -> Period:
        return apply_detector_effects(
            period, effects, self._layout.detectors, dict(self._layout.owner)
        )


@pytest.fixture(scope="module")
def scenario(data: Path) -> Scenario:
    return load_scenario(data / "crossing")


@pytest.fixture(scope="module")
def layout(scenario: Scenario) -> DetectorLayout:
    network = Network.read(scenario)
    return DetectorLayout.of(network, standard_detectors(network))


def an_engine(
    scenario: Scenario,
    layout: DetectorLayout,
    cache: Path | None,
    *,
    seed: int = 3,
    periods: Sequence[Period] = PERIODS,
    budget: Budget | None = None,
    base_days: int = 0,
    thresholds: Thresholds = THRESHOLDS,
) -> tuple[Engine, Streets]:
    streets = Streets(layout)
    made = Engine(
        scenario,
        layout,
        streets,
        periods,
        seed,
        thresholds,
        budget=budget or Budget(),
        unmeasured=Unmeasured.of(periods),
        cache=cache,
        workers=3,
        base_days=base_days,
    )
    return made, streets


def same(one: Replicate, two: Replicate) -> bool:
    return (
        bool((one.tally.sums == two.tally.sums).all())
        and bool((one.tally.bins == two.tally.bins).all())
        and one.travel_time_s == two.travel_time_s
    )


HEADWAY = parse_domain("headway=1.5")
FAULTY = parse_domain("undercount=*,0.3")


def test_a_remembered_day_is_the_simulated_day_to_the_last_digit(
    scenario: Scenario, layout: DetectorLayout, tmp_path: Path
) -> None:
    first, streets = an_engine(scenario, layout, tmp_path)
    simulated = first.replicates(HEADWAY, range(4))
    assert len(streets.calls) == 4
    again, silent = an_engine(scenario, layout, tmp_path)
    remembered = again.replicates(HEADWAY, range(4))
    assert silent.calls == []
    assert all(same(one, two) for one, two in zip(simulated, remembered, strict=True))


def test_a_day_counted_by_other_thresholds_is_not_remembered(
    scenario: Scenario, layout: DetectorLayout, tmp_path: Path
) -> None:
    first, _ = an_engine(scenario, layout, tmp_path)
    first.replicates((), [0])
    finer, streets = an_engine(
        scenario, layout, tmp_path, thresholds=replace(THRESHOLDS, bin_s=THRESHOLDS.bin_s / 2)
    )
    finer.replicates((), [0])
    assert len(streets.calls) == 1
    judged, silent = an_engine(scenario, layout, tmp_path, thresholds=replace(THRESHOLDS, price=1))
    judged.replicates((), [0])
    assert silent.calls == [], "the price of an effect changes no day"


@pytest.mark.parametrize("speeds", [True, False])
@pytest.mark.parametrize("lengths", [True, False])
def test_simulated_days_tell_no_more_than_the_measured_ones(
    speeds: bool, lengths: bool, scenario: Scenario, layout: DetectorLayout, tmp_path: Path
) -> None:
    day = Streets(layout).simulate((), PERIODS[0], 7).period
    told = {
        name: Passages(
            item.on_s,
            item.off_s,
            item.speed_mps if speeds else np.full(len(item), np.nan),
            item.length_m if lengths else np.full(len(item), np.nan),
        )
        for name, item in day.passages.items()
    }
    measured = replace(day, passages=told)

    class SameDay(Streets):
        def simulate(self, effects: Sequence[Effect], period: Period, seed: int) -> Day:
            return Day(day, 50.0)

    def engine(period: Period) -> Engine:
        periods = [period]
        return Engine(
            scenario, layout, SameDay(layout), periods, 3, THRESHOLDS,
            budget=Budget(), unmeasured=Unmeasured.of(periods), cache=tmp_path, workers=1,
        )  # fmt: skip

    made = engine(measured)
    (simulated,) = made.replicates((), [0])
    seen = tally(made.layout, measured, made.layout.greens(measured), THRESHOLDS)
    assert np.allclose(simulated.tally.sums, seen.sums)
    (other,) = engine(day).replicates((), [0])
    assert np.allclose(other.tally.sums, simulated.tally.sums) == (speeds and lengths)


def test_a_detector_that_saw_nobody_tells_nothing_of_speeds(layout: DetectorLayout) -> None:
    names = [item.id for item in layout.detectors]
    none = np.full(3, np.nan)
    times = np.arange(3.0)
    passages = {names[0]: Passages.none(), names[1]: Passages(times, times, none, times)}
    found = Unmeasured.of([replace(PERIODS[0], passages=passages), PERIODS[1]])
    assert found.key == Unmeasured((names[1],)).key
    full = replace(PERIODS[0], passages={names[1]: Passages(times, times, times, times)})
    assert Unmeasured.of([replace(PERIODS[0], passages=passages), full]).key == ()
    assert Unmeasured.of([full], summed=np.ones((2, 1, 1), bool)).key == ()
    assert Unmeasured.of([full], summed=np.eye(2, dtype=bool)).key
    assert np.isnan(found.kept_from(full).passages[names[1]].speed_mps).all()
    assert (found.kept_from(full).passages[names[1]].length_m == times).all()


def test_within_one_run_no_day_is_simulated_twice(
    scenario: Scenario, layout: DetectorLayout
) -> None:
    made, streets = an_engine(scenario, layout, None)
    made.replicates((), range(3))
    made.replicates((), range(5))
    assert len(streets.calls) == 5


def test_days_come_in_the_order_asked_for(scenario: Scenario, layout: DetectorLayout) -> None:
    made, _ = an_engine(scenario, layout, None)
    up, down = made.replicates((), [0, 1, 2]), made.replicates((), [2, 1, 0])
    assert all(same(one, two) for one, two in zip(up, down[::-1], strict=True))
    assert not same(up[0], up[1])


def test_a_day_is_played_under_the_signals_of_its_period(
    scenario: Scenario, layout: DetectorLayout
) -> None:
    made, streets = an_engine(scenario, layout, None)
    made.replicates((), range(4))
    assert sorted(call[1] for call in streets.calls) == ["day1", "day1", "day2", "day2"]


def test_models_share_the_seeds_of_their_days(scenario: Scenario, layout: DetectorLayout) -> None:
    made, streets = an_engine(scenario, layout, None)
    made.replicates((), range(3))
    made.replicates(HEADWAY, range(3))
    plain = {seed for names, _, seed in streets.calls if not names}
    slow = {seed for names, _, seed in streets.calls if names}
    assert len(plain) == 3
    assert plain == slow


def test_faults_of_detectors_cost_no_simulation(scenario: Scenario, layout: DetectorLayout) -> None:
    made, streets = an_engine(scenario, layout, None)
    plain = made.replicates((), range(2))
    faulty = made.replicates(FAULTY, range(2))
    assert len(streets.calls) == 2
    assert faulty[0].tally.bins[0].sum() < plain[0].tally.bins[0].sum()
    assert faulty[0].travel_time_s == plain[0].travel_time_s


def test_days_that_faults_of_detectors_are_tried_on_are_kept(
    scenario: Scenario, layout: DetectorLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_KEPT_DAYS", 2)
    made, streets = an_engine(scenario, layout, None, base_days=4)
    made.replicates((), range(4))
    for number in range(3):
        made.replicates(HEADWAY, [number])
    assert len(streets.calls) == 7
    made.replicates(FAULTY, range(4))
    assert len(streets.calls) == 7, "days of the scenario as it is"
    made.replicates((*HEADWAY, *FAULTY), [1])
    made.replicates(HEADWAY, [3])
    made.replicates((*HEADWAY, *parse_domain("undercount=*,0.2")), [1])
    assert len(streets.calls) == 8, "the day that was used last"
    made.replicates((*HEADWAY, *FAULTY), [0])
    assert len(streets.calls) == 9, "no more than two days of models"


def test_a_day_that_is_being_simulated_is_not_dropped(
    scenario: Scenario, layout: DetectorLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_KEPT_DAYS", 1)
    made, streets = an_engine(scenario, layout, None)
    begun, go_on, simulate = threading.Event(), threading.Event(), streets.simulate

    def slow(effects: Sequence[Effect], period: Period, seed: int) -> Day:
        if not effects:
            begun.set()
            assert go_on.wait(10)
        return simulate(effects, period, seed)

    monkeypatch.setattr(streets, "simulate", slow)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(made.replicates, (), [0])
        assert begun.wait(10)
        made.replicates(HEADWAY, range(2))
        second = pool.submit(made.replicates, FAULTY, [0])
        go_on.set()
        first.result()
        second.result()
    assert [names for names, *_ in streets.calls].count(()) == 1


def test_threads_that_need_the_same_day_simulate_it_once(
    scenario: Scenario, layout: DetectorLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    budget = Budget()
    made, streets = an_engine(scenario, layout, None, budget=budget)
    simulate = streets.simulate

    def slow(*args: Any) -> Day:
        time.sleep(0.1)
        return simulate(*args)

    monkeypatch.setattr(streets, "simulate", slow)
    models = [parse_domain(f"detector_extension=*,{k},split") for k in (0.1, 0.2, 0.3, 0.4)]
    with ThreadPoolExecutor(5) as pool:
        days = list(pool.map(lambda effects: made.replicates(effects, [0]), ((), *models)))
    assert len(streets.calls) == 1
    assert budget.spent_h == pytest.approx(made.periods[0].length_s / 3600.0)
    assert len({day.travel_time_s for (day,) in days}) == 1
    sums = [day.tally.sums.tolist() for (day,) in days]
    assert all(other != sums[0] for other in sums[1:])


def test_a_day_that_failed_is_tried_again(
    scenario: Scenario, layout: DetectorLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, streets = an_engine(scenario, layout, None)

    def fails(*_: Any) -> Day:
        raise SimulatorError("once")

    with monkeypatch.context() as patch:
        patch.setattr(streets, "simulate", fails)
        with pytest.raises(SimulatorError, match="once"):
            made.replicates((), [0])
    assert len(made.replicates((), [0])) == len(streets.calls) == 1


@pytest.mark.parametrize(
    "damage", ["empty", "half", "text", "flipped", "encrypted", "method", "lzma", "other", "head"]
)
def test_a_damaged_file_is_simulated_again(
    scenario: Scenario, layout: DetectorLayout, tmp_path: Path, damage: str
) -> None:
    first, _ = an_engine(scenario, layout, tmp_path)
    simulated = first.replicates((), [0])[0]
    (file,) = tmp_path.rglob("*.npz")
    content = file.read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 3 : len(content) // 3 + 40] = bytes(40)
    entry = content.rindex(b"PK\1\2")  # of the archive's directory; flags and method follow
    encrypted, method, lzma = (bytearray(content) for _ in range(3))
    encrypted[entry + 8] ^= 1
    method[entry + 10] ^= 64
    lzma[entry + 10] = 14
    if damage == "other":
        with file.open("wb") as stream:
            np.savez(stream, something=np.zeros(3))
    elif damage == "head":  # of an array that is longer than what is read at once
        with file.open("wb") as stream:
            np.savez(stream, sums=np.zeros(9999))
        file.write_bytes(file.read_bytes().replace(b"(9999,)", b"[(999,)"))
    else:
        changed = {
            "empty": b"",
            "half": content[: len(content) // 2],
            "text": b"no archive",
            "flipped": flipped,
            "encrypted": encrypted,
            "method": method,
            "lzma": lzma,
        }
        file.write_bytes(changed[damage])
    again, streets = an_engine(scenario, layout, tmp_path)
    assert same(again.replicates((), [0])[0], simulated)
    assert len(streets.calls) == 1
    third, silent = an_engine(scenario, layout, tmp_path)
    assert same(third.replicates((), [0])[0], simulated), "the file was not written again"
    assert silent.calls == []


def test_a_mistake_while_a_file_is_read_is_no_damage(
    scenario: Scenario, layout: DetectorLayout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def mistaken(*_: Any, **__: Any) -> None:
        raise AssertionError("a mistake")

    made, _ = an_engine(scenario, layout, tmp_path)
    monkeypatch.setattr(module.np, "load", mistaken)
    with pytest.raises(AssertionError, match="a mistake"):
        made.replicates((), [0])


def test_what_decides_a_day_decides_which_is_remembered(
    scenario: Scenario, layout: DetectorLayout, tmp_path: Path
) -> None:
    an_engine(scenario, layout, tmp_path)[0].replicates((), [0])
    shorter = replace(PERIODS[0], end_s=180.0)
    others = {
        "seed": an_engine(scenario, layout, tmp_path, seed=4),
        "signals": an_engine(scenario, layout, tmp_path, periods=PERIODS[1:]),
        "end": an_engine(scenario, layout, tmp_path, periods=[shorter]),
        "scenario": an_engine(scenario.with_duration(100.0), layout, tmp_path),
        "detectors": an_engine(
            scenario, replace(layout, detectors=layout.detectors[::-1]), tmp_path
        ),
    }  # fmt: skip
    for name, (made, streets) in others.items():
        made.replicates((), [0])
        assert len(streets.calls) == 1, name


def test_sums_between_places_are_those_of_their_own_period(
    scenario: Scenario, layout: DetectorLayout, tmp_path: Path
) -> None:
    """Two periods of equal signals and hours are one day else; their spans differ."""
    periods = [replace(PERIODS[0], id=name) for name in ("a", "b")]
    keys: list[str] = []
    for order in (periods, periods[::-1]):
        made, _ = an_engine(scenario, layout, tmp_path, periods=order)
        keys.append(made._key((), 0))
        made._supplementary = cast(Any, object())
        keys.append(made._key((), 0))
    assert keys[0] == keys[2] and keys[1] != keys[3]


def test_another_version_of_the_features_forgets(
    scenario: Scenario, layout: DetectorLayout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    an_engine(scenario, layout, tmp_path)[0].replicates((), [0])
    monkeypatch.setattr(module, "VERSION", module.VERSION + 1)
    made, streets = an_engine(scenario, layout, tmp_path)
    made.replicates((), [0])
    assert len(streets.calls) == 1


def test_a_budget_counts_simulated_hours_and_no_stored_days(
    scenario: Scenario, layout: DetectorLayout, tmp_path: Path
) -> None:
    period = an_engine(scenario, layout, tmp_path / "other")[0].periods[0]
    hours = (period.end_s - period.begin_s) / 3600.0
    budget = Budget(1.5 * hours)  # a day that has begun is finished
    short, streets = an_engine(scenario, layout, tmp_path, budget=budget)
    short.replicates((), range(2))
    assert budget.spent_h == pytest.approx(2 * hours)
    assert budget.ended is None
    with pytest.raises(OutOfTime, match="budget"):
        short.replicates((), [2])
    assert budget.ended == "budget_h"
    again = Budget(0.5 * hours)
    later, _ = an_engine(scenario, layout, tmp_path, budget=again)
    later.replicates((), range(3))
    assert again.spent_h == pytest.approx(hours)
    assert len(streets.calls) == 2


def test_when_time_is_up_only_what_is_remembered_is_given(
    scenario: Scenario, layout: DetectorLayout, tmp_path: Path
) -> None:
    known = an_engine(scenario, layout, tmp_path)[0].replicates((), range(2))
    late, streets = an_engine(
        scenario, layout, tmp_path, budget=Budget(deadline=time.monotonic() - 1)
    )
    assert same(late.replicates((), [1])[0], known[1])
    with pytest.raises(OutOfTime, match="budget"):
        late.replicates((), range(3))
    assert late.budget.ended == "budget_s"
    with pytest.raises(OutOfTime):
        late.replicates(HEADWAY, [0])
    assert streets.calls == []


def test_a_failure_of_sumo_is_passed_on(
    scenario: Scenario, layout: DetectorLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, streets = an_engine(scenario, layout, None)

    def fails(effects: Sequence[Effect], period: Period, seed: int) -> Day:
        raise SimulatorError("SUMO failed")

    monkeypatch.setattr(streets, "simulate", fails)
    with pytest.raises(SimulatorError, match="SUMO failed"):
        made.replicates((), range(5))


def test_days_of_other_models_are_no_days_of_the_scenario_as_it_is(
    scenario: Scenario, layout: DetectorLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Streets, "detecting", lambda self, _: self)
    made, _ = an_engine(scenario, layout, None, base_days=4)
    for effects, numbers in (((), [0, 2, 7]), (HEADWAY, [0, 1, 2, 3])):
        made.replicates(effects, numbers)
    assert made.known_base_days == 2
    faulty = made.detecting(FAULTY)
    assert faulty.known_base_days == 0
    faulty.replicates((), [3])
    assert (faulty.known_base_days, made.known_base_days) == (1, 2)


def test_progress_is_told_day_by_day(scenario: Scenario, layout: DetectorLayout) -> None:
    made, _ = an_engine(scenario, layout, None)
    told: list[None] = []
    made.replicates((), range(5), lambda: told.append(None))
    assert len(told) == 5


def test_work_of_unknown_length_is_told_by_the_days_it_adds(
    scenario: Scenario, layout: DetectorLayout
) -> None:
    made, _ = an_engine(scenario, layout, None)
    made.replicates((), range(3))
    told: list[int] = []
    with made.watched(lambda: told.append(1), 4):
        made.replicates((), range(5))  # three of them are known
        assert len(told) == 2
        made.prepare([(HEADWAY, range(9))])
        assert len(told) == 4
    made.replicates((), range(7))
    assert len(told) == 4


def test_measured_periods_are_tallied_under_their_own_signals(
    scenario: Scenario, layout: DetectorLayout
) -> None:
    made, _ = an_engine(scenario, layout, None)
    (day,) = made.replicates((), [0])
    streets = Streets(layout)
    streets.simulate((), PERIODS[0], 0)
    seen = streets.simulate((), PERIODS[0], 5).period
    counted = tally(made.layout, seen, made.layout.greens(seen), THRESHOLDS)
    assert counted.sums.shape == day.tally.sums.shape
    assert counted.days == 1


def test_the_cache_lies_where_caches_lie(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache() == tmp_path / "ugat_marl" / "replicates"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_cache().parts[-3:] == (".cache", "ugat_marl", "replicates")


# --- days of many models at once -----------------------------------------------------------------


def test_days_on_which_traffic_stood_still_are_passed_over(
    scenario: Scenario, layout: DetectorLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    every, _ = an_engine(scenario, layout, None)
    assert every.first(4) == [0, 1, 2, 3]
    assert every.first(0) == []

    def counted(effects: Sequence[Effect], numbers: Sequence[int]) -> list[Replicate]:
        assert not effects
        bins = np.zeros((len(numbers), len(BIN_FEATURES), 1, 1))
        bins[:, 0, 0, 0] = [10.0 if n in (0, 3) else 100.0 + n % 3 for n in numbers]
        return [Replicate(Tally(np.zeros((len(FEATURES), 1, 2)), day), 60.0) for day in bins]

    made, _ = an_engine(scenario, layout, None, base_days=20)
    monkeypatch.setattr(made, "replicates", counted)
    assert made.ordinary_days.set_aside == {0, 3}
    assert made.ordinary_days.day_to_day == pytest.approx(1.4826)
    assert made.first(4) == [1, 2, 4, 5]


def test_prepared_days_are_those_that_are_simulated_one_by_one(
    scenario: Scenario, layout: DetectorLayout
) -> None:
    made, streets = an_engine(scenario, layout, None)
    told: list[None] = []
    models = [(HEADWAY, [0, 1, 2]), ((), [0, 3]), (FAULTY, [0, 3])]
    made.prepare(models, lambda: told.append(None))
    assert len(told) == len(models)
    plain, _ = an_engine(scenario, layout, None)
    calls = len(streets.calls)
    for effects, numbers in models:
        one, two = made.replicates(effects, numbers), plain.replicates(effects, numbers)
        assert all(same(a, b) for a, b in zip(one, two, strict=True))
    assert len(streets.calls) == calls, "it was simulated again"


def test_what_sumo_refuses_is_reported_when_it_is_asked_for(
    scenario: Scenario, layout: DetectorLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, streets = an_engine(scenario, layout, None)
    plays = streets.simulate

    def refuses(effects: Sequence[Effect], period: Period, seed: int) -> Day:
        if effects:
            raise SimulatorError("SUMO failed")
        return plays(effects, period, seed)

    monkeypatch.setattr(streets, "simulate", refuses)
    made.prepare([(HEADWAY, [0, 1]), ((), [0])])
    assert len(streets.calls) == 1, "the other model was simulated"
    with pytest.raises(SimulatorError, match="SUMO failed"):
        made.replicates(HEADWAY, [0, 1])


def test_a_mistake_while_days_are_prepared_is_not_swallowed(
    scenario: Scenario, layout: DetectorLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, streets = an_engine(scenario, layout, None)

    def fails(effects: Sequence[Effect], period: Period, seed: int) -> Day:
        raise ZeroDivisionError

    monkeypatch.setattr(streets, "simulate", fails)
    with pytest.raises(ZeroDivisionError):
        made.prepare([((), [0, 1])])


def test_no_day_is_prepared_when_time_is_up(
    scenario: Scenario, layout: DetectorLayout, tmp_path: Path
) -> None:
    an_engine(scenario, layout, tmp_path)[0].replicates((), range(2))
    late, streets = an_engine(
        scenario, layout, tmp_path, budget=Budget(deadline=time.monotonic() - 1)
    )
    late.prepare([((), [0, 1])])
    with pytest.raises(OutOfTime, match="budget"):
        late.prepare([((), [0, 1]), (HEADWAY, [0])])
    assert streets.calls == []


def test_measured_speeds_decide_arrivals_and_so_the_day() -> None:
    on = np.array([100.0, 190.0, 193.0, 200.0])

    def period(speed_mps: list[float]) -> Period:
        seen = Passages(on, on + 1.0, np.array(speed_mps), np.full(4, 5.0))
        return Period("day", 0.0, 900.0, "fit", {}, {"far": seen})

    quick, slow = period([13.0, 13.0, 13.0, 13.0]), period([13.0, 3.0, 3.0, 13.0])
    assert _signals_hash(quick, True) != _signals_hash(slow, True)
    assert _signals_hash(quick, False) == _signals_hash(slow, False)


def test_days_of_another_stretch_are_no_standstill(layout: DetectorLayout) -> None:
    generator = np.random.default_rng(1)
    lanes = len(layout.places)

    def day(rate: float, window: tuple[float, float]) -> Tally:
        bins = np.zeros((len(BIN_FEATURES), lanes, 6))
        bins[0] = generator.poisson(rate, (lanes, 6))
        return Tally(np.zeros((len(FEATURES), lanes, 2)), bins, window=window)

    mornings = [day(40.0, (25_200.0, 27_000.0)) for _ in range(55)]
    nights = [day(4.0, (0.0, 1_800.0)) for _ in range(5)]
    assert locked_up([*mornings, *nights], THRESHOLDS) == []
    still = day(4.0, (25_200.0, 27_000.0))
    assert locked_up([*mornings, still, *nights], THRESHOLDS) == [55]
