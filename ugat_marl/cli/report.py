"""``ugat-marl report``: show trainings on one page."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.errors import CheckpointError, OptionError, UgatMarlError
from ugat_marl.experiments import TransferConfig
from ugat_marl.files import MALFORMED, require_writable, write_whole
from ugat_marl.policies import is_own, rule_in
from ugat_marl.reporting import (
    RunRecord,
    TableRecord,
    read_records,
    require_page_place,
    runs_page,
    write_pictures,
)

PAGE = "report.html"
_FLAT = ("ugat",)
"""Parts of the configuration whose options have no prefix."""


@dataclass(frozen=True)
class Report:
    """Write one self-contained HTML page about trainings.

    It reads folders of `ugat-marl train`, jobs and tables of `ugat-marl paper`, or folders of
    these. A training may be unfinished or broken; the page lists the missing parts.

    Examples:
        ugat-marl report runs/first
        ugat-marl report runs/first runs/second --out both.html
        ugat-marl report runs/paper --out paper.html --pictures pictures

    Attributes:
        runs: Folders, one or more.
        out: Page to write.
        pictures: Folder for the pictures as SVG and PNG.
    """

    runs: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="RUN", help_behavior_hint="(required)")
    ]
    out: Annotated[
        Path | None,
        arg(
            metavar="FILE",
            help_behavior_hint="(default: report.html, in the folder if one is given)",
        ),
    ] = None
    pictures: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="(default: no files)")
    ] = None

    def run(self, console: Console) -> int:
        """Read the folders, write the page, and print the missing parts."""
        if not self.runs:
            raise OptionError("name at least one folder of a run, such as runs/first")
        records = read_records(self.runs)
        out = self.out or (self.runs[0] / PAGE if len(self.runs) == 1 else Path(PAGE))
        require_page_place(out)
        if self.pictures is not None:
            require_writable(self.pictures / "picture.svg")
        page = runs_page(records, {r.directory: again(r) for r in records})
        write_whole(out, page.text)
        for record in records:
            for text in record.missing:
                console.print(f"{record.name}: {text}", soft_wrap=True)
        lines = [f"page: {out}"]
        if self.pictures is not None:
            write_pictures(page.pictures, self.pictures)
            lines.append(f"{len(page.pictures)} pictures, as SVG and PNG: {self.pictures}")
        console.print("\n".join(lines), soft_wrap=True)
        return 0


def again(record: RunRecord | TableRecord) -> list[str]:
    """Return the commands that repeat or continue a run, and the next commands to use."""
    if isinstance(record, TableRecord):
        return [record.command] if record.command else []
    folder = str(record.directory)
    if record.job:
        return [shlex.join([Path(sys.executable).name, "-m", "ugat_marl.experiments.jobs", folder])]
    if not record.scenario:
        return []
    lines = _train(record, folder)
    if record.finished and (record.directory / "policies").is_dir():
        policies = sorted((record.directory / "policies").glob("*.pt"))
        domains = record.evaluation.domains if record.evaluation is not None else []
        judge = ["ugat-marl", "evaluate", record.scenario, "--domains", *domains]
        if (length_s := record.settings.get("duration_s")) is not None:
            judge += ["--duration-s", str(length_s)]
        if (seeds := record.settings.get("evaluation_seeds")) is not None:
            judge += ["--seeds", str(seeds)]
        named = [_policy(path, record.settings.get("learner")) for path in policies]
        lines.append(shlex.join([*judge, "--policies", *named]))
    return [*lines, shlex.join(["tensorboard", "--logdir", folder])]


def _policy(path: Path, learner: object) -> str:
    """Return the name of a kept policy; the state of a user's learner needs that learner's name."""
    if not isinstance(learner, str) or not is_own(learner):
        return str(path)
    try:
        kept_rule = rule_in(path) is not None
    except CheckpointError:  # a rule that this version does not have
        kept_rule = True
    return str(path) if kept_rule else f"{learner}@{path}"


def _train(record: RunRecord, folder: str) -> list[str]:
    try:
        options = train_options(record.settings)
    except (UgatMarlError, *MALFORMED):
        return []  # of a damaged file, or of a learner that this version does not have
    directory = record.directory
    if directory.name in ("", ".."):  # of ".", "..": the folder itself has a name
        directory = directory.resolve()
    place = ["--out", f"{directory}-again"] if record.finished else ["--out", folder, "--resume"]
    return [shlex.join(["ugat-marl", "train", record.scenario, *options, *place])]


def train_options(settings: Mapping[str, Any]) -> list[str]:
    """Return the options of ``ugat-marl train`` that give these settings, without defaults.

    Args:
        settings: Settings of a `TransferConfig`, read from JSON; unknown ones are ignored.
    """
    preset, learner = settings.get("preset"), settings.get("learner") or ""
    plain = TransferConfig("-", preset=preset)
    if is_own(learner):  # its module may lie elsewhere, and it decides no other setting
        decided = asdict(plain)
    else:
        decided = TransferConfig("-", preset=preset, learner=learner).as_dict()
    usual = {**decided, "preset": None, "learner": plain.learner}
    usual = json.loads(json.dumps(usual, default=str))
    usual.pop("scenario")
    return _options(settings, usual, "")


def _options(settings: Mapping[str, Any], usual: Mapping[str, Any], prefix: str) -> list[str]:
    options: list[str] = []
    for key, default in usual.items():
        if key not in settings or settings[key] == default:
            continue
        value, name = settings[key], key.replace("_", "-")
        if isinstance(default, dict):
            if isinstance(value, Mapping):
                options += _options(value, default, prefix if key in _FLAT else f"{prefix}{name}.")
        elif isinstance(default, bool):
            options.append(f"--{prefix}{name}" if value else f"--{prefix}no-{name}")
        elif isinstance(value, list):
            options += [f"--{prefix}{name}", *map(str, value)]
        else:
            options += [f"--{prefix}{name}", str(value)]
    return options
