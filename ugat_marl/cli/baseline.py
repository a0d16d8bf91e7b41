"""Command line of a baseline's file: train its learner on one scenario and print the results."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ugat_marl.cli.frame import guarded, parse_options
from ugat_marl.experiments import BaselineArgs, BaselineResult
from ugat_marl.policies import EpisodeCallback


def baseline_command(
    kind: type[BaselineArgs], train: Callable[[Any, EpisodeCallback | None], BaselineResult]
) -> None:
    """Read the command line into `kind`, train, print the results and leave the program.

    An error is one line, as with every command.

    Args:
        kind: Options of the baseline.
        train: Function that trains with these options; it calls its second argument after every
            episode.
    """
    program = Path(sys.argv[0]).name

    def call() -> None:
        result = train(
            parse_options(kind, program, program, sys.argv[1:]),
            lambda n, told: print(n, f"return {told['return']:.1f}", flush=True),
        )
        for episodes, att_s in result.att_s.items():
            print(f"{episodes} episodes: mean travel time {np.mean(att_s):.1f} s, by seed {att_s}")

    sys.exit(guarded(program, call))
