"""The log of decisions: whole after every kind of end, and as quick after a year as at first."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import time
from pathlib import Path

import pytest

from ugat_marl.errors import OptionError, OutputError
from ugat_marl.field import Decision, DecisionLog, read_decisions
from ugat_marl.field.decisions import _line_hash

SEGMENT = 4096
"""Size of a segment in these tests, so that many are made."""


@pytest.fixture(autouse=True)
def short_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ugat_marl.field.decisions._SEGMENT_BYTES", SEGMENT)


def decision(number: int) -> Decision:
    return Decision(10.0 * number, {"A0": number % 4, "A1": 0}, {"A0": "missing: no count"}, 0.1, 1)


def numbers(path: Path) -> list[int]:
    """Numbers of the decisions in a log."""
    return [round(json.loads(line)["time_s"] / 10) for line in path.read_text().splitlines()]


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def filled(path: Path, count: int, begin: int = 0) -> DecisionLog:
    log = DecisionLog(path)
    for number in range(begin, begin + count):
        log.add(decision(number))
    return log


def test_segments_become_one_file_in_order(tmp_path: Path) -> None:
    path = tmp_path / "field.jsonl"
    log = filled(path, 503)
    (segment,) = tmp_path.glob("*.part")
    assert path.stat().st_size > 10 * SEGMENT
    assert segment.stat().st_size < SEGMENT
    assert numbers(path) + numbers(segment) == [*range(503)]  # as cat reads a running log
    log.close()
    assert names(tmp_path) == ["field.jsonl"]
    filled(path, 30, begin=503).close()
    assert numbers(path) == [*range(533)]


def test_a_decision_is_on_the_disk_when_its_call_returns(tmp_path: Path) -> None:
    log = DecisionLog(tmp_path / "field.jsonl")
    for number in range(5):
        log.add(decision(number))
        (segment,) = tmp_path.glob("*.part")
        assert numbers(segment) == [*range(number + 1)]
    log.close()


@pytest.mark.parametrize("lag_s", [0.0, 0.01, 0.05, 0.2])
def test_a_killed_loop_loses_nothing_that_it_had_told(
    python: list[str], tmp_path: Path, lag_s: float
) -> None:
    """The child tells each number after `add`; no number told may be missing afterwards."""
    path = tmp_path / "field.jsonl"
    program = (
        "import sys; from pathlib import Path; import ugat_marl.field.decisions as d\n"
        f"d._SEGMENT_BYTES = {SEGMENT}\n"
        "log = d.DecisionLog(Path(sys.argv[1]))\n"
        "for n in range(10**9):\n"
        "    log.add(d.Decision(10.0 * n, {'A0': 1}, {}, 0.1, 1.0))\n"
        "    print(n, flush=True)\n"
    )
    with subprocess.Popen(
        [*python, "-c", program, str(path)], stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "0\n"
        time.sleep(lag_s)
        child.send_signal(signal.SIGKILL)
        told = ["0", *child.stdout.read().split("\n")[:-1]]
    DecisionLog(path).close()
    kept = numbers(path)
    assert kept == [*range(len(kept))]
    assert len(told) <= len(kept) <= len(told) + 1
    assert names(tmp_path) == ["field.jsonl"]


def test_a_merge_killed_at_any_byte_is_completed(tmp_path: Path) -> None:
    path, lines = tmp_path / "field.jsonl", [decision(n).line().decode() for n in range(6)]
    before, segment = "".join(lines[:3]), "".join(lines[3:])
    for done in range(len(segment) + 1):
        path.write_text(before + segment[:done])
        (tmp_path / f"field.jsonl.{len(before):015d}.part").write_text(segment)
        DecisionLog(path).close()
        assert numbers(path) == [*range(6)]
        assert names(tmp_path) == ["field.jsonl"]


def test_a_line_killed_at_any_byte_is_left_out(tmp_path: Path) -> None:
    path, lines = tmp_path / "field.jsonl", [decision(n).line().decode() for n in range(3)]
    for done in range(len(lines[2])):
        path.write_text(lines[0])
        part = tmp_path / f"field.jsonl.{len(lines[0]):015d}.part"
        part.write_text(lines[1] + lines[2][:done])
        filled(path, 1, begin=2).close()
        assert numbers(path) == [0, 1, 2]


def test_segments_of_another_log_are_left_alone(tmp_path: Path) -> None:
    other = tmp_path / "field.jsonl.2.000000000000000.part"
    other.write_text("{}\n")
    filled(tmp_path / "field.jsonl", 2).close()
    assert other.read_text() == "{}\n"
    assert numbers(tmp_path / "field.jsonl") == [0, 1]


def test_a_torn_file_is_refused_though_a_segment_is_there(tmp_path: Path) -> None:
    path = tmp_path / "field.jsonl"
    path.write_text('{"time_s": 0')
    (tmp_path / "field.jsonl.000000000000500.part").write_text(decision(0).line().decode())
    with pytest.raises(OptionError, match="whole line"):
        DecisionLog(path)


def test_a_second_loop_with_the_same_log_is_refused(tmp_path: Path) -> None:
    log = filled(tmp_path / "field.jsonl", 3)
    with pytest.raises(OptionError, match="another loop writes to this log"):
        DecisionLog(log.path)
    log.close()
    filled(log.path, 3, begin=3).close()
    assert numbers(log.path) == [*range(6)]


def test_a_closed_log_can_be_added_to(tmp_path: Path) -> None:
    log = filled(tmp_path / "field.jsonl", 3)
    log.close()
    log.close()
    log.add(decision(3))
    log.close()
    assert numbers(log.path) == [*range(4)]


def test_lines_wait_while_the_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The system cuts a write short at the limit of a file's size, as on a full disk."""
    monkeypatch.setattr("ugat_marl.field.decisions._MOST_WAITING", 50)
    log = filled(tmp_path / "field.jsonl", 10)
    (segment,) = tmp_path.glob("*.part")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (segment.stat().st_size + 40, limits[1]))
        for number in range(10, 70):
            log.add(decision(number))
        assert log.lost == 10
        with pytest.raises(OutputError, match=r"field\.jsonl: cannot be completed \(.+make room"):
            log.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    log.add(decision(70))  # with room again, all that waited is written; one more had to go
    log.close()
    assert numbers(log.path) == [*range(10), *range(21, 71)]
    assert names(tmp_path) == ["field.jsonl"]


def test_a_decision_writes_as_much_after_many_segments_as_at_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bytes are counted, not seconds: those written for a line, and those of a merge."""
    written: list[int] = []
    pwrite = os.pwrite

    def counted(descriptor: int, content: bytes, offset: int) -> int:
        written.append(len(content))
        return pwrite(descriptor, content, offset)

    monkeypatch.setattr(os, "pwrite", counted)
    log = DecisionLog(tmp_path / "field.jsonl")
    per_decision: list[int] = []
    for number in range(3000):
        written.clear()
        log.add(decision(number))
        per_decision.append(sum(written))
    line = len(decision(2999).line())
    assert log.path.stat().st_size > 80 * SEGMENT
    assert max(per_decision) <= SEGMENT + 2 * line
    assert sum(per_decision[-500:]) <= 2 * 500 * line + SEGMENT
    log.close()
    assert numbers(log.path) == [*range(3000)]


def test_decisions_are_read_with_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "field.jsonl"
    log = filled(path, 20)
    (segment,) = tmp_path.glob("*.part")
    running = [*read_decisions(segment)]
    log.close()
    assert [*read_decisions(path)] == running
    assert running[3] == {
        "time_s": 30.0, "source": "both", "reasons": {"A0": "missing: no count"},
        "phases": {"A0": 3, "A1": 0}, "read_ms": 0.1, "latency_ms": 1,
    }  # fmt: skip
    with pytest.raises(OptionError, match="no.jsonl: cannot be read"):
        next(read_decisions(tmp_path / "no.jsonl"))


def test_no_flipped_bit_of_a_log_is_read_as_another_decision(tmp_path: Path) -> None:
    path = tmp_path / "field.jsonl"
    filled(path, 2).close()
    whole, lines = path.read_bytes(), [*read_decisions(path)]
    for place in range(0, 8 * len(whole), 5):
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        line = whole[: place // 8].count(b"\n")
        read: list[object] = []
        with pytest.raises(OptionError, match=f"line {line + 1} is not what was written"):
            read.extend(read_decisions(path))
        path.write_bytes(whole)
    assert [*read_decisions(path)] == lines


def test_a_log_that_is_renamed_goes_on_under_its_name(tmp_path: Path) -> None:
    """As logrotate does it: what came before is in the renamed file, the rest under the name."""
    path = tmp_path / "field.jsonl"
    log = filled(path, 100)
    old = path.rename(tmp_path / "field.jsonl.1")
    for number in range(100, 230):
        log.add(decision(number))
    with pytest.raises(OptionError, match="another loop writes"):
        DecisionLog(path)
    log.close()
    before = numbers(old)
    assert before and before + numbers(path) == [*range(230)]
    assert names(tmp_path) == ["field.jsonl", "field.jsonl.1"]


def test_a_json_file_of_something_else_is_no_log(tmp_path: Path) -> None:
    path = tmp_path / "settings.json"
    path.write_text('{"a": 1}\n')
    with pytest.raises(OptionError, match="holds something else than decisions"):
        DecisionLog(path)
    assert path.read_text() == '{"a": 1}\n'


def test_a_line_with_the_right_hash_and_no_json_is_told(tmp_path: Path) -> None:
    text, path = b'{"x": [}', tmp_path / "log.jsonl"
    path.write_bytes(text[:-1] + b', "hash": "' + _line_hash(text) + b'"}\n')
    with pytest.raises(OptionError, match="line 1 is not what was written"):
        list(read_decisions(path))
