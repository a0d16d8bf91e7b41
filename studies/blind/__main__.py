"""The command line of the blind test: ``python -m studies.blind COMMAND ...``."""

from __future__ import annotations

import sys

from ugat_marl.cli import CommandLine, run

COMMANDS: dict[str, tuple[str, str]] = {
    "generate": ("studies.blind.commands:BlindGenerate", "hide effects, measure, seal the labels"),
    "run": ("studies.blind.commands:BlindRun", "diagnose the cases of a blind test"),
    "visible": (
        "studies.blind.commands:BlindVisible",
        "test if the hidden effects can be seen at all",
    ),
    "detectors": (
        "studies.blind.commands:BlindDetectors",
        "read off the errors of detectors alone, and open all labels",
    ),
    "grade": ("studies.blind.commands:BlindGrade", "open the labels of diagnosed cases"),
    "table": ("studies.blind.commands:BlindTable", "sum up graded blind tests"),
}

LINE = CommandLine(
    program="python -m studies.blind",
    purpose="The sealed blind test of the diagnosis: hide, measure, diagnose, grade.",
    commands=COMMANDS,
    examples=("python -m studies.blind generate --scenario single-v1 --cases 40 --out blind",),
)

if __name__ == "__main__":
    sys.exit(run(LINE, sys.argv[1:]))
