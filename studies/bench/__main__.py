"""The command line of the benchmarks: ``python -m studies.bench COMMAND ...``."""

from __future__ import annotations

import sys
from typing import Any

from rich.console import Console

from ugat_marl.cli import CommandLine, run
from ugat_marl.progress import Bars

COMMANDS: dict[str, tuple[str, str]] = {
    "env": ("studies.bench.env:EnvBench", "measure speed against SUMO alone and sumo-rl"),
    "learning": (
        "studies.bench.learning:LearningBench",
        "measure what learning adds to an episode",
    ),
    "fitting": (
        "studies.bench.fitting:FittingBench",
        "measure cost and calibration of each uncertainty",
    ),
    "strength": (
        "studies.bench.strength:StrengthBench",
        "is the learner as good as the best rule where it was trained?",
    ),
    "memory": ("studies.bench.memory:MemoryBench", "measure memory over many resets"),
    "scale": (
        "studies.bench.scale:ScaleBench",
        "measure many simulations, large networks, deaths",
    ),
    "device": (
        "studies.bench.device:DeviceBench",
        "find the size from which on a GPU learns faster",
    ),
    "field-log": (
        "studies.bench.field_log:FieldLogBench",
        "measure the log of the field loop over a year",
    ),
    "field-soak": (
        "studies.bench.soak:FieldSoakBench",
        "drive lights for hours while something fails every ten minutes",
    ),
    "training-faults": (
        "studies.bench.training_faults:TrainingFaultsBench",
        "disturb short trainings, resume them, compare all numbers",
    ),
    "all": (
        "studies.bench.everything:AllBench",
        "measure all but strength, scale, device, field-* and training-faults",
    ),
}


def perform(command: Any, console: Console) -> int:
    """Measure, print the tables, and return 1 if a target is missed."""
    reports = command.run(Bars(console))
    reports = reports if isinstance(reports, list) else [reports]
    for report in reports:
        console.print(report.tables())
    return 0 if all(report.met for report in reports) else 1


LINE = CommandLine(
    program="python -m studies.bench",
    purpose="The suite's figures, measured on this machine.",
    commands=COMMANDS,
    examples=("python -m studies.bench env --rounds 3",),
    perform=perform,
)

if __name__ == "__main__":
    sys.exit(run(LINE, sys.argv[1:]))
