"""Field loop of the soak, in a process of its own that may be killed: a client of the cabinets.

Called as ``python -m studies.bench.soak_loop_program SOCKET SCENARIO LOG SUBJECT``.
"""

from __future__ import annotations

import json
import math
import socket
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ugat_marl.effects import load_scenario
from ugat_marl.envs import Actions, parallel_env
from ugat_marl.field import DecisionLog, FieldService, Health, LaneCount, Site
from ugat_marl.policies import Policy, make_rule

_ANSWER_S = 1.0
"""Time within which a cabinet has to answer, s."""


class CabinetStreet:
    """Street behind a line to the cabinets: one line of JSON for each question and answer.

    Args:
        address: Path of the cabinets' socket.
        waited_s: Time on the street's clock since the last connection was lost, s.
        blind: True to believe that lights show what they were asked for.
    """

    def __init__(self, address: str, waited_s: float, blind: bool) -> None:
        self._blind = blind
        self._line = socket.socket(socket.AF_UNIX)
        self._line.settimeout(_ANSWER_S)
        self._line.connect(address)
        self._answers = self._line.makefile("rb")
        self.late_s = 0.0
        self._now_s = 0.0
        self._ask(hello=waited_s)
        self._believed: dict[str, str] = self._ask(shown=True)["shown"]

    def now_s(self) -> float:
        """Return the street's clock, s."""
        return self._now_s

    def shown(self) -> Mapping[str, str]:
        """Return what lights show, or what a blind loop believes."""
        return self._believed if self._blind else self._ask(shown=True)["shown"]

    def read(self) -> Mapping[str, LaneCount]:
        """Return the counts of all lanes."""
        answer = self._ask(read=True)
        self.late_s = answer["late_s"]
        return {lane: LaneCount(*row) for lane, row in answer["counts"].items()}

    def show(self, states: Mapping[str, str]) -> None:
        """Command lights."""
        self._believed |= states
        self._ask(show=dict(states))

    def wait(self, until_s: float) -> None:
        """Let the street live until `until_s`, or until something happens to it."""
        self._ask(wait=until_s)

    def close(self) -> None:
        """Cut the line."""
        self._answers.close()
        self._line.close()

    def _ask(self, **question: Any) -> dict[str, Any]:
        self._line.sendall(json.dumps(question).encode() + b"\n")
        answer = json.loads(self._answers.readline() or '{"error": "the line is dead"}')
        if "error" in answer:
            raise ConnectionError(answer["error"])
        self._now_s = answer["now_s"]
        return answer


class _Line:
    """Maker of connections; it tells the cabinets how long the loop waited before."""

    def __init__(self, address: str, blind: bool) -> None:
        self._address, self._blind = address, blind
        self.street: CabinetStreet | None = None
        self._waited_s = 0.0

    def sleep(self, seconds: float) -> None:
        """Count seconds of the street's clock, which real ones would take too long for."""
        self._waited_s += seconds

    def __call__(self) -> CabinetStreet:
        if self.street is not None:
            self.street.close()
        waited_s, self._waited_s = self._waited_s, 0.0
        self.street = CabinetStreet(self._address, waited_s, self._blind)
        return self.street


class _Slow:
    """Policy that answers late as long as the cabinets ask for it."""

    def __init__(self, policy: Policy, line: _Line) -> None:
        self._policy, self._line = policy, line
        self.env_options = policy.env_options
        self.reset = policy.reset

    def act(self, observations: Any, infos: Any) -> Actions:
        time.sleep(self._line.street.late_s if self._line.street else 0.0)
        return self._policy.act(observations, infos)


def _main(address: str, scenario_id: str, log: str, subject: str) -> None:
    scenario = load_scenario(scenario_id)
    policy = make_rule("largest-queue:10", parallel_env(scenario))
    line = _Line(address, subject == "blind")
    service = FieldService(
        Site.of(scenario, policy.env_options),
        _Slow(policy, line),
        line,
        log=DecisionLog(Path(log)),
        health=Health(Path(log).with_name("health.json")),
        sleep=line.sleep,
    )
    service.run(math.inf)


if __name__ == "__main__":
    _main(*sys.argv[1:])
