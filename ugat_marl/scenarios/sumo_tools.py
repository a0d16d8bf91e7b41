"""SUMO's own programs and tools, run with a list of options. Their failures become errors."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from ugat_marl.errors import ScenarioError
from ugat_marl.parallel import DEADLINE_VARIABLE, usual_deadline_s
from ugat_marl.scenarios.confinement import confined_command

_MOST_WORDS = 60
"""Most words quoted from a program's error; netconvert can print pages."""


def sumo_program(name: str) -> Path:
    """Return the path of a program in the eclipse-sumo wheel, not of its Python wrapper."""
    import sumo

    return Path(sumo.SUMO_HOME) / "bin" / name


def netconvert(arguments: Sequence[str], output: Path) -> str:
    """Make a network with netconvert, and remove the comment with date and paths.

    Args:
        arguments: Options of netconvert without the output. The files they name lie in the folder
            of the output.
        output: The ``.net.xml`` to write.

    Returns:
        Warnings of netconvert; empty if there were none.

    Raises:
        ScenarioError: netconvert refused; the message quotes it.
    """
    said = convert("netconvert", [*arguments, "-o", str(output)], output.parent)
    if not output.exists():
        raise ScenarioError(f"netconvert: wrote no network: {_short(said)}")
    text = output.read_text(encoding="utf-8")
    plain = re.sub(r"<!--.*?-->\s*", "", text, count=1, flags=re.DOTALL)
    output.write_text(plain, encoding="utf-8")
    return said if "Warning" in said else ""


def convert(name: str, arguments: Sequence[str], folder: Path, reads: Sequence[Path] = ()) -> str:
    """Run one of SUMO's converters, confined to a folder where the system can do that.

    What it is given may come from a stranger, and its formats can name further files.

    Args:
        name: A program such as ``netconvert``, or a tool in Python such as ``routeSampler.py``.
        arguments: Options of the converter.
        folder: Folder in which it reads and writes; an absolute path.
        reads: Further files that it reads.

    Returns:
        Its standard error.

    Raises:
        ScenarioError: The converter failed; the message quotes it.
    """
    if name.endswith(".py"):
        path = sumo_program("netconvert").parent.parent / "tools" / name
        command = [sys.executable, str(path), *arguments]
    else:
        command = [str(sumo_program(name)), *arguments]
    return run_program(
        name, confined_command(command, [str(path) for path in reads], [str(folder)])
    )


def run_program(name: str, command: Sequence[str]) -> str:
    """Run a program and return its standard error.

    Args:
        name: Name of the program in errors.
        command: The program and its options.

    Raises:
        ScenarioError: The program failed; the message quotes it.
    """
    environment = {**os.environ, "SUMO_HOME": str(sumo_program(name).parent.parent)}
    done = finished(name, command, environment)
    if done.returncode:
        raise ScenarioError(f"{name}: {_short(_errors(done.stderr) or done.stderr or done.stdout)}")
    return done.stderr.strip()


def finished(
    name: str, command: Sequence[str], environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a program until it ends, or kill it at its deadline; return its exit code and its words.

    Args:
        name: Name of the program in errors.
        command: The program and its options.
        environment: Its environment variables; None for those of this process.

    Raises:
        ScenarioError: The program did not end in time.
    """
    deadline_s = usual_deadline_s()
    try:
        return subprocess.run(
            list(command),
            capture_output=True,
            text=True,
            env=environment,
            check=False,
            timeout=deadline_s,
        )
    except subprocess.TimeoutExpired:
        raise ScenarioError(
            f"{name}: did not end within {deadline_s:g} s and was killed (stopped, or too little "
            f"for this network: set {DEADLINE_VARIABLE})"
        ) from None


def _errors(said: str) -> str:
    """Return the lines that are errors, without the warnings between them."""
    return "\n".join(line for line in said.splitlines() if "rror" in line)


def _short(said: str) -> str:
    words = said.split()
    return " ".join(words[:_MOST_WORDS]) + (" ..." if len(words) > _MOST_WORDS else "")
