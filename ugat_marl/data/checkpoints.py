"""Checkpoints: dictionaries of tensors and plain values. Damaged or non-finite ones are refused."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch

from ugat_marl.errors import CheckpointError, first_line, first_names
from ugat_marl.files import (
    MALFORMED,
    OWN_COUNTERS,
    replacing,
    require_checkpoint,
    require_stored,
)

_UNREADABLE = (
    OSError, EOFError, RuntimeError, ValueError, LookupError, TypeError, AttributeError,
    AssertionError, UnpicklingError, zipfile.BadZipFile,
)  # fmt: skip
"""Errors that torch raises on files it did not write."""


def write_checkpoint(path: Path, kind: str, content: Mapping[str, Any]) -> None:
    """Write `content` to `path`, which then holds the old checkpoint or the whole new one.

    Args:
        path: The file.
        kind: Kind of checkpoint, which `read_checkpoint` compares.
        content: Tensors and plain values.

    Raises:
        CheckpointError: A number in `content` is not finite. The file at `path` stays unchanged.
        OSError: The disk is full.
    """
    _require_finite(content, path, "was not overwritten")
    # torch writes the name of a path into the archive, which then differs from run to run.
    with replacing(path) as temporary, temporary.open("wb") as file:
        try:
            torch.save({"kind": kind, **content}, file)
        except RuntimeError as error:  # torch's own, in place of that of a full disk
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise


def read_checkpoint(path: Path, *kinds: str) -> dict[str, Any]:
    """Read a file of `write_checkpoint`; no code from the file is executed.

    Args:
        path: The file.
        *kinds: Kinds of content of which it must have one; its own is under the key ``"kind"``.

    Raises:
        CheckpointError: The file is missing, cut short, of another kind, or holds a number that is
            not finite.
    """
    require_checkpoint(path)
    try:
        _require_sums(path)
        with warnings.catch_warnings():  # torch warns of its own old kinds of tensors
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="cpu", weights_only=True)
    except _UNREADABLE as error:
        if path.suffix in (".npz", ".onnx", ".ts"):
            raise CheckpointError(
                f"{path}: an exported model, which other programs read; give the .pt that it was "
                "made from"
            ) from None
        entries = _entries(path)
        if OWN_COUNTERS in entries:
            raise CheckpointError(
                f"{path}: what a learner of yours has saved, which only the learner can read; "
                f"commands that play policies, and evaluate() in Python, take it as "
                f"MODULE:CLASS@{path}; it cannot be exported"
            ) from None
        if entries and not any(name.endswith("/data.pkl") for name in entries):
            raise CheckpointError(
                f"{path}: an archive of another program ({first_names(entries)}), not a checkpoint "
                "of this suite; give a file that a command of the suite wrote"
            ) from None
        raise CheckpointError(
            f"{path}: not a readable checkpoint ({first_line(error)}); it may have been cut short: "
            "use an earlier one or train again"
        ) from None
    kind_read = content.get("kind") if isinstance(content, dict) else None
    if kind_read not in kinds:
        expected = " or ".join(map(repr, kinds))
        raise CheckpointError(
            f"{path}: holds {kind_read!r}, expected {expected}; give the right file"
        )
    try:
        for name, tensor in _tensors("", content):
            if not _is_plain(tensor):
                raise CheckpointError(
                    f"{path}: {name} is not a dense tensor of usual numbers that stores all its "
                    f"elements ({tensor.layout}, {tensor.dtype}, {tensor.device}); save it with "
                    "write_checkpoint"
                )
    except RecursionError:
        raise CheckpointError(f"{path}: nested too deeply; save it with write_checkpoint") from None
    _require_finite(content, path, "cannot be used: take an earlier checkpoint or train again")
    return content


def _entries(path: Path) -> list[str]:
    """Return the names of the entries of an archive; none if it is no archive, or cut short."""
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.namelist()
    except (OSError, zipfile.BadZipFile, *MALFORMED):
        return []


def _require_sums(path: Path) -> None:
    """Refuse an archive that is packed or has a wrong check sum; torch checks neither.

    Raises:
        ValueError: An entry is packed, or a check sum is wrong, such as after a flipped bit.
    """
    with zipfile.ZipFile(path) as archive:
        require_stored(archive)
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"check sum of {damaged} is wrong")


def _require_finite(content: Mapping[str, Any], path: Path, consequence: str) -> None:
    """Refuse NaN and infinity anywhere below `content`.

    Args:
        content: Tensors and plain values, nested.
        path: The file.
        consequence: End of the message: what this means for the file.

    Raises:
        CheckpointError: An entry is not finite; the message names it.
    """
    for key, tensor in _tensors("", content):
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(f"{path}: {key} holds NaN or infinity; the file {consequence}")


def checked_tensors(
    path: Path, read: Mapping[str, torch.Tensor], expected: Mapping[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Return the tensors of a checkpoint, checked against the learner's own.

    Args:
        path: The checkpoint, for messages.
        read: Tensors of the checkpoint; those that the learner does not need are left out.
        expected: The learner's tensors, with the required names, shapes and types.

    Raises:
        CheckpointError: A tensor has another shape or type.
        KeyError: A tensor is missing.
    """
    for name, tensor in expected.items():
        given = read[name]
        if given.shape != tensor.shape or given.dtype != tensor.dtype:
            raise CheckpointError(
                f"{path}: {name} has shape {tuple(given.shape)}, this learner needs "
                f"{tuple(tensor.shape)}; use the settings it was saved with"
            )
    return {name: read[name] for name in expected}


_DTYPES = frozenset(
    {
        torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.bool, torch.uint8,
        torch.int8, torch.int16, torch.int32, torch.int64,
    }
)  # fmt: skip
"""Kinds of numbers that a checkpoint may hold. Of rarer ones torch cannot say what is finite."""


def _is_plain(tensor: torch.Tensor) -> bool:
    """Return True for a dense tensor in memory that holds all of its elements.

    A stride of 0 lets a few bytes stand for more elements than any memory holds; quantised and meta
    tensors have no values to check.
    """
    if tensor.layout != torch.strided or tensor.is_meta or tensor.dtype not in _DTYPES:
        return False
    return tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


def _tensors(prefix: str, content: Mapping[Any, Any]) -> Iterator[tuple[str, torch.Tensor]]:
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _tensors(f"{prefix}{key}.", value)
        elif isinstance(value, list | tuple):
            yield from _tensors(f"{prefix}{key}.", dict(enumerate(value)))
        elif isinstance(value, torch.Tensor):
            yield f"{prefix}{key}", value
        elif isinstance(value, float):
            yield f"{prefix}{key}", torch.tensor(value)
