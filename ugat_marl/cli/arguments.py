"""Options that several commands share; their help explains the default."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import MISSING, Field, fields
from typing import Annotated, Any

from tyro.conf import arg

from ugat_marl import parallel
from ugat_marl.errors import OptionError, require_distinct


def unused(metavar: str) -> Any:
    """Return the help of an option that is not used unless it is given."""
    return arg(metavar=metavar, help_behavior_hint="(default: not used)")


Workers = Annotated[int | None, arg(metavar="INT", help_behavior_hint="(default: one per core)")]
"""Simulations at a time."""

RayAddress = Annotated[str | None, unused("[ADDRESS]")]
"""Address of Ray: local (--ray without an address), auto, host:port, ray://host:port."""

LengthS = Annotated[
    float | None, arg(metavar="FLOAT", help_behavior_hint="(default: the scenario's own)")
]
"""Length of a day or an episode, s."""


def given_options(command: Any) -> list[str]:
    """Return the options of a command, by the names of its fields, that differ from the default."""
    return [
        field.name
        for field in fields(command)
        if not _required(field) and getattr(command, field.name) != _default(field)
    ]


def _required(field: Field[Any]) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def _default(field: Field[Any]) -> Any:
    return field.default if field.default_factory is MISSING else field.default_factory()


def option_text(name: str) -> str:
    """Return an option as it is typed: ``--duration-s`` for ``duration_s``."""
    return f"--{name.replace('_', '-')}"


def given_words(command: Any, without: Collection[str] = ()) -> list[str]:
    """Return the options of a command that differ from the default, as they are typed.

    Args:
        command: The command.
        without: Names of fields to leave out.
    """
    words: list[str] = []
    for name in given_options(command):
        value = getattr(command, name)
        if name in without:
            continue
        if isinstance(value, bool):
            words.append(option_text(name if value else f"no_{name}"))
        else:
            values = value if isinstance(value, tuple) else (value,)
            words += [option_text(name), *map(str, values)]
    return words


def refuse_options(command: Any, names: Collection[str], reason: str) -> None:
    """Refuse options that the command would ignore.

    Args:
        command: The command.
        names: Names of fields that it would not use.
        reason: First words of the error, as in "--draw draws everything".

    Raises:
        OptionError: One of the options is given.
    """
    if unused := [name for name in given_options(command) if name in names]:
        raise OptionError(f"{reason}; leave out {', '.join(map(option_text, unused))}")


def require_numbers(least: int, **options: int | None) -> None:
    """Refuse numbers below a least one; None, for a default, is allowed.

    Raises:
        OptionError: A number is below `least`.
    """
    for name, value in options.items():
        if value is not None and value < least:
            raise OptionError(f"{option_text(name)} {value}: must be at least {least}")


def require_names(**options: Sequence[str]) -> None:
    """Refuse options without a value, or with one twice.

    Raises:
        OptionError: A value is missing, or given twice.
    """
    for name, values in options.items():
        if not values:
            raise OptionError(f"{option_text(name)} needs at least one value")
        require_distinct(**{option_text(name): values})


@contextlib.contextmanager
def workers_of(
    workers: int | None, ray: str | None, option: str = "--workers"
) -> Iterator[parallel.Workers]:
    """Yield the workers for the parts of a command: processes of this machine, or Ray.

    Args:
        workers: Number of processes on this machine; None for one per core.
        ray: Address of Ray; None for processes of this machine.
        option: Name of the option `workers` on the command line.

    Raises:
        OptionError: `workers` and `ray` are both given, or Ray is not available.
    """
    if ray is None:
        yield workers
        return
    if workers is not None:
        raise OptionError(
            f"{option} is for this machine; with --ray its cores decide: leave it out"
        )
    with parallel.RayExecutor(ray) as executor:
        yield executor
