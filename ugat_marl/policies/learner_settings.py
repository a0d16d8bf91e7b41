"""Settings of learners, given as ``NAME=VALUE``."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import TypeAdapter, ValidationError

from ugat_marl.errors import OptionError, UnknownNameError


def parsed_settings(
    settings: Sequence[str], names: Sequence[str], hints: Mapping[str, Any], learner: str
) -> dict[str, Any]:
    """Return settings of a learner, given as ``NAME=VALUE``, in their types.

    Args:
        settings: The settings; a name may have ``-`` for ``_``.
        names: Known names.
        hints: Name to type. A value without a type becomes a literal of Python, or text.
        learner: Name of the learner for messages.

    Raises:
        OptionError: A setting has another form, or a value another type.
        UnknownNameError: A name is unknown.
    """
    values: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        name = name.replace("-", "_")
        if not equals or not text:
            raise OptionError(f"learner setting {setting!r}: must be NAME=VALUE")
        if name not in names:
            raise UnknownNameError(f"setting of {learner}", name, names)
        if hints.get(name, Any) is Any:
            values[name] = _plain_value(text)
            continue
        whole = text.split(",") if "tuple" in str(hints[name]) else text
        value = None if text.lower() == "none" else whole
        try:
            values[name] = TypeAdapter(hints[name]).validate_python(value)
        except ValidationError as error:
            reason = error.errors()[0]["msg"]
            raise OptionError(f"learner setting {setting!r}: {reason}") from None
    return values


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
