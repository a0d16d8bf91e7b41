"""Folder of a training run: metrics, checkpoints, and how a run is resumed.

A checkpoint is a folder that is renamed into place when it is complete. A killed run loses only the
work since its last checkpoint. Metrics are rewritten whole at every checkpoint. A resumed run drops
the rows of the work it repeats and ends with the same file as an unbroken run.
"""

from __future__ import annotations

import fnmatch
import importlib.metadata
import json
import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import polars as pl

from ugat_marl.data.curves import CURVES_FILE, EventFile
from ugat_marl.data.row_hashes import UNREADABLE, damage, read_quietly, write_hashed
from ugat_marl.errors import CheckpointError, OptionError, first_line
from ugat_marl.files import lock, put_folder, read_json, replacing, require_writable, write_whole
from ugat_marl.progress import Reporter

CHECKPOINT_FOLDER = "checkpoint"
METRICS_FILE = "metrics.parquet"
SETTINGS_FILE = "settings.json"
IDENTITY_FILE = "run.json"
MAIN_CURVES = (
    "episode/return",
    "episode/loss",
    "iteration/att_s/*",
    "iteration/judged/before",
    "iteration/judged/after",
    "iteration/forward/error",
    "iteration/forward/no_change",
    "iteration/inverse/accuracy",
    "iteration/inverse/majority",
    "iteration/calibration/auroc",
    "iteration/gate/acceptance",
    "iteration/gate/alpha",
    "iteration/lost_time/best_s",
    "iteration/channel/lag_[0-3]",
    "iteration/channel/lost",
    "iteration/eyes/lost",
    "iteration/eyes/zone_m",
    "iteration/effects/acceleration",
    "iteration/effects/headway",
    "iteration/effects/startup_delay",
    "iteration/judged/after_the_lessons",
)
"""Curves that TensorBoard shows; the metrics of a run and --verbose have all."""
LogCallback = Callable[[str, int, Mapping[str, float]], None]
"""Called as ``callback(stage, step, numbers)`` for everything that a training measures."""

_VERSIONS = ("ugat-marl", "eclipse-sumo", "libsumo", "numpy", "torch")
_SCHEMA = {"stage": pl.String, "step": pl.Int64, "name": pl.String, "value": pl.Float64}


@dataclass
class Metrics:
    """Numbers in long form: stage, step, name, value.

    Attributes:
        rows: One tuple per number; `step` is the training episode or the iteration.
    """

    rows: list[tuple[str, int, str, float]] = field(default_factory=list)

    def add(self, stage: str, step: int, numbers: Mapping[str, float]) -> None:
        """Append one row for each of the numbers."""
        self.rows += [(stage, step, name, float(value)) for name, value in numbers.items()]

    def write(self, path: Path) -> None:
        """Write all rows as Parquet atomically."""
        frame = pl.DataFrame(self.rows, schema=_SCHEMA, orient="row")
        with replacing(path) as temporary:
            write_hashed(frame, temporary)

    @classmethod
    def read(cls, path: Path) -> Metrics:
        """Read a file of `write`.

        Raises:
            CheckpointError: The file is missing, cut short or of another form.
        """
        try:
            frame, metadata = read_quietly(path)
        except UNREADABLE as error:
            raise CheckpointError(
                f"{path}: cannot be read ({first_line(error)}); it may have been cut short. "
                "Remove the run folder and start again"
            ) from None
        # Parquet allows an empty cell in every column; `write` leaves none.
        if frame.schema != pl.Schema(_SCHEMA) or any(frame.null_count().row(0)):
            raise CheckpointError(f"{path}: not the metrics of a run")
        if wrong := damage(frame, metadata):
            raise CheckpointError(
                f"{path}: damaged, {wrong}; remove the run folder and start again"
            )
        return cls(frame.rows())


class Run:
    """Folder of one training run. It continues from the checkpoint in the folder, if there is one.

    Args:
        directory: The folder.
        identity: Values that must be equal to continue: settings, scenario, seed.
        reporter: Shows progress.
        on_log: Called with all numbers that are logged; what it raises ends the run, which can
            be continued.

    Raises:
        OptionError: Another process trains in the folder.
        CheckpointError: The folder holds a checkpoint of a run with another identity.
    """

    def __init__(
        self,
        directory: Path,
        identity: Mapping[str, Any],
        reporter: Reporter,
        on_log: LogCallback | None = None,
    ) -> None:
        self.directory = directory
        self.reporter = reporter
        self._on_log = on_log
        self.metrics = Metrics()
        self._curves: EventFile | None = None
        require_writable(directory / IDENTITY_FILE)
        self._lock = lock_folder(directory)
        try:
            _remove_remains(directory)
            write_identity(directory, identity, begun=self.resumable)
        except BaseException:  # a notebook keeps the error, and what it holds
            self._lock.close()
            raise

    @property
    def resumable(self) -> bool:
        """True if there is a checkpoint."""
        return (self.directory / CHECKPOINT_FOLDER / "state.json").is_file()

    def save(self, state: Mapping[str, Any], write: Callable[[Path], None]) -> None:
        """Save the next checkpoint.

        Args:
            state: Progress of the run, as plain values.
            write: Function that writes all other files into a given folder.
        """
        fresh = self.directory / f".{CHECKPOINT_FOLDER}.new"
        fresh.mkdir(parents=True)
        write(fresh)
        self.metrics.write(fresh / METRICS_FILE)
        write_whole(fresh / "state.json", json.dumps(dict(state), indent=1) + "\n")
        current, old = (
            self.directory / CHECKPOINT_FOLDER,
            self.directory / f".{CHECKPOINT_FOLDER}.old",
        )
        put_folder(fresh, current, old)
        shutil.rmtree(old, ignore_errors=True)
        self.write_metrics()

    def write_metrics(self) -> None:
        """Write all metrics so far."""
        self.metrics.write(self.directory / METRICS_FILE)
        if self._curves is not None:
            self._curves.flush()

    def restore(self, read: Callable[[Path], None]) -> dict[str, Any]:
        """Restore the checkpoint.

        Args:
            read: Function that reads the files that `write` of `save` wrote.

        Returns:
            The progress of the run, as given to `save`.

        Raises:
            CheckpointError: The checkpoint cannot be used.
        """
        folder = self.directory / CHECKPOINT_FOLDER
        try:
            state = read_json(folder / "state.json", CheckpointError)
            if not isinstance(state, dict):
                raise CheckpointError(f"{folder / 'state.json'}: not an object of JSON")
        except CheckpointError as error:
            raise CheckpointError(f"{error}; remove {self.directory} and start again") from None
        read(folder)
        self.metrics = Metrics.read(folder / METRICS_FILE)
        for stage, step, name, value in self.metrics.rows:  # without what is now repeated
            self._draw(stage, step, {name: value})
        return state

    def log(self, stage: str, step: int, numbers: Mapping[str, float]) -> None:
        """Add numbers to the metrics and, if finite, to TensorBoard.

        TensorBoard receives the `MAIN_CURVES`, and all numbers if the reporter is verbose.
        """
        self.metrics.add(stage, step, numbers)
        self._draw(stage, step, numbers)
        if self._on_log is not None:
            self._on_log(stage, step, dict(numbers))

    def close(self) -> None:
        """End the TensorBoard file and release the folder."""
        self._lock.close()
        if self._curves is not None:
            self._curves.close()
            self._curves = None

    def _draw(self, stage: str, step: int, numbers: Mapping[str, float]) -> None:
        if self._curves is None:
            self._curves = EventFile(self.directory / CURVES_FILE)
        for name, value in numbers.items():
            if math.isfinite(value) and (self.reporter.verbose or _is_main(stage, name)):
                self._curves.add_scalar(f"{stage}/{name}", value, step)


def _is_main(stage: str, name: str) -> bool:
    """Return True if a number is one of the `MAIN_CURVES`."""
    return any(fnmatch.fnmatchcase(f"{stage}/{name}", curve) for curve in MAIN_CURVES)


def write_settings(directory: Path, settings: Mapping[str, Any]) -> None:
    """Write all options of a run and the versions of its packages, for readers.

    ``run.json`` holds only the values that must be equal to continue the run.
    """
    content = {"settings": settings, "versions": installed_versions(*_VERSIONS)}
    write_whole(directory / SETTINGS_FILE, json.dumps(content, indent=1, default=str) + "\n")


def other_versions(directory: Path) -> dict[str, tuple[str | None, str | None]]:
    """Return package to version in a run's settings and version installed, where they differ."""
    try:
        held = read_json(directory / SETTINGS_FILE, CheckpointError)
    except CheckpointError:  # readers miss it; the run can go on
        return {}
    known = held.get("versions") if isinstance(held, dict) else None
    before = known if isinstance(known, dict) else {}
    now = installed_versions(*_VERSIONS).items()
    return {name: (before[name], v) for name, v in now if name in before and before[name] != v}


def write_identity(directory: Path, identity: Mapping[str, Any], *, begun: bool) -> None:
    """Write what must be equal to continue a run, or compare it with what the folder holds.

    Args:
        directory: Folder of the run.
        identity: Values that must be equal to continue: settings, scenario, seed.
        begun: True if the folder holds results; a file without results is replaced.

    Raises:
        CheckpointError: The folder holds results of a run with another identity.
    """
    file = directory / IDENTITY_FILE
    wanted: dict[str, Any] = json.loads(json.dumps(identity, sort_keys=True))
    if begun and file.exists():
        _refuse_other(file, wanted)
    else:
        write_whole(file, json.dumps(wanted, indent=1) + "\n")


def lock_folder(directory: Path) -> IO[str]:
    """Lock a folder: return a file that stays locked while it is open; a killed process frees it.

    Raises:
        OptionError: Another process has locked the folder.
    """
    file = (directory / ".lock").open("w")
    try:
        lock(file.fileno())
    except BlockingIOError:
        file.close()
        raise OptionError(
            f"{directory}: another process is training in this folder; wait for it, or name "
            "another one"
        ) from None
    except OSError as error:  # such as a network drive without locks
        file.close()
        raise OptionError(
            f"{directory}: cannot be locked ({error.strerror}), so two trainings could write "
            "there at once; name a folder on another drive"
        ) from None
    return file


def _refuse_other(file: Path, identity: Mapping[str, Any]) -> None:
    try:
        held = read_json(file, CheckpointError)
        if not isinstance(held, dict):
            raise CheckpointError(f"{file}: not an object of JSON")
    except CheckpointError as error:
        raise CheckpointError(f"{error}; use another --out") from None
    if different := _difference(held, identity):
        name, there, here = different
        raise CheckpointError(
            f"{file.parent} holds another run: its {name} is {_short(there)}, asked for is "
            f"{_short(here)}; repeat its options, or use another --out"
        )


def _difference(held: Mapping[str, Any], asked: Mapping[str, Any]) -> tuple[str, Any, Any] | None:
    """Return the first option that differs, with the names it is in, and both values."""
    for key in sorted({*held, *asked}):
        there, here = held.get(key), asked.get(key)
        if there == here:
            continue
        if isinstance(there, Mapping) and isinstance(here, Mapping):
            inner = _difference(there, here)
            if inner is not None:
                return f"{key}.{inner[0]}", *inner[1:]
        return key, there, here
    return None


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 120 else f"{text[:117]}..."


def _remove_remains(directory: Path) -> None:
    """Remove remains of a killed run; keep one whole checkpoint."""
    current, old = directory / CHECKPOINT_FOLDER, directory / f".{CHECKPOINT_FOLDER}.old"
    fresh = directory / f".{CHECKPOINT_FOLDER}.new"
    if old.exists() and not current.exists():
        old.rename(current)
    for remains in (old, fresh):
        shutil.rmtree(remains, ignore_errors=True)
    remove_temporaries(directory)


def remove_temporaries(directory: Path) -> None:
    """Remove temporary files of `files.replacing` that a killed process left.

    Only the process that has locked the folder may call this.
    """
    for remains in directory.glob(".*.tmp"):
        remains.unlink(missing_ok=True)


def installed_version(distribution: str) -> str | None:
    """Return the installed version of a package, or None."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def installed_versions(*distributions: str) -> dict[str, str | None]:
    """Return package to installed version, or None if it is not installed."""
    return {name: installed_version(name) for name in distributions}
