"""Halting vehicles per intersection and minute of an evaluation."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data import damage, read_quietly, write_hashed
from ugat_marl.envs import AnyParallelEnv, as_traffic_env
from ugat_marl.errors import CheckpointError, first_line
from ugat_marl.files import replacing
from ugat_marl.policies import StepCallback

QUEUES = "queues.parquet"
_SCHEMA = {
    "policy": pl.String,
    "domain": pl.String,
    "batch": pl.Int64,
    "minute": pl.Int64,
    "intersection": pl.String,
    "queue": pl.Float64,
    "looks": pl.Int64,
}
_MOST_MINUTES = 60 * 24 * 366
_OWNER = ["policy", "domain"]
_BATCH = [*_OWNER, "batch"]
_PLACE = ["policy", "domain", "minute", "intersection"]


@dataclass
class _Sums:
    intersections: tuple[str, ...]
    queues: NDArray[np.float64]  # (minutes, intersections)
    looks: NDArray[np.float64]  # (minutes,)


class QueueRecord:
    """Mean number of halting vehicles on incoming lanes, by minute, over all whole episodes."""

    def __init__(self) -> None:
        self._sums: dict[tuple[str, str], _Sums] = {}
        self._lock = threading.Lock()

    def watch(self, policy: str, domain: str, env: AnyParallelEnv) -> StepCallback:
        """Return a callback for `evaluation_of`, one per environment.

        Args:
            policy: Name of the policy.
            domain: Name of the domain.
            env: An environment of the suite, wrapped or not.

        Returns:
            A callback, to be called after every decision.
        """
        base = as_traffic_env(env)
        lights = base.network.intersections
        lanes = base.network.lane_table()
        incoming = [lanes.indices(light.incoming_lanes) for light in lights]
        places = np.concatenate(incoming)
        starts = np.cumsum([0, *map(len, incoming)])[:-1]
        interval_s = base.decision_interval_s
        minutes = math.ceil(base.scenario.decisions * interval_s / 60)
        names = tuple(light.id for light in lights)
        with self._lock:
            sums = self._sums.setdefault(
                (policy, domain),
                _Sums(names, np.zeros((minutes, len(names))), np.zeros(minutes)),
            )

        episode: list[tuple[int, NDArray[np.float64]]] = []

        def look(step: int) -> None:
            if step == 1:
                episode.clear()  # an episode whose simulation died begins again
            minute = math.ceil(step * interval_s / 60) - 1
            episode.append((minute, np.add.reduceat(base.snapshot.halting[places], starts)))
            if step < base.scenario.decisions:
                return
            with self._lock:
                for minute, queues in episode:
                    sums.queues[minute] += queues
                    sums.looks[minute] += 1

        return look

    def frame(self) -> pl.DataFrame:
        """Return the record as a table.

        Columns: policy, domain, minute (from 0), intersection, queue (mean number of halting
        vehicles), looks (number of decisions in the mean).
        """
        rows: list[tuple[str, str, int, str, float, int]] = []
        with self._lock:
            for (policy, domain), sums in self._sums.items():
                for minute in np.flatnonzero(sums.looks).tolist():
                    looks = int(sums.looks[minute])
                    named = zip(sums.intersections, sums.queues[minute].tolist(), strict=True)
                    rows += [(policy, domain, minute, t, q / looks, looks) for t, q in named]
        schema = {name: kind for name, kind in _SCHEMA.items() if name != "batch"}
        return pl.DataFrame(rows, schema=schema, orient="row")

    def write(self, path: Path, *, keep: bool = False, batch: int = 0, anew: bool = False) -> None:
        """Write the record as Parquet atomically.

        Args:
            path: The file.
            keep: True to keep the other batches in the file, if there is one that can be read.
            batch: Number of these episodes. A batch of this number in the file, with the same
                policies and domains, is replaced.
            anew: True to replace all batches of these policies and domains, such as those of
                another world of that name, or those whose scores were lost.

        Raises:
            OSError: The file cannot be written, or the record in it cannot be read now, such as
                when the process has no descriptors left. The file stays as it was.
        """
        frame = self.frame().with_columns(pl.lit(batch, pl.Int64).alias("batch")).select(*_SCHEMA)
        if keep and path.exists():
            with contextlib.suppress(CheckpointError):  # a damaged record is given up
                kept = _batches(path).join(frame, on=_OWNER if anew else _BATCH, how="anti")
                frame = pl.concat([kept, frame])
        _write(frame, path)


def write_queues(path: Path, sources: Mapping[str, tuple[Path, str]]) -> None:
    """Write the queues of several policies into one file; missing and damaged files are left out.

    Args:
        path: File to write, atomically.
        sources: For the name of each policy, a file that `QueueRecord.write` wrote and the name of
            the policy in it.

    Raises:
        OSError: A file cannot be read or written now; `path` stays as it was.
    """
    frames = [pl.DataFrame(schema=_SCHEMA)]
    for name, (source, name_there) in sources.items():
        with contextlib.suppress(CheckpointError):
            rows = _batches(source).filter(policy=name_there)
            frames.append(rows.with_columns(policy=pl.lit(name)))
    _write(pl.concat(frames), path)


def read_queues(path: Path) -> pl.DataFrame:
    """Read a table that `QueueRecord.write` wrote, as means over all episodes.

    Returns:
        A table with the columns of `QueueRecord.frame`.

    Raises:
        CheckpointError: The file is missing, cut short or of another form.
        OSError: The file is there, and the system cannot read it now.
    """
    mean = (pl.col("queue") * pl.col("looks")).sum() / pl.col("looks").sum()
    return _batches(path).group_by(_PLACE, maintain_order=True).agg(mean, pl.col("looks").sum())


def _write(frame: pl.DataFrame, path: Path) -> None:
    with replacing(path) as temporary:
        write_hashed(frame.sort([*_PLACE, "batch"]), temporary)


def _batches(path: Path) -> pl.DataFrame:
    """Read a table of queues with every batch of episodes by itself."""
    try:
        frame, metadata = read_quietly(path)
    except (FileNotFoundError, pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
        raise CheckpointError(f"{path}: cannot be read ({first_line(error)})") from None
    if frame.schema != pl.Schema(_SCHEMA):
        raise CheckpointError(f"{path}: not the queues of a run")
    if sum(frame.null_count().row(0)):
        raise CheckpointError(f"{path}: not the queues of a run, since a cell is empty")
    if wrong := damage(frame, metadata):
        raise CheckpointError(f"{path}: damaged, {wrong}")
    possible = pl.col("queue").is_finite() & pl.col("minute").is_between(0, _MOST_MINUTES)
    possible &= pl.col("looks") > 0
    if not frame.select(possible.all()).item():
        raise CheckpointError(
            f"{path}: not the queues of a run, since a queue, a minute or a number of looks is "
            "impossible"
        )
    return frame
