"""Transition logs: what is written is read back, and what cannot be a log is refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.data.row_hashes import write_hashed
from ugat_marl.data.transitions import FORMAT, METADATA_KEY
from ugat_marl.errors import LogError

LAYOUTS = {"signal_1": AgentLayout(3, 2, 1), "signal_0": AgentLayout(2, 4)}


def provenance(**changes: object) -> Provenance:
    given = Provenance(
        scenario="toy-v1",
        scenario_hash="abc",
        domain="sim",
        seeds=(7, 8),
        decision_interval_s=10.0,
        observation="count",
        layouts=LAYOUTS,
        versions={"sumo": "1.28.0"},
        units={"reward": "vehicles"},
    )
    return dataclasses.replace(given, **changes)


def recorded(episodes: int = 2, steps: int = 5, **changes: object) -> TransitionLog:
    recorder = TransitionRecorder(provenance(**changes))
    rng = np.random.default_rng(0)
    for episode in range(episodes):
        for step in range(steps):
            recorder.record(
                episode,
                step,
                {a: rng.random(v.size, np.float32) for a, v in LAYOUTS.items()},
                {a: np.int64(step % v.phases) for a, v in LAYOUTS.items()},
                {a: (step + 1) % v.phases for a, v in LAYOUTS.items()},
                dict.fromkeys(LAYOUTS, -float(step)),
                {a: rng.random(v.size, np.float32) for a, v in LAYOUTS.items()},
            )
    return recorder.log()


def test_the_first_decisions_of_each_episode_are_a_log() -> None:
    log = recorded(episodes=2, steps=5)
    begun = log.first(3)
    assert (log.decisions, begun.decisions, begun.episodes) == (5, 3, 2)
    rows = log.transitions("signal_0")
    kept = begun.transitions("signal_0").observation
    assert np.array_equal(kept, rows.observation[rows.step < 3])
    assert log.first(5) is log


def test_what_was_recorded_comes_out_per_agent() -> None:
    recorder = TransitionRecorder(provenance())
    buffer = np.arange(6, dtype=np.float32)
    other = np.ones(6, np.float32)
    for step in range(3):
        buffer[0] = step  # a reused buffer must not change rows already recorded
        recorder.record(
            0,
            step,
            {"signal_0": buffer, "signal_1": other},
            {"signal_0": 3, "signal_1": 1},
            {"signal_0": 2, "signal_1": 0},
            {"signal_0": -1.5, "signal_1": 0.0},
            {"signal_0": buffer + 1, "signal_1": other},
        )
    rows = recorder.log().transitions("signal_0")
    assert rows.observation.shape == (3, 6) and rows.observation.dtype == np.float32
    assert rows.observation[:, 0].tolist() == [0, 1, 2]
    assert (rows.next_observation == rows.observation + 1).all()
    assert rows.action.tolist() == [3, 3, 3] and rows.executed.tolist() == [2, 2, 2]
    assert rows.reward.tolist() == [-1.5] * 3
    assert rows.step.tolist() == [0, 1, 2] and rows.episode.tolist() == [0, 0, 0]
    rows.observation[:] = 0  # writable, so that torch.from_numpy does not warn


def test_round_trip_keeps_every_number_and_the_provenance(tmp_path: Path) -> None:
    log = recorded()
    log.write(tmp_path / "deep" / "log.parquet")
    again = TransitionLog.read(tmp_path / "deep" / "log.parquet")
    assert again.provenance == log.provenance
    assert again.agents == ("signal_1", "signal_0")  # the environment's order, not the alphabet's
    assert again.frame.equals(log.frame)
    assert len(again) == 2 * 5 * 2
    assert dict(again.frame.schema)["observation"] == pl.List(pl.Float32)


def test_an_empty_log_is_a_log(tmp_path: Path) -> None:
    empty = TransitionRecorder(provenance()).log()
    empty.write(tmp_path / "empty.parquet")
    again = TransitionLog.read(tmp_path / "empty.parquet")
    assert len(again) == 0 and again.episodes == 0
    assert again.transitions("signal_0").observation.shape == (0, 6)


def test_unknown_agent_is_named() -> None:
    with pytest.raises(LogError, match="signal_9"):
        recorded().transitions("signal_9")


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.9, 0.999])
def test_a_file_cut_short_is_named_with_the_way_out(tmp_path: Path, share: float) -> None:
    path = tmp_path / "half.parquet"
    recorded().write(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(LogError, match="half.parquet.*record"):
        TransitionLog.read(path)


def test_a_file_with_damaged_inside_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "damaged.parquet"
    recorded().write(path)
    whole = bytearray(path.read_bytes())
    whole[4 : len(whole) * 3 // 4] = bytes(len(whole) * 3 // 4 - 4)
    path.write_bytes(bytes(whole))
    with pytest.raises(LogError, match=r"damaged\.parquet"):
        TransitionLog.read(path)


def test_missing_file_foreign_parquet_and_no_parquet(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="nowhere.*check the path"):
        TransitionLog.read(tmp_path / "nowhere.parquet")
    (tmp_path / "text.parquet").write_text("episode,step\n1,2\n")
    with pytest.raises(LogError, match="not a Parquet file"):
        TransitionLog.read(tmp_path / "text.parquet")
    (tmp_path / "cut.parquet").write_bytes(b"PAR1PAR1")
    with pytest.raises(LogError, match=r"cut short \(8 bytes, no footer\); record or copy it"):
        TransitionLog.read(tmp_path / "cut.parquet")
    pl.DataFrame({"x": [1]}).write_parquet(tmp_path / "other.parquet")
    with pytest.raises(LogError, match=f"other.parquet.*{METADATA_KEY}"):
        TransitionLog.read(tmp_path / "other.parquet")
    with pytest.raises(LogError, match="cannot be read"):
        TransitionLog.read(tmp_path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", ""),
        ("[]", ""),
        ("{}", ""),
        ('{"format": 99}', "has another format"),
        (
            json.dumps({"format": FORMAT, "layouts": {"a": {"features": 0}}}),
            "cannot be understood",
        ),
    ],
)
def test_broken_provenance_is_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "log.parquet"
    write_hashed(recorded().frame, path, {METADATA_KEY: text})
    with pytest.raises(LogError, match=rf"log\.parquet: provenance.*{says}"):
        TransitionLog.read(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("decision_interval_s", "NaN"),
        ("decision_interval_s", "Infinity"),
        ("decision_interval_s", str(1 << 63) + "0" * 400),
        ("seeds", f"[{1 << 63}]"),
        ("seeds", "[NaN]"),
        ("deviation", '{"lane": NaN}'),
        ("versions", f'{{"sumo": {1 << 63}}}'),
        ("layouts", '{"a": {"features": NaN, "phases": 2}}'),
        ("layouts", f'{{"a": {{"features": {1 << 63}, "phases": 2}}}}'),
    ],
)
def test_provenance_with_impossible_numbers_is_refused(
    key: str, value: str, tmp_path: Path
) -> None:
    path = tmp_path / "log.parquet"
    recorded().write(path)
    text = pl.read_parquet_metadata(path)[METADATA_KEY]
    given = json.loads(text) | {key: "HERE"}
    write_hashed(recorded().frame, path, {METADATA_KEY: json.dumps(given).replace('"HERE"', value)})
    with pytest.raises(LogError, match=r"log\.parquet: (provenance|AgentLayout)"):
        TransitionLog.read(path)


def test_a_log_without_hashes_or_with_other_rows_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    recorded().write(path)
    frame, metadata = pl.read_parquet(path), pl.read_parquet_metadata(path)
    frame.write_parquet(path, metadata={METADATA_KEY: metadata[METADATA_KEY]})
    with pytest.raises(LogError, match="has no hashes of its rows"):
        TransitionLog.read(path)
    own = {key: text for key, text in metadata.items() if key.startswith("ugat_marl")}
    frame.with_columns(pl.col("reward") + 1).write_parquet(path, metadata=own)
    with pytest.raises(LogError, match=r"damaged, row group 0 \(rows 0 to \d+\) is not what was"):
        TransitionLog.read(path)


def replaced(column: str, values: list[object], dtype: pl.DataType | None = None) -> pl.DataFrame:
    return recorded(1, 1).frame.with_columns(pl.Series(column, values, dtype=dtype, strict=False))


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("frame", "complaint"),
    [
        (recorded(1, 1).frame.drop("executed"), "'executed' is missing"),
        (replaced("action", ["0", "1"]), "'action' has type String"),
        (replaced("action", [0.5, 1.0]), "'action' has type Float64"),
        (replaced("step", [2**40, 0]), "'step' does not fit into Int32"),
        (replaced("reward", [NAN, 0.0]), "signal_1: reward is not finite"),
        (replaced("reward", [None, 0.0]), "'reward' has missing values"),
        (replaced("action", [0, 4]), r"signal_0: action is not a phase of its agent \(4\)"),
        (replaced("executed", [-1, 0]), "signal_1: executed is not a phase"),
        (replaced("agent", ["signal_1", "north"]), "unknown agents .*north"),
        (replaced("agent", ["signal_1", "signal_1"]), "wrong length|twice"),
        (replaced("observation", [[0.0] * 6, [0.0] * 5]), "signal_0: observation has the wrong"),
        (replaced("observation", [[0.0] * 5 + [NAN], [0.0] * 6]), "observation holds a number"),
        (replaced("next_observation", [[0.0] * 6, [0.0] * 5 + [INF]]), "next_observation holds"),
        (replaced("observation", [[0.0] * 5 + [None], [0.0] * 6]), "observation holds a number"),
        (pl.concat([recorded(1, 1).frame] * 2), "twice"),
    ],
)
def test_impossible_tables_are_refused(frame: pl.DataFrame, complaint: str) -> None:
    with pytest.raises(LogError, match=complaint):
        TransitionLog(provenance(), frame)


def test_a_table_made_elsewhere_with_wider_types_is_accepted() -> None:
    log = recorded()
    wide = log.frame.with_columns(
        pl.col("episode", "step", "action", "executed").cast(pl.Int64),
        pl.col("reward").cast(pl.Float64),
        pl.col("observation", "next_observation").cast(pl.List(pl.Float64)),
    ).with_columns(extra=1)
    assert TransitionLog(provenance(source="measured"), wide).frame.equals(log.frame)


def test_a_failed_write_leaves_the_file_that_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "log.parquet"
    log = recorded()
    log.write(path)
    before = path.read_bytes()

    def full_disk(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pl.DataFrame, "write_parquet", full_disk)
    with pytest.raises(OSError, match="No space"):
        log.write(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["log.parquet"]


def test_recorder_refuses_a_missing_agent_and_a_wrong_shape() -> None:
    recorder = TransitionRecorder(provenance())
    six = np.zeros(6, np.float32)
    one = {"signal_0": 0, "signal_1": 0}
    with pytest.raises(LogError, match="step 3: agent 'signal_1' is missing"):
        recorder.record(0, 3, {"signal_0": six}, one, one, one, {"signal_0": six})
    assert len(recorder) == 0
    short = {"signal_0": six, "signal_1": six[:5]}
    recorder.record(0, 0, short, one, one, one, short)
    with pytest.raises(LogError, match=r"signal_1.*\(5,\).*expected \(6,\)"):
        recorder.log()


def test_concatenation_renumbers_episodes_and_keeps_their_order() -> None:
    first, second = recorded(2, 3), recorded(1, 4, seeds=(9,), versions={"sumo": "1.29.0"})
    second = TransitionLog(second.provenance, second.frame.with_columns(episode=5))
    both = TransitionLog.concatenate([first, second])
    rows = both.transitions("signal_0")
    assert rows.episode.tolist() == [0] * 3 + [1] * 3 + [2] * 4
    assert both.provenance.seeds == (7, 8, 9)
    assert both.provenance.versions == {"sumo": "1.28.0, 1.29.0"}
    assert both.provenance == TransitionLog.concatenate([both]).provenance
    assert (rows.observation[:6] == first.transitions("signal_0").observation).all()


def test_a_concatenated_log_is_as_uncertain_as_the_worst_of_its_parts() -> None:
    one, two = ({"a": 1.0, "b": 3.0}, {"a": 2.0, "c": 0.5})
    logs = [TransitionLog(provenance(deviation=each), recorded().frame) for each in (one, two)]
    assert TransitionLog.concatenate(logs).provenance.deviation == {"a": 2.0, "b": 3.0, "c": 0.5}


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"scenario": "toy-v2"}, "scenario"),
        ({"domain": "V1"}, "domain"),
        ({"observation": "queue"}, "observation"),
        ({"source": "measured"}, "source"),
        ({"layouts": dict(reversed(LAYOUTS.items()))}, "layouts"),
    ],
)
def test_concatenation_refuses_logs_of_different_things(change: dict, name: str) -> None:
    with pytest.raises(LogError, match=f"different {name}"):
        TransitionLog.concatenate(
            [recorded(), TransitionLog(provenance(**change), recorded().frame)]
        )
    with pytest.raises(LogError, match="at least one"):
        TransitionLog.concatenate([])


def test_provenance_refuses_impossible_values() -> None:
    with pytest.raises(LogError, match="guessed.*simulated, measured"):
        provenance(source="guessed")
    with pytest.raises(LogError, match="must be > 0"):
        provenance(decision_interval_s=0.0)
    with pytest.raises(LogError, match="phases >= 1"):
        AgentLayout(1, 0)
