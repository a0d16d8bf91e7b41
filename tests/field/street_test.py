"""The field loop at a SUMO that runs as a program of its own and is reached over TraCI."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ugat_marl.__main__ import main
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError, SimulatorError
from ugat_marl.policies import DQN, UNIVERSAL_NAME, make_rule, observed_options, suite_config
from ugat_marl.scenarios import GREEN, sumo_program
from ugat_marl.simulation import Trips, launch_of, read_trips

pytest.importorskip("traci")

from ugat_marl.field import FieldLoop, SimulatedStreet, Site, TraciStreet, TrustLimits

PATIENT = TrustLimits(answer_ms=5000)
"""Limits under which every answer is in time, also on a busy machine."""


class Watched(TraciStreet):
    """The street, with somebody who writes down what its lights show in every second."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.by_second = [self.shown()]

    def wait(self, until_s: float) -> None:
        for second in range(round(self.now_s()) + 1, round(until_s) + 1):
            super().wait(float(second))
            self.by_second.append(self.shown())


class Remembering:
    """A policy, and what it saw."""

    def __init__(self, policy: Any) -> None:
        self.policy = policy
        self.env_options: Mapping[str, Any] = policy.env_options
        self.seen: list[dict[str, Any]] = []

    def reset(self, seed: int) -> None:
        self.seen = []
        self.policy.reset(seed)

    def act(self, observations: Any, infos: Any) -> dict[str, int]:
        self.seen.append({agent: seen.copy() for agent, seen in observations.items()})
        return self.policy.act(observations, infos)


class SumoServer:
    """``sumo --remote-port`` with a scenario, as somebody else may have started it."""

    def __init__(self, scenario: Any, directory: Path, port: int | None = None) -> None:
        if port is None:
            with socket.socket() as probe:
                probe.bind(("localhost", 0))
                port = int(probe.getsockname()[1])
        self.port, self._directory = port, directory
        launch = launch_of(scenario, 3, directory, ())
        self.end_s = launch.end_s
        launch.write()
        self.process = subprocess.Popen(
            [str(sumo_program("sumo")), *launch.arguments, "--remote-port", str(port)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def trips(self) -> Trips:
        self.process.wait(20)
        return read_trips(self._directory / "trips.xml", self.end_s)

    def end(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Callable[..., tuple[SumoServer, Watched]]]:
    """Starts SUMO with a scenario and connects to it."""
    ends: list[Callable[[], None]] = []

    def run(scenario: Any, site: Site, **options: Any) -> tuple[SumoServer, Watched]:
        sumo = SumoServer(scenario, tmp_path / f"sumo{len(ends)}")
        ends.append(sumo.end)
        street = Watched(tuple(site.capacity), sumo.port, **options)
        ends.append(street.close)
        return sumo, street

    yield run
    for end in reversed(ends):
        end()


def test_minutes_of_single_v1_in_snow(running: Callable[..., Any]) -> None:
    scenario = scenario_in_domain(load_scenario("single-v1"), "V4")
    policy = make_rule("largest-queue:10", parallel_env(scenario))
    site = Site.of(scenario, policy.env_options)
    sumo, street = running(scenario, site)
    loop = FieldLoop(site, policy, street, PATIENT)
    summary = loop.drive(240.0)
    assert (summary.decisions, summary.fallback_share) == (24, 0)
    assert street.now_s() == 240
    assert len(street.by_second) == 241
    (light,) = site.lights
    shown = [states[light] for states in street.by_second]
    assert len({state for state in shown if "y" not in state}) > 2, "it never switched"
    for before, after in pairwise(shown):
        assert not any(
            a in GREEN and b not in GREEN | {"y"} for a, b in zip(before, after, strict=True)
        )
    yellow = "".join("y" if "y" in state else "-" for state in shown)
    assert set(map(len, re.findall("y+", yellow))) == {3}
    street.close()
    trips = sumo.trips()
    assert trips.entered.sum() > 50
    assert 20 < trips.travel_time_s.mean() < 240


def cycling(env: Any) -> Any:
    return make_rule("fixed-time:20", env)


def universal(env: Any) -> Any:
    return DQN.of(env, suite_config(UNIVERSAL_NAME)).policy()


@pytest.mark.parametrize(
    ("options", "make"),
    [({"observation": "movements"}, cycling), (observed_options(UNIVERSAL_NAME), universal)],
)
def test_a_policy_sees_in_the_field_what_it_sees_in_an_environment(
    running: Callable[..., Any],
    crossing: Callable[..., Path],
    options: dict[str, Any],
    make: Callable[[Any], Any],
) -> None:
    scenario = load_scenario(crossing())  # no clearance and no minimum green: both begin alike
    env = parallel_env(scenario, **options)
    here, there = Remembering(make(env)), Remembering(make(env))
    site = Site.of(scenario, options)
    _, street = running(scenario, site)
    FieldLoop(site, there, street, PATIENT).drive(200.0)
    observations, infos = env.reset(seed=3)
    here.reset(0)
    while env.agents:
        observations, _, _, _, infos = env.step(here.act(observations, infos))
    env.close()
    assert len(here.seen) == len(there.seen) == 20
    for place, (a, b) in enumerate(zip(here.seen, there.seen, strict=True)):
        for agent in a:
            np.testing.assert_array_equal(a[agent], b[agent], err_msg=f"decision {place}")
    assert any(seen[agent][:4].any() for seen in here.seen for agent in seen), "no traffic"


AREAS = """<additional>
    <laneAreaDetector id="near" lane="S_C_0" pos="-40" endPos="-1" period="3600" file="NUL"/>
    <laneAreaDetector id="far" lane="S_C_0" pos="-80" endPos="-40" period="3600" file="NUL"/>
</additional>
"""


def test_areas_count_where_they_lie_and_other_lanes_are_missing(
    running: Callable[..., Any], crossing: Callable[..., Path], tmp_path: Path
) -> None:
    def with_areas(text: str) -> str:
        return text.replace("duration_s", 'additional = ["areas.add.xml"]\nduration_s', 1)

    directory = crossing(toml=with_areas)
    (directory / "areas.add.xml").write_text(AREAS.replace("NUL", str(tmp_path / "areas.xml")))
    scenario = load_scenario(directory)
    policy = make_rule("random", parallel_env(scenario))
    site = Site.of(scenario, policy.env_options)
    _, street = running(scenario, site, detectors="areas")
    assert set(street.read()) == {"S_C_0"}
    loop = FieldLoop(site, policy, street)
    (light,) = site.lights
    reasons: list[str] = []
    loop.drive(60.0, lambda decision: reasons.append(decision.fallback[light]))
    assert all("missing: no count of lane W_C_0" in reason for reason in reasons)


def test_a_simulation_without_areas_is_refused(running: Callable[..., Any]) -> None:
    scenario = load_scenario("single-v1")
    with pytest.raises(OptionError, match=r"no lane-area detector \(E2\) on any of the 12 lanes"):
        running(scenario, Site.of(scenario, {}), detectors="areas")


def test_a_simulation_of_another_network_is_refused(running: Callable[..., Any]) -> None:
    site = Site.of(load_scenario("grid2x2-v1"), {})
    with pytest.raises(SimulatorError, match="own network"):
        running(load_scenario("single-v1"), site)


def test_nobody_at_the_port_is_said_so() -> None:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        port = int(probe.getsockname()[1])
    with pytest.raises(SimulatorError, match=f"--remote-port {port}"):
        TraciStreet(["a"], port, patience_s=0.1)


def test_a_street_that_goes_away_is_told(running: Callable[..., Any]) -> None:
    scenario = load_scenario("single-v1")
    policy = make_rule("random", parallel_env(scenario))
    site = Site.of(scenario, policy.env_options)
    sumo, street = running(scenario, site)
    loop = FieldLoop(site, policy, street)

    def end(decision: Any) -> None:
        if decision.time_s >= 20:
            sumo.end()

    with pytest.raises(SimulatorError, match="Connection closed by SUMO"):
        loop.drive(100.0, end)
    assert loop.summary.decisions == 3
    assert street.now_s() == 30


def test_late_greens_are_refused() -> None:
    scenario = scenario_in_domain(load_scenario("single-v1"), "late_green=*,1")
    with pytest.raises(OptionError, match="late"):
        SimulatedStreet(scenario, 0, ())


def test_detectors_see_the_vehicle_that_closes_a_lane() -> None:
    scenario = scenario_in_domain(load_scenario("single-v1"), "lane_closure=northA_A1_1,55,145")
    with SimulatedStreet(scenario, 0, ("northA_A1_1",)) as street:
        street.wait(120.0)
        counted = street.read()["northA_A1_1"]
    assert counted.vehicles >= 1 and counted.halting >= 1


@pytest.mark.parametrize(
    "effect",
    [
        "execution_delay=20",
        "lost_commands=0.3",
        "phase_order=cyclic",
        "counting_noise=0.5",
        "objective=safety",
        "lane_service=northA_A1_0,2,0",
    ],
)
def test_effects_on_controllers_are_refused(effect: str) -> None:
    scenario = scenario_in_domain(load_scenario("single-v1"), f"V4+{effect}")
    with pytest.raises(OptionError, match=f"effect {effect} acts on .* only the environments"):
        SimulatedStreet(scenario, 0, ())


def test_the_own_sumo_of_a_demonstration_is_the_same_street(
    running: Callable[..., Any],
) -> None:
    scenario = scenario_in_domain(load_scenario("single-v1"), "V4")
    policy = make_rule("largest-queue:10", parallel_env(scenario))
    site = Site.of(scenario, policy.env_options)
    sumo, over_traci = running(scenario, site)
    seen: list[list[Any]] = []
    trips: list[Trips] = []
    with SimulatedStreet(scenario, 3, tuple(site.capacity)) as own:
        for street in (own, over_traci):
            made: list[Any] = []
            FieldLoop(site, policy, street, PATIENT).drive(240.0, made.append)
            seen.append([(d.time_s, d.phases, d.fallback) for d in made])
        trips.append(own.trips())
    over_traci.close()
    trips.append(sumo.trips())
    assert seen[0] == seen[1]
    assert trips[0].entered.sum() > 50
    assert np.sort(trips[0].travel_time_s).tolist() == np.sort(trips[1].travel_time_s).tolist()


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="reads /proc")
def test_a_demonstration_opens_no_port() -> None:
    scenario = load_scenario("single-v1")

    def listening() -> set[str]:
        rows = Path("/proc/net/tcp").read_text().splitlines()[1:]
        return {row.split()[9] for row in rows if row.split()[3] == "0A"}

    with SimulatedStreet(scenario, 0, ()) as street:
        street.wait(street.now_s() + 5.0)
        descriptors = [
            str(entry.readlink())
            for pid in ("self", str(street._simulator._worker._pid))  # type: ignore[union-attr]
            for entry in Path(f"/proc/{pid}/fd").iterdir()
            if entry.is_symlink()
        ]
        sockets = {name[len("socket:[") : -1] for name in descriptors if name.startswith("socket")}
        assert sockets
        assert not sockets & listening()


def test_the_command_drives_and_sums_up(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "field.jsonl"
    call = ["field", "single-v1", "--policy", "fixed-time:30", "--start", "--seconds", "60"]
    assert main([*call, "--limits.answer-ms", "5000", "--log", str(log)]) == 0
    said = capsys.readouterr().out
    assert "6 decisions for 1 light;" in said
    assert "fixed time in 0.0%" in said
    assert re.search(r"ATT \d+\.\d s", said)
    assert len(log.read_text().splitlines()) == 6


@pytest.mark.parametrize(
    ("number", "code", "says"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")],
)
def test_a_stopped_command_leaves_its_log_and_nothing_else(
    number: int,
    code: int,
    says: str,
    python: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    log = tmp_path / "field.jsonl"
    health = tmp_path / "health.json"
    call = ["-m", "ugat_marl", "field", "single-v1", "--policy", "fixed-time:30", "--start"]
    with subprocess.Popen(
        [*python, *call, "--seconds", "inf", "--log", str(log), "--health", str(health)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as command:
        until = time.monotonic() + 60
        while not any(x.stat().st_size for x in tmp_path.glob("field.jsonl.*")) and (
            time.monotonic() < until
        ):
            time.sleep(0.05)
        command.send_signal(number)
        _, said = command.communicate(timeout=30)
    assert command.returncode == code, said
    assert said.strip().splitlines()[-1] == f"ugat-marl: {says}"
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    assert rows
    assert [row["time_s"] for row in rows] == [10.0 * n for n in range(len(rows))]
    told = json.loads(health.read_text())
    assert (told["state"], told["times_gone"]) == ("ended", 0)
    # the signal may have come between the last line and its count
    assert told["decisions"] in (len(rows) - 1, len(rows))
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["field.jsonl", "health.json"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--policy", "random"], "--port is missing"),
        (["--policy", "random", "--port", "70000"], "--port 70000: a port is a number from 1"),
        (["--policy", "random", "--port", "-1"], "--port -1: a port is a number from 1"),
        (["--policy", "random", "--start", "--host", "far"], "--host far"),
        (["--policy", "random", "--start", "--port", "8813"], "opens no port"),
        (["--policy", "random", "--start", "--look-for-s", "9"], "opens no port"),
        (["--policy", "random", "--port", "1", "--look-for-s", "-1"], "--look-for-s"),
        (["--policy", "random", "--port", "1", "--sumo-answer-s", "inf"], "--sumo-answer-s"),
        (["--policy", "random", "--port", "1", "--domain", "V4"], "leave out --domain"),
        (["--policy", "random", "--port", "1", "--seed", "7"], "leave out --seed"),
        (["--policy", "random", "--start", "--seconds", "0"], "above 0"),
        (["--policy", "random", "--start", "--seconds", "5"], "shorter than one decision"),
        (
            ["--policy", "random", "--port", "1", "--seconds", "5", "--log", __file__],
            "something else than decisions",  # after the scenario, before the street
        ),
        (["--policy", "programme", "--start"], "programme"),
        (["--policy", "longest-waiting", "--start"], "waiting times"),
        (["--policy", "random", "--start", "--limits.answer-ms", "5"], "reserve_ms"),
        (
            ["--policy", "random", "--start", "--limits.green-s", "0"],
            "--limits.green-s 0: must be above",
        ),
        (["--policy", "a.pt", "--start", "--health", "a.pt"], "--health and --policy are one file"),
        (["--policy", "random", "--start", "--log", "a", "--health", "./a"], "are one file"),
        (["--policy", "random", "--start", "--health", __file__], "something else than the state"),
        (["--policy", "random", "--start", "--sumo-answer-s", "1"], "leave out --sumo-answer-s"),
        (["--policy", "random", "--start", "--log", __file__], "something else than decisions"),
    ],
)
def test_wrong_calls_are_one_line(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["field", "single-v1", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert says in error
    assert len(error.splitlines()) == 1
