"""Help of a command: the options of the first screen, or all of them.

A command with many options names those of the first screen in the class variable ``FIRST``, without
dashes. The others appear with ``--help-all``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import io
import re
import shutil
import sys
import types
from collections.abc import Collection, Sequence
from typing import Annotated, Any, TextIO, Union, get_args, get_origin, get_type_hints

HELP = ("-h", "--help")
COMPLETION = "completion"
"""Command that prints the script of a shell."""
DEADLINE = "--deadline-s"
"""Option of every command: seconds within which a simulation has to answer."""
HELP_ALL = "--help-all"
LEAST_WIDTH = 40
"""Width of lines in narrower terminals, in characters."""
_STYLE = re.compile(r"\x1b\[[\d;]*m")


def print_help(command: Any, program: str, words: Sequence[str]) -> None:
    """Print the help of a command and exit, as tyro does.

    Args:
        command: Dataclass of the command.
        program: Name of the program with that of the command.
        words: Words of the call; ``--help-all`` among them asks for all options.

    Raises:
        SystemExit: Always, with exit code 0.
    """
    import tyro

    first: Sequence[str] = getattr(command, "FIRST", ())
    everything = not first or HELP_ALL in words
    description = described(command)
    description += f"\n\nAlso, as with every command: --quiet, --verbose, {DEADLINE} SECONDS."
    if not everything:
        description += f"\nThe options used most. All of them: {program} {HELP_ALL}"
    text = _Text(sys.stdout)
    try:
        with contextlib.redirect_stdout(text):
            tyro.cli(
                _shown(command, None if everything else set(first)),
                args=["--help"],
                prog=program,
                description=description,
            )
    finally:
        width = shutil.get_terminal_size().columns
        for line in text.getvalue().splitlines():
            print(_wrapped(line, max(width, LEAST_WIDTH)))


def described(command: Any) -> str:
    """Return the docstring with its examples, one line each, without its list of attributes."""
    text = (inspect.getdoc(command) or "").partition("\nAttributes:")[0].strip()
    before, heading, examples = text.partition("Examples:\n")
    return before + heading + re.sub(r"\n +(?!ugat-marl|python -m)(?=\S)", " ", examples)


class _Text(io.StringIO):
    """Text that is kept; it takes the colours and lines that its goal takes."""

    def __init__(self, goal: TextIO) -> None:
        super().__init__()
        self._goal = goal

    @property
    def encoding(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Encoding of the goal."""
        return self._goal.encoding

    def isatty(self) -> bool:
        """Return True if the text goes to a terminal."""
        return self._goal.isatty()


def _wrapped(line: str, width: int) -> str:
    """Return a line of the help in lines that fit; a long command goes on behind a backslash.

    tyro breaks the texts of options, but neither its usage nor descriptions.
    """
    if len(_STYLE.sub("", line)) <= width:
        return line
    indent = line[: len(line) - len(line.lstrip())]
    command = line.lstrip().startswith(("ugat-marl ", "python -m "))
    later = indent + ("    " if command or line.startswith("usage:") else "")
    lines, room = [indent], width - (2 if command else 0)
    for word in re.findall(r"""(?:"[^"]*"|'[^']*'|\[[^]]*\]|\S)+""", line):
        longer = lines[-1] + ("" if lines[-1].isspace() or not lines[-1] else " ") + word
        if len(_STYLE.sub("", longer)) <= room or not lines[-1].strip():
            lines[-1] = longer
        else:
            lines.append(later + word)
    return (" \\\n" if command else "\n").join(lines)


def options_of(command: Any, prefix: str = "") -> dict[str, Any]:
    """Return the types of a command's long options by name, nested settings included."""
    options: dict[str, Any] = {}
    hints = get_type_hints(command, include_extras=True)
    for option in dataclasses.fields(command):
        hint = hints[option.name]
        inner = _settings_of(hint)
        if inner is not None:
            options |= options_of(inner, _inner_prefix(hint, option.name, prefix))
        else:
            options[f"--{prefix}{option.name}".replace("_", "-")] = hint
    return options


def _shown(kind: Any, first: Collection[str] | None, prefix: str = "") -> type[Any]:
    """Return a dataclass like `kind` for the help alone.

    It hides all options but those named, and says nothing of the value None, which stands for
    defaults that the texts explain.
    """
    import tyro

    hints = get_type_hints(kind, include_extras=True)
    entries: list[tuple[str, Any, Any]] = []
    for option in dataclasses.fields(kind):
        hint, name = hints[option.name], f"{prefix}{option.name}".replace("_", "-")
        default = _default_of(option)
        if (inner := _settings_of(hint)) is not None:
            within = _inner_prefix(hint, option.name, prefix)
            shown = _shown(inner, first, within)
            if option.default_factory is not dataclasses.MISSING:
                default = dataclasses.field(default_factory=shown)
            hidden = first is not None and not any(key.startswith(within) for key in first)
            hint = _like(hint, shown)
        else:
            hidden = first is not None and name not in first and not is_positional(hint)
            hint = _without_none(hint) if option.default in (None, (), "") else hint
        hint = Annotated[hint, tyro.conf.Suppress] if hidden else hint
        entries.append((option.name, hint, default))
    documented = (base for base in kind.__mro__ if "Attributes:" in (base.__doc__ or ""))
    names = {"__doc__": next(documented, kind).__doc__, "__module__": kind.__module__}
    return dataclasses.make_dataclass(kind.__name__, entries, namespace=names, kw_only=True)


def _default_of(option: Any) -> Any:
    """Return a fresh field with the default of another one."""
    if option.default is not dataclasses.MISSING:
        return dataclasses.field(default=option.default)
    if option.default_factory is not dataclasses.MISSING:
        return dataclasses.field(default_factory=option.default_factory)
    return dataclasses.field()


def _like(hint: Any, kind: Any) -> Any:
    """Return another type with the annotations of a hint."""
    extras = getattr(hint, "__metadata__", ())
    return Annotated[(kind, *extras)] if extras else kind


def _settings_of(hint: Any) -> Any:
    """Return the dataclass of nested settings, or None for a plain option."""
    inner = getattr(hint, "__origin__", hint)
    return inner if isinstance(inner, type) and dataclasses.is_dataclass(inner) else None


def _inner_prefix(hint: Any, name: str, prefix: str) -> str:
    """Return the prefix of nested options; settings with an empty name add none."""
    extras = getattr(hint, "__metadata__", ())
    flat = any(getattr(extra, "name", None) == "" for extra in extras)
    return prefix if flat else f"{prefix}{name}.".replace("_", "-")


def is_positional(hint: Any) -> bool:
    """Return True if an argument is given without the name of an option."""
    from tyro.conf import Positional

    marker = get_args(Positional[Any])[1]
    return marker in getattr(hint, "__metadata__", ())


def _without_none(hint: Any) -> Any:
    """Return the type of an option whose default needs no mention."""
    import tyro

    extras = getattr(hint, "__metadata__", ())
    if any(getattr(extra, "help_behavior_hint", None) for extra in extras):
        return hint
    inner = get_args(hint)[0] if extras else hint
    if get_origin(inner) in (Union, types.UnionType):
        kinds = [kind for kind in get_args(inner) if kind is not type(None)]
        metavar = "|".join(_metavar(kind) for kind in kinds)
        return Annotated[inner, tyro.conf.arg(metavar=metavar, help_behavior_hint=" ")]
    return Annotated[hint, tyro.conf.arg(help_behavior_hint=" ")]


def _metavar(kind: Any) -> str:
    """Return the name of a type in a help text."""
    choices = get_args(kind)
    if choices:
        return "{" + ",".join(map(str, choices)) + "}"
    return str(getattr(kind, "__name__", kind)).upper()
