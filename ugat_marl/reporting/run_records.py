"""Records of trainings, read from their folders as far as possible.

A missing or damaged file raises no error. The record names it.

A folder is one of three things: a run of ``ugat-marl train``, a job of ``ugat-marl paper``, or a
finished table of ``ugat-marl paper``. A folder that contains such folders stands for all of them.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import math
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import polars as pl

from ugat_marl.data import (
    CHECKPOINT_FOLDER,
    METRICS_FILE,
    SETTINGS_FILE,
    Metrics,
    csv_damage,
    csv_texts,
    json_damage,
)
from ugat_marl.errors import CheckpointError, OptionError, UgatMarlError, listed
from ugat_marl.experiments import QUEUES, TRAININGS, Evaluation, read_queues, result_of
from ugat_marl.files import MALFORMED, distinct_endings, read_json
from ugat_marl.reporting.formats import commands_in

RUN, JOB, TABLE, SCORES = "run.json", "job.json", "table.json", "scores.json"
TABLE_CSV, TABLE_MD = "table.csv", "table.md"
_DEPTH = 4
"""Levels of folders that are searched."""
_LONGEST = 200_000_000
"""Size, in bytes, above which a file is not read: no file of the suite is so large."""

T = TypeVar("T")


@dataclass(frozen=True)
class RunRecord:
    """One training.

    Attributes:
        name: Name of the training on the page.
        directory: Folder of the training.
        job: True for a job of ``ugat-marl paper``.
        settings: All recorded options, nested as in the configuration; empty for none.
        hashes: Domain to hash of the scenario in that domain.
        versions: Package to version.
        evaluation: Scores of its policies; None if there are none yet.
        metrics: Values logged during the training.
        state: Progress at the last checkpoint: ``pretrained`` episodes and ``iteration``.
        queues: Number of halting vehicles by policy, domain, minute and intersection.
        missing: One sentence for each file that is missing or cannot be read.
        written: Time of the last change of a file in the folder, in seconds since 1970; nan if
            there is no file.
    """

    name: str
    directory: Path
    job: bool
    settings: Mapping[str, Any]
    hashes: Mapping[str, str]
    versions: Mapping[str, str]
    evaluation: Evaluation | None
    metrics: Metrics | None
    state: Mapping[str, int] | None
    queues: pl.DataFrame | None
    missing: tuple[str, ...]
    written: float

    @property
    def scenario(self) -> str:
        """Name of the scenario as the user gave it; "" if it is not known."""
        name = self.settings.get("scenario") or (self.evaluation and self.evaluation.scenario)
        return str(name or "")

    @property
    def sim(self) -> str:
        """Domain of the simulation in which the policy was trained."""
        return str(self.settings.get("sim", "sim"))

    @property
    def real(self) -> str:
        """The real domain; "" for none."""
        if self.job and self.settings.get("target"):
            return str(self.settings["target"])
        if self.evaluation is not None and len(self.evaluation.domains) == 2:
            return self.evaluation.domains[1]
        return "" if self.job else str(self.settings.get("real") or "")

    @property
    def seed(self) -> str:
        """Seed of the training, as text."""
        return "" if self.settings.get("seed") is None else str(self.settings["seed"])

    @property
    def ugat(self) -> Mapping[str, Any]:
        """Settings of the algorithm."""
        settings = self.settings.get("ugat")
        return settings if isinstance(settings, Mapping) else {}

    @property
    def setting(self) -> str:
        """Name of the setting of a job; "" for none."""
        return str(self.settings.get("name", ""))

    @property
    def grounding(self) -> str:
        """Kind of grounding; "" for none."""
        return str(self.ugat.get("grounding", "phase")) if self.ugat else ""

    @property
    def finished(self) -> bool:
        """True if there is a final evaluation."""
        return self.evaluation is not None

    def series(self, stage: str, name: str) -> list[tuple[int, float]]:
        """Return the steps and values logged under a name, one per episode or iteration.

        If several values were logged in one step, the last one counts.
        """
        rows = self.metrics.rows if self.metrics is not None else []
        return sorted({step: v for s, step, n, v in rows if (s, n) == (stage, name)}.items())

    @functools.cached_property
    def last_iteration(self) -> Mapping[str, float]:
        """Numbers logged in the last iteration, by name; empty before the first one.

        What an iteration does not find, such as late commands, it does not log. So a number of an
        earlier iteration says nothing of the last one.
        """
        rows = self.metrics.rows if self.metrics is not None else []
        last = max((step for stage, step, *_ in rows if stage == "iteration"), default=0)
        return {n: v for stage, step, n, v in rows if (stage, step) == ("iteration", last)}

    def parts(self, name: str) -> dict[str, float]:
        """Return agent or part to the value of the last iteration under ``name/part``."""
        begin = f"{name}/"
        found = self.last_iteration.items()
        return {key.removeprefix(begin): v for key, v in found if key.startswith(begin)}


@dataclass(frozen=True)
class TableRecord:
    """A finished table of ``ugat-marl paper``.

    Attributes:
        name: Name of the table on the page.
        directory: Folder of the table.
        rows: Rows as returned by `ugat_marl.experiments.Comparison.rows`.
        command: Command that made the table; "" if it is not known.
        missing: One sentence for each file that is missing or cannot be read.
    """

    name: str
    directory: Path
    rows: tuple[Mapping[str, Any], ...]
    command: str
    missing: tuple[str, ...]


@dataclass
class _Reader:
    """A reader of the files of one folder that collects a sentence for each failure."""

    directory: Path
    missing: list[str] = field(default_factory=list)

    def read(self, name: str, parse: Callable[[Path], T], without: str) -> T | None:
        """Return a file's content; if it cannot be read, note why and return None.

        Args:
            name: Name of the file.
            parse: Function that reads it; its usual exceptions are noted, not raised.
            without: Second half of the noted sentence: what is unknown without the file.
        """
        path = self.directory / name
        try:
            if not path.is_file():
                self.missing.append(f"{name} is not there: {without}")
                return None
            if path.stat().st_size > _LONGEST:
                raise ValueError(f"it has more than {_LONGEST // 1_000_000} MB")
            return parse(path)
        except (UgatMarlError, OSError, csv.Error, *MALFORMED) as error:
            reason = str(error).replace(f"{path}: ", "")
            reason = textwrap.shorten(reason, 400, placeholder=" …")
            self.missing.append(f"{name} cannot be used ({reason}): {without}")
            return None


def read_records(paths: Sequence[Path]) -> list[RunRecord | TableRecord]:
    """Return the records of all folders, in their order, each once.

    Raises:
        OptionError: A path is not a folder, or it contains no file of the suite.
    """
    by_place: dict[Path, Path] = {}
    for path in paths:
        if not path.is_dir():
            text = "is a file; give the folder it lies in" if path.exists() else "no such folder"
            raise OptionError(f"{path}: {text}")
        folders = list(_folders(path, _DEPTH))
        if not folders:
            raise OptionError(
                f"{path}: neither a run (run.json, table.json) nor a job or table of `ugat-marl "
                "paper` (job.json, table.csv) lies in it or in its folders"
            )
        for folder in folders:
            by_place.setdefault(folder.resolve(), folder)
    names = distinct_endings(by_place) or map(str, by_place)
    return [
        _table(folder, name) if (folder / TABLE_CSV).is_file() else _run(folder, name)
        for folder, name in zip(by_place.values(), names, strict=True)
    ]


def as_number(value: Any) -> float:
    """Return a value of a record as a number; nan if it is none."""
    if isinstance(value, bool) or not isinstance(value, int | float | str) or value == "":
        return math.nan
    try:
        return float(value)
    except ValueError:
        return math.nan


def _folders(path: Path, depth: int) -> Iterable[Path]:
    if any((path / name).is_file() for name in (RUN, JOB, TABLE, METRICS_FILE, TABLE_CSV)):
        yield path
    elif depth:
        try:
            inner = sorted(p for p in path.iterdir() if p.is_dir() and not p.name.startswith("."))
        except OSError:
            return
        for folder in inner:
            yield from _folders(folder, depth - 1)


def _object(path: Path) -> dict[str, Any]:
    content = read_json(path, CheckpointError)
    if not isinstance(content, dict):
        raise ValueError("not a JSON object")
    return content


def _run(directory: Path, name: str) -> RunRecord:
    reader = _Reader(directory)
    job = (directory / JOB).is_file()
    kept = reader.read(JOB if job else SETTINGS_FILE, _object, "its settings are unknown") or {}
    settings = kept.get("settings", kept)
    settings = settings if isinstance(settings, dict) else {}
    if isinstance(setting := settings.get("setting"), dict):  # a job nests its setting and its name
        settings = {**setting, **settings}  # the episodes are those of the job
    if job:
        evaluation = reader.read(
            SCORES, lambda path: _scores(path, settings), "it has not been judged (yet)"
        )
        if evaluation is not None and (gaps := _unjudged(evaluation, settings)):
            reader.missing.append(f"{SCORES} is not complete: {gaps}")
    else:
        evaluation = reader.read(
            TABLE, Evaluation.read, "the run is under way, or was stopped; no final table"
        )
    grounded = not job or isinstance(settings.get("ugat"), dict)
    checkpoint = CHECKPOINT_FOLDER if job else _checkpoint_of_run(directory)
    without = "nobody knows where and when vehicles stood"
    queues = reader.read(QUEUES, read_queues, without) if evaluation is not None else None
    return RunRecord(
        name=name,
        directory=directory,
        job=job,
        settings=settings,
        hashes=_texts(_hashes(reader, job=job)),
        versions=_texts(kept.get("versions")),
        evaluation=evaluation,
        metrics=_metrics(reader, checkpoint) if grounded else None,
        state=_state(reader, checkpoint) if grounded else None,
        queues=queues,
        missing=tuple(reader.missing),
        written=_written(directory, checkpoint),
    )


def _hashes(reader: _Reader, *, job: bool) -> Any:
    without = "the hash of its scenario is unknown"
    if not job:
        without += "; it is compared with no other"
    elif not (reader.directory / RUN).is_file():  # only a grounded job has one
        return None
    identity = reader.read(RUN, _object, without) or {}
    return identity.get("scenario_hash") or identity.get("worlds")


def _texts(value: Any) -> dict[str, str]:
    return {str(k): str(v) for k, v in value.items()} if isinstance(value, dict) else {}


def _checkpoint_of_run(directory: Path) -> str:
    """Return the folder of the newest checkpoint of the training, relative to the run's."""
    places = directory.glob(f"{TRAININGS}/*/{CHECKPOINT_FOLDER}")
    newest = max(places, key=lambda place: (place.stat().st_mtime, place), default=None)
    return CHECKPOINT_FOLDER if newest is None else str(newest.relative_to(directory))


def _metrics(reader: _Reader, checkpoint: str) -> Metrics | None:
    """Return the metrics of the run or, without them, those of its last checkpoint."""
    without = "no learning curves, nothing of the gate"
    metrics = reader.read(METRICS_FILE, Metrics.read, without)
    if metrics is None and (reader.directory / checkpoint / METRICS_FILE).is_file():
        name = f"{checkpoint}/{METRICS_FILE}"
        metrics = reader.read(name, Metrics.read, without)
        if metrics is not None:
            reader.missing[-1] = reader.missing[-1].replace(without, f"{name} is shown instead")
    return metrics


def _state(reader: _Reader, checkpoint: str) -> dict[str, int] | None:
    if not (reader.directory / checkpoint).is_dir():
        return None
    state = reader.read(f"{checkpoint}/state.json", _object, "how far it had come is unknown")
    if state is None:
        return None
    return {k: v for k, v in state.items() if isinstance(v, int)}


def _written(directory: Path, checkpoint: str) -> float:
    """Return the time of the newest of the files that tell the state, in s since 1970."""
    times: list[float] = []
    for name in (RUN, JOB, TABLE, SCORES, METRICS_FILE, f"{checkpoint}/state.json"):
        with contextlib.suppress(OSError):
            times.append((directory / name).stat().st_mtime)
    return max(times, default=math.nan)


def _scores(path: Path, settings: Mapping[str, Any]) -> Evaluation:
    """Return the scores of a job: of its last training, and of seeds played in every domain."""
    content = _object(path)
    rows = content["episodes"]
    if wrong := json_damage(content, "episodes"):
        raise ValueError(f"damaged, {wrong}")
    if not isinstance(rows, list) or not rows:
        raise ValueError("no scores in it")
    policy = str(settings.get("name", "unknown"))
    last, wanted = max(int(row["trained"]) for row in rows), settings.get("episodes")
    if isinstance(wanted, int) and last < wanted:
        raise ValueError(f"judged after {last} of {wanted} training episodes")
    results = [result_of({**row, "policy": policy}) for row in rows if int(row["trained"]) == last]
    seeds: dict[str, set[int]] = {}
    for result in results:
        seeds.setdefault(result.domain, set()).add(result.seed)
    everywhere = set.intersection(*seeds.values())
    if not everywhere:
        raise ValueError("no seed was played in every domain")
    results = [result for result in results if result.seed in everywhere]
    return Evaluation(str(settings.get("scenario", "")), "", tuple(results), {})


def _unjudged(evaluation: Evaluation, settings: Mapping[str, Any]) -> str:
    """Return what a job still has to play to be judged, in words; "" for nothing."""
    told: list[str] = []
    for name, what, played in (
        ("domains", "domain", evaluation.domains),
        ("evaluation_seeds", "evaluation seed", [result.seed for result in evaluation.results]),
    ):
        wanted = settings.get(name)
        if isinstance(wanted, list) and (left := set(map(str, wanted)) - set(map(str, played))):
            told.append(f"it is not judged yet in {listed(sorted(left), what)}")
    return " and ".join(told)


def _table(directory: Path, name: str) -> TableRecord:
    reader = _Reader(directory)
    rows = reader.read(TABLE_CSV, read_rows, "there is nothing to show") or []
    page = reader.read(TABLE_MD, lambda p: p.read_text(errors="replace"), "its command is unknown")
    command = next(iter(commands_in(page or "")), "")
    return TableRecord(name, directory, tuple(rows), command, tuple(reader.missing))


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a ``table.csv``; nan for a cell that is no number.

    Raises:
        ValueError: The file is no such table, or damaged.
    """
    try:
        wrong = csv_damage(path, csv_texts(path.read_bytes()))
    except pl.exceptions.PolarsError as error:
        raise ValueError(f"not a table: {error}") from None
    if wrong:
        raise ValueError(f"damaged, {wrong}")
    # a table that was saved as CSV by a spreadsheet begins with a mark
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        rows = [row for row in csv.DictReader(file) if row.get("setting") and row.get("domain")]
    if not rows:
        raise ValueError("no rows with a setting and a domain in it")
    scenarios = sorted({str(row.get("scenario")) for row in rows})
    if len(scenarios) > 1:
        raise ValueError(
            f"rows of several scenarios ({', '.join(scenarios[:3])}); give each a table of its own"
        )
    cells = Counter((row["setting"], row["domain"]) for row in rows)
    for (setting, domain), times in cells.items():
        if times > 1:
            raise ValueError(f"setting {setting!r} in {domain} is there {times} times")
    texts = ("scenario", "setting", "domain")
    return [{k: str(v) if k in texts else as_number(v) for k, v in row.items()} for row in rows]
