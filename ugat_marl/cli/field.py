"""``ugat-marl field``: drive the lights of a running SUMO by a policy, within safe limits."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.cli.arguments import LengthS, refuse_options, require_numbers
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError, UgatMarlError, counted
from ugat_marl.experiments import policy_factory
from ugat_marl.field import (
    CountSource,
    DecisionLog,
    FieldService,
    Health,
    LoopSummary,
    SimulatedStreet,
    Site,
    Street,
    TraciStreet,
    TrustLimits,
)
from ugat_marl.files import read_json, require_writable
from ugat_marl.policies import Policy
from ugat_marl.progress import Bars, Silent

Port = Annotated[int | None, arg(metavar="INT", help_behavior_hint="(or --start)")]
Log = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: nowhere)")]


@dataclass(frozen=True)
class Field:
    """Drive the lights of a SUMO that runs elsewhere, as if it were the street.

    Counts are read once per decision. Minimum green and clearance are always
    kept. If counts are stale, missing or absurd, the policy fails, or a light
    does not obey, lights follow a fixed-time plan (docs/how-to/field.md).

    Examples:
        ugat-marl field single-v1 --policy largest-queue:20 --start --domain V4
        ugat-marl field single-v1 --policy runs/demo/policies/fitted-street.pt
        --port 8813 --log field.jsonl

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        policy: A rule or the file of a trained policy.
        port: Port of SUMO (its --remote-port).
        host: The machine on which SUMO runs.
        start: Run a SUMO with the scenario, without a port, for a demonstration.
        domain: Domain of the SUMO that --start runs.
        seed: Seed of the SUMO that --start runs.
        seconds: Time to drive, s, rounded up to whole decisions; inf for ever.
        detectors: Count on whole lanes, or on SUMO's lane-area detectors.
        sumo_answer_s: Time within which SUMO has to answer, s; else it counts as gone.
        look_for_s: Time to look for a SUMO that is gone, s; inf for ever.
        log: File of JSON lines, one for each decision; new lines are appended.
        health: JSON file with the state of the loop, written after each decision.
        limits: Limits beyond which counts, policy and lights are not trusted.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    policy: str
    port: Port = None
    host: str = "localhost"
    start: bool = False
    domain: str = "sim"
    seed: int = 0
    seconds: LengthS = None
    detectors: CountSource = "lanes"
    sumo_answer_s: float = 60.0
    look_for_s: float = 0.0
    log: Log = None
    health: Log = None
    limits: TrustLimits = field(default_factory=TrustLimits)

    def run(self, console: Console) -> int:
        """Drive the lights and print a summary."""
        self._check()
        # what is simulated has to fit the demand; a street has its own
        simulated = self.start and self.seconds is not None and math.isfinite(self.seconds)
        length_s = self.seconds if simulated else None
        scenario = scenario_in_domain(
            load_scenario(self.scenario, length_s), self.domain, duration_s=length_s
        )
        policy = policy_factory(self.policy)(parallel_env(scenario))
        site = Site.of(scenario, policy.env_options)
        seconds = self.seconds or scenario.settings.duration_s
        if self.health is not None:
            require_writable(self.health)
        with contextlib.ExitStack() as stack:
            log = None if self.log is None else DecisionLog(self.log)
            if log is not None:
                stack.callback(log.close)
            console.print(self._reach(), soft_wrap=True)
            if self.start:
                street = SimulatedStreet(scenario, self.seed, tuple(site.capacity))
                stack.enter_context(street)
                summary = self._driven(site, policy, lambda: street, seconds, log, console)
                att = f"; ATT {street.trips().travel_time_s.mean():.1f} s"
            else:
                connect = stack.enter_context(_Connections(self, tuple(site.capacity)))
                summary = self._driven(site, policy, connect, seconds, log, console)
                att = ""
        console.print(f"{_told(summary, len(site.lights))}{att}", soft_wrap=True)
        if log is not None:
            lost = f" ({log.lost} decisions lost while it could not be written)" if log.lost else ""
            console.print(f"log: {self.log}{lost}", soft_wrap=True)
        return 0

    def _check(self) -> None:
        if self.port is None and not self.start:
            raise OptionError("--port is missing: where SUMO listens; or let --start run one")
        if self.port is not None and not 1 <= self.port <= 65535:
            raise OptionError(f"--port {self.port}: a port is a number from 1 to 65535")
        if not self.start:
            refuse_options(self, ("domain", "seed"), "only --start uses these options")
        else:
            refuse_options(self, ("sumo_answer_s",), "--start runs SUMO here, which answers")
        if self.start and self.host != "localhost":
            raise OptionError(f"--start runs SUMO here, and not at --host {self.host}")
        if self.start and (self.port is not None or self.look_for_s or self.detectors != "lanes"):
            raise OptionError(
                "--start runs a SUMO of its own that opens no port, ends with the loop and counts "
                "on whole lanes; leave --port, --look-for-s and --detectors out"
            )
        require_numbers(0, seed=self.seed)
        if self.seconds is not None and not self.seconds > 0:
            raise OptionError(f"--seconds {self.seconds}: must be above 0")
        if not self.look_for_s >= 0:
            raise OptionError(f"--look-for-s {self.look_for_s}: must be 0 or more")
        if not 0 < self.sumo_answer_s < math.inf:
            raise OptionError(f"--sumo-answer-s {self.sumo_answer_s}: must be above 0")
        self._check_files()

    def _check_files(self) -> None:
        """Refuse to write over the policy, or over a file that is no log and no state."""
        named = {"--policy": Path(self.policy), "--log": self.log, "--health": self.health}
        places = {name: path.resolve() for name, path in named.items() if path is not None}
        for (one, place), (other, same) in itertools.combinations(places.items(), 2):
            if place == same:
                raise OptionError(f"{other} and {one} are one file, {named[other]}; name two")
        # An empty one is what a loss of power may leave.
        if self.health is not None and self.health.exists() and self.health.stat().st_size:
            with contextlib.suppress(UgatMarlError):
                held = read_json(self.health, OptionError)
                if isinstance(held, dict) and {"state", "written_at", "pid"} <= held.keys():
                    return
            raise OptionError(
                f"--health {self.health}: holds something else than the state of a loop, which "
                "would be lost; name another file"
            )

    def _reach(self) -> str:
        """Return what the loop reaches and writes, for whoever guards this machine."""
        reached = "no port" if self.start else f"{self.host}:{self.port} (SUMO, without a password)"
        files = [str(file) for file in (self.log, self.health) if file is not None]
        return f"opens no port; reaches {reached}; writes {' and '.join(files) or 'no file'}"

    def _driven(
        self,
        site: Site,
        policy: Policy,
        connect: Callable[[], Street],
        seconds: float,
        log: DecisionLog | None,
        console: Console,
    ) -> LoopSummary:
        endless = math.isinf(seconds)
        decisions = 1 if endless else -int(-seconds // site.decision_interval_s)
        reporter = Bars(console)
        service = FieldService(
            site,
            policy,
            connect,
            self.limits,
            log,
            health=Health(self.health),
            look_for_s=self.look_for_s,
            say=reporter.say,
        )
        where = "a SUMO of its own" if self.start else f"{self.host}:{self.port}"
        bars = Silent() if endless else reporter
        with bars.task(f"{self.policy} at {where}", decisions) as advance:
            return service.run(seconds, lambda decision: advance(note=decision.source))


class _Connections:
    """Maker of connections to SUMO; each one closes the one before."""

    def __init__(self, command: Field, lanes: tuple[str, ...]) -> None:
        self._command, self._lanes = command, lanes
        self._street: TraciStreet | None = None

    def __call__(self) -> TraciStreet:
        self.close()
        self._street = TraciStreet(
            self._lanes,
            self._command.port or 0,
            self._command.host,
            detectors=self._command.detectors,
            answer_s=self._command.sumo_answer_s,
        )
        return self._street

    def close(self) -> None:
        if self._street is not None:
            self._street.close()

    def __enter__(self) -> _Connections:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _told(summary: LoopSummary, lights: int) -> str:
    low, high, most = (summary.latency_ms(q) for q in (0.5, 0.95, 1.0))
    reasons = ", ".join(f"{kind} {count}" for kind, count in summary.reasons.most_common())
    return (
        f"{counted(summary.decisions, 'decision')} for {counted(lights, 'light')}; "
        f"set after {low:.1f} ms (median), {high:.1f} ms (95 %), {most:.1f} ms (longest); "
        f"fixed time in {summary.fallback_share:.1%}{f' ({reasons})' if reasons else ''}"
    )
