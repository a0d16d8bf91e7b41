"""Diagnose the cases of a blind test without reading their labels."""

from __future__ import annotations

import concurrent.futures
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from studies.blind.cases import DIAGNOSIS, OPTIONS, RUN, Case, chosen, read_json
from studies.errors import BlindTestError
from studies.same_options import require_same
from ugat_marl.files import write_whole
from ugat_marl.parallel import import_path
from ugat_marl.progress import Reporter, Silent

_INTERRUPTED = (130, 143, -signal.SIGINT, -signal.SIGTERM)
"""Exit codes of a process that was interrupted or terminated."""

_SPENT = "spent.txt"
"""File of the seconds that interrupted diagnoses of a case took."""

Diagnose = Callable[[Case, Path, Path], None]
"""Diagnose a case: the case, its measured data, and the folder that gets ``diagnosis.json``."""


def run_cases(
    directory: Path,
    diagnose: Diagnose,
    *,
    only: Sequence[str] = (),
    jobs: int = 1,
    command: Sequence[str] = (),
    options: Mapping[str, Any] | None = None,
    reporter: Reporter | None = None,
) -> tuple[int, int]:
    """Diagnose the cases that have no diagnosis yet; one that fails does not stop the others.

    Args:
        directory: Directory of a blind test.
        diagnose: Function that makes one diagnosis.
        only: Ids of cases; empty for all.
        jobs: Cases at a time; several run in their own processes.
        command: Command line that runs one case; the id is appended.
        options: Options on which diagnoses depend; None to compare none.
        reporter: Reporter of the progress.

    Returns:
        Number of diagnosed cases, and number of failed ones. One that was interrupted is neither.

    Raises:
        BlindTestError: The directory holds no blind test, or a case has not been measured.
        OutputError: Diagnoses of other options are there.
        UnknownNameError: There is no such case.
    """
    left = [
        case for case in chosen(directory, only) if not (directory / case.case / DIAGNOSIS).exists()
    ]
    for case in left:
        if not (directory / case.case / "measured" / "periods.csv").exists():
            raise BlindTestError(
                f"{directory / case.case}: not measured yet; go on with "
                "python -m studies.blind generate"
            )
    if options is not None:
        begun = any(directory.glob(f"*/{DIAGNOSIS}"))
        require_same(directory / OPTIONS, options, begun=begun)
    failed = 0
    with (reporter or Silent()).task("diagnosing", len(left)) as advance:
        if jobs == 1:
            for case in left:
                failed += not _one(directory, case, diagnose)
                advance(note=case.case)
        else:
            with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
                runs = [pool.submit(_apart, directory, case, command) for case in left]
                try:
                    for run in concurrent.futures.as_completed(runs):
                        failed += not run.result()
                        advance()
                finally:
                    pool.shutdown(cancel_futures=True)
    return len(left) - failed, failed


def _one(directory: Path, case: Case, diagnose: Diagnose) -> bool:
    """Diagnose a case in this process; write the wall time, or the reason of a failure."""
    folder = directory / case.case
    spent = folder / _SPENT
    start = time.monotonic() - (float(spent.read_text()) if spent.exists() else 0.0)
    error = None
    try:
        diagnose(case, folder / "measured", folder)
        if not (folder / DIAGNOSIS).exists():
            error = f"no {DIAGNOSIS} was written"
    except KeyboardInterrupt:
        write_whole(spent, f"{time.monotonic() - start:.3f}\n")
        raise
    except Exception as found:  # noqa: BLE001 - a bug in one case is a result, not the end
        error = f"{type(found).__name__}: {found}"
    _note(folder, time.monotonic() - start, error)
    spent.unlink(missing_ok=True)
    return error is None


def _apart(directory: Path, case: Case, command: Sequence[str]) -> bool:
    """Diagnose a case in another process."""
    folder = directory / case.case
    start = time.monotonic()
    (folder / RUN).unlink(missing_ok=True)
    call = [sys.executable, "-m", "studies.blind", *command, "--only", case.case]
    # the module path of this process, by which the checkout is found
    variables = {**os.environ, "PYTHONPATH": import_path()}
    done = subprocess.run(call, capture_output=True, text=True, env=variables, check=False)
    if done.returncode in _INTERRUPTED:  # no result; the same command goes on with this case
        raise KeyboardInterrupt
    if not (folder / RUN).exists():  # the process ended before it could write why
        said = " ".join(done.stderr.split())[-500:]
        _note(folder, time.monotonic() - start, f"exit code {done.returncode}: {said}")
    return read_json(folder / RUN).get("error") is None


def _note(folder: Path, wall_s: float, error: str | None) -> None:
    content = {"wall_s": round(wall_s, 3), "error": error}
    write_whole(folder / RUN, json.dumps(content, indent=1) + "\n")
