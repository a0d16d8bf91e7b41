"""Where and when vehicles stand: counted by hand, and in episodes that are played."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest

from tests.interrupts import few_descriptors
from ugat_marl.effects import load_scenario
from ugat_marl.errors import CheckpointError
from ugat_marl.experiments import evaluation_of, read_queues, rule_factory
from ugat_marl.experiments.queues import _SCHEMA, QueueRecord, write_queues
from ugat_marl.scenarios import Network


def stub(decisions: int, interval_s: float) -> Any:
    """An environment of grid2x2-v1 whose snapshot the test writes."""
    network = Network.read(load_scenario("grid2x2-v1"))
    env = SimpleNamespace(
        network=network, decision_interval_s=interval_s,
        scenario=SimpleNamespace(decisions=decisions), snapshot=None,
    )  # fmt: skip
    env.unwrapped = env
    return env


def test_queues_are_means_by_minute_and_intersection() -> None:
    env = stub(decisions=9, interval_s=10.0)
    lanes = env.network.lane_table()
    record = QueueRecord()
    look = record.watch("rule", "V4", env)
    first, second = env.network.intersections[:2]
    for step in range(1, 10):
        halting = np.zeros(len(lanes.ids))
        halting[lanes.indices(first.incoming_lanes[:2])] = step, 1.0
        halting[lanes.indices(first.outgoing_lanes[:1])] += 0.0
        halting[lanes.indices(second.incoming_lanes[:1])] = 2.0
        env.snapshot = SimpleNamespace(halting=halting)
        look(step)
    rows = {(m, tls): queue for _, _, m, tls, queue, _ in record.frame().rows()}
    # 6 decisions in the first minute, 3 in the second
    assert rows[0, first.id] == np.mean([1, 2, 3, 4, 5, 6]) + 1
    assert rows[1, first.id] == np.mean([7, 8, 9]) + 1
    assert rows[0, second.id] == rows[1, second.id] == 2.0
    assert {m for m, _ in rows} == {0, 1} and len(rows) == 8
    assert {(row[2], row[5]) for row in record.frame().rows()} == {(0, 6), (1, 3)}


def test_an_episode_whose_simulation_dies_counts_once() -> None:
    whole, broken = QueueRecord(), QueueRecord()
    env = stub(decisions=3, interval_s=10.0)
    for record, steps in ((whole, [1, 2, 3]), (broken, [1, 2, 1, 2, 3])):
        look = record.watch("rule", "V4", env)
        for step in steps:
            env.snapshot = SimpleNamespace(halting=np.full(len(env.network.lane_table().ids), step))
            look(step)
    assert broken.frame().equals(whole.frame())


def test_long_intervals_leave_minutes_out() -> None:
    env = stub(decisions=2, interval_s=90.0)
    look = (record := QueueRecord()).watch("rule", "V4", env)
    env.snapshot = SimpleNamespace(halting=np.ones(len(env.network.lane_table().ids)))
    look(1)
    look(2)
    assert set(record.frame()["minute"]) == {1, 2}


def test_an_evaluation_fills_it(tmp_path: Path) -> None:
    record = QueueRecord()
    rules = {name: rule_factory(name) for name in ("fixed-time:30", "max-pressure:20")}
    found = evaluation_of(
        load_scenario("single-v1"), rules, ["sim", "V4"], [1, 2], duration_s=300, watch=record.watch
    )
    record.write(tmp_path / "queues.parquet")
    frame = read_queues(tmp_path / "queues.parquet")
    assert len(frame) == 2 * 2 * 5
    for policy in rules:
        for domain in ("sim", "V4"):
            own = frame.filter(policy=policy, domain=domain)
            # 6 decisions in each of 5 minutes: the mean of the means is that of the scores
            mean = found.values(policy, domain, "queue").mean()
            assert own["queue"].mean() == pytest.approx(mean)


def test_another_evaluation_adds_its_episodes(tmp_path: Path) -> None:
    path = tmp_path / "queues.parquet"

    def write(domain: str, *episodes: float, keep: bool = True, **options: Any) -> None:
        env = stub(decisions=1, interval_s=60.0)
        look = (record := QueueRecord()).watch("policy", domain, env)
        for halting in episodes:
            lanes = len(env.network.lane_table().ids)
            env.snapshot = SimpleNamespace(halting=np.full(lanes, halting))
            look(1)
        record.write(path, keep=keep, **options)

    path.write_bytes(b"broken")
    write("sim", 1.0)
    write("V4", 2.0)
    first = read_queues(path)
    assert set(first["domain"]) == {"sim", "V4"}
    write("V4", 4.0, 6.0, batch=1)
    again = read_queues(path)
    assert len(again) == len(first)
    assert again.filter(domain="sim").equals(first.filter(domain="sim"))
    assert again.filter(domain="V4")["queue"].sum() == 2 * first.filter(domain="V4")["queue"].sum()
    whole = path.read_bytes()
    for _ in range(2):  # the same episodes after a kill between queues and scores
        write("V4", 4.0, 6.0, batch=1)
        assert path.read_bytes() == whole
    write("V4", 2.0, 4.0, 6.0)  # a batch grows, since more seeds were asked for after the kill
    assert set(read_queues(path).filter(domain="V4")["looks"]) == {5}
    write("V4", 3.0, batch=7, anew=True)  # of another world of that name
    assert set(read_queues(path).filter(domain="V4")["looks"]) == {1}
    write("V1", 1.0, keep=False)
    assert set(read_queues(path)["domain"]) == {"V1"}


def test_queues_of_several_policies_share_a_file_under_their_new_names(tmp_path: Path) -> None:
    env = stub(decisions=1, interval_s=60.0)
    record = QueueRecord()
    for policy, halting in (("last", 3.0), ("first", 1.0)):
        look = record.watch(policy, "V4", env)
        env.snapshot = SimpleNamespace(halting=np.full(len(env.network.lane_table().ids), halting))
        look(1)
    record.write(tmp_path / "job.parquet")
    (tmp_path / "damaged.parquet").write_bytes(b"PAR1 no more")
    sources = {
        "trained": (tmp_path / "job.parquet", "last"),
        "damaged": (tmp_path / "damaged.parquet", "last"),
        "missing": (tmp_path / "missing.parquet", "last"),
        "unknown": (tmp_path / "job.parquet", "never played"),
    }
    write_queues(tmp_path / "queues.parquet", sources)
    frame = read_queues(tmp_path / "queues.parquet")
    assert set(frame["policy"]) == {"trained"}
    last = record.frame().filter(policy="last")
    assert frame.drop("policy").equals(last.drop("policy"))
    assert not last.drop("policy").equals(record.frame().filter(policy="first").drop("policy"))
    write_queues(tmp_path / "queues.parquet", {})
    assert read_queues(tmp_path / "queues.parquet").is_empty()


@pytest.mark.parametrize("spare", range(5))
def test_a_record_that_cannot_be_read_now_is_not_replaced(spare: int, tmp_path: Path) -> None:
    """Reading takes more descriptors than writing: a sound record must not count as damaged."""
    env = stub(decisions=1, interval_s=60.0)
    look = (record := QueueRecord()).watch("policy", "V4", env)
    env.snapshot = SimpleNamespace(halting=np.ones(len(env.network.lane_table().ids)))
    look(1)
    kept, together = tmp_path / "kept.parquet", tmp_path / "together.parquet"
    record.write(kept)
    sources = {"policy": (kept, "policy")}
    write_queues(together, sources)
    looks = 1
    with few_descriptors(spare):
        with contextlib.suppress(OSError):
            record.write(kept, keep=True, batch=1)
            looks += 1
        with contextlib.suppress(OSError):
            write_queues(together, sources)
    assert set(read_queues(kept)["looks"]) == {looks}
    assert set(read_queues(together)["policy"]) == {"policy"}
    assert looks == 1 or spare > 0


@pytest.mark.parametrize("content", [b"", b"PAR1 no more"])
def test_a_damaged_file_is_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "q.parquet").write_bytes(content)
    with pytest.raises(CheckpointError, match=r"q\.parquet: cannot be read"):
        read_queues(tmp_path / "q.parquet")
    pl.DataFrame({"a": [1]}).write_parquet(tmp_path / "q.parquet")
    with pytest.raises(CheckpointError, match="not the queues of a run"):
        read_queues(tmp_path / "q.parquet")
    for minute, queue, looks in ((0, math.nan, 1), (10**12, 1.0, 1), (-1, 1.0, 1), (0, 0.0, 0)):
        row = ("policy", "sim", 0, minute, "A", queue, looks)
        pl.DataFrame([row], schema=_SCHEMA, orient="row").write_parquet(tmp_path / "q.parquet")
        with pytest.raises(CheckpointError, match="a number of looks is impossible"):
            read_queues(tmp_path / "q.parquet")
