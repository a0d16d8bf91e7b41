"""Objects of users by their names, and what tells two objects of one name apart.

A name is ``module:name``, as in an entry point of Python, and the module is looked for in the
working folder, too. An object that was given in Python has a name of the same form.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.util
import inspect
import re
import sys
import traceback
from collections import deque
from collections.abc import Mapping, Sequence
from enum import Enum
from operator import itemgetter
from pathlib import Path, PurePath
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from ugat_marl.errors import OptionError, UgatMarlError, UnknownNameError, first_line
from ugat_marl.files import file_hash, with_home

_NAME = re.compile(r"([\w./\\-]+|.+\.py):[A-Za-z_<][\w.<>]*")

_given: dict[str, Any] = {}
"""Objects that were given in Python, by the name under which settings hold them."""

_loaded: dict[tuple[str, Path], tuple[Any, str]] = {}
"""Module and file to the specification of the module, which is another one after a reload, and the
hash of the file as it was loaded."""


def is_own(name: str) -> bool:
    """Return True if a name has the form ``module:name`` or ``FILE.py:name``."""
    return _NAME.fullmatch(name) is not None


def own_name(given: Any) -> str:
    """Return the name ``module:name`` of an object, under which `load_own` finds it here."""
    kind = _named(given)
    name = f"{kind.__module__}:{kind.__qualname__}"
    if not _is_found(kind, given):
        name += ".<given>"  # no other process may take what it finds by the name for it
    _given[name] = given
    _file_hash(kind)  # keeps it
    return name


def _is_found(kind: Any, given: Any) -> bool:
    """Return False if the name of `kind` leads to another object than was given.

    It does so for an object of a class, a `functools.partial`, a bound method, and a function or
    class in a decorator that copied its name.
    """
    found: Any = sys.modules.get(kind.__module__)
    for part in kind.__qualname__.split("."):
        found = getattr(found, part, None)
    return found == given or "<" in kind.__qualname__


def load_own(name: str, what: str) -> Any:
    """Return the object that a user names.

    Args:
        name: ``module:name``; the module may also be a path that ends in .py.
        what: Kind of thing for messages, such as "learner".

    Raises:
        OptionError: The module is missing, needs what is missing, or raised an exception.
        UnknownNameError: The object is missing in it.
    """
    if name in _given:
        return _given[name]
    place, _, path = name.rpartition(":")  # a path of Windows has a colon, too
    file = with_home(place).resolve() if place.endswith(".py") else None
    folder = str(Path.cwd() if file is None else file.parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    module_name = place if file is None else file.stem
    try:
        if file is None and not re.fullmatch(r"\w+(\.\w+)*", place):
            raise ModuleNotFoundError(name=place)  # such as ./my_algo
        if file is None:
            found: Any = importlib.import_module(place)
        else:  # files of two folders may share their names
            found = module_of_file(file, f"{file.stem} in {file.parent}")
    except ModuleNotFoundError as error:
        if not f"{module_name}.".startswith(f"{error.name}."):
            raise OptionError(
                f"{what} {name!r}: the module needs {error.name}, which is not installed"
            ) from None
        if file is not None:
            missing = f"there is no file {place}"
        elif (there := Path(f"{place}.py")).is_file():
            missing = f"there is no module {place!r}; give the file as {there}:{path or 'NAME'}"
        else:
            missing = (
                f"there is no module {module_name!r} in {folder} or among the installed packages; "
                "write FILE.py:NAME, or the name of a module, a colon, and the name in it"
            )
        raise OptionError(f"{what} {name!r}: {missing}") from None
    except SyntaxError as error:
        where = f"{error.filename}, line {error.lineno}"
        raise OptionError(f"{what} {name!r}: {where} is no Python ({error.msg})") from None
    except (UgatMarlError, MemoryError):
        raise
    except Exception as error:
        where = (file and line_in(str(file), error)) or last_line(error)
        said = f"{type(error).__name__}: {first_line(error)}"
        raise OptionError(f"{what} {name!r}: {where}: {said}") from error
    found = _member(found, path, f"{what} in {module_name}", of_learners=what == "learner")
    _file_hash(_named(found))  # keeps it
    return found


def line_in(file: str | None, error: BaseException) -> str:
    """Return the last line of a file that an error came through, as "FILE, line 7"; "" if none."""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == file]
    return f"{file}, line {lines[-1]}" if lines else ""


def last_line(error: BaseException) -> str:
    """Return where an error was raised, as "FILE, line 7"."""
    *_, last = traceback.extract_tb(error.__traceback__)
    return f"{last.filename}, line {last.lineno}"


def _member(found: Any, path: str, what: str, *, of_learners: bool) -> Any:
    """Return what stands in a module under a dotted name; `what` is for the error."""
    for part in path.split("."):
        if not hasattr(found, part):
            own = getattr(found, "__module__", getattr(found, "__name__", None))
            names = [
                key
                for key, value in getattr(found, "__dict__", {}).items()
                if callable(value) and getattr(value, "__module__", own) == own
            ]
            if of_learners:
                names = [key for key in names if hasattr(getattr(found, key), "learn")] or names
            raise UnknownNameError(what, part, names)
        found = getattr(found, part)
    return found


def _named(given: Any) -> Any:
    """Return the class or function by whose name an object is known."""
    if isinstance(given, functools.partial):
        return _named(given.func)
    return given if hasattr(given, "__qualname__") else type(given)


def own_values(name: str) -> list[str]:
    """Return what an object that was given in Python holds beside its source, as text.

    These are arguments of a `functools.partial`, values captured by an inner function or by the
    methods of an inner class, its defaults, and attributes of such a class or of an instance, those
    in slots included. A function or class without a file counts as an inner one. Two objects of one
    name and source differ in nothing else.
    """
    return _values(_given[name]) if name in _given else []


def _values(given: Any, inside: tuple[int, ...] = ()) -> list[str]:
    text = functools.partial(_stable, inside=inside)
    if isinstance(given, functools.partial):
        keywords = [f"{key}={text(value)}" for key, value in sorted(given.keywords.items())]
        return [*_values(given.func, inside), *map(text, given.args), *keywords]
    if isinstance(given, FunctionType):
        if _is_of_file(given):
            return []
        defaults = (given.__kwdefaults__ or {}).items()
        return [
            *(f"{key}={text(value)}" for key, value in sorted(_captured(given).items())),
            *map(text, given.__defaults__ or ()),
            *(f"{key}={text(value)}" for key, value in sorted(defaults)),
        ]
    if inspect.isclass(given):
        return [] if _is_of_file(given) else _values_of_class(given, inside)
    if isinstance(given, MethodType):
        return [text(given.__self__)]
    held = {} if hasattr(given, "__qualname__") else _attributes(given)
    return [text(held)] if held else []


def _is_of_file(kind: Any) -> bool:
    """Return True if the source of a function or class says all: no other function made it."""
    return "<" not in kind.__qualname__ and _file_of(kind) is not None


def _captured(function: FunctionType) -> dict[str, Any]:
    """Return the values of a closure; a variable that has none yet is left out."""
    captured: dict[str, Any] = {}
    cells = function.__closure__ or ()
    for name, cell in zip(function.__code__.co_freevars, cells, strict=True):
        with contextlib.suppress(ValueError):
            captured[name] = cell.cell_contents
    return captured


def _attributes(value: Any) -> dict[str, Any]:
    """Return the attributes of an object, those in slots included."""
    state: Any = object.__getstate__(value)
    held, slots = state if isinstance(state, tuple) else (state, None)
    return {**(held or {}), **(slots or {})}


def _values_of_class(given: type, inside: tuple[int, ...]) -> list[str]:
    """Return what a class holds that no file tells: attributes, and values in its methods."""
    held: list[str] = []
    for name, member in sorted(_members(given), key=itemgetter(0)):
        function = getattr(member, "__func__", member)  # of a static method or a class method
        if isinstance(function, FunctionType):
            held += [f"{name}: {value}" for value in _values(function, inside)]
        elif not name.startswith("__") and not hasattr(member, "__get__"):
            held.append(f"{name}={_stable(member, inside)}")
    return held


def _members(kind: type) -> list[tuple[str, Any]]:
    """Return the members of a class, and of its bases that were typed at the same place."""
    kinds = [
        one
        for one in kind.__mro__
        if one is kind or (one.__module__ == kind.__module__ and _is_typed(one))
    ]
    return [member for one in kinds for member in vars(one).items()]


def _stable(value: Any, inside: tuple[int, ...] = ()) -> str:
    """Return a value as text that is the same in another process.

    `repr` is not where an object has none of its own (its address), for sets (their order), and for
    long arrays (their middle is left out).

    Args:
        value: The value.
        inside: Identities of the objects that hold it, against endless descents.
    """
    if id(value) in inside:
        return "..."
    inside = (*inside, id(value))
    deeper = functools.partial(_stable, inside=inside)
    if type(value) is dict:
        return f"{{{', '.join(f'{deeper(key)}: {deeper(held)}' for key, held in value.items())}}}"
    if type(value) in (list, tuple):
        return f"{type(value).__name__}({', '.join(map(deeper, value))})"
    if type(value) in (set, frozenset):
        return f"{type(value).__name__}({', '.join(sorted(map(deeper, value)))})"
    if isinstance(value, np.ndarray) and value.dtype != object:
        digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return f"array({value.shape}, {value.dtype}, {digest})"
    if isinstance(value, FunctionType | MethodType | functools.partial | type):
        kind = _named(value)
        return (
            f"{kind.__module__}.{kind.__qualname__}({_file_hash(kind)}, {_values(value, inside)})"
        )
    return repr(value) if isinstance(value, _PLAIN) else _stable_object(value, inside)


_PLAIN = (type(None), bool, int, float, complex, str, bytes, range, slice, PurePath, Enum)
"""Types whose `repr` says all."""


def _stable_object(value: Any, inside: tuple[int, ...]) -> str:
    """Return any other object as text: its class, and what it holds.

    The `repr` of a data class, a tensor or a table may leave out the middle of long arrays.
    """
    kind, deeper = type(value), functools.partial(_stable, inside=inside)
    named = f"{kind.__module__}.{kind.__qualname__}"
    if named == "torch.Tensor" or named.startswith("torch.nn.parameter."):
        array = value.detach().cpu()
        whole = array.double() if array.is_floating_point() else array  # numpy lacks some types
        return f"{named}({array.dtype}, {deeper(whole.numpy())})"
    if isinstance(value, Mapping):
        return f"{named}({deeper(dict(value.items()))})"
    if isinstance(value, Sequence | deque):
        return f"{named}({deeper(list(value))})"
    if all(hasattr(value, name) for name in ("reset", "step", "unwrapped")):
        return f"{named}({_file_hash(kind)}, {deeper(_made_of(value.unwrapped))})"
    held = _attributes(value)
    if dataclasses.is_dataclass(kind):
        held = {field.name: getattr(value, field.name) for field in dataclasses.fields(kind)}
    says_what = kind.__getstate__ is not object.__getstate__  # as a table of polars does
    if not says_what and (held or kind.__repr__ is object.__repr__):
        of_class = [] if _file_of(kind) else _values(kind, inside)
        return f"{named}({', '.join([str(_file_hash(kind)), deeper(held), *of_class])})"
    try:  # what a copy is made of
        _, *made_of = value.__reduce_ex__(4)
    except TypeError:
        return repr(value)
    return f"{named}({deeper([one for one in made_of[:2] if one is not None])})"


def _made_of(env: Any) -> dict[str, Any]:
    """Return what an environment was made of; where it is in an episode is no setting."""
    scenario = getattr(env, "scenario", None)
    return {
        "environment": type(env),
        "scenario": getattr(scenario, "hash", None),
        "domain": getattr(env, "domain", None),
        "options": dict(getattr(env, "env_options", {})),
    }


def own_source(name: str) -> str | None:
    """Return the hash of the file that defines a user's learner; None if it has no code.

    An edit after the file was loaded changes neither the learner nor the hash.

    Args:
        name: Name as for `load_own`.

    Raises:
        OptionError: The module is missing.
        UnknownNameError: The object is missing in it.
    """
    return _file_hash(_named(load_own(name, "learner")))


def require_unchanged(name: str) -> None:
    """Refuse a user's learner whose file is no longer the one that was loaded.

    Args:
        name: Name as for `load_own`.

    Raises:
        OptionError: The file was changed, or the module is missing.
        UnknownNameError: The object is missing in it.
    """
    kind = _named(load_own(name, "learner"))
    file = _file_of(kind)
    if file is not None and file_hash(file) != _file_hash(kind):
        raise OptionError(f"{file} was changed after it was imported; restart Python")


def _file_of(kind: Any) -> Path | None:
    """Return the file that defines a class or function; None for what is typed at a prompt."""
    try:
        file = inspect.getsourcefile(kind)
    except (TypeError, OSError):
        return None
    return Path(file) if file is not None and Path(file).is_file() else None


def _is_typed(kind: Any) -> bool:
    """Return True for a class or function of no file, neither a source nor a compiled module."""
    module = sys.modules.get(kind.__module__)
    return _file_of(kind) is None and getattr(module, "__file__", None) is None


def _file_hash(kind: Any) -> str | None:
    """Return the hash of the file that defines a class or function, or else of its code.

    The hash is that of the file when it was first asked for. None if there is no code either.
    """
    if (file := _file_of(kind)) is not None:
        place = kind.__module__, file
        # A script that is run again in the same Python makes another object, and has no spec.
        loaded = getattr(sys.modules.get(kind.__module__), "__spec__", None) or kind
        if place not in _loaded or _loaded[place][0] is not loaded:
            _loaded[place] = loaded, file_hash(file)
        return _loaded[place][1]
    members = [one for _, one in _members(kind)] if inspect.isclass(kind) else [kind]
    holding = _HOLDING if _is_typed(kind) else ()
    functions = [
        one for each in members for one in (each, *(getattr(each, key, None) for key in holding))
    ]
    codes = [getattr(one, "__code__", None) for one in functions]
    texts = [_code_text(code) for code in codes if code is not None]
    return hashlib.sha256("".join(texts).encode()).hexdigest() if texts else None


_HOLDING = ("__wrapped__", "fget", "fset", "fdel", "func")
"""Attributes in which static methods, properties and decorators hold functions."""


def _code_text(code: CodeType) -> str:
    """Return all that a function does as text, without the place where it was written."""
    constants = (
        _code_text(one) if isinstance(one, CodeType) else _stable(one) for one in code.co_consts
    )
    return f"{code.co_code.hex()} {code.co_names} {code.co_varnames} {list(constants)}"


def module_of_file(path: Path, name: str) -> ModuleType:
    """Return the module of a file; all calls with one name return the same object.

    Args:
        path: A Python file.
        name: Name of the module in `sys.modules`.

    Raises:
        ModuleNotFoundError: There is no such file, or the module needs another one.
    """
    if name in sys.modules:
        return sys.modules[name]
    specification = importlib.util.spec_from_file_location(name, path)
    if specification is None or specification.loader is None or not path.is_file():
        raise ModuleNotFoundError(name=path.stem)
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # dataclasses look their module up here
    try:
        specification.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
