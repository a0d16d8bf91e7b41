"""SUMO's own programs and tools, run with a list of options; their complaints become errors."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from ugat_marl.errors import ScenarioError

_MOST_WORDS = 60
"""Words kept of a program's complaint; netconvert can complain for pages."""


def sumo_program(name: str) -> Path:
    """Return the path of a program in the eclipse-sumo wheel, not of its wrapper in Python."""
    import sumo

    return Path(sumo.SUMO_HOME) / "bin" / name


def netconvert(arguments: Sequence[str], output: Path) -> str:
    """Make a network, without the comment that holds date and paths.

    Args:
        arguments: Options without the output.
        output: The ``.net.xml`` to write.

    Returns:
        Its warnings; empty if there were none.

    Raises:
        ScenarioError: It refused; holds its words.
    """
    said = run_program(
        "netconvert", [str(sumo_program("netconvert")), *arguments, "-o", str(output)]
    )
    if not output.exists():
        raise ScenarioError(f"netconvert: wrote no network: {_short(said)}")
    text = output.read_text(encoding="utf-8")
    plain = re.sub(r"<!--.*?-->\s*", "", text, count=1, flags=re.DOTALL)
    output.write_text(plain, encoding="utf-8")
    return said if "Warning" in said else ""


def tool(script: str, arguments: Sequence[str]) -> None:
    """Run one of SUMO's tools written in Python.

    Args:
        script: Its name, ``routeSampler.py`` say.
        arguments: Its options.

    Raises:
        ScenarioError: It failed; holds its last words.
    """
    path = sumo_program("netconvert").parent.parent / "tools" / script
    run_program(script, [sys.executable, str(path), *arguments])


def run_program(name: str, command: Sequence[str]) -> str:
    """Run a program and return its standard error.

    Raises:
        ScenarioError: It failed.
    """
    environment = {**os.environ, "SUMO_HOME": str(sumo_program(name).parent.parent)}
    done = subprocess.run(
        list(command), capture_output=True, text=True, env=environment, check=False
    )
    if done.returncode:
        raise ScenarioError(f"{name}: {_short(_errors(done.stderr) or done.stderr or done.stdout)}")
    return done.stderr.strip()


def _errors(said: str) -> str:
    """Return the lines that are errors; there are warnings between them."""
    return "\n".join(line for line in said.splitlines() if "rror" in line)


def _short(said: str) -> str:
    words = said.split()
    return " ".join(words[:_MOST_WORDS]) + (" ..." if len(words) > _MOST_WORDS else "")
