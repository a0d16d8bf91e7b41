"""Signal logs of a recording: the commands of a controller, and the signals of other lights."""

from __future__ import annotations

import re
import tempfile
import threading
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from xml.sax.saxutils import unescape

from ugat_marl.envs import parallel_env
from ugat_marl.errors import SimulatorError
from ugat_marl.files import parse_xml, xml_bytes
from ugat_marl.policies import PolicyFactory, roll_out, stop_callback
from ugat_marl.scenarios import Document, Network, Scenario, SignalLog, finished
from ugat_marl.simulation import SignalPlans, launch_of

_STATE = re.compile(r'<tlsState time="([\d.]+)" id="([^"]*)" [^>]*?state="([^"]*)"')


class _Commands:
    """Commands of a controller, as `TrafficEnv.watch_plans` shows them.

    The log holds the plan before an effect of the domain delays a green.
    """

    def __init__(self) -> None:
        self._given: dict[str, list[tuple[float, str]]] = defaultdict(list)

    def look(self, time_s: float, plans: SignalPlans) -> None:
        """Add the plans of a step that begins at a time."""
        for light, segments in plans.items():
            log, since_s = self._given[light], time_s
            for duration_s, shown in segments:
                if not log or log[-1][1] != shown:
                    log.append((round(since_s, 3), shown))
                since_s += duration_s

    def logs(self) -> dict[str, SignalLog]:
        """Return time in s and state of each change, by id of the traffic light."""
        return {light: tuple(log) for light, log in self._given.items()}


def play(
    scenario: Scenario, make: PolicyFactory, seed: int, stop: threading.Event
) -> dict[str, SignalLog]:
    """Play one episode and return the commands, by id of the traffic light."""
    policy = make(parallel_env(scenario))
    env, commands = parallel_env(scenario, **policy.env_options), _Commands()
    env.watch_plans(commands.look)
    try:
        roll_out(env, policy, seed, on_step=stop_callback(stop))
    finally:
        env.close()
    return commands.logs()


def own_programmes(
    scenario: Scenario, network: Network, make: PolicyFactory
) -> tuple[dict[str, SignalLog], tuple[str, ...]]:
    """Return the signals of the traffic lights that the policy does not command.

    SUMO plays fixed programmes without vehicles and without the effects of a domain, and writes
    their states.

    Returns:
        The signals of lights with a fixed programme, by id; and the ids of lights whose programme
        depends on the traffic.
    """
    policy = make(parallel_env(scenario))
    with_programme = set(network.uncontrolled)
    if policy.env_options.get("signals") == "programme":
        with_programme |= {light.id for light in network.intersections}
    if not with_programme:
        return {}, ()
    kinds: dict[str, str] = {}
    for document in (scenario.network, *scenario.additional):
        for logic in parse_xml(document.read(), document.source).iter("tlLogic"):
            kinds[logic.get("id", "")] = logic.get("type", "static")
    fixed = sorted(tls for tls in with_programme if kinds.get(tls, "static") == "static")
    watched = tuple(sorted(with_programme - set(fixed)))
    if not fixed:
        return {}, watched
    interval_s = scenario.control.decision_interval_s
    end_s = scenario.settings.begin_s + scenario.decisions * interval_s  # the end of a period
    with tempfile.TemporaryDirectory(prefix="ugat_marl-") as name:
        directory = Path(name)
        watching = switch_document(fixed, directory / "signals.xml")
        empty = replace(
            scenario, routes=(), additional=(*scenario.additional, watching), outputs=(name,)
        )
        launch = launch_of(empty, 0, directory / "sumo", ())
        launch.write()
        command = launch.command("--end", repr(end_s))
        done = finished("sumo", command)
        if done.returncode:
            said = " ".join(done.stderr.split())
            raise SimulatorError(f"SUMO cannot run the signals of {scenario.id!r}: {said}")
        return switches(directory / "signals.xml", end_s), watched


def switch_document(lights: Sequence[str], file: Path) -> Document:
    """Return an additional file that makes SUMO write every change of some traffic lights."""
    root = ET.Element("additional")
    for tls in lights:
        options = {"type": "SaveTLSSwitchStates", "source": tls, "dest": str(file)}
        ET.SubElement(root, "timedEvent", options)
    return Document("switches.add.xml", None, xml_bytes(root))


def switches(file: Path, end_s: float) -> dict[str, SignalLog]:
    """Read the states of lights until `end_s` from SUMO's output."""
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise SimulatorError(f"SUMO's signal states cannot be read ({error.strerror})") from None
    logs: dict[str, list[tuple[float, str]]] = defaultdict(list)
    for time, tls, state in _STATE.findall(text):
        log = logs[unescape(tls)]
        if float(time) < end_s and (not log or log[-1][1] != state):
            log.append((float(time), state))
    return {tls: tuple(log) for tls, log in logs.items()}
