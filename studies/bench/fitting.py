"""``bench fitting``: measure cost and calibration of each uncertainty of the inverse models."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from studies.bench.fresh_process import in_fresh_process
from studies.bench.report import Report, Spread, require_positive
from ugat_marl.grounding import UNCERTAINTY_METHODS
from ugat_marl.progress import Reporter, Silent

_PROGRAM = ["-m", "studies.bench.fitting_program"]


@dataclass(frozen=True)
class FittingBench:
    """Measure cost and calibration of the methods of uncertainty.

    A rule with 30 % random phases is rolled out in sim and in another domain. In every round, each
    method is fitted to the same simulated transitions with its default settings. Each round has
    another seed. Times are CPU seconds of one thread.

    Examples:
        python -m studies.bench fitting --out fitting.json

    Attributes:
        scenario: Scenario to simulate.
        domain: Domain of the transitions that h was not fitted to.
        episodes: Roll-outs in sim and in the domain; one in four is held out.
        duration_s: Simulated seconds per episode.
        rounds: Fits of every method; medians and quartiles are over these.
        epochs: Largest number of epochs of a fit.
        off_data_weight: Weight of the penalty for certainty on invented inputs.
        seed: Seed of simulation, exploration and weights.
        out: JSON file to write.
    """

    scenario: str = "grid4x4-v1"
    domain: str = "V4"
    episodes: int = 4
    duration_s: float = 3600.0
    rounds: int = 3
    epochs: int = 100
    off_data_weight: float = 0.1
    seed: int = 1
    out: Path | None = None

    def __post_init__(self) -> None:
        require_positive("fitting", episodes=self.episodes, rounds=self.rounds, epochs=self.epochs)

    def run(self, reporter: Reporter | None = None) -> Report:
        """Measure, and write `out` if it is given.

        Args:
            reporter: Reporter of the progress.

        Raises:
            MeasurementError: The measured process failed.
        """
        with (reporter or Silent()).task(f"fitting on {self.scenario}", 1):
            found = in_fresh_process(_PROGRAM, {**asdict(self), "out": None})
        measured: dict[str, dict[str, list[float]]] = found["methods"]
        rows = [_row("CPU time of a fit / edl", measured, "fit_s", relative=True)]
        rows += [
            _row(what, measured, name)
            for what, name in (
                ("CPU time of a fit [s]", "fit_s"),
                ("epochs of it", "epochs"),
                ("answer for all agents [ms]", "answer_ms"),
                ("held-out accuracy", "accuracy"),
                ("AUROC of u and errors", "auroc"),
                ("errors of the 60 % with least u", "risk"),
                ("expected calibration error", "ece"),
                ("mean u", "mean_u"),
                ("mean u off the data", "mean_u_off_data"),
                ("AUROC of u off and on the data", "auroc_off_data"),
                (f"accuracy in {self.domain}", "accuracy_there"),
                (f"mean u in {self.domain}", "mean_u_there"),
            )
        ]
        notes = [
            f"{self.scenario}, {found['agents']} agents, {found['rows']} transitions each in sim. "
            "Median (first-third quartile) of the rounds."
        ]
        report = Report("fitting", asdict(self), rows, [], notes)
        if self.out is not None:
            report.write(self.out)
        return report


def _row(
    what: str, measured: dict[str, dict[str, list[float]]], name: str, relative: bool = False
) -> dict[str, Any]:
    row: dict[str, Any] = {"what": what}
    for method in UNCERTAINTY_METHODS:
        values = measured[method][name]
        row[method] = (
            Spread.of_ratios(values, measured["edl"][name]) if relative else Spread.of(values)
        )
    return row
