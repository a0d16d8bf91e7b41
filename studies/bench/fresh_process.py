"""Run one measured program in a fresh process, so that no measurement warms up another.

A program is called as ``python program request.json result.json``. It runs in its own temporary
folder. If it fails, its output becomes part of the message.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from studies.errors import MeasurementError
from ugat_marl.parallel import import_path

CHECKOUT = Path(__file__).resolve().parents[2]


def in_fresh_process(
    program: Sequence[str | Path],
    request: Mapping[str, Any],
    *,
    python: str | Path = sys.executable,
    variables: Mapping[str, str] | None = None,
    timeout_s: float = 3600.0,
) -> dict[str, Any]:
    """Run a program and return its result.

    Args:
        program: Arguments of Python: ``["-m", module]`` or ``[path]``.
        request: Input of the program, as values for JSON.
        python: Python interpreter.
        variables: Environment variables to add; one thread per process is the default.
        timeout_s: Longest time of the program, in seconds.

    Raises:
        MeasurementError: The program failed, took too long or left no result.
    """
    name = " ".join(str(part) for part in program)
    with tempfile.TemporaryDirectory(prefix="ugat_marl-bench-") as folder:
        asked, found = Path(folder, "request.json"), Path(folder, "result.json")
        scratch = Path(folder, "tmp")
        scratch.mkdir()
        asked.write_text(json.dumps(dict(request)))
        command = [str(python), "-P", *map(str, program), str(asked), str(found)]
        try:
            finished = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=_variables(scratch, variables or {}),
                timeout=timeout_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise MeasurementError(f"{name}: no result after {timeout_s:g} s") from None
        if finished.returncode or not found.exists():
            words = " ".join(finished.stdout.decode(errors="replace").split())
            said = words[-2000:] or "nothing"
            raise MeasurementError(
                f"{name}: failed with status {finished.returncode}; it said: {said}"
            )
        return json.loads(found.read_text())


def _variables(scratch: Path, more: Mapping[str, str]) -> dict[str, str]:
    # The folders of this process come first, so that the suite measured is the one that it has.
    return {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([import_path(), str(CHECKOUT)]),
        "TMPDIR": str(scratch),
        **more,
    }
