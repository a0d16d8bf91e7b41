"""Transition logs: written by roll-outs, read by grounding.

A log holds one row per (episode, step, agent): the observation of the intersection, the phase its
policy requested, the phases it was permitted, the phase that was served, the delay of its green,
the reward, and the next observation. Simulated and measured logs have the same form. The provenance
in the metadata of the Parquet file tells them apart.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ugat_marl.data.layouts import AgentLayout
from ugat_marl.data.row_hashes import (
    UNREADABLE,
    damage,
    half_parquet,
    is_hashed,
    read_quietly,
    write_hashed,
)
from ugat_marl.errors import LogError, OutputError, first_line
from ugat_marl.files import MALFORMED, parse_json, refuse_endless, replacing, require_writable

FORMAT = 2
METADATA_KEY = "ugat_marl.data.transitions"
SOURCES = ("simulated", "measured")

# One model cannot be fitted to logs that differ in one of these: they describe two processes.
SAME_IN_CONCATENATION = (
    "scenario",
    "scenario_hash",
    "domain",
    "decision_interval_s",
    "observation",
    "layouts",
    "source",
    "units",
    "from_begin",
)

SCHEMA: Mapping[str, pl.DataType] = {
    "episode": pl.Int32(),
    "step": pl.Int32(),
    "agent": pl.String(),
    "observation": pl.List(pl.Float32()),
    "action": pl.Int16(),
    "executed": pl.Int16(),
    "delay_s": pl.Float32(),
    "reward": pl.Float32(),
    "next_observation": pl.List(pl.Float32()),
    "served_features": pl.List(pl.Float32()),
    "mask": pl.List(pl.Int8()),
}
OPTIONAL: Mapping[str, pl.Expr] = {
    "delay_s": pl.lit(0.0, pl.Float32()),
    "served_features": pl.lit([], pl.List(pl.Float32())),
    "mask": pl.lit([], pl.List(pl.Int8())),
}
"""Columns that may be missing, with their default."""
VECTORS = ("observation", "next_observation")
CHOICES = ("action", "executed")


@dataclass(frozen=True)
class Provenance:
    """Origin of a log, with all facts that a reader needs.

    Attributes:
        scenario: Scenario id.
        scenario_hash: Hash of the scenario with the domain's effects applied ("" if measured
            without one).
        domain: "sim", "V1" ..., or the name of the measured place.
        seeds: Seed of every episode, in order; empty if measured.
        decision_interval_s: Seconds between two rows of one agent.
        observation: Name of the observation function.
        layouts: Agent to the layout of its observation vector, in the order of the agents.
        source: "simulated" or "measured".
        versions: Package to version, for packages that can change the numbers.
        units: Column to unit.
        deviation: Incoming lane to the standard deviation of its vehicles, where they are
            estimated; empty if they were counted.
        from_begin: True if the steps count from the begin of the scenario, on a log that may begin
            later.
    """

    scenario: str
    scenario_hash: str
    domain: str
    seeds: tuple[int, ...]
    decision_interval_s: float
    observation: str
    layouts: Mapping[str, AgentLayout]
    source: str = "simulated"
    versions: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    deviation: Mapping[str, float] = field(default_factory=dict)
    from_begin: bool = False

    def __post_init__(self) -> None:
        if self.source not in SOURCES:
            raise LogError(f"provenance: source is {self.source!r}; allowed: {', '.join(SOURCES)}")
        if not 0 < self.decision_interval_s < np.inf:
            raise LogError(
                f"provenance: decision_interval_s is {self.decision_interval_s}; must be > 0"
            )
        for lane, vehicles in self.deviation.items():
            if not 0 <= vehicles < np.inf:
                raise LogError(f"provenance: deviation of lane {lane!r} is {vehicles!r}")
        if not self.layouts:
            raise LogError("provenance: layouts is empty; name at least one agent")

    def to_json(self) -> str:
        """Return the provenance as a JSON object."""
        return json.dumps({"format": FORMAT, **dataclasses.asdict(self)})

    @classmethod
    def from_json(cls, text: str) -> Provenance:
        """Read the text that `to_json` returned.

        Raises:
            LogError: The text is not JSON or has another format. Or a field is missing, unknown or
                of the wrong type.
        """
        try:
            content = parse_json(text, "provenance", LogError)
            if content.pop("format") != FORMAT:
                raise LogError(f"provenance has another format; this version reads {FORMAT}")
            layouts = {name: AgentLayout(**part) for name, part in content.pop("layouts").items()}
            for name, layout in layouts.items():
                if not all(type(size) is int for size in dataclasses.astuple(layout)):
                    raise LogError(f"provenance: the sizes of agent {name!r} are not whole numbers")
            for seed in content["seeds"]:
                if type(seed) is not int or not 0 <= seed < 1 << 63:
                    raise LogError(
                        f"provenance: {seed!r} among the seeds is not a seed of an episode"
                    )
            for told in (*content["versions"].values(), *content["units"].values()):
                if not isinstance(told, str):
                    raise LogError(f"provenance: {told!r} is neither a version nor a unit")
            return cls(seeds=tuple(content.pop("seeds")), layouts=layouts, **content)
        except MALFORMED as error:
            raise LogError(f"provenance cannot be understood ({error!r})") from None


@dataclass(frozen=True)
class Transitions:
    """All transitions of one agent as arrays; n rows, observation size d.

    Attributes:
        observation: ``(n, d)`` float32.
        action: ``(n,)`` int64, the phase the policy requested.
        executed: ``(n,)`` int64, the phase that was served.
        delay_s: ``(n,)`` float32, the intended delay of a green that begins in this step.
        reward: ``(n,)`` float32.
        next_observation: ``(n, d)`` float32.
        served_features: ``(n, features)`` float32, the features at the start of the step without
            the vehicles that left, averaged over the interval. They show how many vehicles were
            served and how early. ``(n, 0)`` if a row was not measured.
        mask: ``(n, phases)`` bool, the phases that the policy was permitted to request. ``(n, 0)``
            if a row has none.
        episode: ``(n,)`` int64.
        step: ``(n,)`` int64.
    """

    observation: NDArray[np.float32]
    action: NDArray[np.int64]
    executed: NDArray[np.int64]
    delay_s: NDArray[np.float32]
    reward: NDArray[np.float32]
    next_observation: NDArray[np.float32]
    served_features: NDArray[np.float32]
    mask: NDArray[np.bool_]
    episode: NDArray[np.int64]
    step: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.action)


class TransitionLog:
    """Checked table of transitions with its provenance.

    Args:
        provenance: Origin of the rows.
        frame: Columns as in `SCHEMA`; wider number types are converted.

    Raises:
        LogError: A column is missing or of another kind, a vector has the wrong length, a phase
            does not exist, a number is missing or not finite, an agent is unknown, or a row
            (episode, step, agent) occurs twice.
    """

    def __init__(self, provenance: Provenance, frame: pl.DataFrame) -> None:
        self.provenance = provenance
        self.frame = checked(
            frame,
            sizes={agent: layout.size for agent, layout in provenance.layouts.items()},
            phases={agent: layout.phases for agent, layout in provenance.layouts.items()},
            features={agent: layout.features for agent, layout in provenance.layouts.items()},
        )

    @property
    def agents(self) -> tuple[str, ...]:
        """The agents, in the order of the environment."""
        return tuple(self.provenance.layouts)

    @property
    def episodes(self) -> int:
        """Number of different episodes."""
        return self.frame["episode"].n_unique()

    def __len__(self) -> int:
        """Number of rows, over all agents."""
        return self.frame.height

    @property
    def decisions(self) -> int:
        """Number of decisions of the longest episode."""
        return int(self.frame["step"].to_numpy().max(initial=-1)) + 1

    def first(self, decisions: int) -> TransitionLog:
        """Return the first decisions of each episode."""
        if decisions >= self.decisions:
            return self
        return TransitionLog(self.provenance, self.frame.filter(pl.col("step") < decisions))

    def from_step_0(self) -> TransitionLog:
        """Return the log with the steps of each episode counted from 0."""
        since = pl.col("step") - pl.col("step").min().over("episode")
        provenance = dataclasses.replace(self.provenance, from_begin=False)
        return TransitionLog(provenance, self.frame.with_columns(step=since))

    def since(self, step: int) -> TransitionLog:
        """Return the log from a step on, which becomes step 0."""
        if not step:
            return self
        later = self.frame.filter(pl.col("step") >= step).with_columns(pl.col("step") - step)
        return TransitionLog(self.provenance, later)

    def transitions(self, agent: str) -> Transitions:
        """Return the rows of one agent, ordered by episode and step.

        Raises:
            LogError: The log has no such agent.
        """
        if agent not in self.provenance.layouts:
            raise LogError(f"the log has no agent {agent!r}; it has {', '.join(self.agents)}")
        rows = self.frame.filter(pl.col("agent") == agent).sort("episode", "step")
        layout = self.provenance.layouts[agent]

        def vectors(column: str, size: int = layout.size) -> NDArray[np.float32]:
            if rows.is_empty():  # explode() of an empty column gives one null
                return np.zeros((0, size), np.float32)
            return rows[column].explode().to_numpy().reshape(-1, size).copy()

        def numbers(column: str) -> NDArray[np.int64]:
            return rows[column].to_numpy().astype(np.int64)

        return Transitions(
            observation=vectors("observation"),
            action=numbers("action"),
            executed=numbers("executed"),
            delay_s=rows["delay_s"].to_numpy().astype(np.float32),
            reward=rows["reward"].to_numpy().astype(np.float32),
            next_observation=vectors("next_observation"),
            served_features=vectors("served_features", layout.features)
            if (rows["served_features"].list.len() == layout.features).all()
            else np.zeros((len(rows), 0), np.float32),
            mask=vectors("mask", layout.phases).astype(np.bool_)
            if (rows["mask"].list.len() == layout.phases).all()
            else np.zeros((len(rows), 0), np.bool_),
            episode=numbers("episode"),
            step=numbers("step"),
        )

    @staticmethod
    def concatenate(logs: Sequence[TransitionLog]) -> TransitionLog:
        """Return the logs as one, with episodes renumbered from 0.

        A lane's deviation is the largest of all logs.

        Raises:
            LogError: There are no logs, or they differ in one of `SAME_IN_CONCATENATION`.
        """
        if not logs:
            raise LogError("no transition logs to concatenate; give at least one")
        first = logs[0].provenance
        frames: list[pl.DataFrame] = []
        versions: dict[str, str] = {}
        deviation: dict[str, float] = {}
        offset = 0
        for log in logs:
            _refuse_difference(first, log.provenance)
            for name, version in log.provenance.versions.items():
                known = versions.get(name, "").split(", ") + version.split(", ")
                versions[name] = ", ".join(dict.fromkeys(part for part in known if part))
            for lane, vehicles in log.provenance.deviation.items():
                deviation[lane] = max(vehicles, deviation.get(lane, 0.0))
            number = (pl.col("episode").rank("dense").cast(pl.Int32) - 1 + offset).alias("episode")
            frames.append(log.frame.with_columns(number))
            offset += log.episodes
        seeds = tuple(seed for log in logs for seed in log.provenance.seeds)
        provenance = dataclasses.replace(first, seeds=seeds, versions=versions, deviation=deviation)
        return TransitionLog(provenance, pl.concat(frames))

    def write(self, path: Path) -> None:
        """Write the log as Parquet. An existing file is replaced whole or stays unchanged."""
        with replacing(path) as temporary:
            write_hashed(self.frame, temporary, {METADATA_KEY: self.provenance.to_json()})

    @classmethod
    def read(cls, path: Path | str) -> TransitionLog:
        """Read and check a file of `write`, written on this machine or another one.

        Raises:
            LogError: The file is missing, cut short, not a transition log, or has impossible
                values.
        """
        frame, metadata = read_parquet(Path(path))
        if METADATA_KEY not in metadata:
            raise LogError(
                f"{path}: a Parquet file, but not a transition log: its metadata lacks "
                f"{METADATA_KEY!r}; write logs with TransitionLog.write"
            )
        if not is_hashed(metadata):
            raise LogError(
                f"{path}: has no hashes of its rows, so damage could not be seen; write logs with "
                "TransitionLog.write"
            )
        if wrong := damage(frame, metadata, (METADATA_KEY,)):
            raise LogError(f"{path}: damaged, {wrong}; record or copy it again")
        try:
            return cls(Provenance.from_json(metadata[METADATA_KEY]), frame)
        except LogError as error:
            raise LogError(f"{path}: {error}") from None


def consecutive(episode: NDArray[np.int64], step: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether each decision but the first follows the one before it, ``(n - 1,)``."""
    return (np.diff(episode) == 0) & (np.diff(step) == 1)


_Row = tuple[
    NDArray[np.float32],
    int,
    int,
    float,
    float,
    NDArray[np.float32],
    NDArray[np.float32],
    NDArray[np.int8],
]
_NONE = np.zeros(0, np.float32)
_NO_MASK = np.zeros(0, np.int8)


class TransitionRecorder:
    """Collector of transitions during episodes. It keeps plain rows and makes the table at the end.

    Args:
        provenance: Origin of the rows.
    """

    def __init__(self, provenance: Provenance) -> None:
        self._provenance = provenance
        self._clock: list[tuple[int, int]] = []
        self._rows: list[list[_Row]]
        self._rows = [[] for _ in provenance.layouts]

    def __len__(self) -> int:
        """Number of steps recorded."""
        return len(self._clock)

    def record(
        self,
        episode: int,
        step: int,
        observations: Mapping[str, NDArray[np.float32]],
        actions: Mapping[str, Any],
        executed: Mapping[str, Any],
        rewards: Mapping[str, float],
        next_observations: Mapping[str, NDArray[np.float32]],
        delays_s: Mapping[str, float] | None = None,
        served: Mapping[str, NDArray[np.float32]] | None = None,
        masks: Mapping[str, Any] | None = None,
    ) -> None:
        """Add one step of all agents; the arrays are copied.

        Args:
            episode: Number of the episode.
            step: Number of the decision in the episode.
            observations: Observation of each agent before the step.
            actions: Phase each policy requested.
            executed: Phase each intersection served.
            rewards: Reward of each agent.
            next_observations: Observation of each agent after the step.
            delays_s: Intended delay of each agent's green, s; None for no delays.
            served: Served features of each agent; None if not measured.
            masks: 1 for each phase an agent was permitted to request; None if not known.

        Raises:
            LogError: An agent of the provenance is missing in one of the mappings.
        """
        try:
            rows = [
                (
                    np.array(observations[agent], np.float32),
                    int(actions[agent]),
                    int(executed[agent]),
                    0.0 if delays_s is None else float(delays_s[agent]),
                    float(rewards[agent]),
                    np.array(next_observations[agent], np.float32),
                    _NONE if served is None else np.array(served[agent], np.float32),
                    _NO_MASK if masks is None else np.array(masks[agent], np.int8),
                )
                for agent in self._provenance.layouts
            ]
        except KeyError as error:
            raise LogError(
                f"episode {episode}, step {step}: agent {error} is missing; all agents of the "
                "environment are recorded together"
            ) from None
        self._clock.append((episode, step))
        for kept, row in zip(self._rows, rows, strict=True):
            kept.append(row)

    def log(self) -> TransitionLog:
        """Return all recorded steps as a checked log."""
        frames = [
            self._agent_frame(agent, layout, rows)
            for (agent, layout), rows in zip(
                self._provenance.layouts.items(), self._rows, strict=True
            )
        ]
        frame = pl.concat(frames).sort("episode", "step", maintain_order=True)
        return TransitionLog(self._provenance, frame)

    def _agent_frame(
        self,
        agent: str,
        layout: AgentLayout,
        rows: list[_Row],
    ) -> pl.DataFrame:
        if not rows:
            return pl.DataFrame(schema=SCHEMA)
        clock = np.asarray(self._clock, np.int32)
        return pl.DataFrame(
            {
                "episode": clock[:, 0],
                "step": clock[:, 1],
                "agent": [agent] * len(rows),
                "observation": _stacked(agent, layout, [row[0] for row in rows]),
                "action": [row[1] for row in rows],
                "executed": [row[2] for row in rows],
                "delay_s": np.array([row[3] for row in rows], np.float32),
                "reward": np.array([row[4] for row in rows], np.float32),
                "next_observation": _stacked(agent, layout, [row[5] for row in rows]),
                "served_features": [row[6].tolist() for row in rows],
                "mask": [row[7].tolist() for row in rows],
            },
            schema_overrides={
                name: SCHEMA[name]
                for name in ("observation", "next_observation", "served_features", "mask")
            },
        )


def _stacked(agent: str, layout: AgentLayout, vectors: list[NDArray[np.float32]]) -> pl.Series:
    """Return vectors of equal length as one list column, without a Python object per number."""
    for vector in vectors:
        if vector.shape != (layout.size,):
            raise LogError(
                f"agent {agent}: an observation of shape {vector.shape}; expected ({layout.size},)"
            )
    flat = pl.Series(np.concatenate(vectors))
    return flat.reshape((len(vectors), layout.size)).arr.to_list()


def _refuse_difference(first: Provenance, other: Provenance) -> None:
    for name in SAME_IN_CONCATENATION:
        one, two = getattr(first, name), getattr(other, name)
        if one != two or (name == "layouts" and tuple(one) != tuple(two)):
            raise LogError(
                f"transition logs with different {name} ({one!r} and {two!r}) cannot be "
                "concatenated; fit them apart"
            )


def require_log_place(path: Path) -> None:
    """Refuse a path that cannot become a transition log, or whose file holds something else.

    Raises:
        OutputError: No log can be written there, or the file there is another table.
    """
    require_writable(path, ".parquet")
    if path.exists():
        try:
            is_log = METADATA_KEY in pl.read_parquet_metadata(path)
        except UNREADABLE:
            is_log = False
        if not is_log:
            raise OutputError(f"{path}: is no transition log, and would be lost; give another name")


def read_parquet(path: Path) -> tuple[pl.DataFrame, dict[str, str]]:
    """Return the table in a Parquet file and the file's metadata.

    Raises:
        LogError: The file is missing, unreadable, cut short or damaged.
    """
    _refuse_half_file(path)
    try:
        return read_quietly(path)
    except UNREADABLE as error:
        raise LogError(
            f"{path}: damaged Parquet file ({first_line(error)}); record or copy it again"
        ) from None


def checked(
    frame: pl.DataFrame,
    sizes: Mapping[str, int],
    phases: Mapping[str, int],
    features: Mapping[str, int],
) -> pl.DataFrame:
    """Return the frame in the columns and types of `SCHEMA`; refuse impossible values.

    Args:
        frame: Any table; wider number types are converted where nothing is lost.
        sizes: Agent to the length of its observation vector.
        phases: Agent to its number of green phases.
        features: Agent to its number of features.

    Raises:
        LogError: A value is impossible; the message names the column and usually the first bad row.
    """
    frame = _converted(frame)
    for column in SCHEMA:
        if frame[column].null_count():
            raise LogError(f"column {column!r} has missing values; drop or fill those rows")
    unknown = set(frame["agent"].unique()) - set(sizes)
    if unknown:
        raise LogError(f"unknown agents {sorted(unknown)}; the provenance has {sorted(sizes)}")
    agent = pl.col("agent")
    size = agent.replace_strict(dict(sizes), return_dtype=pl.UInt32)
    limit = agent.replace_strict(dict(phases), return_dtype=pl.Int16)
    widths = agent.replace_strict(dict(features), return_dtype=pl.UInt32)
    length = pl.col("served_features").list.len()
    wrong = (length != widths) & (length != 0)
    _refuse_rows(frame, wrong, "served_features", "has the wrong length")
    _refuse_masks(frame, limit)
    for column in VECTORS:
        _refuse_rows(frame, pl.col(column).list.len() != size, column, "has the wrong length")
    for column in (*VECTORS, "served_features"):
        bad = ~pl.col(column).list.eval(pl.element().is_finite().fill_null(False)).list.all()
        _refuse_rows(frame, bad, column, "holds a number that is not finite")
    for column in CHOICES:
        bad = (pl.col(column) < 0) | (pl.col(column) >= limit)
        _refuse_rows(frame, bad, column, "is not a phase of its agent")
    _refuse_rows(frame, ~pl.col("reward").is_finite(), "reward", "is not finite")
    delay = pl.col("delay_s")
    _refuse_rows(frame, ~delay.is_finite() | (delay < 0), "delay_s", "is not a time to wait")
    key = ["episode", "step", "agent"]
    _refuse_rows(frame, pl.struct(key).is_duplicated(), "step", "occurs twice in its episode")
    return frame


def _refuse_masks(frame: pl.DataFrame, phases: pl.Expr) -> None:
    """Refuse masks of a wrong length, with other values than 0 and 1, or without any 1."""
    length = pl.col("mask").list.len()
    _refuse_rows(frame, (length != phases) & (length != 0), "mask", "has the wrong length")
    values = pl.col("mask").list.eval(pl.element().is_in([0, 1]).fill_null(False)).list.all()
    _refuse_rows(frame, ~values & (length != 0), "mask", "holds another number than 0 and 1")
    nothing = (pl.col("mask").list.sum() == 0) & (length != 0)
    _refuse_rows(frame, nothing, "mask", "permits no phase")


def _converted(frame: pl.DataFrame) -> pl.DataFrame:
    columns: list[pl.Series] = []
    absent = [name for name in OPTIONAL if name not in frame.columns]
    frame = frame.with_columns(OPTIONAL[name].alias(name) for name in absent)
    for name, wanted in SCHEMA.items():
        if name not in frame.columns:
            raise LogError(f"column {name!r} is missing; a log has {', '.join(SCHEMA)}")
        column = frame[name]
        if not _same_kind(column.dtype, wanted):
            raise LogError(f"column {name!r} has type {column.dtype}; expected {wanted}")
        try:
            columns.append(column.cast(wanted))
        except pl.exceptions.PolarsError as error:
            raise LogError(
                f"column {name!r} does not fit into {wanted}: {first_line(error)}"
            ) from None
    return pl.DataFrame(columns)


def _same_kind(given: pl.DataType, wanted: pl.DataType) -> bool:
    if isinstance(wanted, pl.List):
        if not isinstance(given, pl.List | pl.Array):
            return False
        inner: Any = given.inner
        return inner.is_float() if wanted == pl.List(pl.Float32) else inner.is_integer()
    if wanted.is_integer():
        return given.is_integer()
    if wanted.is_float():
        return given.is_float()
    return given == wanted


def _refuse_rows(frame: pl.DataFrame, bad: pl.Expr, column: str, complaint: str) -> None:
    wrong = frame.filter(bad)
    if not wrong.is_empty():
        row = wrong.row(0, named=True)
        place = f"episode {row['episode']}, step {row['step']}, agent {row['agent']}"
        value = str(row[column])
        shown = value if len(value) <= 80 else value[:77] + "..."
        raise LogError(
            f"{place}: {column} {complaint} ({shown}); {wrong.height} of {frame.height} rows"
        )


def _refuse_half_file(path: Path) -> None:
    """Refuse a file that does not begin and end with the magic number of Parquet."""
    refuse_endless(path, LogError)
    try:
        with path.open("rb") as file:
            wrong = half_parquet(file)
    except OSError as error:
        way_out = "check the path" if isinstance(error, FileNotFoundError) else "make it readable"
        raise LogError(f"{path}: cannot be read ({error.strerror}); {way_out}") from None
    if wrong:
        raise LogError(f"{path}: {wrong}; record or copy it again")
