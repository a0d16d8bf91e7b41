"""``ugat-marl diagnose``: compare a scenario with measured data and name the missing effects."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.cli.arguments import (
    RayAddress,
    Workers,
    given_words,
    require_numbers,
    workers_of,
)
from ugat_marl.data import MeasuredData, read_measured
from ugat_marl.diagnosis import (
    CORRECTED,
    FILE,
    Diagnosis,
    DiagnosisConfig,
    LogGrounds,
    NamedEffect,
    default_cache,
    diagnose,
)
from ugat_marl.effects import known_effects, load_scenario, measurement_effects
from ugat_marl.errors import OptionError, OutputError
from ugat_marl.files import require_writable
from ugat_marl.progress import Bars
from ugat_marl.reporting import (
    DIAGNOSIS_TITLE,
    LightNames,
    diagnosis_summary,
    require_page_place,
    training_command,
    write_diagnosis_page,
)
from ugat_marl.scenarios import Network

REPORT = "report.html"


@dataclass(frozen=True)
class Diagnose:
    """Compare measured data with a scenario; name the missing effects and add them.

    Examples:
        ugat-marl diagnose single-v1 measured --out found
        ugat-marl diagnose my.sumocfg street --out found --leave-out parking

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        measured: Directory of measured data from record or import-atspm
            (docs/reference/measured-data.md). Nothing is written to it.
        out: Directory for diagnosis.json, report.html and the corrected scenario. An earlier
            diagnosis in it is replaced.
        budget_h: Simulated hours after which no further simulation begins; stored days are free,
            and so is the warm-up before each measured period. The result is then provisional; the
            same command continues from there.
        budget_s: Time in s after which no further simulation begins either.
        alpha: Chance of naming an effect if there is none.
        seed: Root of the simulated days; the same data and seed give the same diagnosis.
        leave_out: Names of effects (docs/reference/effects.md) that are not examined.
        cache: Folder of stored simulations.
        workers: Simulations at a time.
        ray: Simulate on Ray instead.
        correct_anyway: Write the corrected scenario also if its effects explain only a part, or do
            not bring held-out travel times and queues nearer.
        unnamed: Where the named effects do not explain the data, try a correction of service and
            demand that imitates what is left. It has no name and says nothing of the cause.
        limits: Where nothing but chance is left, find from which strength on the data would have
            shown the effects that are not named. It takes longer than the search; the same command
            with this option goes on from what is stored.
        report: Write the page report.html.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    measured: Annotated[Positional[Path], arg(metavar="MEASURED")]
    out: Path
    budget_h: float = 1500.0
    budget_s: Annotated[
        float | None, arg(metavar="FLOAT", help_behavior_hint="(default: no limit)")
    ] = None
    alpha: float = 0.05
    seed: int = 0
    leave_out: Annotated[
        tuple[str, ...], arg(metavar="EFFECT ...", help_behavior_hint="(default: none)")
    ] = ()
    cache: Annotated[
        Path | None, arg(metavar="PATH", help_behavior_hint="(default: the user's cache folder)")
    ] = None
    workers: Workers = None
    ray: RayAddress = None
    correct_anyway: bool = False
    unnamed: bool = False
    limits: bool = False
    report: bool = True

    def run(self, console: Console) -> int:
        """Diagnose, write and print; the exit code is 0 for every finding."""
        config = self._config()
        self._check_out()
        scenario = load_scenario(self.scenario)
        network = Network.read(scenario)
        measured = read_measured(self.measured, scenario, network)
        # Without a report, an earlier page is removed.
        require_page_place(self.out / REPORT, DIAGNOSIS_TITLE)
        self._check_cache()
        _say_what_cannot_be_seen(measured, console)
        try:
            with workers_of(self.workers, self.ray) as workers:
                config = replace(config, workers=workers)
                diagnosis = diagnose(scenario, measured, self.out, config, Bars(console))
        except KeyboardInterrupt as interrupt:
            raise type(interrupt)("the same command goes on where it stopped") from None
        console.print(diagnosis_summary(diagnosis, LightNames.of(network)))
        (self.out / REPORT).unlink(missing_ok=True)  # of an earlier diagnosis
        if self.report:
            write_diagnosis_page(diagnosis, network, self.out / REPORT, self._commands(diagnosis))
        self._say_where(diagnosis, console)
        return 0

    def _config(self) -> DiagnosisConfig:
        require_numbers(1, workers=self.workers)
        return DiagnosisConfig(
            budget_h=self.budget_h,
            budget_s=self.budget_s,
            alpha=self.alpha,
            seed=self.seed,
            leave_out=self.leave_out,
            cache=self.cache,
            correct_anyway=self.correct_anyway,
            unnamed=self.unnamed,
            limits=self.limits,
        )

    def _check_out(self) -> None:
        """Refuse an output directory inside the measured data, which must not change."""
        out, measured = self.out.resolve(), self.measured.resolve()
        if out == measured or measured in out.parents:
            raise OptionError(
                f"--out {str(self.out)!r} lies in the measured data, which are never written to; "
                "give another directory"
            )

    def _check_cache(self) -> None:
        """Refuse an unwritable cache before the first day is simulated."""
        place = self.cache or default_cache()
        try:
            require_writable(place / "writable")
        except OutputError:
            raise OutputError(
                f"{place}: simulated days cannot be cached there; name another folder with --cache"
            ) from None

    def _commands(self, diagnosis: Diagnosis) -> list[str]:
        """Return the command line of this diagnosis and the next one."""
        words = ["ugat-marl", "diagnose", self.scenario, str(self.measured), "--out", str(self.out)]
        return [shlex.join([*words, *given_words(self)]), *self._next(diagnosis)]

    def _next(self, diagnosis: Diagnosis) -> list[str]:
        """Return the command that uses the corrected scenario; nothing if traffic is as before."""
        used = [
            effect
            for effect in diagnosis.effects
            if diagnosis.not_corrected is None or isinstance(effect.evidence, LogGrounds)
        ]
        changed = diagnosis.unnamed or any(map(_in_the_model, used))
        if diagnosis.corrected is None or not changed:
            return []
        return [training_command(self.scenario, str(self.out / CORRECTED))]

    def _say_where(self, diagnosis: Diagnosis, console: Console) -> None:
        lines = [f"diagnosis: {self.out / FILE}"]
        if self.report:
            lines.append(f"page:      {self.out / REPORT}")
        if diagnosis.corrected is not None:
            lines.append(f"corrected: {self.out / CORRECTED}")
        if following := self._next(diagnosis):
            lines.append(f"use it:    {following[0]}")
        elif diagnosis.effects and not any(map(_in_the_model, diagnosis.effects)):
            lines.append("The effects are faults of detectors; the simulation stays as it is.")
        elif not diagnosis.effects and diagnosis.verdict != "no_discrepancy":
            lines.append("There is no corrected scenario: no effect was found to correct it by.")
        if diagnosis.verdict in ("no_discrepancy", "explained") and not self.limits:
            lines.append("What could be there unseen, the same command with --limits says.")
        if diagnosis.not_corrected is not None:
            lines.append(f"{diagnosis.not_corrected} --correct-anyway does it all the same.")
        console.print("\n" + "\n".join(lines), soft_wrap=True)


def _say_what_cannot_be_seen(measured: MeasuredData, console: Console) -> None:
    """Print the effects that the data cannot show, before the first simulation.

    Without single vehicles a note of the data says it, with what can be examined.
    """
    ruled_out = {name for finding in measured.findings for name in finding.rules_out}
    if ruled_out and measured.has_events:
        console.print(f"Ruled out by what the data lack: {', '.join(sorted(ruled_out))}.")


def _in_the_model(effect: NamedEffect) -> bool:
    """Return true if an effect changes the traffic, not only the detections."""
    return not {**known_effects(), **measurement_effects()}[effect.name].on_detectors
