"""Blind cases: sealed, drawn by the seed alone, and gone on with where they were left."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from studies.blind.__main__ import LINE
from studies.blind.cases import Case, read_label, read_plan
from studies.blind.generate import Blueprint, Consequences, _begin, differing, generate
from studies.blind.outside_effects import BusStops, Driveway
from studies.blind.places import Busy, busy_places, telling, with_next_lane
from studies.blind.run import run_cases
from studies.blind.sampling import (
    GROUPS,
    OUTSIDE,
    Sample,
    Task,
    draw_effect,
    draw_sample,
    draw_tasks,
)
from studies.blind.strengths import ERRORS, KINDS
from studies.errors import BlindTestError
from tests.studies.blind.diagnoses import says
from ugat_marl.cli import run
from ugat_marl.data import read_measured
from ugat_marl.diagnosis import IN_THE_LOG, Routes
from ugat_marl.diagnosis.hypotheses import library
from ugat_marl.effects import effect_from_record, known_effects, load_scenario
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.experiments import policy_factory, record
from ugat_marl.scenarios import Detector, Network, Passages, Period, Scenario


@pytest.fixture(scope="module")
def test_folder(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Blueprint]:
    directory = tmp_path_factory.mktemp("blind") / "test"
    blueprint = Blueprint(
        (str(data / "crossing"),),
        ("none", "headway", "undercount", "detector_splash"),
        cases=4,
        periods=2,
        seed=3,
    )
    assert generate(directory, blueprint) == 4
    return directory, blueprint


def contents(directory: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(directory)): path.read_bytes()
        for path in sorted(directory.rglob("*"))
        if path.is_file()
    }


def test_cases_are_sealed(test_folder: tuple[Path, Blueprint]) -> None:
    directory, _ = test_folder
    cases = read_plan(directory)
    assert [case.case for case in cases] == ["case001", "case002", "case003", "case004"]
    labels = [read_label(directory, case.case) for case in cases]
    assert Counter(item.group for item in labels)["none"] >= 1
    for item in labels:
        folder = directory / item.case
        names = {path.name for path in folder.rglob("*")}
        assert names == {
            "measured", "periods.csv", "detectors.csv", "signals.parquet", "detections.parquet",
            "row-hashes.json",
        }  # fmt: skip
    plan = (directory / "plan.json").read_text()
    given = json.loads(plan)["cases"][0]
    assert set(given) == {"case", "scenario", "leave_out"}
    assert "seed" not in plan
    assert "policy" not in plan


def test_the_data_hold_what_the_label_says(test_folder: tuple[Path, Blueprint]) -> None:
    directory, blueprint = test_folder
    scenario = load_scenario(blueprint.scenarios[0])
    for case in read_plan(directory):
        label = read_label(directory, case.case)
        found = read_measured(directory / case.case / "measured", scenario, Network.read(scenario))
        assert len(found.periods) == 2
        effects = tuple(f"{x.name}={','.join(_values(x))}" for x in label.effects)
        again = record(
            scenario, "+".join(effects) or "sim", policy_factory(label.policy), periods=2,
            seed=label.seed, day_to_day=label.day_to_day,
        )  # fmt: skip
        assert again.hash == label.measured


def _values(item: object) -> list[str]:
    place, parameters = getattr(item, "place", None), getattr(item, "parameters", {})
    return [x for x in (place,) if x] + [f"{value:.12g}" for value in parameters.values()]


@pytest.mark.slow
def test_the_same_seed_draws_the_same_test(
    test_folder: tuple[Path, Blueprint], tmp_path: Path
) -> None:
    directory, blueprint = test_folder
    generate(tmp_path / "again", blueprint)
    first, second = contents(directory), contents(tmp_path / "again")
    assert first == second
    generate(tmp_path / "other", replace(blueprint, seed=4))
    assert contents(tmp_path / "other") != first


def test_a_test_is_gone_on_with_and_no_other_is_mixed_in(
    test_folder: tuple[Path, Blueprint], tmp_path: Path
) -> None:
    directory, blueprint = test_folder
    assert generate(directory, blueprint) == 0
    with pytest.raises(BlindTestError, match="another blind test"):
        generate(directory, replace(blueprint, seed=4))
    (tmp_path / "mine.txt").write_text("something else")
    with pytest.raises(BlindTestError, match="not empty"):
        generate(tmp_path, blueprint)


def test_shares_are_kept_and_nothing_hidden_is_rounded_up() -> None:
    tasks = draw_tasks(tuple(GROUPS), ("medium",), 50, rng())
    counts = Counter(task.group for task in tasks)
    assert counts["none"] == 10
    tasks = draw_tasks(tuple(GROUPS), ("medium",), 41, rng())
    assert sum(task.group == "none" for task in tasks) == 9, "a fifth of 41, rounded up"
    assert counts["measurement"] == counts["single"] == 14
    assert counts.total() == 50
    names = Counter(task.member for task in tasks if task.group == "single")
    assert max(names.values()) <= min(names.values()) + 1
    tasks = draw_tasks(("headway", "none"), ("small", "large"), 7, rng())
    assert {task.strength for task in tasks if task.member == "headway"} <= {"small", "large"}


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def single() -> tuple[Scenario, Busy]:
    scenario = load_scenario("single-v1").with_duration(900)
    return scenario, busy_places(scenario, 0)


def test_places_are_busy(single: tuple[Scenario, Busy]) -> None:
    _, busy = single
    assert busy.lights == ("A1",)
    assert set(busy.origins) == {"east1_A1", "northA_A1", "southA_A1", "west1_A1"}
    assert ("northA_A1", "A1_west1") in busy.turns
    assert set(busy.closable) <= set(busy.lanes)
    assert busy.several_lanes


@pytest.mark.parametrize("member", OUTSIDE)
def test_what_is_outside_the_library_stays_outside(
    member: str, single: tuple[Scenario, Busy]
) -> None:
    drawn = draw_sample(Task("outside", member), *single, rng())
    if member == "without gap_acceptance":  # nobody yields on this network's greens
        assert drawn is None
        return
    assert isinstance(drawn, Sample)
    unknown = {effect.name for effect in drawn.effects} & {"bus_stops", "driveway"}
    assert unknown or {effect.name for effect in drawn.effects} & set(drawn.leave_out)


def test_pairs_are_of_two_families_and_leaving_out_says_nothing(
    single: tuple[Scenario, Busy],
) -> None:
    left_out = 0
    for number in range(30):
        generator = np.random.default_rng(number)
        drawn = draw_sample(Task("pair"), *single, generator)
        assert isinstance(drawn, Sample)
        names = {effect.name for effect in drawn.effects}
        assert len(names) == 2
        assert not names & set(drawn.leave_out)
        left_out += bool(drawn.leave_out)
    assert 0 < left_out < 30


@pytest.mark.parametrize("name", ERRORS)
def test_errors_of_measurement_are_hidden_where_detectors_are(
    name: str, single: tuple[Scenario, Busy]
) -> None:
    scenario, busy = single
    assert {"*", "advance", "stop", "exit", "advance@northA_A1"} <= set(busy.groups)
    places = set[str]()
    for number in range(30):
        generator = np.random.default_rng(number)
        drawn = draw_sample(Task("measurement", name, "medium"), scenario, busy, generator)
        assert drawn is not None and drawn.group == "measurement"
        places.add(str(drawn.effects[0].record()["place"]))
    assert len(places) > 3
    if name == "detector_offset":
        assert {place.partition("@")[0] for place in places} == {"advance"}


def test_buses_stop_and_cars_turn_off(single: tuple[Scenario, Busy]) -> None:
    scenario, _ = single
    policy = policy_factory("fixed-time:30")
    plain, buses, cut = (
        record(scenario, effects, policy, periods=1, seed=1).periods[0]
        for effects in ((), (BusStops("northA_A1", 20.0, 25.0),), (Driveway("northA_A1", 0.5),))
    )

    def length(period: object) -> float:
        passages = getattr(period, "passages", {})
        return max(float(np.nanmax(item.length_m)) for item in passages.values())

    assert length(plain) == 5.0
    assert length(buses) == 12.0
    lanes = [f"northA_A1_{lane}" for lane in range(3)]
    before, after = (
        [sum(len(x.passages.get(f"{kind}:{lane}", ())) for lane in lanes) for x in (plain, cut)]
        for kind in ("advance", "stop")
    )
    assert before[1] >= 0.9 * before[0]
    assert after[1] <= 0.7 * after[0]


def test_buses_go_where_demand_is_written_as_flows(data: Path) -> None:
    scenario = load_scenario(data / "crossing")
    buses = (BusStops("S_C", 60.0, 10.0),)
    found = record(scenario, buses, policy_factory("fixed-time:20"), periods=1)
    lengths = found.periods[0].passages["exit:C_N_0"].length_m
    assert 12.0 in lengths


@pytest.mark.usefixtures("python")
def test_cases_are_diagnosed_once_and_a_failure_is_noted(
    test_folder: tuple[Path, Blueprint], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = shutil.copytree(test_folder[0], tmp_path / "test")  # it is written to
    seen: list[str] = []

    def diagnose(case: Case, measured: Path, folder: Path) -> None:
        assert (measured / "periods.csv").is_file()
        seen.append(case.case)
        if case.case == "case002":
            raise ZeroDivisionError("a bug")
        diagnosis = says("no_discrepancy")
        assert diagnosis is not None
        diagnosis.write(folder)

    assert run_cases(directory, diagnose, only=("case001", "case002")) == (1, 1)
    assert run_cases(directory, diagnose) == (2, 1)
    assert seen == ["case001", "case002", "case002", "case003", "case004"]
    note = json.loads((directory / "case002" / "run.json").read_text())
    assert note["error"] == "ZeroDivisionError: a bug"
    assert run(LINE, ["grade", str(directory)]) == 0
    assert run(LINE, ["table", str(directory), "--out", str(directory / "table.md")]) == 0
    assert "| failed | 4 | 1 of 4" in (directory / "table.md").read_text()
    assert run(LINE, ["table", str(directory), f"{directory}/../test"]) == 2
    assert "directories holds one twice" in capsys.readouterr().err
    # In processes of their own; one that does not even start is a failure with a reason.
    (directory / "case004" / "diagnosis.json").unlink()
    command = ("run", str(directory), "--no-such-option")
    assert run_cases(directory, diagnose, jobs=2, command=command) == (0, 2)
    note = json.loads((directory / "case004" / "run.json").read_text())
    assert "no-such-option" in note["error"]
    with pytest.raises(UnknownNameError, match="case009"):
        run_cases(directory, diagnose, only=("case009",))


def test_a_case_that_was_interrupted_has_no_result(
    test_folder: tuple[Path, Blueprint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = shutil.copytree(test_folder[0], tmp_path / "test")
    ended = subprocess.CompletedProcess[str]([], 130, "", "interrupted")
    monkeypatch.setattr("studies.blind.run.subprocess.run", lambda *_, **__: ended)
    with pytest.raises(KeyboardInterrupt):
        run_cases(directory, lambda *_: None, jobs=2, command=["run", str(directory)])
    assert not list(directory.glob("*/run.json"))


def test_the_time_of_an_interrupted_diagnosis_counts(
    test_folder: tuple[Path, Blueprint], tmp_path: Path
) -> None:
    directory = shutil.copytree(test_folder[0], tmp_path / "test")

    def stopped(*_: object) -> None:
        time.sleep(0.3)
        raise KeyboardInterrupt

    def quick(_: Case, __: Path, folder: Path) -> None:
        (folder / "diagnosis.json").write_text("{}")

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            run_cases(directory, stopped, only=("case001",))
    run_cases(directory, quick, only=("case001",))
    assert json.loads((directory / "case001" / "run.json").read_text())["wall_s"] >= 0.6
    assert {path.name for path in (directory / "case001").iterdir()} == {
        "measured", "diagnosis.json", "run.json"
    }  # fmt: skip


def test_a_test_that_was_killed_at_once_is_begun_again(
    test_folder: tuple[Path, Blueprint], tmp_path: Path
) -> None:
    whole, blueprint = test_folder
    (tmp_path / "labels").mkdir()
    shutil.copy(whole / "labels" / "blueprint.json", tmp_path / "labels")
    _begin(tmp_path, blueprint, read_plan(whole))
    assert read_plan(tmp_path) == read_plan(whole)


def test_diagnoses_with_other_options_are_not_mixed(
    test_folder: tuple[Path, Blueprint], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = shutil.copytree(test_folder[0], tmp_path / "test")
    assert run(LINE, ["run", str(tmp_path / "none")]) == 2
    assert not (tmp_path / "none").exists(), "what is no blind test gets no file"
    words = ["run", str(directory), "--only"]

    def failing(*_: object) -> None:
        raise RuntimeError

    for seed in (3, 7):  # options without a diagnosis bind nobody
        run_cases(directory, failing, options={"budget_s": 600.0, "alpha": 0.05, "seed": seed})
    (directory / "case001" / "diagnosis.json").write_text("{}")
    assert run(LINE, words) == 2
    assert "seed = 7, not 0; give the same options" in capsys.readouterr().err
    (directory / "run-options.json").unlink()
    assert run(LINE, words) == 2
    assert "no run-options.json tells their options" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"cases": 0}, "at least 1"),
        ({"scenarios": ()}, "at least one"),
        ({"classes": ("none", "none")}, "twice"),
        ({"pressure_share": 2.0}, "from 0 to 1"),
        ({"day_to_day": (0.05, 1.0)}, "0.05 1: needs shares"),
    ],
)
def test_impossible_blueprints_are_refused(change: dict[str, object], says: str) -> None:
    base = Blueprint(("single-v1",))
    with pytest.raises(OptionError, match=says):
        replace(base, **change)  # pyright: ignore[reportArgumentType]


def test_unknown_classes_and_hopeless_places_are_named(
    crossing: Callable[..., Path], tmp_path: Path
) -> None:
    with pytest.raises(UnknownNameError, match="headway"):
        draw_tasks(("hedway",), ("medium",), 2, rng())
    with pytest.raises(UnknownNameError, match="medium"):
        draw_tasks(("headway",), ("medum",), 2, rng())
    blueprint = Blueprint((str(crossing()),), ("turning",), cases=1)
    with pytest.raises(BlindTestError, match="'turning'"):
        generate(tmp_path / "none", blueprint)


# --- how strong, and where -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("per_hour", "factor"),
    [(120.0, 1 + 6 / math.sqrt(3 * 120)), (400.0, 1 + 6 / math.sqrt(3 * 400)), (1600.0, 1.15)],
)
def test_demand_differs_by_what_can_be_counted(per_hour: float, factor: float) -> None:
    # Six standard errors of three hours of vehicles that come by chance, or 15 % if that is more.
    kind = KINDS["demand_level"]
    assert kind.value("medium", per_hour=per_hour) == pytest.approx(factor, abs=1e-4)
    assert kind.value("medium", True, per_hour) == pytest.approx(2 - factor, abs=1e-4)
    assert kind.value("small", per_hour=per_hour) - 1 == pytest.approx((factor - 1) / 2, abs=1e-4)
    assert kind.value("medium") == 1.15


def test_the_demand_that_is_hidden_is_what_can_be_counted(single: tuple[Scenario, Busy]) -> None:
    scenario, busy = single
    quiet = replace(busy, origins={"east1_A1": 120.0})
    found = set[float]()
    for number in range(10):
        generator = np.random.default_rng(number)
        effect = draw_effect("demand_level", "medium", scenario, quiet, generator)
        assert effect is not None
        found.add(effect.record()["factor"])
    assert found == {1.3162, 0.6838}


def test_detectors_have_room_for_the_errors_that_are_hidden(single: tuple[Scenario, Busy]) -> None:
    """A zone of 4 m has no room behind the stop detectors, which lie 2.5 m before the line."""
    scenario, busy = single
    assert busy.room_m["stop"][1] == pytest.approx(2.5)
    assert busy.room_m["advance"][1] == pytest.approx(47.5)
    kinds = dict[str, set[str]]()
    for strength, number in product(("medium", "large"), range(30)):
        generator = np.random.default_rng(number)
        effect = draw_effect("detector_zone", strength, scenario, busy, generator)
        assert effect is not None
        place = effect.record()["place"]
        kinds.setdefault(strength, set()).add(place.partition("@")[0])
    assert kinds["medium"] == {"*", "advance", "stop", "exit"}
    assert kinds["large"] == {"advance", "exit"}


def test_splash_is_hidden_where_a_next_lane_is_busy() -> None:
    lanes = {"wide_0": 300.0, "wide_1": 90.0, "narrow_0": 300.0}
    detectors = tuple(Detector(f"stop:{lane}", lane, 97.5, 0.0, "stop") for lane in lanes)

    def shown(place: str, rates: Mapping[str, float]) -> bool:
        at = {f"stop:{lane}": n for lane, n in rates.items()}
        return with_next_lane([place], detectors, at) == (place,)

    assert shown("*", lanes)
    assert shown("stop@wide", lanes)
    assert not shown("stop@narrow", lanes)
    assert not shown("stop@wide", {**lanes, "wide_0": 90.0})


def test_vehicles_among_others_tell_less_than_alone() -> None:
    # 120 of the 480 an hour on "shared" come from A: their change is as hard to see as one of
    # 120**2 / 480 = 30 alone. On "own", where no detector is, they would be 120.
    routes = Routes(
        origins={"A": 120.0, "B": 360.0},
        passing={"A": {"own": 120.0, "shared": 120.0}, "B": {"shared": 360.0}},
        turns={},
        joint={"own": {"own": 120.0}, "shared": {"shared": 480.0}},
    )
    assert telling(routes, "A", ["shared"]) == pytest.approx(30.0)
    assert telling(routes, "A", ["shared", "own"]) == pytest.approx(120.0)
    assert telling(routes, "B", ["shared"]) == pytest.approx(270.0)
    assert telling(routes, "B", ["own"]) == 0.0


@pytest.mark.parametrize(("gap_s", "shown"), [(20.0, False), (15.0, True)])
def test_how_drivers_yield_is_hidden_where_enough_of_them_do(
    crossing: Callable[..., Path], gap_s: float, shown: bool
) -> None:
    # A vehicle every 20 s is 180 an hour, one every 15 s more than 200; both times with a green
    # on which they yield.
    count = math.ceil(200 / gap_s)
    vehicles = "".join(
        f'<vehicle id="{road}{i}" type="car" route="{road}" depart="{gap_s * i:g}"/>'
        for i in range(count)
        for road in ("north", "east")
    )
    yields = lambda text: text.replace('state="Gr"', 'state="gr"')  # noqa: E731
    scenario = load_scenario(crossing(vehicles=vehicles, edit=yields))
    busy = busy_places(scenario, 0)
    assert busy.permitted == shown
    drawn = draw_sample(Task("single", "gap_acceptance", "medium"), scenario, busy, rng())
    assert (drawn is not None) == shown
    priority = load_scenario(crossing(vehicles=vehicles))
    assert not busy_places(priority, 0).permitted, "nobody yields there"


def test_every_effect_that_is_left_out_for_show_can_be_left_out(
    single: tuple[Scenario, Busy],
) -> None:
    shown = set[str]()
    for number in range(300):
        generator = np.random.default_rng(number)
        drawn = draw_sample(Task("none"), *single, generator)
        assert isinstance(drawn, Sample)
        assert not library(drawn.leave_out) & set(drawn.leave_out)
        shown |= set(drawn.leave_out)
    assert set(IN_THE_LOG) <= shown, "the log's effects are among them"
    for name in known_effects():
        assert name not in library((name,))


@pytest.mark.parametrize("last_s", [200.0, 800.0])
def test_only_vehicles_of_the_day_make_an_origin_busy(
    crossing: Callable[..., Path], last_s: float
) -> None:
    # Ten in 200 s are 180 an hour, whatever comes afterwards.
    vehicles = "".join(
        f'<vehicle id="v{i}" type="car" depart="{20 * i}"><route edges="S_C C_N"/></vehicle>'
        for i in range(int(last_s / 20))
    )
    directory = crossing(vehicles=vehicles)
    demand = directory / "demand.rou.xml"
    lines = demand.read_text().splitlines()
    demand.write_text("\n".join(line for line in lines if "<route id=" not in line))
    assert busy_places(load_scenario(directory), 0).origins == pytest.approx({"S_C": 180.0})


def test_what_changes_no_detection_is_not_hidden(crossing: Callable[..., Path]) -> None:
    scenario = load_scenario(crossing()).with_duration(300)
    consequences = Consequences(3)

    def has(*records: dict[str, str | float], group: str = "pair") -> bool:
        effects = tuple(effect_from_record(item) for item in records)
        return consequences.has(scenario, Sample(group, "", "", effects), "fixed-time:20")

    nobody_weaves = {"name": "lane_discipline", "strategic": 0.0}  # every approach has one lane
    headway = {"name": "headway", "seconds": 1.6}
    assert not has(nobody_weaves)
    assert has(headway)
    assert not has(headway, nobody_weaves)
    assert has(headway, nobody_weaves, group="setting")  # all of it together
    assert not has(nobody_weaves, group="setting")
    assert has({"name": "undercount", "place": "*", "share": 0.1})


def test_detections_that_differ_are_counted_both_ways() -> None:
    def period(**times: list[float]) -> Period:
        seen = {
            name: Passages(np.array(off) - 0.5, np.array(off), np.full(len(off), np.nan),
                           np.full(len(off), np.nan))
            for name, off in times.items()
        }  # fmt: skip
        return Period("day1", 0.0, 60.0, "fit", {}, seen)

    one = period(a=[1.0, 2.0, 3.0], b=[5.0])
    assert differing(one, one) == 0
    assert differing(one, period(a=[1.0, 2.02, 3.0], b=[5.0])) == 0
    assert differing(one, period(a=[1.0, 2.5, 3.0], b=[5.0])) == 2
    assert differing(one, period(a=[1.0, 3.0])) == 2
