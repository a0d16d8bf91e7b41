"""Frame of a command line: pick a command, read its options, turn errors into one line."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import io
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, get_type_hints

from rich.console import Console

from ugat_marl.errors import UgatMarlError, UnknownNameError, nearest
from ugat_marl.progress import Bars, showing


def run_command(command: Any, console: Console) -> int:
    """Run a command's dataclass and return its exit code."""
    return command.run(console)


@dataclass(frozen=True)
class CommandLine:
    """Commands of one program.

    Attributes:
        program: Name of the program, as a user types it.
        purpose: The first line of its help.
        commands: Name of each command to where it is, ``"module:Dataclass"``, and one line of help.
        short: Short names of commands, and what they stand for.
        examples: Command lines for a first try.
        perform: Runs a command's dataclass and returns the exit code.
    """

    program: str
    purpose: str
    commands: Mapping[str, tuple[str, str]]
    short: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    examples: tuple[str, ...] = ()
    perform: Callable[[Any, Console], int] = run_command


USAGE_ERROR = 2
INTERRUPTED = 130


def run(line: CommandLine, arguments: Sequence[str]) -> int:
    """Run the command that the arguments name.

    Args:
        line: The commands there are.
        arguments: Words behind the program's name.

    Returns:
        The exit code: 0, 1 (a check or target failed), 2 (a wrong call or input; one line says
        which), 130 (interrupted).
    """
    console = Console(highlight=False)
    shown = console if console.is_terminal else Console(stderr=True, highlight=False)
    try:
        with showing(Bars(shown)):
            return _run(line, list(arguments), console)
    except UgatMarlError as error:
        print(f"{line.program}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt as stop:
        print("; ".join([f"{line.program}: interrupted", *map(str, stop.args)]), file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return USAGE_ERROR


def _run(line: CommandLine, given: list[str], console: Console) -> int:
    if not given or given[0] in ("-h", "--help", "help"):
        _print_help(line, console)
        return 0 if given else USAGE_ERROR
    if given[0] == "--version":
        from ugat_marl import __version__

        console.print(f"ugat-marl {__version__}")
        return 0
    given = [*line.short.get(given[0], (given[0],)), *given[1:]]
    name, rest = given[0], given[1:]
    if parts := {key.split()[1] for key in line.commands if key.startswith(f"{name} ")}:
        if not rest or rest[0] in ("-h", "--help"):
            _print_help(line, console, f"{name} ")
            return 0 if rest else USAGE_ERROR
        if rest[0] not in parts:
            raise UnknownNameError(name, rest[0], parts)
        name, rest = f"{name} {rest[0]}", rest[1:]
    if name not in line.commands:
        names = {*(key.split()[0] for key in line.commands), *line.short}
        raise UnknownNameError("command", name, names, f"{line.program} --help explains them.")
    return line.perform(_parse(line, name, rest), console)


def _parse(line: CommandLine, name: str, rest: list[str]) -> Any:
    """Parse the command's dataclass; turn a message of tyro into one line."""
    import tyro

    module, _, attribute = line.commands[name][0].partition(":")
    kind = getattr(importlib.import_module(module), attribute)
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            command, unknown = tyro.cli(
                kind,
                args=_with_address(rest),
                prog=f"{line.program} {name}",
                description=_description(kind),
                return_unknown_args=True,
            )
    except SystemExit as end:
        if not end.code:
            raise
        raise UgatMarlError(
            f"{_one_line(said.getvalue())}; see {line.program} {name} --help"
        ) from None
    if unknown:
        first = unknown[0].partition("=")[0]
        if first.startswith("-"):
            options = sorted(_options(kind))
            guess = nearest(first, options)
            hint = f"Did you mean {guess!r}?" if guess else ""
            raise UgatMarlError(
                f"unknown option {first!r} of {name}. {hint} See {line.program} {name} --help"
            )
        raise UgatMarlError(f"{name}: unexpected {first!r}; see {line.program} {name} --help")
    return command


def _with_address(rest: list[str]) -> list[str]:
    """Complete a bare ``--ray``, which means the Ray of this machine."""
    followed = zip(rest, [*rest[1:], "--"], strict=False)
    bare = [word == "--ray" and after.startswith("-") for word, after in followed]
    return [
        part
        for word, b in zip(rest, bare, strict=True)
        for part in ((word, "local") if b else (word,))
    ]


def _description(kind: Any) -> str:
    """Return the docstring up to its list of attributes, examples included."""
    return (inspect.getdoc(kind) or "").partition("\nAttributes:")[0].strip()


def _options(kind: Any, prefix: str = "") -> set[str]:
    """Return the long options of a command, nested settings included."""
    found: set[str] = set()
    hints = get_type_hints(kind, include_extras=True)
    for item in fields(kind):
        hint = hints[item.name]
        inner = getattr(hint, "__origin__", hint)
        if isinstance(inner, type) and is_dataclass(inner):
            flat = any(
                getattr(extra, "name", None) == "" for extra in getattr(hint, "__metadata__", ())
            )
            found |= _options(inner, prefix if flat else f"{prefix}{item.name}.")
        else:
            found.add(f"--{prefix}{item.name}".replace("_", "-"))
    return found


def _one_line(box: str) -> str:
    """Return the message inside the box that tyro draws."""
    lines = [re.sub(r"[│╭╮╰╯]", " ", line).strip() for line in box.splitlines()]
    until = next((i for i, line in enumerate(lines) if line.startswith("──")), len(lines))
    words = " ".join(re.sub(r"─+", " ", line) for line in lines[:until])
    words = re.sub(r"^\s*(Value error|Invalid choice|Required options)\s", "", words)
    words = re.sub(r"Error parsing config[\w.]*:", "", words)
    return " ".join(words.split()).rstrip(".")


def _print_help(line: CommandLine, console: Console, prefix: str = "") -> None:
    console.print(f"{line.purpose}\n")
    console.print(f"usage: {line.program} {prefix}COMMAND [options]\n", markup=False)
    for name, (_, text) in line.commands.items():
        if name.startswith(prefix):
            console.print(f"  {name.removeprefix(prefix):<15} {text}")
    console.print(
        f"\n{line.program} {prefix}COMMAND --help shows options and examples of a command."
    )
    if not prefix and line.short:
        short = ", ".join(f"{name} = {' '.join(words)}" for name, words in line.short.items())
        console.print(f"Short: {short}.")
    if not prefix and line.examples:
        console.print("\nA first try:\n")
        for example in line.examples:
            console.print(f"  {example}", markup=False)
    console.print("\nExit codes: 0 done, 1 a check or target failed, 2 a wrong call or input.")
