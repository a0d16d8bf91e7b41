"""Settings of learners, given as ``NAME=VALUE``."""

from __future__ import annotations

import ast
import contextlib
from collections.abc import Mapping, Sequence
from types import UnionType
from typing import Any, Union, get_args, get_origin

import numpy as np
from pydantic import PydanticUserError, TypeAdapter, ValidationError

from ugat_marl.errors import OptionError, UnknownNameError


def parsed_settings(
    settings: Sequence[str], names: Sequence[str], hints: Mapping[str, Any], learner: str
) -> dict[str, Any]:
    """Return settings of a learner, given as ``NAME=VALUE``, in their types.

    Args:
        settings: The settings; a name may have ``-`` for ``_``.
        names: Known names.
        hints: Name to type. A value without a type that pydantic knows becomes a literal of Python,
            or text.
        learner: Name of the learner for messages.

    Raises:
        OptionError: A setting has another form or is given twice, or a value has another type.
        UnknownNameError: A name is unknown.
    """
    values: dict[str, Any] = {}
    for setting in settings:
        name, (_, equals, text) = setting_name(setting), setting.partition("=")
        if not equals or not text:
            raise OptionError(f"learner setting {setting!r}: must be NAME=VALUE")
        if name not in names:
            raise UnknownNameError(f"setting of {learner}", name, names)
        if name in values:
            raise OptionError(f"learner setting {setting!r}: {name} is given twice; give it once")
        try:
            values[name] = _converted(text, hints.get(name, Any))
        except ValidationError as error:
            reason = error.errors()[0]["msg"]
            raise OptionError(f"learner setting {setting!r}: {reason}") from None
    return values


def setting_name(setting: str) -> str:
    """Return the name in ``NAME=VALUE``, with ``_`` for ``-``."""
    return setting.partition("=")[0].replace("-", "_")


def setting_text(name: str, value: Any, hint: Any) -> str:
    """Return a value of Python as ``NAME=VALUE``, from which `parsed_settings` reads it.

    Args:
        name: Name of the setting.
        value: A value for the type; if it is none, the text is for the message of
            `parsed_settings`.
        hint: Type of the setting; `Any` without one.

    Raises:
        OptionError: No text is read as the value.
    """
    plain = _without_numpy(value)
    usual = ",".join(map(str, plain)) if isinstance(plain, list | tuple) else str(plain)
    try:
        wanted = TypeAdapter(hint).validate_python(plain)
    except PydanticUserError:
        wanted = plain
    except ValidationError:
        return f"{name}={usual}"
    for text in filter(None, (usual, repr(plain))):
        with contextlib.suppress(ValidationError):
            if _is_same(_converted(text, hint), wanted):
                return f"{name}={text}"
    raise OptionError(
        f"learner setting {name} = {value!r}: a run keeps settings as text, and none is read as "
        "this value; give other plain data, or functools.partial(CLASS, ...) as the learner"
    )


def _without_numpy(value: Any) -> Any:
    """Return a value with numbers and lists of Python in place of NumPy's."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if type(value) in (list, tuple):
        return type(value)(map(_without_numpy, value))
    if type(value) is dict:
        return {key: _without_numpy(item) for key, item in value.items()}
    return value


def _is_same(one: Any, other: Any) -> bool:
    """Return True for equal values of one type, nan among them."""
    return type(one) is type(other) and (one == other or repr(one) == repr(other))


def _converted(text: str, hint: Any) -> Any:
    """Return a text in a type: as none, as a list, as parts between commas, or as it is.

    Raises:
        ValidationError: It has none of these forms in this type; the error is that of the parts, or
            else of the first form.
    """
    plain = _plain_value(text)
    if hint is Any:
        return plain
    try:
        adapter = TypeAdapter(hint)
    except PydanticUserError:  # such as types of NumPy
        return plain
    forms: list[Any] = [None] if text.lower() == "none" else []
    parts: list[str] | None = None
    if not isinstance(plain, (str, bytes)):  # a number for `float | str` is no text
        forms.append(plain)
    several = any(kind in str(hint) for kind in ("tuple", "list", "Sequence"))
    alone = get_origin(hint) in (Union, UnionType) and str in get_args(hint)
    if several and ("," in text or not alone):  # or text may stand for itself
        forms.append(parts := text.split(","))
    told: ValidationError | None = None
    for form in (*forms, text, plain):
        try:
            value = adapter.validate_python(form)
        except ValidationError as error:
            if told is None or form is parts:
                told = error
        else:
            # pydantic takes true for the number 1
            if not (isinstance(form, bool) and type(value) in (int, float)):
                return value
    assert told is not None  # text is no number where true became one
    raise told


def _plain_value(text: str) -> Any:
    """Return a number, a tuple or another literal of Python; other words stay text.

    Truth values and none may have any case, as in other settings.
    """
    word = text.capitalize()
    if word in ("True", "False", "None"):
        return ast.literal_eval(word)
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return text
