"""Results of checks: running a list of checks, and showing their results."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol, TypeVar

from rich.text import Text

from ugat_marl.errors import UgatMarlError


class ConformanceError(UgatMarlError, AssertionError):
    """A subject breaks a rule; the message names the rule and the repair."""


class NotChecked(ConformanceError):
    """A check could not be made because another one failed."""


@dataclass(frozen=True)
class CheckResult:
    """Outcome of one check.

    Attributes:
        name: Name of the check's function.
        passed: Whether the subject passed; None if the check could not be made.
        message: Fault and its repair; "" if the subject passed.
    """

    name: str
    passed: bool | None
    message: str = ""


class Closing(Protocol):
    """A case that cleans up after each check."""

    def tidy(self) -> None:
        """Close all that the last check has opened."""
        ...


AnyCase = TypeVar("AnyCase", bound=Closing)


class Listening:
    """Context that catches and keeps the exceptions of a subject; Ctrl-C still passes.

    Attributes:
        error: The exception; None if there was none.
    """

    error: BaseException | None = None

    def __enter__(self) -> Listening:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        self.error = error
        return isinstance(error, Exception)


def run_checks(checks: Sequence[Callable[[AnyCase], None]], case: AnyCase) -> list[CheckResult]:
    """Run every check on one case, even if earlier ones failed, and return their results."""
    results: list[CheckResult] = []
    for check in checks:
        with Listening() as heard:
            check(case)
        case.tidy()
        if heard.error is None:
            results.append(CheckResult(check.__name__, True))
        elif isinstance(heard.error, NotChecked):
            results.append(CheckResult(check.__name__, None, str(heard.error)))
        else:
            results.append(CheckResult(check.__name__, False, said(heard.error)))
    return results


def said(error: BaseException) -> str:
    """Return an exception in one line: the suite's own as message, others with type and place."""
    if isinstance(error, UgatMarlError):
        return str(error)
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {error}{where}"


def require(condition: object, message: str) -> None:
    """Raise a `ConformanceError` unless `condition` holds."""
    if not condition:
        raise ConformanceError(message)


def failed_checks(results: Sequence[CheckResult]) -> list[CheckResult]:
    """Return the checks that did not pass, including those that could not be made."""
    return [result for result in results if not result.passed]


def check_report(results: Sequence[CheckResult]) -> Text:
    """Return one line per check and a count, for `rich` to print (`.plain` is the text)."""
    words = {
        True: ("ok     ", "green"),
        False: ("FAILED ", "bold red"),
        None: ("skipped", "yellow"),
    }
    text = Text()
    for result in results:
        word, style = words[result.passed]
        text.append(word, style)
        text.append(f" {result.name.replace('_', ' ')}\n")
        if result.message:
            text.append(f"          {result.message}\n", "default" if result.passed else style)
    good = sum(result.passed is True for result in results)
    text.append(f"{good} of {len(results)} checks passed")
    return text
