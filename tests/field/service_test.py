"""The field loop as a service: streets that go away and come back, and what it tells of itself."""

from __future__ import annotations

import errno
import json
import math
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.field.loop_test import LIGHT, QUICK, SITE, MadeUpStreet, Scripted
from tests.field.street_test import SumoServer
from ugat_marl.effects import load_scenario
from ugat_marl.errors import EpisodeError, OptionError, OutputError, SimulatorError
from ugat_marl.field import DecisionLog, FieldService, Health, TraciStreet
from ugat_marl.field.service import FIRST_PAUSE_S, LONGEST_PAUSE_S


class Leaving(MadeUpStreet):
    """A street that is gone at some time of its own clock."""

    def __init__(self, at_s: float, error: type[Exception] = SimulatorError) -> None:
        super().__init__()
        self.at_s, self.error = at_s, error

    def wait(self, until_s: float) -> None:
        if until_s > self.at_s:
            raise self.error("no line to the cabinet")
        super().wait(until_s)


class Coming:
    """Connections, in order: a street, or the error of an attempt."""

    def __init__(self, *answers: MadeUpStreet | Exception) -> None:
        self.answers = [*answers]

    def __call__(self) -> MadeUpStreet:
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


def service(connect: Callable[[], Any], **options: Any) -> FieldService:
    return FieldService(SITE, Scripted(), connect, QUICK, **options)


@pytest.mark.parametrize("error", [SimulatorError, ConnectionResetError, TimeoutError])
def test_a_street_that_comes_back_is_driven_for_what_is_left(
    error: type[Exception], tmp_path: Path
) -> None:
    first, second = Leaving(45.0, error), MadeUpStreet()
    second.states[LIGHT] = "r" * len(second.states[LIGHT])
    refused = [error("refused") for _ in range(8)]
    pauses: list[float] = []
    said: list[str] = []
    log = DecisionLog(tmp_path / "field.jsonl")
    connect = Coming(error("not yet"), first, *refused, second)
    summary = service(connect, log=log, say=said.append, sleep=pauses.append).run(100.0)
    doubled = [min(FIRST_PAUSE_S * 2**n, LONGEST_PAUSE_S) for n in range(9)]
    assert pauses == [FIRST_PAUSE_S, *doubled]
    assert doubled[-1] == LONGEST_PAUSE_S
    assert [line.partition(" (")[0] for line in said] == [
        "the street is gone",
        "the street is back",
    ] * 2
    assert "no line to the cabinet" in said[2]
    times = [json.loads(line)["time_s"] for line in log.path.read_text().splitlines()]
    assert times == [0, 10, 20, 30, 40, *range(0, 60, 10)]  # the fifth was under way
    assert summary.decisions == 11
    assert second.time_s == 60.0


def test_a_full_disk_behind_the_output_does_not_stop_the_lights() -> None:
    def full(_: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    connect = Coming(Leaving(45.0), MadeUpStreet())
    summary = service(connect, say=full, sleep=lambda _: None).run(100.0)
    assert summary.decisions == 11


def test_a_host_that_takes_no_connection_is_not_waited_for_without_end() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(0)
        port = listener.getsockname()[1]
        waiting = [socket.socket() for _ in range(4)]
        for one in waiting:  # until the queue of the listener is full
            one.setblocking(False)
            one.connect_ex(("127.0.0.1", port))
        begun = time.monotonic()
        with pytest.raises(SimulatorError, match="nobody listened for 0.5 s"):
            TraciStreet((), port, "127.0.0.1", patience_s=0.5)
        assert time.monotonic() - begun < 10.0
        for one in waiting:
            one.close()
    assert socket.getdefaulttimeout() is None


def test_a_street_that_stays_away_ends_the_service_after_its_time() -> None:
    begun = time.monotonic()
    street = Leaving(15.0)
    connect = Coming(street, *[SimulatorError("refused")] * 1000)
    with pytest.raises(SimulatorError, match="refused"):
        service(connect, look_for_s=0.3, sleep=lambda s: time.sleep(min(s, 0.05))).run(math.inf)
    assert 0.25 < time.monotonic() - begun < 10.0


def test_without_time_to_look_the_first_loss_ends_the_service() -> None:
    with pytest.raises(SimulatorError, match="no line"):
        service(Coming(Leaving(15.0)), look_for_s=0.0, sleep=pytest.fail).run(100.0)


def test_a_street_with_other_lights_is_no_street_to_wait_for() -> None:
    street = MadeUpStreet()
    street.states[LIGHT] = "GG"
    with pytest.raises(OptionError, match="own network"):
        service(Coming(street), sleep=pytest.fail).run(100.0)


def test_an_error_of_the_caller_is_not_taken_for_a_lost_street() -> None:
    def full(_: Any) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        service(Coming(MadeUpStreet()), sleep=pytest.fail).run(100.0, full)


def test_a_log_that_cannot_be_completed_is_not_taken_for_a_lost_street(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = DecisionLog(tmp_path / "field.jsonl")

    def fail() -> None:
        raise OutputError("the disk is full")

    monkeypatch.setattr(log, "close", fail)
    with pytest.raises(OutputError):
        service(Coming(MadeUpStreet()), log=log, sleep=pytest.fail).run(20.0)


def test_the_health_file_follows_the_loop(tmp_path: Path) -> None:
    path = tmp_path / "health.json"
    seen: list[dict[str, Any]] = []

    def read(*_: Any) -> None:
        seen.append(json.loads(path.read_text()))

    street = Leaving(25.0)
    street.spoil = lambda counts: {}
    connect = Coming(street, MadeUpStreet())
    runs = service(connect, health=Health(path), sleep=read)
    runs.run(40.0, read)
    read()
    states = [told["state"] for told in seen]
    assert states == ["driving"] * 2 + ["looking"] + ["driving"] * 2 + ["ended"]
    assert [told["decisions"] for told in seen] == [1, 2, 3, 4, 5, 5]
    assert [told["times_gone"] for told in seen] == [0, 0, 1, 1, 1, 1]
    assert seen[2]["gone_because"] == "no line to the cabinet"
    assert set(seen[0]["lights_on_plan"]) == set(SITE.lights)
    assert seen[0]["lights_on_plan"][LIGHT].startswith("missing")
    assert seen[3]["lights_on_plan"] == {}
    assert seen[-1]["faults"]["missing"] == 3 * len(SITE.lights)
    assert [entry.name for entry in tmp_path.iterdir()] == ["health.json"]


def test_a_health_file_that_cannot_be_written_does_not_stop_the_lights(tmp_path: Path) -> None:
    (tmp_path / "taken").touch()
    for place in (tmp_path, tmp_path / "taken" / "health.json"):  # a folder; below a file
        with pytest.raises(OutputError):
            Health(place)
    place = tmp_path / "new" / "health.json"
    health = Health(str(place))
    place.mkdir()  # nobody can write such a file any more
    assert service(Coming(MadeUpStreet()), health=health).run(20.0).decisions == 2
    shutil.rmtree(place.parent)
    health.tell("driving")
    assert json.loads(place.read_text())["state"] == "driving"


@pytest.mark.skipif(not hasattr(socket, "AF_UNIX"), reason="has no Unix sockets")
@pytest.mark.parametrize("abstract", [False, True])
def test_systemd_hears_when_it_begins_that_it_lives_and_when_it_ends(
    abstract: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"@ugat-marl-{tmp_path.name}" if abstract else str(tmp_path / "notify")
    heard: list[str] = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(name.replace("@", "\0", 1) if abstract else name)
        line.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        service(Coming(Leaving(15.0), MadeUpStreet()), sleep=lambda s: None).run(30.0)
        while True:
            try:
                heard.append(line.recv(1000).decode())
            except BlockingIOError:
                break
    alive = "STATUS=driving\nWATCHDOG=1"
    assert heard == [
        f"READY=1\n{alive}",
        "STATUS=looking\nWATCHDOG=1",
        *[alive] * 2,
        "STATUS=ended\nSTOPPING=1",
    ]


def test_no_listener_disturbs_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    assert service(Coming(MadeUpStreet())).run(20.0).decisions == 2


# --- at a SUMO of somebody else -------------------------------------------------------------------


def test_the_command_goes_on_when_sumo_is_started_again(python: list[str], tmp_path: Path) -> None:
    scenario = load_scenario("single-v1")
    sumo = SumoServer(scenario, tmp_path / "first")
    health, log = tmp_path / "health.json", tmp_path / "field.jsonl"
    call = ["-m", "ugat_marl", "field", "single-v1", "--policy", "fixed-time:30"]
    options = ["--port", str(sumo.port), "--look-for-s", "60", "--seconds", "inf"]
    files = ["--log", str(log), "--health", str(health)]
    command = subprocess.Popen(
        [*python, *call, *options, *files], stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    try:
        _until(lambda: _told(health)["decisions"] > 3)
        sumo.end()
        _until(lambda: _told(health)["state"] == "looking")
        lost_at = _told(health)["decisions"]
        sumo = SumoServer(scenario, tmp_path / "second", sumo.port)
        _until(lambda: _told(health)["decisions"] > lost_at + 3)
        command.send_signal(signal.SIGTERM)
        said = command.communicate(timeout=30)[0].decode()
    finally:
        command.kill()
        command.wait()
        sumo.end()
    assert command.returncode == 143, said
    assert "opens no port; reaches localhost:" in said
    assert _told(health)["times_gone"] == 1
    times = [json.loads(line)["time_s"] for line in log.read_text().splitlines()]
    assert times.count(0.0) == 2  # the second SUMO begins its day anew


def _told(path: Path) -> Mapping[str, Any]:
    return json.loads(path.read_text()) if path.exists() else {"decisions": 0, "state": ""}


def _until(true: Callable[[], bool], patience_s: float = 60.0) -> None:
    until = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_a_sumo_that_stops_counts_as_gone(tmp_path: Path) -> None:
    sumo = SumoServer(load_scenario("single-v1"), tmp_path / "sumo")
    street = TraciStreet((), sumo.port, answer_s=1.0)
    street.wait(5.0)
    sumo.process.send_signal(signal.SIGSTOP)
    begun = time.monotonic()
    with pytest.raises(SimulatorError, match="no answer for 1 s"):
        street.wait(10.0)
    street.close()
    assert time.monotonic() - begun < 5.0
    sumo.end()


def test_a_service_runs_once() -> None:
    once = service(Coming(MadeUpStreet(), MadeUpStreet()))
    assert once.run(20.0).decisions == 2
    with pytest.raises(EpisodeError, match="make another one"):
        once.run(20.0)
