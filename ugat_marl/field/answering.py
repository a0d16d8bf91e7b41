"""Calls with a deadline: functions run in a thread of their own."""

from __future__ import annotations

import queue
import threading
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

Answer = TypeVar("Answer")
_Question = tuple[Callable[..., Any], tuple[Any, ...]]
_Questions = queue.SimpleQueue[_Question | None]
_Answers = queue.SimpleQueue[tuple[Any, BaseException | None]]


class NoAnswer(Exception):
    """The function raised an exception; the message names it."""


class Late(NoAnswer):
    """There was no answer in time."""


class Answering:
    """Caller of functions, one at a time, that waits for each until a deadline.

    A thread cannot be ended from outside. A late function therefore runs to its end, and its answer
    is thrown away. No other function is called before that end. The thread does not keep the
    program alive, and ends with this object.
    """

    def __init__(self) -> None:
        self._questions: _Questions = queue.SimpleQueue()
        self._answers: _Answers = queue.SimpleQueue()
        self._owed = 0
        arguments = (self._questions, self._answers)
        threading.Thread(target=_serve, args=arguments, daemon=True, name="policy").start()
        self._end = weakref.finalize(self, self._questions.put, None)

    def ask(self, function: Callable[..., Answer], *arguments: Any, within_s: float) -> Answer:
        """Call a function and return its answer.

        Raises:
            Late: No answer came within `within_s`, or an earlier function is still running.
            NoAnswer: The function raised an exception; `SystemExit` counts as one.
        """
        while self._owed:
            try:
                self._answers.get_nowait()
            except queue.Empty:
                raise Late("still busy with an earlier decision") from None
            self._owed -= 1
        self._owed += 1  # until it is here: a signal may end the wait too
        self._questions.put((function, arguments))
        try:
            answer, error = self._answers.get(timeout=max(within_s, 0.0))
            self._owed -= 1
        except queue.Empty:
            raise Late(f"no answer within {1e3 * within_s:.0f} ms") from None
        if error is not None:
            raise NoAnswer(f"{type(error).__name__}: {error}") from error
        return answer

    def close(self) -> None:
        """Let the thread end as soon as it is free."""
        self._end()


def _serve(questions: _Questions, answers: _Answers) -> None:
    while (question := questions.get()) is not None:
        function, arguments = question
        try:
            answers.put((function(*arguments), None))
        # Ctrl-C is for the main thread; an exception that ended this one would leave no answers.
        except BaseException as error:  # noqa: BLE001 - told where it was asked
            answers.put((None, error))
