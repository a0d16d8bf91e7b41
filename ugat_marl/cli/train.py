"""``ugat-marl train``: train across the gap and print the comparison."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from rich.console import Console
from rich.text import Text
from tyro.conf import arg

from ugat_marl.cli.arguments import RayAddress, Workers, require_numbers, workers_of
from ugat_marl.cli.frame import continued_by, given_call
from ugat_marl.data import METRICS_FILE, Metrics
from ugat_marl.errors import OptionError
from ugat_marl.experiments import TransferConfig, outcome_of, run_folder, transfer
from ugat_marl.policies import is_own
from ugat_marl.progress import Bars
from ugat_marl.reporting import calibration_picture, transfer_picture, transfer_table


@dataclass(frozen=True)
class Train:
    """Train a policy in sim for a real domain; compare it with others in both.

    Examples:
        ugat-marl train grid2x2-v1 --real V4
        ugat-marl train resco:cologne3 --real V3 --seed 1 --out runs/cologne3
        ugat-marl train path/to/my.sumocfg --real startup_delay=0.8+acceleration=1.2
        ugat-marl train single-v1 --real none --real-log measured.parquet
        ugat-marl train single-v1 --real V4 --learner my_algo:MyLearner
        ugat-marl train grid4x4-v1 --real V4 --ray auto

    Attributes:
        config: Settings of the training and of the evaluation.
        out: Folder of the run; default: runs/SCENARIO-REAL-sSEED.
        resume: Continue the run in that folder.
        workers: Simulations at a time; with two or more, the other rows of the table are trained
            beside the first. Results do not depend on it.
        ray: Play roll-outs and search for the best rule on Ray; learning stays on this machine.
    """

    FIRST: ClassVar[tuple[str, ...]] = (
        "real",
        "learner",
        "preset",
        "grounding",
        "pretrain-episodes",
        "iterations",
        "grounded-episodes",
        "real-log",
        "corrected",
        "evaluation-seeds",
        "seed",
        "out",
        "resume",
    )
    """Options of the first screen of the help."""

    config: Annotated[TransferConfig, arg(name="")]
    out: Path | None = None
    resume: bool = False
    workers: Workers = None
    ray: RayAddress = None

    def run(self, console: Console) -> int:
        """Train and evaluate; print and draw the table."""
        config = self.config
        if self.out == Path():
            raise OptionError("--out is the working folder itself, or empty; name a folder")
        require_numbers(1, workers=self.workers)
        config.ugat.gate.require_settings_count()
        directory = self.out or run_folder(config)
        with (
            continued_by(self._call(directory), f"run: {directory}"),
            workers_of(self.workers, self.ray) as workers,
        ):
            table = transfer(
                config, directory, resume=self.resume, reporter=Bars(console), workers=workers
            )
        picture = directory / "gap.png"
        metrics = Metrics.read(directory / METRICS_FILE)
        transfer_picture(table, metrics, picture)
        calibration_picture(metrics, directory / "calibration.png")
        console.print(transfer_table(table))
        if outcome := outcome_of(table):
            console.print(Text(f"{outcome.sentence()}\n", "bold"))
        places = {
            "run": directory,
            "table": directory / "table.json",
            "picture": picture,
            "policies": directory / "policies",
            "curves": f"tensorboard --logdir {directory}",
        }
        if not (directory / "policies").exists():  # of a learner that cannot be kept
            del places["policies"]
        for name, place in places.items():
            console.print(f"{name}: {place}", soft_wrap=True)
        if "policies" in places and is_own(config.learner):
            console.print(
                f"Other commands take a file there as {config.learner}@FILE.", soft_wrap=True
            )
        return 0

    def _call(self, directory: Path) -> list[str]:
        """Return the words of the command that continues the run."""
        words = given_call("train")
        given = [word for word in words or () if word != "--resume"]
        if words is None:
            given = ["train", self.config.scenario, "..."]
        if self.out is None or words is None:
            given += ["--out", str(directory)]
        return [*given, "--resume"]
