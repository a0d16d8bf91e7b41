"""The command line: ``ugat-marl COMMAND ...``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ugat_marl.cli import CommandLine, run

COMMANDS: dict[str, tuple[str, str]] = {
    "train": ("ugat_marl.cli.train:Train", "train by UGAT across the gap, print what was won"),
    "report": ("ugat_marl.cli.report:Report", "trainings as one page: tables, curves, maps"),
    "evaluate": (
        "ugat_marl.cli.evaluate:Evaluate",
        "policies and rules in any domains: measures, gaps",
    ),
    "tune": ("ugat_marl.cli.tune:Tune", "the settings with which each rule does best in a domain"),
    "rollout": ("ugat_marl.cli.rollout:Rollout", "record transitions as a Parquet log"),
    "field": (
        "ugat_marl.cli.field:Field",
        "drive the lights of a running SUMO as if it were the street",
    ),
    "record": ("ugat_marl.cli.record:Record", "measure a domain as a street is measured"),
    "import-atspm": (
        "ugat_marl.cli.import_atspm:ImportAtspm",
        "measured data from a signal controllers' log",
    ),
    "policy-gap": (
        "ugat_marl.cli.policy_gap:PolicyGap",
        "what a diagnosis is worth: policies before, after",
    ),
    "diagnose": (
        "ugat_marl.cli.diagnose:Diagnose",
        "where a simulation and measured data disagree, and why",
    ),
    "export": ("ugat_marl.cli.export:Export", "a trained policy as TorchScript, ONNX or matrices"),
    "scenario list": (
        "ugat_marl.cli.scenario_list:ScenarioList",
        "the networks and domains that can be named",
    ),
    "scenario new": (
        "ugat_marl.cli.scenario_new:ScenarioNew",
        "a scenario from any road network and demand",
    ),
    "scenario check": (
        "ugat_marl.cli.scenario_check:ScenarioCheck",
        "what a controller will face; is it sound?",
    ),
    "scenario draw": (
        "ugat_marl.cli.scenario_draw:ScenarioDraw",
        "every intersection with its phases, as pictures",
    ),
    "domains": ("ugat_marl.cli.domains:Domains", "the named domains: gap, effects, counterpart"),
    "paper main": ("ugat_marl.cli.paper:Main", "UGAT and every control, with intervals over seeds"),
    "paper ablation": ("ugat_marl.cli.paper:Ablation", "UGAT without its parts"),
    "paper alpha": ("ugat_marl.cli.paper:Alpha", "static thresholds against the dynamic one"),
    "paper uncertainty": ("ugat_marl.cli.paper:Uncertainty", "the methods of uncertainty compared"),
    "paper gap": ("ugat_marl.cli.paper:Gap", "what direct transfer loses, as radar charts"),
}

SHORT: dict[str, tuple[str, ...]] = {
    "scenarios": ("scenario", "list"),
    "check": ("scenario", "check", "--conformance"),
}
"""Short names of commands, and what they stand for."""


LINE = CommandLine(
    program="ugat-marl",
    purpose="Traffic signals across the gap between simulation and street.",
    commands=COMMANDS,
    short=SHORT,
    examples=(
        "ugat-marl scenario list",
        "ugat-marl evaluate single-v1 --domains sim V4 --seeds 2",
        "ugat-marl train grid2x2-v1 --real V4",
    ),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command of ``ugat-marl``.

    Returns:
        The exit code: 0, 1 (a check or target failed), 2 (a wrong call or input; one line says
        which), 130 (interrupted).
    """
    return run(LINE, sys.argv[1:] if arguments is None else arguments)


if __name__ == "__main__":
    sys.exit(main())
