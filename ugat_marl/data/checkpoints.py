"""Checkpoints: dictionaries of tensors and plain values, whole and finite or refused."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch

from ugat_marl.errors import CheckpointError
from ugat_marl.files import replacing

_UNREADABLE = (
    OSError, EOFError, RuntimeError, ValueError, LookupError, TypeError, AttributeError,
    AssertionError, UnpicklingError, zipfile.BadZipFile,
)  # fmt: skip
"""Errors that torch raises on files it did not write."""


def write_checkpoint(path: Path, kind: str, content: Mapping[str, Any]) -> None:
    """Write `content` so that `path` holds the old checkpoint or the new one, never half.

    Raises:
        CheckpointError: A number in `content` is not finite; the file at `path` is left as it was.
    """
    require_finite(content, str(path), "was not written over")
    with replacing(path) as temporary:
        torch.save({"kind": kind, **content}, temporary)


def read_checkpoint(path: Path, kind: str) -> dict[str, Any]:
    """Read what `write_checkpoint` wrote, without executing anything from the file.

    Raises:
        CheckpointError: Missing, cut short, of another kind, or with a number that is not finite.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: no such checkpoint file")
    try:
        _require_sums(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
    except _UNREADABLE as error:
        first_line = (str(error).splitlines() or [type(error).__name__])[0]
        raise CheckpointError(
            f"{path}: not a readable checkpoint ({first_line[:200]}); it may have been cut short: "
            "use an earlier one or train again"
        ) from None
    found = content.get("kind") if isinstance(content, dict) else None
    if found != kind:
        raise CheckpointError(f"{path}: holds {found!r}, expected {kind!r}; give the right file")
    require_finite(content, str(path), "cannot be used: take an earlier checkpoint or train again")
    return content


def _require_sums(path: Path) -> None:
    """Compare the check sums of the archive, which torch does not: a flipped bit is an error."""
    with zipfile.ZipFile(path) as archive:
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"check sum of {damaged} is wrong")


def require_finite(content: Mapping[str, Any], name: str, consequence: str) -> None:
    """Refuse NaN and infinity anywhere below `content`.

    Raises:
        CheckpointError: Names the entry that is not finite.
    """
    for key, tensor in _tensors("", content):
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(f"{name}: {key} holds NaN or infinity; the file {consequence}")


def tensors_like(
    path: Path, found: Mapping[str, torch.Tensor], own: Mapping[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Return the tensors of a checkpoint, checked against the learner's own.

    Args:
        path: The checkpoint, for messages.
        found: The tensors it holds; those not needed are left out.
        own: The learner's tensors, with the names, shapes and types needed.

    Raises:
        CheckpointError: One is of another shape or type.
        KeyError: One is missing.
    """
    for name, tensor in own.items():
        given = found[name]
        if given.shape != tensor.shape or given.dtype != tensor.dtype:
            raise CheckpointError(
                f"{path}: {name} has shape {tuple(given.shape)}, this learner needs "
                f"{tuple(tensor.shape)}; use the settings it was saved with"
            )
    return {name: found[name] for name in own}


def _tensors(prefix: str, content: Mapping[str, Any]) -> Iterator[tuple[str, torch.Tensor]]:
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _tensors(f"{prefix}{key}.", value)
        elif isinstance(value, torch.Tensor):
            yield f"{prefix}{key}", value
        elif isinstance(value, float):
            yield f"{prefix}{key}", torch.tensor(value)
