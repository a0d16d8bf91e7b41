"""Frame of a command line: pick a command, read its options, turn errors into one line."""

from __future__ import annotations

import contextlib
import errno
import importlib
import io
import itertools
import os
import re
import shlex
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from ugat_marl.cli.help import (
    COMPLETION,
    DEADLINE,
    HELP,
    HELP_ALL,
    described,
    options_of,
    print_help,
)
from ugat_marl.errors import UgatMarlError, UnknownNameError, joined, nearest, terminated_as
from ugat_marl.progress import Bars, Loudness, loudness, showing

USAGE_ERROR = 2
INTERRUPTED = 130
TERMINATED = 143
LOUDNESS: dict[str, Loudness] = {"--quiet": "quiet", "--verbose": "verbose"}
"""Options of every command."""
_INDENT_OF_REQUIRED = 6
"""Spaces before the name of an argument in tyro's box of missing ones."""
_PLAIN_WORDS = {
    r"^Error parsing config[\w.]*: *": "",
    r"^Error parsing (\S+): invalid literal for int\(\) with base 10: (.*)": (
        r"\1 \2: not a whole number"
    ),
    r"^Error parsing (\S+): could not convert string to float: (.*)": r"\1 \2: not a number",
    r"^Error parsing (\S+): no type matching \{None\}\|FLOAT .* from \['(.*?)'\].*": (
        r"\1 \2: not a number, such as 600 or 7.5, nor None"
    ),
    r"^Error parsing (\S+): no type matching \{None\}\|INT .* from \['(.*?)'\].*": (
        r"\1 \2: not a whole number, nor None"
    ),
    r"^invalid choice (.*) for argument '(.*)'\. Expected one of \((.*)\)": (
        r"\2 \1: must be one of \3"
    ),
    r"^Missing value for argument '(.*)'\. Expected 1 values": r"\1 needs a value",
    r"^Error parsing [\w.]+: *": "",
}
"""Messages of tyro to what they mean."""
_CLOCK = re.compile(r"(?<![-\d:])([01]?\d|2[0-3]):([0-5]\d)(?::([0-5]\d))?'?: not a number")
_LONGEST_MESSAGE = 1500
"""Most characters of an error: about twenty lines of a terminal."""
_WAYS_OUT = {
    errno.ENOSPC: "; make room, or name another folder (TMPDIR for temporary files)",
    errno.EDQUOT: "; make room, or name another folder (TMPDIR for temporary files)",
    errno.EMFILE: "; raise the limit (ulimit -n), or use fewer workers or environments",
    errno.ENFILE: "; close other programs, or use fewer workers or environments",
    errno.ENAMETOOLONG: "; give a shorter name",
}
"""Number of an error of the operating system to its remedy."""


class Terminated(KeyboardInterrupt):
    """The program got SIGTERM; it ends in order, as after Ctrl-C."""


def run_command(command: Any, console: Console) -> int:
    """Run a command's dataclass and return its exit code."""
    return command.run(console)


@dataclass(frozen=True)
class CommandLine:
    """Commands of one program.

    Attributes:
        program: Name of the program, as a user types it.
        purpose: First line of the program's help.
        commands: Name of each command to its place, ``"module:Dataclass"``, and one line of help.
        short: Short names of commands, and the words that replace them.
        groups: Purpose of commands of two words, by their first word.
        examples: Command lines for a first try.
        perform: Function that runs a command's dataclass and returns the exit code.
    """

    program: str
    purpose: str
    commands: Mapping[str, tuple[str, str]]
    short: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    groups: Mapping[str, str] = field(default_factory=dict)
    examples: tuple[str, ...] = ()
    perform: Callable[[Any, Console], int] = run_command


def run(line: CommandLine, arguments: Sequence[str]) -> int:
    """Run the command that the arguments name.

    Args:
        line: Commands of the program.
        arguments: Words after the program's name.

    Returns:
        The exit code: 0, 1 (a check or target failed), 2 (wrong call or input; one line names the
        fault), 130 (interrupted), 143 (terminated).
    """
    # a path as runs/a:x:b stays one
    plain = partial(Console, highlight=False, markup=False, emoji=False)
    console = plain()
    arguments, level = without_loudness(arguments)
    arguments, seconds = without_deadline(arguments)
    progress = console if console.is_terminal else plain(stderr=True)

    def perform() -> int:
        with loudness(level), showing(Bars(progress)), _deadline(seconds):
            try:
                return _dispatch(line, list(arguments), console)
            except UgatMarlError as error:
                raise UgatMarlError(_as_typed(str(error), arguments)) from error

    return guarded(line.program, perform)


@contextlib.contextmanager
def _warnings_as_notes() -> Iterator[None]:
    """Show warnings of the suite to users as notes, without the place in the code."""
    usual = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *place: Any) -> None:
        if category is UserWarning:
            print(f"note: {_in_one_line(str(message))}", file=sys.stderr)
        else:
            usual(message, category, *place)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = usual


def guarded(program: str, call: Callable[[], int | None]) -> int:
    """Call a program's main function; errors and warnings are one line, SIGTERM ends it in order.

    Args:
        program: Name of the program, as a user types it.
        call: The function; it returns the exit code, or None for 0.

    Returns:
        The exit code; see `run`.
    """
    for stream in (sys.stdout, sys.stderr):  # a terminal without Greek letters shows "?" for them
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        with terminated_as(Terminated()), _warnings_as_notes():
            return call() or 0
    except UgatMarlError as error:
        print(f"{program}: error: {_in_one_line(str(error))}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt as interrupt:
        terminated = isinstance(interrupt, Terminated)
        ended = f"{program}: {'terminated' if terminated else 'interrupted'}"
        print("; ".join([ended, *map(str, interrupt.args)]), file=sys.stderr)
        return TERMINATED if terminated else INTERRUPTED
    except BrokenPipeError:  # else the interpreter writes to the closed pipe at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return USAGE_ERROR
    except OSError as error:  # a full disk, too few descriptors, a name that is too long
        place = f"{str(error.filename)[:200]}: " if error.filename is not None else ""
        said = error.strerror or str(error) or type(error).__name__
        way_out = _WAYS_OUT.get(error.errno or 0, "")
        print(f"{program}: error: {place}{said}{way_out}", file=sys.stderr)
        return USAGE_ERROR
    except RecursionError:
        print(
            f"{program}: error: a file is nested too deeply to be read; no file of the suite "
            "nests that deep",
            file=sys.stderr,
        )
        return USAGE_ERROR
    except MemoryError:
        print(
            f"{program}: error: out of memory; use a smaller file, fewer workers, or a larger "
            "machine",
            file=sys.stderr,
        )
        return USAGE_ERROR


def _as_typed(message: str, words: Sequence[str]) -> str:
    """Return a message with options as they were typed, for settings as they are called in Python.

    ``fit learning_rate is inf`` becomes ``--fit.learning-rate inf``.
    """
    typed = [word for given in words for word in given.split("=", 1)]
    for option, value in dict(zip(typed, typed[1:], strict=False)).items():
        group, _, name = option.removeprefix("--").replace("-", "_").rpartition(".")
        if not option.startswith("--") or not name.isidentifier():
            continue
        owner = rf"(?:{re.escape(group)}[ .]|\w+Config\.)?" if group else ""
        for found in re.finditer(rf"\b{owner}{name} (?:=|is) ([^\s:;,]+)", message):
            if _same(found[1], value):
                return message.replace(found[0], f"{option} {value}")
    return message


def _same(shown: str, typed: str) -> bool:
    """Return True if a message shows the value that was typed: 2.0 for 2."""
    try:
        return shown.strip("'") == typed or float(shown) == float(typed)
    except ValueError:
        return False


def _in_one_line(text: str) -> str:
    """Return a message as one line, without the middle of one that quotes a whole file."""
    words = " ".join(text.split())
    if len(words) <= _LONGEST_MESSAGE:
        return words
    return f"{words[: 2 * _LONGEST_MESSAGE // 3]} ... {words[-_LONGEST_MESSAGE // 3 :]}"


def without_loudness(words: Sequence[str]) -> tuple[list[str], Loudness]:
    """Return the words without --quiet and --verbose, and how much they ask to be said."""
    asked = [word for word in words if word in LOUDNESS]
    rest = [word for word in words if word not in LOUDNESS]
    return rest, LOUDNESS[asked[-1]] if asked else "usual"


def without_deadline(words: Sequence[str]) -> tuple[list[str], str | None]:
    """Return the words without --deadline-s, and its seconds; None if it is not among them."""
    rest, seconds = list[str](), None
    left = iter(words)
    for word in left:
        option, equals, value = word.partition("=")
        if option == DEADLINE:
            seconds = value if equals else next(left, "")
        else:
            rest.append(word)
    return rest, seconds


def given_call(*command: str) -> list[str] | None:
    """Return the words with which a command was called; None if another program called it.

    Options that every command has are left out.

    Args:
        *command: Name of the command, word by word.
    """
    program, *words = sys.argv
    words, _ = without_deadline(without_loudness(words)[0])
    known = Path(program).name in ("ugat-marl", "__main__.py")
    return words if known and words[: len(command)] == [*command] else None


@contextlib.contextmanager
def continued_by(words: Sequence[str], place: str) -> Iterator[None]:
    """Tell at an interruption how the work goes on.

    Args:
        words: Words of the command that continues the work; "..." stands for unknown ones.
        place: Folder of the work, with what it holds, as in "run: runs/demo".
    """
    try:
        yield
    except KeyboardInterrupt as interrupt:
        call = shlex.join(["ugat-marl", *words]).replace("'...'", "...")
        raise type(interrupt)(f"{place}; go on with: {call}") from None


@contextlib.contextmanager
def _deadline(seconds: str | None) -> Iterator[None]:
    """Set the deadline of simulations, SUMO's programs and jobs, for all processes started here.

    Raises:
        OptionError: It is not a number of seconds above 0, up to `LONGEST_DEADLINE_S`.
    """
    if seconds is None:
        yield
        return
    from ugat_marl.parallel import DEADLINE_VARIABLE, deadline_of

    deadline_of(f"{DEADLINE} {seconds}".rstrip(), seconds)
    before = os.environ.get(DEADLINE_VARIABLE)
    os.environ[DEADLINE_VARIABLE] = seconds
    try:
        yield
    finally:
        if before is None:
            del os.environ[DEADLINE_VARIABLE]
        else:
            os.environ[DEADLINE_VARIABLE] = before


def _dispatch(line: CommandLine, words: list[str], console: Console) -> int:
    """Print help or the version, or run the command that the words name."""
    if not words or words[0] in (*HELP, HELP_ALL, "help"):
        _print_help(line, console)
        return 0 if words else USAGE_ERROR
    if words[0] == "--version":
        from ugat_marl import __version__

        console.print(f"ugat-marl {__version__}")
        return 0
    if words[0] == COMPLETION:
        return _print_completion(line, words[1:])
    words = [*line.short.get(words[0], (words[0],)), *words[1:]]
    name, rest = words[0], words[1:]
    if members := {key.split()[1] for key in line.commands if key.startswith(f"{name} ")}:
        if not rest or rest[0] in (*HELP, HELP_ALL):
            _print_help(line, console, f"{name} ")
            return 0 if rest else USAGE_ERROR
        if rest[0] not in members:
            raise UnknownNameError(name, rest[0], members)
        name, rest = f"{name} {rest[0]}", rest[1:]
    if name not in line.commands:
        names = {*(key.split()[0] for key in line.commands), *line.short, COMPLETION}
        raise UnknownNameError("command", name, names, f"{line.program} --help explains them.")
    command = _parse(line, name, rest)
    from ugat_marl.files import without_empty_folders  # which help does not need

    with without_empty_folders():
        return line.perform(command, console)


def _help_that_has(command_type: Any, message: str) -> str:
    """Return the option that shows the help with the option a message begins with."""
    shown: Sequence[str] = getattr(command_type, "FIRST", ())
    option = re.match(r"--([\w.-]+)", message)
    hidden = shown and option and option[1].replace("-", "_") not in shown
    return HELP_ALL if hidden else HELP[-1]


def _parse(line: CommandLine, name: str, words: list[str]) -> Any:
    """Parse the options of a command into its dataclass, or print its help."""
    module, _, attribute = line.commands[name][0].partition(":")
    command_type = getattr(importlib.import_module(module), attribute)
    program = f"{line.program} {name}"
    if any(word in (*HELP, HELP_ALL) for word in words):
        print_help(command_type, program, words)
    return parse_options(command_type, program, name, words)


def parse_options(command_type: Any, program: str, name: str, words: Sequence[str]) -> Any:
    """Parse options into a dataclass.

    Args:
        command_type: The dataclass.
        program: Name of the program with that of the command, as a user types it.
        name: Name of the command.
        words: Words after the name.

    Raises:
        UgatMarlError: An option is unknown, missing or impossible; one line says which.
        SystemExit: The words ask for help, which is printed.
    """
    import tyro

    messages = io.StringIO()
    try:
        with contextlib.redirect_stderr(messages):
            command, unknown = tyro.cli(
                command_type,
                args=_with_address(words),
                prog=program,
                description=described(command_type),
                return_unknown_args=True,
            )
    except SystemExit as end:
        if not end.code:
            raise
        message = _one_line(messages.getvalue(), name)
        told = _help_that_has(command_type, message)
        raise UgatMarlError(f"{message}; see {program} {told}") from None
    if unknown:
        first, is_value, _ = unknown[0].partition("=")
        if first.startswith("-"):
            guess = nearest(first, sorted(options_of(command_type)))
            hint = f"Did you mean {guess!r}?" if guess else ""
            told = _help_that_has(command_type, guess or first)
            raise UgatMarlError(f"unknown option {first!r} of {name}. {hint} See {program} {told}")
        joined_by = (
            "; effects of one domain are joined by +, as in V1+late_green=2" if is_value else ""
        )
        raise UgatMarlError(f"{name}: unexpected {unknown[0]!r}{joined_by}; see {program} --help")
    return command


def _with_address(words: Sequence[str]) -> list[str]:
    """Complete a ``--ray`` without an address to ``--ray local``, the Ray of this machine."""
    complete: list[str] = []
    for word, following in zip(words, [*words[1:], "--"], strict=False):
        complete.append(word)
        if word == "--ray" and following.startswith("-"):
            complete.append("local")
    return complete


def _one_line(box: str, name: str) -> str:
    """Return the message in the box that tyro draws, as one line.

    Args:
        box: The box, in line-drawing characters or, on terminals without them, in ASCII.
        name: Name of the command.
    """
    title, *lines = [re.sub(r"[│╭╮╰╯]", " ", line).rstrip() for line in box.splitlines()] or [""]
    under_title = itertools.dropwhile(_is_rule, lines)
    message = list(itertools.takewhile(lambda line: not _is_rule(line), under_title))
    if "Required options" in title:
        return f"{name} needs {joined([*filter(None, map(_required, message))])}"
    words = " ".join(" ".join(message).split()).rstrip(".")
    for pattern, plain in _PLAIN_WORDS.items():
        words = re.sub(pattern, plain, words)
    if clock := _CLOCK.search(words):
        hour, minute, second = (int(part or 0) for part in clock.groups())
        words += f"; this time of day is {3600 * hour + 60 * minute + second} s"
    return words


def _is_rule(line: str) -> bool:
    return re.fullmatch(r"\s*[─-]{5,}\s*", line) is not None


def _required(line: str) -> str:
    """Return the argument that a line of tyro's "Required options" names; empty if it explains."""
    indent = len(line) - len(line.lstrip())
    return line.strip() if indent == _INDENT_OF_REQUIRED else ""


def _print_completion(line: CommandLine, words: list[str]) -> int:
    """Print the script that completes words in a shell."""
    from ugat_marl.cli.completion import SHELLS, completion_script

    if len(words) != 1 or words[0] in HELP:
        print(f"usage: {line.program} {COMPLETION} {{{','.join(SHELLS)}}}\n")
        for shell, load in SHELLS.items():
            print(f"  {shell:<5} {load.format(program=line.program)}")
        return 0 if words and words[0] in HELP else USAGE_ERROR
    print(completion_script(line.program, line.commands, words[0], line.short), end="")
    return 0


def _print_help(line: CommandLine, console: Console, prefix: str = "") -> None:
    console.print(f"{line.purpose}\n")
    console.print(f"usage: {line.program} {prefix}COMMAND [options]\n")
    listed: dict[str, str] = {}
    for name, (_, text) in line.commands.items():
        if name.startswith(prefix):
            first, _, second = name.removeprefix(prefix).partition(" ")
            listed[first] = line.groups.get(first, text) if second else text
    if not prefix:
        listed[COMPLETION] = "print a script for tab completion in bash, zsh or fish"
    width = max(map(len, listed))
    for name, text in listed.items():
        begin, later = f"  {name:<{width}}  ", " " * (width + 4)
        entry = textwrap.fill(text, console.width, initial_indent=begin, subsequent_indent=later)
        console.print(entry)
    console.print(
        f"\n{line.program} {prefix}COMMAND --help shows options and examples of a command."
    )
    console.print("With every command: --quiet (results only), --verbose (all that is measured),")
    console.print(f"{DEADLINE} SECONDS (a simulation that does not answer is replaced; 900).")
    if not prefix and line.short:
        short = ", ".join(f"{name} = {' '.join(words)}" for name, words in line.short.items())
        console.print(f"Short: {short}.")
    if not prefix and line.examples:
        console.print("\nA first try:\n")
        for example in line.examples:
            console.print(f"  {example}")
    console.print(
        "\nExit codes: 0 done, 1 a check or target failed, 2 a wrong call or input, "
        "130 and 143 interrupted."
    )
