"""Checkpoint files: whole and finite, or refused."""

from __future__ import annotations

import contextlib
import errno
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ugat_marl.data import read_checkpoint, write_checkpoint
from ugat_marl.errors import CheckpointError

CONTENT = {"weights": torch.arange(50.0), "counters": {"steps": 7}, "rate": 0.5}


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    write_checkpoint(path, "toy", CONTENT)
    found = read_checkpoint(path, "toy")
    assert torch.equal(found["weights"], CONTENT["weights"])
    assert found["counters"] == {"steps": 7}


def test_a_flipped_byte_is_noticed_wherever_it_matters(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    write_checkpoint(path, "toy", CONTENT)
    whole = path.read_bytes()
    refused: list[str] = []
    for place in np.random.default_rng(0).choice(len(whole), 300, replace=False):
        damaged = bytearray(whole)
        damaged[place] ^= 0x10
        path.write_bytes(damaged)
        try:
            found = read_checkpoint(path, "toy")
        except CheckpointError as error:
            refused.append(str(error))
        else:  # padding, or a date inside the archive
            assert torch.equal(found["weights"], CONTENT["weights"])
            assert (found["counters"], found["rate"]) == ({"steps": 7}, 0.5)
    assert len(refused) > 50
    assert all(str(path) in message for message in refused)


def test_half_a_file_another_file_and_no_file(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    write_checkpoint(path, "toy", CONTENT)
    with pytest.raises(CheckpointError, match="expected 'other'"):
        read_checkpoint(path, "other")
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(CheckpointError, match="cut short"):
        read_checkpoint(path, "toy")
    path.write_text("not a checkpoint")
    with pytest.raises(CheckpointError, match="not a readable"):
        read_checkpoint(path, "toy")
    with pytest.raises(CheckpointError, match="no such"):
        read_checkpoint(tmp_path / "b.pt", "toy")
    with zipfile.ZipFile(path, "w") as archive:  # as Stable-Baselines3 writes
        for name in ("data", "policy.pth"):
            archive.writestr(name, "{}")
    with pytest.raises(CheckpointError, match=r"of another program \(data, policy\.pth\), not a"):
        read_checkpoint(path, "toy")


def test_what_is_not_finite_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    write_checkpoint(path, "toy", CONTENT)
    before = path.read_bytes()
    bad = {"nested": {"weights": torch.tensor([1.0, float("nan")])}}
    with pytest.raises(CheckpointError, match=r"nested\.weights"):
        write_checkpoint(path, "toy", bad)
    assert path.read_bytes() == before


@pytest.mark.filterwarnings("ignore")  # torch will drop quantised tensors
@pytest.mark.parametrize(
    "make",
    [
        lambda: torch.zeros(1).expand(10**13),
        lambda: torch.zeros(2, device="meta"),
        lambda: torch.quantize_per_tensor(torch.ones(2), 0.1, 0, torch.qint8),
        lambda: torch.eye(2).to_sparse(),
    ],
    ids=["stride 0", "meta", "quantised", "sparse"],
)
def test_tensors_that_are_not_plain_are_refused(
    make: Callable[[], torch.Tensor], tmp_path: Path
) -> None:
    path = tmp_path / "a.pt"
    torch.save({"kind": "x", "net": {"weight": make()}}, path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the refusal is one line, without torch's own words
        with pytest.raises(CheckpointError, match=r"net\.weight is not a dense|not a readable"):
            read_checkpoint(path, "x")


def test_the_same_content_is_the_same_file_wherever_it_lies(tmp_path: Path) -> None:
    for name in ("a.pt", "other.pt"):
        write_checkpoint(tmp_path / name, "toy", CONTENT)
    assert (tmp_path / "a.pt").read_bytes() == (tmp_path / "other.pt").read_bytes()


def test_a_full_disk_is_an_error_of_the_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full:
        """A disk that is full at first, or after some of the content."""

        def __init__(self, left: int) -> None:
            self.left = left

        def write(self, content: bytes) -> int:
            self.left -= len(content)
            if self.left < 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            return len(content)

        def flush(self) -> None:
            pass

    for left in (0, 500):

        def open_on_it(_: Path, mode: str, left: int = left) -> Any:
            assert mode == "wb"
            return contextlib.nullcontext(Full(left))

        monkeypatch.setattr(Path, "open", open_on_it)
        with pytest.raises(OSError, match="No space left"):
            write_checkpoint(tmp_path / "a.pt", "toy", CONTENT)
    assert list(tmp_path.iterdir()) == []


def test_a_packed_archive_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    """A megabyte could unpack to a gigabyte; the suite packs no checkpoint."""
    write_checkpoint(tmp_path / "a.pt", "toy", {"a": torch.zeros(10**6)})
    with (
        zipfile.ZipFile(tmp_path / "a.pt") as plain,
        zipfile.ZipFile(tmp_path / "b.pt", "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for entry in plain.infolist():
            packed.writestr(entry.filename, plain.read(entry))
    assert (tmp_path / "b.pt").stat().st_size < 10**5
    with pytest.raises(CheckpointError, match="is packed, which the suite never does"):
        read_checkpoint(tmp_path / "b.pt", "toy")


def test_what_holds_itself_and_rare_kinds_of_numbers_are_refused(tmp_path: Path) -> None:
    endless: list[Any] = []
    endless.append(endless)
    for content, says in (
        (endless, "nested too deeply"),
        (torch.zeros(2, dtype=torch.float8_e4m3fn), "not a dense tensor of usual numbers"),
        (torch.zeros(2, dtype=torch.complex64), "not a dense tensor of usual numbers"),
    ):
        path = tmp_path / "x.pt"
        torch.save({"kind": "policy", "x": content}, path)
        with pytest.raises(CheckpointError, match=says):
            read_checkpoint(path, "policy")
