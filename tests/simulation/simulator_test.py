"""SUMO inside this process: what it measures, what it refuses, and what it says then."""

from __future__ import annotations

import gzip
import itertools
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import pytest

from ugat_marl import parallel_env
from ugat_marl.effects import Acceleration, StartupDelay, apply_effects, load_scenario
from ugat_marl.errors import SimulatorBusy, SimulatorError
from ugat_marl.scenarios import GREEN
from ugat_marl.simulation import LibsumoSimulator, launch_of, read_trips

Crossing = Callable[..., Path]
LANES = ("S_C_0", "W_C_0", "C_N_0", "C_E_0")


@pytest.fixture
def simulator() -> Iterator[LibsumoSimulator]:
    made = LibsumoSimulator()
    yield made
    made.close()


def started(simulator: LibsumoSimulator, directory: Path, tmp_path: Path, **options: bool) -> Path:
    """Starts the scenario of a directory; returns the simulation's own folder."""
    own = tmp_path / f"own{len(list(tmp_path.iterdir()))}"
    own.mkdir()
    simulator.start(launch_of(load_scenario(directory), 1, own, LANES, **options))
    return own


def car(route: str, depart: float, position: float, speed: float) -> str:
    return (
        f'<vehicle id="{route}{depart}" type="car" route="{route}" depart="{depart}" '
        f'departPos="{position}" departSpeed="{speed}"/>'
    )


def test_plans_are_shown_to_the_second(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    """A standing car moves in the very second its light turns green, not before and not after."""
    started(simulator, crossing(vehicles=car("east", 0, 490, 0)), tmp_path)
    red = simulator.advance(10, {"C": [(4.0, "Gr"), (6.0, "rr")]})
    assert (red.time_s, red.vehicles[1], red.halting[1]) == (10, 1, 1)
    # Four more seconds of red, then green for two: 2.5 m/s after the first, 5 m/s after the other.
    moving = simulator.advance(6, {"C": [(4.0, "rr"), (2.0, "rG")]})
    assert (moving.vehicles[1], moving.halting[1], moving.vehicles[3]) == (0, 0, 0)
    picture = simulator.vehicles()
    assert picture.speed_mps.tolist() == [5.0]
    # SUMO's x of the car: 490 m along the road, then 2.5 + 5 m across the junction.
    np.testing.assert_allclose(picture.position, [[497.5, 500.0]], atol=1e-6)
    assert picture.angle_deg.tolist() == [90.0]
    assert picture.length_m.tolist() == [5.0]
    assert simulator.signals() == {"C": "rG"}
    # A light that is left out goes on showing what it showed.
    assert simulator.advance(1, {}).time_s == 17
    assert simulator.signals() == {"C": "rG"}


@pytest.mark.parametrize("step", [0.5, 0.1])
def test_plans_hold_at_fractions_of_a_second(
    step: float, simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    directory = crossing(
        vehicles=car("east", 0, 490, 0),
        toml=lambda text: text.replace("duration_s", f"step_length_s = {step}\nduration_s"),
    )
    started(simulator, directory, tmp_path)
    for _ in range(7):  # sums of tenths: 0.7 + 0.1 is not 0.8
        simulator.advance(step, {"C": [(step, "Gr")]})
    green_s = 3 * step
    simulator.advance(10 * step, {"C": [(7 * step, "rr"), (green_s, "rG")]})
    assert libsumo.simulation.getTime() == pytest.approx(17 * step)
    assert simulator.vehicles().speed_mps.tolist() == pytest.approx([2.5 * green_s])


def test_a_second_simulation_knows_nothing_of_the_first(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    directory = crossing()
    for _ in range(2):
        started(simulator, directory, tmp_path)
        assert simulator.signals() == {"C": "Gr"}
        simulator.advance(1, {"C": [(1.0, "rr")]})
        assert simulator.signals() == {"C": "rr"}
        assert simulator.advance(0.0, {}).time_s == 1


def test_without_plans_the_programme_runs(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    started(simulator, crossing(), tmp_path)
    seen = [simulator.signals()["C"]]
    for _ in range(6):
        simulator.advance(10, {})
        seen.append(simulator.signals()["C"])
    # 40 s and 10 s; SUMO switches in the second that begins at 40.
    assert seen == ["Gr", "Gr", "Gr", "Gr", "Gr", "rG", "Gr"] or seen == [
        "Gr", "Gr", "Gr", "Gr", "rG", "Gr", "Gr",
    ]  # fmt: skip


def test_waiting_times_are_measured_when_asked_for(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    directory = crossing(vehicles=car("east", 0, 490, 0) + car("east", 5, 482.5, 0))
    started(simulator, directory, tmp_path, waiting=True)
    snapshot = simulator.advance(20, {"C": [(20.0, "Gr")]})
    # One stands since second 0, the other since second 5; both count from the second after.
    assert snapshot.waiting_s.tolist() == [0, 19 + 14, 0, 0]
    simulator.close()
    started(simulator, directory, tmp_path)
    assert simulator.advance(20, {}).waiting_s.size == 0


def test_a_second_simulation_in_one_process_is_refused(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    started(simulator, crossing(), tmp_path)
    second = LibsumoSimulator()
    with pytest.raises(SimulatorBusy, match='close the other one, or use simulator="process"'):
        started(second, crossing(), tmp_path)
    second.close()  # must not end the first
    assert simulator.advance(10, {}).time_s == 10
    simulator.close()
    started(second, crossing(), tmp_path)
    assert second.advance(10, {}).departed == 2
    second.close()


def test_a_second_environment_in_process_is_refused(crossing: Crossing) -> None:
    first = parallel_env(crossing(), simulator="inprocess")
    second = parallel_env(crossing(), simulator="inprocess")
    try:
        first.reset(seed=0)
        with pytest.raises(SimulatorBusy):
            second.reset(seed=0)
        second.close()
        first.step({"signal_0": 0})
        first.reset(seed=0)  # its own may be replaced
        first.close()
        second.reset(seed=0)
    finally:
        first.close()
        second.close()


def test_a_simulation_somebody_else_started_is_not_touched(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    network = crossing() / "network.net.xml"
    libsumo.start(["sumo", "-n", str(network), "--no-step-log", "--no-warnings"])
    try:
        with pytest.raises(SimulatorBusy):
            started(simulator, crossing(), tmp_path)
        simulator.close()
        libsumo.simulation.step(5)
        assert libsumo.simulation.getTime() == 5
    finally:
        libsumo.close()


@pytest.mark.parametrize(
    ("vehicles", "words"),
    [
        ('<vehicle id="v" route="nowhere" depart="0"/>', "route 'nowhere' .*'v'"),
        ('<vehicle id="v" type="ship" route="east" depart="0"/>', "type 'ship'.*'v'"),
    ],
)
def test_sumo_s_own_words_when_it_refuses(
    vehicles: str, words: str, simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    with pytest.raises(SimulatorError, match=words) as caught:
        started(simulator, crossing(vehicles=vehicles), tmp_path)
    assert "\n" not in str(caught.value)
    assert "Quitting" not in str(caught.value)
    started(simulator, crossing(), tmp_path)  # and the process is as good as new


def test_sumo_s_own_words_when_it_fails_on_the_way(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    cars = "".join(car("east", depart, 0, 10) for depart in range(0, 600, 100))
    broken = '<vehicle id="lost" depart="600"><route edges="W_C C_N"/></vehicle>'
    started(simulator, crossing(vehicles=cars + broken), tmp_path)
    simulator.advance(300, {})
    with pytest.raises(SimulatorError, match=r"SUMO failed after 300 s: .*'lost' has no valid rou"):
        simulator.advance(400, {})
    started(simulator, crossing(), tmp_path)


def test_a_state_of_the_wrong_length_is_sumo_s_error(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    started(simulator, crossing(), tmp_path)
    with pytest.raises(SimulatorError, match="SUMO failed after 0 s: Mismatching .*'C'"):
        simulator.advance(10, {"C": [(10.0, "G")]})


# --- the signals SUMO really shows


def test_what_sumo_shows_keeps_every_rule() -> None:
    """Random requests every second on unequal intersections, read back from SUMO each second."""
    scenario = load_scenario("mixed-v1").with_control(decision_interval_s=1, min_green_s=4)
    env = parallel_env(scenario, simulator="inprocess", duration_s=150)
    generator = np.random.default_rng(2)
    shown: list[dict[str, str]] = []
    env.reset(seed=2)
    wanted = dict.fromkeys(env.agents, 0)
    while env.agents:
        for agent in env.agents:
            if generator.random() < 0.15:
                wanted[agent] = int(generator.integers(env.action_space(agent).n))
        env.step(wanted)
        if env.agents:
            assert env._simulator is not None
            shown.append(env._simulator.signals())
    env.close()
    changes = 0
    for item in env.network.intersections:
        phases = set(item.phases)
        green_since = dict.fromkeys(range(len(item.phases[0])), -1000)
        for second, (before, after) in enumerate(
            itertools.pairwise(states[item.id] for states in shown)
        ):
            changes += before != after
            for link, (a, b) in enumerate(zip(before, after, strict=True)):
                if a in GREEN and b not in GREEN:
                    assert b == "y", f"{item.id}, link {link}: {before} -> {after}"
                    assert second + 1 - green_since[link] >= 4
                if a == "y" and b != "y":
                    assert b == "r"
                    yellow = [states[item.id][link] for states in shown[second - 2 : second + 1]]
                    assert yellow == ["y"] * 3
                if a not in GREEN and b in GREEN:
                    green_since[link] = second + 1
                    assert after in phases
    assert changes > 100


# --- launching


def test_edited_files_are_written_and_others_are_not_copied(
    crossing: Crossing, tmp_path: Path
) -> None:
    scenario = load_scenario(crossing())
    own = tmp_path / "own"
    assert launch_of(scenario, 7, own, LANES).files == ()
    launch = launch_of(apply_effects(scenario, [StartupDelay(1)]), 7, own, LANES)
    assert not own.exists()
    launch.write()
    files = {str(file.relative_to(own)) for file in own.rglob("*.xml")}
    assert files == {"scenario/default-types.add.xml", "scenario/demand.rou.xml"}
    assert own.stat().st_mode & 0o777 == 0o700
    arguments = dict(zip(launch.arguments[::2], launch.arguments[1::2], strict=True))
    assert arguments["--seed"] == "7"
    assert arguments["--net-file"] == str(scenario.network.path)
    assert arguments["--time-to-teleport"] == "-1"


def test_edited_files_of_one_name_are_kept_apart(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    directory = crossing(
        vehicles=car("east", 0, 490, 0),
        toml=lambda text: text.replace('"demand.rou.xml"', '"demand.rou.xml", "b/demand.rou.xml"'),
    )
    (directory / "b").mkdir()
    (directory / "b" / "demand.rou.xml").write_text(
        '<routes><vType id="van"/><vehicle id="x" type="van" depart="0"><route edges="S_C C_N"/>'
        "</vehicle></routes>"
    )
    own = tmp_path / "own"
    own.mkdir()
    scenario = apply_effects(load_scenario(directory), [Acceleration(1.0)])
    simulator.start(launch_of(scenario, 1, own, LANES))
    assert simulator.advance(5, {}).departed == 2


def test_packed_files_run_as_they_are(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    directory = crossing(toml=lambda text: text.replace('.xml"', '.xml.gz"'))
    for name in ("network.net.xml", "demand.rou.xml"):
        (directory / f"{name}.gz").write_bytes(gzip.compress((directory / name).read_bytes()))
        (directory / name).unlink()
    scenario = load_scenario(directory)
    for number, effects in enumerate(([], [Acceleration(1.0)])):
        own = tmp_path / f"own{number}"
        simulator.start(launch_of(apply_effects(scenario, effects), 1, own, LANES))
        assert simulator.advance(5, {}).departed == 2


@pytest.mark.parametrize("name", ["with blank", "with,comma", "with;semicolon", "mit-ü", "a'b"])
def test_directories_may_have_any_name(
    name: str, simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    directory = crossing().rename(tmp_path / name)
    started(simulator, directory, tmp_path)
    assert simulator.advance(5, {}).departed == 2


def test_late_begins_are_not_rounded(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    directory = crossing(
        vehicles=car("east", 1234571, 490, 0),
        toml=lambda text: text.replace("duration_s", "begin_s = 1234567\nduration_s"),
    )
    started(simulator, directory, tmp_path)
    assert simulator.advance(4, {}).departed == 0
    assert simulator.advance(1, {}).departed == 1
    assert libsumo.simulation.getTime() == 1234572


def test_a_folder_of_its_own_is_all_it_writes(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    directory = crossing()
    before = sorted(directory.iterdir())
    own = started(simulator, directory, tmp_path)
    simulator.advance(100, {})
    simulator.finish()
    assert sorted(file.name for file in own.iterdir()) == ["errors.log", "trips.xml"]
    assert sorted(directory.iterdir()) == before
    assert list(here.iterdir()) == []


# --- trips


def test_trips_are_read_as_sumo_writes_them(tmp_path: Path) -> None:
    file = tmp_path / "trips.xml"
    file.write_text(
        '<tripinfos><tripinfo id="a" depart="5.00" arrival="105.00" departDelay="5.00" '
        'duration="100.00" timeLoss="12.00"/><tripinfo id="b" depart="5.00" arrival="-1.00" '
        'departDelay="0.00" duration="95.00" timeLoss="1.00"/><tripinfo id="c" depart="-1.00" '
        'arrival="-1.00" departDelay="60.00" duration="0.00" timeLoss="0.00"/></tripinfos>'
    )
    trips = read_trips(file, 100.0)
    assert trips.travel_time_s.tolist() == [105, 95, 60]
    assert trips.delay_s.tolist() == [17, 1, 60]
    assert trips.finished.tolist() == [True, False, False]
    assert trips.entered.tolist() == [True, True, False]
    assert trips.finished.dtype == bool


def test_emissions_of_a_blocker_are_nobody_else_s(tmp_path: Path) -> None:
    file = tmp_path / "trips.xml"
    emissions = '<emissions CO2_abs="{}"/></tripinfo>'
    file.write_text(
        f'<tripinfos><tripinfo id="a" depart="5" arrival="9">{emissions.format(1000)}'
        f'<tripinfo id="parking.east.0" vType="parking.east" depart="5">{emissions.format(777000)}'
        '<tripinfo id="b" depart="-1" arrival="-1"/></tripinfos>'
    )
    (tmp_path / "statistics.xml").write_text("<statistics/>")
    assert read_trips(file, 100.0, {"": 1.3}).co2_g.tolist() == [1, 0]


CARELESS = (
    '<vType id="bad" length="5" minGap="0.5" tau="0.1" sigma="1" accel="4" decel="3" '
    'emergencyDecel="3" apparentDecel="9" actionStepLength="3" speedFactor="1.5"/>'
)


def test_what_a_calibrator_removes_is_no_traveller(tmp_path: Path) -> None:
    file = tmp_path / "trips.xml"
    rows = [(name, f'arrival="12" vaporized="{name}"') for name in ("calibrator", "collision", "")]
    file.write_text(
        "<tripinfos>"
        + "".join(
            f'<tripinfo id="{n}" depart="2" {a} departDelay="1" duration="10" timeLoss="3"/>'
            for n, a in rows
        )
        + "</tripinfos>"
    )
    trips = read_trips(file, 100.0)
    assert trips.travel_time_s.tolist() == [99.0, 11.0]
    assert trips.delay_s.tolist() == [92.0, 4.0]
    assert trips.finished.tolist() == [False, True]


def held(scenario: Path, domain: str) -> Any:
    """The scores of an episode in which the first phase is held."""
    env = parallel_env(scenario, domain, simulator="inprocess")
    env.reset(seed=1)
    while env.agents:
        env.step(dict.fromkeys(env.agents, 0))
    scores = env.scores()
    env.close()
    return scores


@pytest.mark.parametrize("action", ["warn", "remove"])
def test_vehicles_that_sumo_removes_have_not_arrived(crossing: Crossing, action: str) -> None:
    """Careless drivers collide at the red light. Removed at once, they had the shortest trips."""
    due = "".join(
        f'<vehicle id="v{k}" type="bad" depart="{3 * k}" route="east" departSpeed="max"/>'
        for k in range(30)
    )
    scenario = crossing(
        types=CARELESS,
        vehicles=due,
        toml=lambda text: f'{text}\n[sumo]\n"collision.action" = "{action}"\n',
    )
    scores = held(scenario, "sim")
    assert (scores.due, scores.departed, scores.throughput) == (30, 30, 0)
    assert scores.att_s == pytest.approx(200 - 1.5 * 29, abs=1.0)


@pytest.mark.parametrize(
    "option", ["emergencydecel.warning-threshold", "device.emissions.probability"]
)
def test_options_of_a_scenario_that_an_objective_sets_too(crossing: Crossing, option: str) -> None:
    """SUMO refuses an option that is given twice."""
    scenario = crossing(toml=lambda text: f'{text}\n[sumo]\n"{option}" = "0.5"\n')
    assert held(scenario, "objective=emissions").hidden["co2_g"] > 0


def test_no_trips_are_empty_arrays(tmp_path: Path) -> None:
    file = tmp_path / "trips.xml"
    file.write_text("<tripinfos/>")
    trips = read_trips(file, 100.0)
    assert trips.travel_time_s.shape == trips.finished.shape == (0,)


@pytest.mark.parametrize("content", [None, '<tripinfos><tripinfo id="a" depart="5', ""])
def test_a_report_cut_short_is_an_error_of_the_simulator(
    content: str | None, tmp_path: Path
) -> None:
    file = tmp_path / "trips.xml"
    if content is not None:
        file.write_text(content)
    with pytest.raises(SimulatorError, match="report on its vehicles cannot be read .*room left"):
        read_trips(file, 100.0)


def test_trips_add_up_to_sumo_s_own_statistics(crossing: Crossing, tmp_path: Path) -> None:
    """Against the summary SUMO writes itself, on a shipped network with everything in it."""
    scenario = load_scenario("mixed-v1").with_duration(400)
    own = tmp_path / "own"
    own.mkdir()
    simulator = LibsumoSimulator()
    launch = launch_of(scenario, 3, own, ())
    statistics = tmp_path / "statistics.xml"
    arguments = (*launch.arguments, "--statistic-output", str(statistics))
    simulator.start(replace(launch, arguments=arguments))
    simulator.advance(400, {})
    trips = simulator.finish()
    root = ET.parse(statistics).getroot()
    vehicles, summary = root.find("vehicles"), root.find("vehicleTripStatistics")
    assert vehicles is not None
    assert summary is not None
    assert int(trips.entered.sum()) == int(vehicles.get("inserted", ""))
    assert int((~trips.entered).sum()) == int(vehicles.get("waiting", ""))
    assert int((trips.entered & ~trips.finished).sum()) == int(vehicles.get("running", ""))
    inside_s, outside_s = (
        float(summary.get(name, "")) for name in ("totalTravelTime", "totalDepartDelay")
    )
    assert trips.travel_time_s.sum() == pytest.approx(inside_s + outside_s, abs=0.1)
    lost_s = float(summary.get("timeLoss", "")) * int(summary.get("count", ""))
    assert trips.delay_s.sum() == pytest.approx(lost_s + outside_s, rel=1e-3)
