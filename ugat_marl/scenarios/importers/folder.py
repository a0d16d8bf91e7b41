"""A scenario directory that is written whole or not at all, and replaces nothing by accident."""

from __future__ import annotations

import contextlib
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from ugat_marl.errors import OutputError, ScenarioError
from ugat_marl.scenarios.scenario import shipped_scenarios


@contextlib.contextmanager
def new_folder(target: Path, *, force: bool) -> Iterator[Path]:
    """Yields an empty folder beside `target`, which becomes `target` if the block ends normally.

    Args:
        target: The directory to be.
        force: Whether a scenario that is there already may be replaced. Anything else never is.

    Raises:
        OutputError: `target` exists, cannot be written, or has the name of a shipped scenario.
    """
    require_free(target, force=force)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=target.parent, prefix=".new-scenario-"))
    except OSError as error:
        raise OutputError(
            f"{target}: cannot be written ({error.strerror}); give another place"
        ) from None
    made = folder / target.name
    try:
        with _stopped_in_order():
            made.mkdir()
            yield made
            require_free(target, force=force)  # it may have appeared meanwhile
            _put(made, target, folder / "before")
    except ScenarioError as error:
        # Files are checked where they are made; what is said of them is about where they belong.
        if str(made) not in str(error):
            raise
        raise ScenarioError(str(error).replace(str(made), str(target))) from None
    except OSError as error:
        where = str(error.filename2 or error.filename or made).replace(str(made), str(target))
        raise OutputError(
            f"{where}: cannot be written ({error.strerror}); make room, or give another place"
        ) from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def _stopped_in_order() -> Iterator[None]:
    """Whoever ends the program (``kill``, a system that shuts down) finds nothing left behind."""

    def stop(number: int, _: object) -> None:
        raise SystemExit(128 + number)

    main_thread = threading.current_thread() is threading.main_thread()
    if not main_thread or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _put(made: Path, target: Path, before: Path) -> None:
    if target.exists():
        target.rename(before)
    try:
        made.rename(target)
    except BaseException:
        if before.exists():
            before.rename(target)
        raise


def require_free(target: Path, *, force: bool) -> None:
    """Refuses a place that holds something.

    Raises:
        OutputError: As for `new_folder`.
    """
    if not target.name or target.name in (".", ".."):
        raise OutputError(f"{str(target)!r} is no name for a scenario; give one, as in my-city")
    if str(target) in dict(shipped_scenarios()):
        raise OutputError(
            f"{str(target)!r} is the name of a scenario of the suite; choose another one"
        )
    try:
        occupied = target.is_symlink() or (target.exists() and not target.is_dir())
    except OSError as error:  # a name that is too long, say
        raise OutputError(
            f"{target!s:.80}: cannot be written ({error.strerror}); give another place"
        ) from None
    if occupied:
        raise OutputError(f"{target} exists and is not a folder; choose another name")
    if not target.is_dir() or not any(target.iterdir()):
        return
    if not (target / "scenario.toml").is_file():
        raise OutputError(f"{target} exists and is not a scenario; choose another name")
    if not force:
        raise OutputError(f"scenario {str(target)!r} exists; --force replaces it")
