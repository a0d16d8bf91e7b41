"""Damaged inputs of every kind the suite reads. Each is read, or refused in one line.

A `Surface` writes sound files and uses them as a command would. `attempt` damages them as a seed
says, and returns what went wrong: a traceback, a message of several lines, or more time than
`MOST_S`. `main` tries many seeds in a process of its own, so that a crash is seen too.

`keep` writes the damaged files of a failure into `tests/fixtures/fuzz`, and `make test` tries them
again with `attempt_kept`.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gzip
import json
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from filecmp import cmp
from functools import cache
from pathlib import Path
from typing import Any

from ugat_marl.errors import UgatMarlError

MOST_S = 60.0
"""Most processor time of an input, s. Sound ones take less than two."""
MOST_BYTES = 6 << 30
"""Most address space of the process that tries inputs."""

KEPT = Path(__file__).parent / "fixtures" / "fuzz"
"""Damaged files that failed once: a folder for each surface, and in it one for each seed."""

TOKENS = (
    b"", b"-5", b"0", b"inf", b"nan", b"1_000", b"true", b"\xd9\xa1", b"1e999", b"9" * 30,
    b"9" * 400, b"9" * 5000, b"x" * 300, b"../../x", b"/etc/passwd", b" ", b"a,b", b"NUL",
    b"400000000", b"9223372036854775808", b"-9223372036854775809", b"1e308", b"-0.0", b"1e-320",
    b"\xff\xfe", b"\x00", b"\n", b"%s", b"{}", b"${HOME}", b"--help", b"\xf0\x9f\x9a\xa6",
    b"2024-13-45", b"null", b"None",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, -1, 0, 2, 1e308, -1e308, 2**31, 2**63, -(2**63) - 1, 10**30, 10**400, "",
    "x" * 300, "../../x", "1", "nan", [], {}, [[]], [None], {"a": {}}, [1, "a"], float("nan"),
    float("inf"), "\x00", "\ud7ff", 0.5, [0] * 3000,
)  # fmt: skip
_TOKEN = re.compile(rb'"[^"\n]*"|(?<![\w.])[-+]?\d[\d.eE+-]*')

Damage = Callable[[Path, random.Random], None]


@dataclass(frozen=True)
class Surface:
    """Something of the suite that reads files or texts of others.

    Attributes:
        name: Name.
        build: Writes sound files into an empty folder.
        use: Reads them.
        damages: Ways to damage a file of the folder, from which a seed draws.
        files: Pattern of the files that are damaged.
        share: Its share of the inputs; expensive surfaces have a smaller one.
    """

    name: str
    build: Callable[[Path], None]
    use: Callable[[Path], Any]
    damages: Sequence[Damage] = field(default_factory=lambda: (damage_bytes, damage_token))
    files: str = "*"
    share: float = 1.0


def damage_bytes(file: Path, draw: random.Random) -> None:
    """Cut, flip, insert, remove or repeat bytes."""
    content = file.read_bytes()
    if not content:
        return
    place = draw.randrange(len(content))
    kind = draw.choice(["cut", "flip", "insert", "remove", "repeat", "deep", "empty"])
    if kind == "cut":
        content = content[:place]
    elif kind == "flip":
        changed = bytearray(content)
        for _ in range(draw.choice([1, 1, 3, 40])):
            changed[draw.randrange(len(changed))] ^= 1 << draw.randrange(8)
        content = bytes(changed)
    elif kind == "insert":
        content = content[:place] + draw.choice(TOKENS) + content[place:]
    elif kind == "remove":
        content = content[:place] + content[place + draw.randrange(1, 60) :]
    elif kind == "repeat":
        lines = content.splitlines(keepends=True)
        lines.insert(draw.randrange(len(lines)), draw.choice(lines) * draw.choice([1, 1, 50]))
        content = b"".join(lines)
    elif kind == "deep":
        opening = draw.choice([b"[", b"{", b"<a>", b'{"a":', b"a=["]) * draw.choice([70, 3000])
        content = content[:place] + opening + content[place:]
    else:
        content = b""
    file.write_bytes(content)


def damage_token(file: Path, draw: random.Random) -> None:
    """Put something else in the place of a number or a quoted text."""
    content = file.read_bytes()
    for _ in range(draw.choice([1, 1, 1, 2, 5])):
        found = [*_TOKEN.finditer(content)]
        if not found:
            return
        token = draw.choice(found)
        new = draw.choice(TOKENS)
        if token[0].startswith(b'"'):
            new = b'"' + new + b'"'
        content = content[: token.start()] + new + content[token.end() :]
    file.write_bytes(content)


def damage_json(file: Path, draw: random.Random) -> None:
    """Replace, remove or rename values of a JSON file."""
    if not file.name.endswith(".json"):
        return damage_token(file, draw)
    content = damaged_value(json.loads(file.read_bytes()), draw)
    return file.write_text(json.dumps(content)) and None


def damaged_value(content: Any, draw: random.Random) -> Any:
    """Return plain values with one of them replaced, removed, renamed or repeated."""
    places = [*_places(content)]
    if not places:
        return draw.choice(VALUES)
    holder, key = draw.choice(places)
    kind = draw.choice(["value", "value", "value", "remove", "rename", "swap"])
    if kind == "value":
        holder[key] = draw.choice(VALUES)
    elif kind == "swap":
        other, there = draw.choice(places)
        holder[key] = other[there]
    elif isinstance(holder, list):
        holder.append(holder[key]) if kind == "rename" else holder.pop(key)
    else:
        value = holder.pop(key)
        if kind == "rename":
            holder[f"{key}s"] = value
    return json.loads(json.dumps(content)) if kind == "swap" else content


def _places(content: Any, depth: int = 0) -> Iterator[tuple[Any, Any]]:
    """Yield every list or dictionary inside, with an index or key of it."""
    keys = content if isinstance(content, dict) else range(len(content))
    for key in keys:
        yield content, key
        if isinstance(content[key], list | dict) and depth < 20:
            yield from _places(content[key], depth + 1)


def damage_table(file: Path, draw: random.Random) -> None:
    """Damage cells or columns of a Parquet file, which stays a Parquet file; hashes are gone."""
    import polars as pl

    if file.suffix != ".parquet":
        return damage_token(file, draw)
    frame = pl.read_parquet(file)
    own = {
        key: value
        for key, value in pl.read_parquet_metadata(file).items()
        if key.startswith("ugat_marl") and "hashes" not in key
    }
    if draw.random() < 0.3 and own:
        key = draw.choice(sorted(own))
        with contextlib.suppress(ValueError):
            own[key] = json.dumps(damaged_value(json.loads(own[key]), draw))
    else:
        frame = _damaged_frame(frame, draw)
    if draw.random() < 0.5:
        from ugat_marl.data.row_hashes import write_hashed

        return write_hashed(frame, file, own)
    return frame.write_parquet(file, metadata=own)


def _damaged_frame(frame: Any, draw: random.Random) -> Any:
    import polars as pl

    name = draw.choice(frame.columns)
    kind = draw.choice(["cells", "cells", "type", "drop", "rename", "empty", "order", "null"])
    if kind == "drop":
        return frame.drop(name)
    if kind == "rename":
        return frame.rename({name: f"{name}s"})
    if kind == "empty":
        return frame.clear()
    if kind == "order":
        return frame.reverse()
    if kind == "null":
        return frame.with_columns(pl.lit(None).alias(name))
    if kind == "type":
        other = draw.choice([pl.String, pl.Float32, pl.Int8, pl.Boolean, pl.Datetime, pl.Binary])
        with contextlib.suppress(pl.exceptions.PolarsError):
            return frame.with_columns(pl.col(name).cast(other, strict=False))
        return frame
    values = frame[name].to_list()
    for _ in range(draw.choice([1, 1, 5, len(values)])):
        if values:
            values[draw.randrange(len(values))] = draw.choice(VALUES)
    with contextlib.suppress(Exception):
        return frame.with_columns(pl.Series(name, values, frame.schema[name], strict=False))
    return frame.with_columns(pl.Series(name, [str(value) for value in values]))


def damage_checkpoint(file: Path, draw: random.Random) -> None:
    """Replace a value or tensor of a checkpoint, whose archive stays whole."""
    import torch

    content = torch.load(file, weights_only=True)
    places = [*_places_of_checkpoint(content)]
    holder, key = draw.choice(places)
    if isinstance(holder[key], torch.Tensor):
        holder[key] = _other_tensor(holder[key], draw)
    elif draw.random() < 0.2:
        del holder[key]
    else:
        holder[key] = draw.choice(VALUES)
    torch.save(content, file)


def _other_tensor(tensor: Any, draw: random.Random) -> Any:
    import torch

    return draw.choice(
        (
            lambda: torch.zeros(1).expand(10**7, 10**6),
            lambda: torch.empty(tensor.shape, device="meta"),
            lambda: torch.quantize_per_tensor(torch.zeros(tensor.shape), 0.1, 0, torch.qint8),
            lambda: torch.zeros(tensor.shape).to_sparse(),
            lambda: tensor.to(torch.complex64),
            lambda: tensor.to(torch.bool),
            lambda: tensor.to(torch.float64),
            lambda: torch.full(tensor.shape, float("nan")),
            lambda: torch.full(tensor.shape, 10**15).long(),
            lambda: tensor.reshape(-1)[:-1],
            lambda: tensor[None],
            lambda: torch.zeros(0),
            lambda: "text",
            lambda: None,
        )
    )()


def _places_of_checkpoint(content: Any) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    for key, value in content.items():
        found.append((content, key))
        if isinstance(value, dict):
            found += _places_of_checkpoint(value)
        elif isinstance(value, list):
            found += [(value, index) for index in range(len(value))]
    return found


def damage_packed(file: Path, draw: random.Random) -> None:
    """Damage a packed file: its content, then packed again, or its archive."""
    if file.suffix != ".gz":
        return damage_token(file, draw)
    if draw.random() < 0.5:
        return damage_bytes(file, draw)
    plain = file.with_suffix("")
    plain.write_bytes(gzip.decompress(file.read_bytes()))
    draw.choice([damage_bytes, damage_token])(plain, draw)
    file.write_bytes(gzip.compress(plain.read_bytes()))
    return plain.unlink()


class _TooLong(BaseException):
    """An input took more than `MOST_S`."""


def attempt(surface: Surface, seed: int, sound: Path) -> str:
    """Damage the files of a surface and use them; return what went wrong, or nothing.

    Args:
        surface: The surface.
        seed: Seed of the damage.
        sound: Folder with its sound files.
    """
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        folder = Path(name) / "in"
        shutil.copytree(sound, folder)
        _damage(surface, seed, folder)
        return _fault_of(surface.use, folder)


def _damage(surface: Surface, seed: int, folder: Path) -> None:
    import polars as pl

    draw = random.Random(f"{surface.name} {seed}")
    files = sorted(path for path in folder.glob(surface.files) if path.is_file())
    for _ in range(draw.choice([1, 1, 1, 2])):
        file = draw.choice(files)
        if file.exists():
            with contextlib.suppress(Exception, pl.exceptions.PanicException):
                # A second damage may find a file that no reader reads any more.
                draw.choice(list(surface.damages))(file, draw)


def keep(name: str, seed: int) -> None:
    """Write the files that a seed damages below `KEPT`."""
    surface = surfaces()[name]
    with built(surface) as sound:
        folder = sound.parent / "damaged"
        shutil.copytree(sound, folder)
        _damage(surface, seed, folder)
        for file in folder.rglob("*"):
            before = sound / file.relative_to(folder)
            if file.is_file() and not (before.exists() and cmp(file, before, shallow=False)):
                target = KEPT / name / str(seed) / file.relative_to(folder)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(file, target)


def attempt_kept(surface: Surface, kept: Path, sound: Path) -> str:
    """Use damaged files that `keep` wrote; return what went wrong, or nothing."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        folder = Path(name) / "in"
        shutil.copytree(sound, folder)
        shutil.copytree(kept, folder, dirs_exist_ok=True)
        return _fault_of(surface.use, folder)


def _fault_of(use: Callable[[Path], Any], folder: Path) -> str:
    def stop(*_: object) -> None:
        raise _TooLong

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, MOST_S)
    try:
        use(folder)
    except UgatMarlError as error:
        text = str(error)
        return f"several lines: {text[:400]!r}" if "\n" in text.strip() else ""
    except _TooLong:
        return f"hang: more than {MOST_S:g} s"
    except SystemExit as end:
        return f"exit {end.code}"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        lines = traceback.format_exception(error)
        return (
            f"traceback: {type(error).__name__}: {str(error)[:200]}\n{''.join(lines[-4:])[:2000]}"
        )
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
    return ""


@contextlib.contextmanager
def built(surface: Surface) -> Iterator[Path]:
    """Yield a folder with the sound files of a surface, which it reads without a complaint."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        sound = Path(name) / "in"
        sound.mkdir()
        surface.build(sound)
        check = Path(name) / "check"
        shutil.copytree(sound, check)
        surface.use(check)
        yield sound


def main(name: str, first: int, count: int) -> None:
    """Try seeds of a surface. Print each before it is tried, and what went wrong, as JSON lines."""
    faulthandler.enable()
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    with built(surfaces()[name]) as sound:
        for seed in range(first, first + count):
            print(json.dumps({"seed": seed}), flush=True)
            if fault := attempt(surfaces()[name], seed, sound):
                print(json.dumps({"seed": seed, "fault": fault}), flush=True)
    print(json.dumps({"done": count}), flush=True)


@cache
def surfaces() -> dict[str, Surface]:
    """Return all surfaces by name."""
    from tests import fuzz_surfaces

    return {surface.name: surface for surface in fuzz_surfaces.SURFACES}


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
