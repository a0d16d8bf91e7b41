"""The command line: ``ugat-marl COMMAND ...``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ugat_marl.cli import CommandLine, run

COMMANDS: dict[str, tuple[str, str]] = {
    "train": ("ugat_marl.cli.train:Train", "train a policy across the gap and compare"),
    "report": (
        "ugat_marl.cli.report:Report",
        "show trainings on one page, with tables, curves and maps",
    ),
    "evaluate": (
        "ugat_marl.cli.evaluate:Evaluate",
        "measure policies and rules in any domains",
    ),
    "compare": (
        "ugat_marl.cli.compare:Compare",
        "put the row of your algorithm into a table",
    ),
    "tune": ("ugat_marl.cli.tune:Tune", "find the best settings of each rule in a domain"),
    "rollout": ("ugat_marl.cli.rollout:Rollout", "record transitions as a Parquet log, or film"),
    "field": (
        "ugat_marl.cli.field:Field",
        "drive the lights of a running SUMO, as on a street",
    ),
    "record": ("ugat_marl.cli.record:Record", "measure a domain as a street is measured"),
    "import-atspm": (
        "ugat_marl.cli.import_atspm:ImportAtspm",
        "convert a log of signal controllers to measured data",
    ),
    "import-log": (
        "ugat_marl.cli.import_log:ImportLog",
        "convert measured data to a log of transitions",
    ),
    "policy-gap": (
        "ugat_marl.cli.policy_gap:PolicyGap",
        "compare policies before and after a diagnosis",
    ),
    "diagnose": (
        "ugat_marl.cli.diagnose:Diagnose",
        "find why a simulation and measured data disagree",
    ),
    "plan": ("ugat_marl.cli.plan:Plan", "read and write fixed-time signal plans"),
    "export": ("ugat_marl.cli.export:Export", "write a policy as TorchScript, ONNX or matrices"),
    "policy list": ("ugat_marl.cli.policy_list:PolicyList", "list the policies that are shipped"),
    "policy card": (
        "ugat_marl.cli.policy_card:PolicyCardCommand",
        "print how a shipped policy was made",
    ),
    "policy pack": (
        "ugat_marl.cli.policy_pack:PolicyPack",
        "copy trained policies with their cards",
    ),
    "scenario list": (
        "ugat_marl.cli.scenario_list:ScenarioList",
        "list the networks and domains that have a name",
    ),
    "scenario new": (
        "ugat_marl.cli.scenario_new:ScenarioNew",
        "make a scenario from a road network and demand",
    ),
    "scenario check": (
        "ugat_marl.cli.scenario_check:ScenarioCheck",
        "check that a scenario is sound",
    ),
    "scenario draw": (
        "ugat_marl.cli.scenario_draw:ScenarioDraw",
        "draw every intersection with its phases",
    ),
    "domains": ("ugat_marl.cli.domains:Domains", "list the named domains by their gap"),
    "paper main": ("ugat_marl.cli.paper:Main", "compare UGAT with every control over seeds"),
    "paper ablation": ("ugat_marl.cli.paper:Ablation", "compare UGAT with and without its parts"),
    "paper alpha": ("ugat_marl.cli.paper:Alpha", "compare static thresholds with the dynamic one"),
    "paper uncertainty": ("ugat_marl.cli.paper:Uncertainty", "compare the methods of uncertainty"),
    "paper gap": ("ugat_marl.cli.paper:Gap", "draw the losses of direct transfer as radar charts"),
}

SHORT: dict[str, tuple[str, ...]] = {
    "scenarios": ("scenario", "list"),
    "check": ("scenario", "check", "--conformance"),
}
"""Short names of commands, and the words that replace them."""

GROUPS: dict[str, str] = {
    "policy": "shipped policies, and cards for yours: list, card, pack",
    "scenario": "make, check, draw and list scenarios: new, check, draw, list",
    "paper": "the tables of the paper: main, ablation, alpha, uncertainty, gap",
}
"""Purpose of the commands of two words, by their first."""

LINE = CommandLine(
    program="ugat-marl",
    purpose="Traffic signals across the gap between simulation and street.",
    commands=COMMANDS,
    short=SHORT,
    groups=GROUPS,
    examples=(
        "ugat-marl scenario list",
        "ugat-marl evaluate single-v1 --domains sim V4 --seeds 2",
        "ugat-marl train grid2x2-v1 --real V4",
    ),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command of ``ugat-marl``.

    Returns:
        The exit code: 0, 1 (a check or target failed), 2 (wrong call or input; one line names the
        fault), 130 (interrupted), 143 (terminated).
    """
    return run(LINE, sys.argv[1:] if arguments is None else arguments)


if __name__ == "__main__":
    sys.exit(main())
