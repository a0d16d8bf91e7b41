"""``ugat-marl field``: drive the lights of a running SUMO by a policy, within safe limits."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.cli.arguments import LengthS
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.experiments import policy_factory
from ugat_marl.field import (
    CountSource,
    DecisionLog,
    FieldLoop,
    LoopSummary,
    Site,
    StartedSumo,
    TraciStreet,
    TrustLimits,
)
from ugat_marl.progress import Bars

Port = Annotated[int | None, arg(metavar="INT", help_behavior_hint="(with --start: a free one)")]
Log = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: nowhere)")]


@dataclass(frozen=True)
class Field:
    """Drive the lights of a SUMO that runs elsewhere, as if it were the street.

    Counts are read once per decision. Minimum green and clearance are always
    kept. If counts are stale, missing or absurd, or the policy fails, the lights
    follow a fixed-time plan (docs/how-to/field.md).

    Examples:
        ugat-marl field single-v1 --policy largest-queue:20 --start --domain V4
        ugat-marl field single-v1 --policy runs/demo/policies/fitted-street.pt
        --port 8813 --log field.jsonl

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        policy: A rule or the file of a trained policy.
        port: Port of SUMO (its --remote-port).
        host: The machine on which SUMO runs.
        start: Start a SUMO with the scenario, for a demonstration.
        domain: Domain of the SUMO that --start runs.
        seed: Seed of the SUMO that --start runs.
        seconds: Time to drive, s.
        detectors: Count on whole lanes, or on SUMO's lane-area detectors.
        log: File of JSON lines, one for each decision; new lines are appended.
        limits: Limits beyond which counts and policy are not trusted.
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
    log: Log = None
    limits: TrustLimits = field(default_factory=TrustLimits)

    def run(self, console: Console) -> int:
        """Drive the lights and print a summary."""
        if self.port is None and not self.start:
            raise OptionError("--port is missing: where SUMO listens; or let --start run one")
        if self.start and self.host != "localhost":
            raise OptionError(f"--start runs SUMO here, and not at --host {self.host}")
        if self.seed < 0 or (self.seconds is not None and not self.seconds > 0):
            raise OptionError("--seed must not be negative, and --seconds must be above 0")
        scenario = scenario_in_domain(load_scenario(self.scenario), self.domain)
        policy = policy_factory(self.policy)(parallel_env(scenario))
        site = Site.of(scenario, policy.env_options)
        seconds = self.seconds or scenario.settings.duration_s
        decisions = -int(-seconds // site.decision_interval_s)
        log = None if self.log is None else DecisionLog(self.log)
        att = ""
        with contextlib.ExitStack() as stack:
            if log is not None:
                stack.callback(log.close)
            sumo = StartedSumo(scenario, self.seed, self.port) if self.start else None
            if sumo is not None:
                stack.enter_context(sumo)
            port, process = (sumo.port, sumo.process) if sumo else (self.port or 0, None)
            lanes = tuple(site.capacity)
            street = TraciStreet(lanes, port, self.host, detectors=self.detectors, process=process)
            stack.callback(street.close)
            loop = FieldLoop(site, policy, street, self.limits, log)
            stack.callback(loop.close)
            with Bars(console).task(f"{self.policy} at {self.host}:{port}", decisions) as advance:
                summary = loop.run(seconds, lambda decision: advance(note=decision.source))
            if sumo is not None:
                street.close()
                att = f"; ATT {sumo.trips().travel_time_s.mean():.1f} s"
        console.print(f"{_told(summary, len(site.lights))}{att}", soft_wrap=True)
        if log is not None:
            lost = f" ({log.lost} decisions lost while it could not be written)" if log.lost else ""
            console.print(f"log: {self.log}{lost}", soft_wrap=True)
        return 0


def _told(summary: LoopSummary, lights: int) -> str:
    low, high, most = (summary.latency_ms(q) for q in (0.5, 0.95, 1.0))
    reasons = ", ".join(f"{kind} {count}" for kind, count in summary.reasons.most_common())
    return (
        f"{summary.decisions} decisions for {lights} light{'s' if lights > 1 else ''}; "
        f"ready after {low:.1f} ms (median), {high:.1f} ms (95 %), {most:.1f} ms (longest); "
        f"fixed time in {summary.fallback_share:.1%}{f' ({reasons})' if reasons else ''}"
    )
