"""Measured program: a street that breaks down every ten minutes, with a field loop at it."""

from __future__ import annotations

import contextlib
import json
import os
import random
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import libsumo

from studies.bench.soak_cabinets import Cabinets, Fault
from studies.bench.soak_observer import Observer, Rules

_SLOT_S = 600
"""Time in which one fault is drawn, s."""
_PATIENCE_S = 120.0
"""Real time for a loop to begin, s."""
_LATE_S = 0.08
"""Time that a late policy takes, s; it has 0.04."""

LIGHT_FAULTS: tuple[Fault, ...] = ("stuck", "slow", "own plan")
FAULTS = (*LIGHT_FAULTS, "street gone", "street stuck", "kill -9", "stopped", "full disk",
          "late answers", "wrong counts")  # fmt: skip


@dataclass(frozen=True)
class Event:
    """One fault.

    Attributes:
        kind: One of `FAULTS`.
        begin_s: Begin, s.
        end_s: End, s.
        lights: Lights that are affected, if it is a fault of lights.
    """

    kind: str
    begin_s: int
    end_s: int
    lights: tuple[str, ...]


def drawn_events(seconds: int, lights: list[str], seed: int) -> list[Event]:
    """Draw a fault in every ten minutes; each kind comes once in a round of all kinds."""
    rng = random.Random(f"soak {seed}")
    events: list[Event] = []
    kinds: list[str] = []
    for slot in range(seconds // _SLOT_S):
        kinds = kinds or rng.sample(FAULTS, len(FAULTS))
        begin = slot * _SLOT_S + rng.randint(30, 300)
        chosen = tuple(light for light in lights if rng.random() < 0.5) or (lights[0],)
        events.append(Event(kinds.pop(), begin, begin + rng.randint(10, 150), chosen))
    return events


class Traffic:
    """SUMO in this process, one day after the other."""

    def __init__(self, directory: Path, seed: int) -> None:
        self._files = ["-n", str(directory / "network.net.xml"), "-r"]
        self._files += [str(directory / "demand.rou.xml"), "--no-step-log", "--no-warnings"]
        self._day_s, self._seed = 3600, seed
        self._left_s = 0
        self._lanes: list[str] = []

    def second(self, states: Mapping[str, str]) -> dict[str, str]:
        """Simulate one second under these states; return what SUMO's lights show."""
        if self._left_s == 0:
            self._seed, self._left_s = self._seed + 1, self._day_s
            options = [*self._files, "--seed", str(self._seed), "--time-to-teleport", "-1"]
            if self._lanes:
                libsumo.load(options)
            else:
                libsumo.start(["sumo", *options])
                self._lanes = [lane for lane in libsumo.lane.getIDList() if lane[0] != ":"]
        for light, state in states.items():
            libsumo.trafficlight.setRedYellowGreenState(light, state)
        libsumo.simulation.step()
        self._left_s -= 1
        return {light: libsumo.trafficlight.getRedYellowGreenState(light) for light in states}

    def counts(self) -> dict[str, tuple[int, int]]:
        """Return lane to vehicles and standing vehicles."""
        api = libsumo.lane
        return {
            lane: (api.getLastStepVehicleNumber(lane), api.getLastStepHaltingNumber(lane))
            for lane in self._lanes
        }


class Soak:
    """The street with its controllers and faults, and the process of the loop.

    Args:
        directory: Scenario directory.
        seconds: Time to simulate, s.
        seed: Seed of the faults.
        subject: ``"loop"``, or ``"blind"`` for a loop that does not look at lights.
        folder: Folder for the log and the socket.
    """

    def __init__(
        self, directory: Path, seconds: int, seed: int, subject: str, folder: Path
    ) -> None:
        self._seconds, self._folder = seconds, folder
        self.observer = Observer(Rules.read(directory))
        self._traffic = Traffic(directory, seed)
        self._cabinets = Cabinets(_greens(directory))
        self._events = drawn_events(seconds, [*self._cabinets.by_light], seed)
        self._rng = random.Random(f"places {seed}")
        self._now_s = 0
        self._current: Event | None = None
        self._acts: list[Event] = []
        self.begun: Counter[str] = Counter()
        self.unsafe_during: Counter[str] = Counter()
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(folder / "cabinets"))
        self._listener.listen(1)
        self._command = [
            sys.executable, "-m", "studies.bench.soak_loop_program", str(folder / "cabinets"),
            str(directory), str(folder / "field.jsonl"), subject,
        ]  # fmt: skip
        self._loop: subprocess.Popen[bytes] | None = None
        self.connections = 0
        self._advance(1)

    def run(self) -> None:
        """Simulate until the end, then end the loop."""
        self._start_loop()
        while self._now_s < self._seconds:
            with self._connection() as line:
                self._serve(line)
        assert self._loop is not None
        self._loop.send_signal(signal.SIGINT)
        self._loop.wait(_PATIENCE_S)
        self._listener.close()

    def _start_loop(self) -> None:
        with (self._folder / "said.txt").open("ab") as said:
            self._loop = subprocess.Popen(self._command, stdout=said, stderr=said)

    @contextlib.contextmanager
    def _connection(self) -> Iterator[Any]:
        assert self._loop is not None
        until = time.monotonic() + _PATIENCE_S
        self._listener.settimeout(1.0)
        while True:
            try:
                line, _ = self._listener.accept()
                break
            except TimeoutError:
                if self._loop.poll() is not None or time.monotonic() > until:
                    said = (self._folder / "said.txt").read_text()[-1500:]
                    raise RuntimeError(f"the loop ended or does not begin: {said}") from None
        self.connections += 1
        line.settimeout(_PATIENCE_S)
        with line, line.makefile("rwb") as stream:
            yield stream

    def _serve(self, line: Any) -> None:
        """Answer questions until the line is cut, or the time is over."""
        with contextlib.suppress(ConnectionError):
            while self._now_s < self._seconds and (question := line.readline()):
                answer = self._answer(json.loads(question))
                if self._acts and self._acts[0].kind == "street stuck":
                    self._advance(self._acts.pop().end_s - self._now_s)
                    while line.readline():  # until the loop has lost patience
                        pass
                    return
                line.write(json.dumps({**answer, "now_s": float(self._now_s)}).encode() + b"\n")
                line.flush()
                if "error" in answer:
                    return
                while self._acts:
                    if self._act(self._acts.pop()):
                        return

    def _answer(self, question: dict[str, Any]) -> dict[str, Any]:
        event = self._current
        if "hello" in question:
            self._advance(round(question["hello"]))
            event = self._current
            if event is not None and event.kind == "street gone":
                return {"error": "nobody listens"}
            self._cabinets.connected()
        elif event is not None and event.kind == "street gone":
            return {"error": "the line is dead"}
        elif "show" in question:
            if not self._cabinets.command(question["show"]):
                return {"error": "a controller runs its own plan since you were silent"}
        elif "wait" in question:
            while self._now_s < question["wait"] - 1e-6 and not self._acts:
                self._advance(1)
        elif "read" in question:
            return {"counts": self._counts(), "late_s": _LATE_S if self._is("late answers") else 0}
        return {"shown": self._cabinets.shown()} if "shown" in question else {}

    def _act(self, event: Event) -> bool:
        """Do to the loop's process what the fault says; return True if its line is cut."""
        assert self._loop is not None
        time.sleep(self._rng.uniform(0.0, 0.004))  # so that the loop is anywhere
        left_s = event.end_s - self._now_s
        if event.kind == "kill -9":
            self._loop.kill()
            self._loop.wait()
            self._advance(left_s)
            self._start_loop()
            return True
        self._loop.send_signal(signal.SIGSTOP)
        self._advance(left_s)
        self._loop.send_signal(signal.SIGCONT)
        return False

    def _is(self, kind: str) -> bool:
        return self._current is not None and self._current.kind == kind

    def _counts(self) -> dict[str, Any]:
        counts = {lane: (self._now_s, *row) for lane, row in self._traffic.counts().items()}
        if self._is("wrong counts"):
            lanes = self._rng.sample(sorted(counts), len(counts) // 3)
            wrong: list[Any] = [None, (self._now_s - 60, 1, 0), (self._now_s, -3, 0), ("x", 1, 1)]
            drawn = {lane: self._rng.choice(wrong) for lane in lanes}
            counts = {lane: row for lane, row in (counts | drawn).items() if row is not None}
        return counts

    def _advance(self, seconds: int) -> None:
        """Let the street live for some seconds."""
        for _ in range(seconds):
            unsafe = self.observer.unsafe
            self.observer.look(self._traffic.second(self._cabinets.shown()))
            if self.observer.unsafe > unsafe:
                self.unsafe_during[self._current.kind if self._current else "no fault"] += 1
            self._now_s += 1
            self._cabinets.second()
            if self._current is not None and self._now_s >= self._current.end_s:
                self._end(self._current)
            if self._events and self._now_s >= self._events[0].begin_s:
                self._begin(self._events.pop(0))

    def _begin(self, event: Event) -> None:
        self._current = event
        self.begun[event.kind] += 1
        if event.kind in ("street stuck", "kill -9", "stopped"):
            self._acts.append(event)
        if event.kind in LIGHT_FAULTS:
            for light in event.lights:
                self._cabinets.by_light[light].fault = event.kind
        if event.kind == "full disk":
            self._limit_files(0)

    def _end(self, event: Event) -> None:
        self._current = None
        for light in event.lights:
            self._cabinets.by_light[light].fault = ""
        if event.kind == "full disk":
            self._limit_files(resource.RLIM_INFINITY)

    def _limit_files(self, most: int) -> None:
        """Limit the size of the files that the loop can write, which fails like a full disk."""
        assert self._loop is not None
        with contextlib.suppress(ProcessLookupError):
            _, hard = resource.prlimit(self._loop.pid, resource.RLIMIT_FSIZE)
            resource.prlimit(self._loop.pid, resource.RLIMIT_FSIZE, (most, hard))


def _greens(directory: Path) -> dict[str, list[str]]:
    """Return light to the states with green of the network's own programme."""
    import xml.etree.ElementTree as ET

    return {
        logic.attrib["id"]: [
            phase.attrib["state"]
            for phase in logic.iter("phase")
            if "y" not in phase.attrib["state"] and "G" in phase.attrib["state"]
        ]
        for logic in ET.parse(directory / "network.net.xml").getroot().iter("tlLogic")
    }


def _log_facts(path: Path) -> dict[str, Any]:
    """Return what the log says; every line must be whole."""
    sources: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    for line in path.read_text().splitlines():
        row = json.loads(line)
        sources[row["source"]] += 1
        reasons.update({reason.partition(":")[0] for reason in row["reasons"].values()})
    return {"decisions": sum(sources.values()), "sources": sources, "reasons": reasons}


def measure(request: dict[str, Any]) -> dict[str, Any]:
    """Run a soak and return its facts."""
    folder = Path(tempfile.mkdtemp(prefix="soak-"))
    soak = Soak(
        Path(request["directory"]),
        request["seconds"],
        request["seed"],
        request["subject"],
        folder,
    )
    soak.run()
    facts = {
        "seconds": soak.observer.seconds,
        "unsafe": soak.observer.unsafe,
        "broken": soak.observer.broken,
        "unsafe_during": soak.unsafe_during,
        "examples": soak.observer.examples,
        "begun": soak.begun,
        "connections": soak.connections,
        "left": sorted(
            entry.name for entry in folder.iterdir() if entry.name.endswith((".part", ".tmp"))
        ),
        "said": (folder / "said.txt").read_text()[-1000:],
        **_log_facts(folder / "field.jsonl"),
    }
    shutil.rmtree(folder)
    return facts


if __name__ == "__main__":
    os.environ["TMPDIR"] = tempfile.gettempdir()
    Path(sys.argv[2]).write_text(json.dumps(measure(json.loads(Path(sys.argv[1]).read_text()))))
