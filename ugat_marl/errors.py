"""Exceptions of the suite.

A message names the thing, its value, the allowed values and the way out. The command line prints it
as one line and ends with exit code 2.
"""

from __future__ import annotations

import contextlib
import difflib
import math
import operator
import re
import signal
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from functools import partial
from numbers import Integral, Real
from types import UnionType
from typing import Literal, TypeGuard, Union, get_args, get_origin, get_type_hints

LISTED = 32
"""Most names in one error message. If there are more, the message lists the nearest ones."""


_CLOSE = 0.62
"""Likeness from which a name is close to a known one. At 0.5 words that share a few letters are
taken for each other, such as "learning" and "flag"; at 0.7 slips in short words are lost."""


_CLOSE_IF_SHORT = 0.5
"""The same for names of one or two letters: one of two letters is right, as in V5 for V4."""


def first_line(error: BaseException) -> str:
    """Return the first line of an error's text, or its type; libraries add stacks and hints."""
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


class UgatMarlError(Exception):
    """Base of all errors a user of `ugat_marl` can provoke."""


class ScenarioError(UgatMarlError):
    """A scenario directory, or one of its files, is missing, unreadable or contradicts itself."""


class UnknownNameError(UgatMarlError, ValueError):
    """A name (scenario, domain, observation, option ...) that does not exist.

    Args:
        kind: Kind of thing that was requested, such as ``"domain"``.
        name: The requested name.
        allowed: All names that exist.
        hint: Sentence with a way out, added to the message.
    """

    def __init__(self, kind: str, name: str, allowed: Iterable[str], hint: str = "") -> None:
        self.kind = kind
        self.name = name
        self.hint = hint
        self.allowed = sorted(set(allowed))
        near = nearest(str(name), self.allowed)
        guess = f" Did you mean {near!r}?" if near else ""
        shown = self.allowed
        if len(shown) > LISTED:
            close = difflib.get_close_matches(str(name), shown, n=LISTED, cutoff=0.0)
            shown = [*sorted(close), f"and {len(self.allowed) - LISTED} more"]
        listed = ", ".join(repr(item) if "," in item else item for item in shown)
        known = f" Known: {listed}." if listed else ""
        super().__init__(f"unknown {kind} {name!r}.{guess}{known}{' ' + hint if hint else ''}")

    def __reduce__(self) -> tuple[type[UnknownNameError], tuple[str, str, list[str], str]]:
        return (type(self), (self.kind, self.name, self.allowed, self.hint))


class OptionError(UgatMarlError, ValueError):
    """An option has an impossible value."""


class ActionError(UgatMarlError, ValueError):
    """An action is missing, of the wrong type, or outside the action space of its agent."""


class SimulatorError(UgatMarlError, RuntimeError):
    """SUMO refused to start or failed while it ran. The message quotes SUMO."""


class SimulatorBusy(SimulatorError):
    """A second simulation was requested in a process that already runs one."""


class SimulatorCrashed(SimulatorError):
    """The process that ran the simulation died; other simulations are not affected."""


class WorkerError(UgatMarlError, RuntimeError):
    """A reward or wrapper of the user raised an exception in the process of a simulation."""


class EpisodeError(UgatMarlError, RuntimeError):
    """A call does not fit the state of the episode, such as `step` before `reset`."""


class OutputError(UgatMarlError, OSError):
    """A file or folder cannot be written."""


class LogError(UgatMarlError):
    """A transition log cannot be read or does not fit the scenario."""


class MeasuredDataError(UgatMarlError):
    """Measured data of the street are missing, damaged, or contradict themselves or the network."""


class JobError(UgatMarlError):
    """A training or an evaluation of a table failed in its own process."""


class CheckpointError(UgatMarlError):
    """A checkpoint cannot be read, holds impossible numbers, or belongs to something else."""


@contextlib.contextmanager
def terminated_as(end: BaseException) -> Iterator[None]:
    """Raise an exception at the first SIGTERM, so that files and folders are left in order.

    Nothing changes outside of the main thread, or where SIGTERM has a handler already.

    Args:
        end: The exception.
    """

    def terminate(number: int, frame: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the end must not be interrupted in turn
        raise end

    main_thread = threading.current_thread() is threading.main_thread()
    if not main_thread or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def install_command(extra: str) -> str:
    """Return the command that installs what an extra of the package brings.

    It names the libraries themselves, because the package may have been installed from a file that
    no index knows.
    """
    from importlib import metadata

    needed: list[str] = []
    with contextlib.suppress(metadata.PackageNotFoundError):
        for requirement in metadata.requires("ugat-marl") or ():
            library, _, condition = requirement.partition(";")
            if re.search(rf"extra == ['\"]{re.escape(extra)}['\"]", condition):
                needed.append(f"'{library.strip()}'")
    libraries = " ".join(needed) or f"'.[{extra}]'"
    return f"pip install {libraries}"


def require_least(least: int, **values: int | None) -> None:
    """Refuse numbers below a least one; None, for a default, is allowed.

    Raises:
        OptionError: A number is below `least`.
    """
    for name, value in values.items():
        if value is not None and value < least:
            raise OptionError(f"{name} = {value}: must be at least {least}")


def _dtype_kind(value: object) -> str:
    """Return NumPy's letter for the kind of a number of its own; "" for other values."""
    return getattr(getattr(value, "dtype", None), "kind", "")


_KINDS: dict[object, tuple[Callable[[object], bool], str]] = {
    bool: (lambda x: isinstance(x, bool) or _dtype_kind(x) == "b", "True or False"),
    int: (lambda x: not isinstance(x, bool) and isinstance(x, Integral), "a whole number"),
    float: (lambda x: not isinstance(x, bool) and isinstance(x, Real), "a number"),
    str: (lambda x: isinstance(x, str), "a text"),
    type(None): (lambda x: x is None, "None"),
}
"""What a value of a simple type is, and its name in messages."""


def require_kinds(settings: object, name: str) -> None:
    """Refuse a field of a data class whose value is not of the annotated kind.

    Numbers, texts, True and False, None, the names of a ``Literal``, tuples of such values, and
    data classes are checked; a list or a set counts as a tuple. Fields of other kinds are not
    checked.

    Args:
        settings: An object of the data class.
        name: Name of the settings for the message.

    Raises:
        OptionError: A field holds another value.
    """
    for field, hint in get_type_hints(type(settings)).items():
        value = getattr(settings, field)
        several = get_origin(hint) in (Union, UnionType)
        kinds = [_kind(kind) for kind in (get_args(hint) if several else (hint,))]
        if not any(kind is None or kind[0](value) for kind in kinds):
            allowed = " or ".join(kind[1] for kind in kinds if kind is not None)
            raise OptionError(f"{name} {field} is {value!r}; allowed: {allowed}")


def require_ranges(
    settings: object,
    name: str,
    *,
    at_least: Mapping[str, int] | None = None,
    positive: Iterable[str] = (),
    non_negative: Iterable[str] = (),
    shares: Iterable[str] = (),
    below_one: Iterable[str] = (),
) -> None:
    """Refuse a number of a data class that is out of its range; NaN is in none.

    Args:
        settings: An object of the data class.
        name: Name of the settings for the message.
        at_least: Field to its smallest number; None for no such field.
        positive: Fields with finite numbers above 0.
        non_negative: Fields with finite numbers of at least 0.
        shares: Fields with numbers from 0 to 1.
        below_one: Fields with numbers from 0 to below 1.

    Raises:
        OptionError: A number is out of its range.
    """
    ranges: list[tuple[Iterable[str], Callable[[float], bool], str]] = [
        *(
            ((field,), partial(operator.le, least), f">= {least}")
            for field, least in (at_least or {}).items()
        ),
        (positive, lambda x: 0 < x < math.inf, "> 0, finite"),
        (non_negative, lambda x: 0 <= x < math.inf, ">= 0, finite"),
        (shares, lambda x: 0 <= x <= 1, "0 to 1"),
        (below_one, lambda x: 0 <= x < 1, "from 0 to below 1"),
    ]
    for fields, holds, allowed in ranges:
        for field in fields:
            value = getattr(settings, field)
            if not holds(value):
                raise OptionError(f"{name} {field} is {value}; allowed: {allowed}")


def _is_list(value: object) -> TypeGuard[Collection[object]]:
    return isinstance(value, Collection) and not isinstance(value, str | bytes | Mapping)


def _kind(hint: object) -> tuple[Callable[[object], bool], str] | None:
    """Return what is a value of an annotated kind, and its name; None for kinds not known."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Literal:
        return lambda x: isinstance(x, str) and x in inner, ", ".join(inner)
    if origin is tuple and len(inner) == 2 and inner[0] in _KINDS and inner[1] is Ellipsis:
        of_kind, told = _KINDS[inner[0]]
        each = f"a list, of which each is {told}"
        return lambda x: _is_list(x) and all(map(of_kind, x)), each
    if isinstance(hint, type) and is_dataclass(hint):
        article = "an" if hint.__name__[0] in "AEIOU" else "a"
        return lambda x: isinstance(x, hint), f"{article} {hint.__name__}"
    return _KINDS.get(hint)


def require_distinct(**values: Sequence[object]) -> None:
    """Refuse lists that hold something twice.

    Raises:
        OptionError: A list does.
    """
    for name, given in values.items():
        if len(set(given)) < len(given):
            raise OptionError(f"{name} holds one twice: {' '.join(map(str, given))}")


def first_names(names: Sequence[str]) -> str:
    """Return the first four names, with dots for further ones."""
    return ", ".join([*names[:4], *["..."] * (len(names) > 4)])


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, such as "1 seed" or "2 seeds"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def joined(texts: Sequence[str]) -> str:
    """Join texts: ``a``, ``a and b``, ``a, b and c``."""
    return " and ".join(filter(None, (", ".join(texts[:-1]), *texts[-1:])))


def listed(names: Sequence[str], noun: str) -> str:
    """Return how many things there are with their first names, such as "2 lanes ('a', 'b')"."""
    return f"{counted(len(names), noun)} ({first_names([*map(repr, names)])})"


def unknown_key(key: str, name: str, known: Collection[str]) -> str:
    """Return that a file has an unknown key, and the key that was meant or those that there are.

    Args:
        key: The key with the tables that it is in.
        name: The key alone.
        known: Keys that its table has.
    """
    guess = nearest(name, known)
    hint = f"did you mean {guess!r}?" if guess else f"known: {', '.join(known)}"
    return f"unknown key {key!r}; {hint}"


def nearest(name: str, allowed: Iterable[str]) -> str | None:
    """Return the name in `allowed` closest to `name`, or None if none is close.

    The only name that begins with three letters or more of `name` is close. A name of several words
    is as close as the closest of them.
    """
    by_lower = {candidate.lower(): candidate for candidate in allowed}
    longer = [lower for lower in by_lower if lower.startswith(name.lower())]
    if len(longer) == 1 and len(name) > 2:
        return by_lower[longer[0]]
    matcher = difflib.SequenceMatcher(b=name.lower())

    def likeness(lower: str) -> float:
        matcher.set_seq1(lower)
        return matcher.ratio()

    def words(lower: str) -> list[str]:
        return [word for word in re.split(r"[\s,:/_-]+", lower) if len(word) > 2]

    close = {lower: max(map(likeness, (lower, *words(lower)))) for lower in by_lower}
    best = max(close, key=lambda lower: (close[lower], likeness(lower)), default="")
    least = _CLOSE if len(name) > 2 else _CLOSE_IF_SHORT
    return by_lower[best] if best and close[best] >= least else None
