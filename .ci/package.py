"""Build the source archive and the wheel, install them into fresh environments, and try them.

Run by `make package`: ``python .ci/package.py``. Each environment is made anew and gets one file:
the source archive alone, the wheel alone, the wheel with every extra but those of learners, the
wheel with the learners of all libraries. There the commands below run in an empty folder, and
every library of the extras must be there. An environment that works is removed again.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
import venv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
SCENARIOS = sorted(path.parent.name for path in ROOT.glob("scenarios/*/scenario.toml"))
LEARNERS = "baselines"
"""Extra that brings the learners of all libraries."""

TRAIN = (
    "train single-v1 --real V4 --out run --duration-s 300 --pretrain-episodes 1 --iterations 1 "
    "--grounded-episodes 1 --real-rollouts 1 --street.simulations 20 --evaluation-seeds 1 "
    "--tuning-seeds 1 --no-control"
)
COMMANDS = (
    "scenario list",
    "scenario check single-v1",
    "scenario draw single-v1 --out pictures",
    "evaluate single-v1 --policies programme --domains sim V4 --seeds 1 --duration-s 300",
    TRAIN,
    "report run",
)
LIBRARIES = """
import importlib.metadata, re, sys
missing = []
for text in importlib.metadata.requires("ugat-marl"):
    name, _, condition = text.partition(";")
    extra = re.search(r"extra == ['\\"]([^'\\"]+)", condition)
    name = re.split(r"[\\[<>=!~ ]", name.strip())[0]
    if extra is None or extra.group(1) in sys.argv[1:]:
        try:
            importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
sys.exit(f"not installed: {', '.join(missing)}" if missing else 0)
"""
"""Program that fails if a library of the package, or of the extras in its arguments, is missing."""


@dataclass(frozen=True)
class Installation:
    """A file of the package, and the environment it is installed into.

    Attributes:
        name: Name of the environment.
        suffix: Ending of the file, ".whl" or ".tar.gz".
        extras: Extras that are installed with it.
        constraints: File of the versions.
        commands: Commands of ``ugat-marl`` that must work.
    """

    name: str
    suffix: str
    extras: tuple[str, ...] = ()
    constraints: str = "constraints.txt"
    commands: tuple[str, ...] = COMMANDS


def installations() -> list[Installation]:
    """Return what is tried: both files, and every extra with one of them."""
    extras = PROJECT["optional-dependencies"]
    # "ugat-marl[sb3,...]" names the extras that it gathers
    (gathered,) = extras[LEARNERS]
    learners = gathered.partition("[")[2].rstrip("]").split(",")
    others = tuple(name for name in extras if name not in (*learners, LEARNERS))
    first = COMMANDS[:1]
    return [
        Installation("sdist", ".tar.gz", commands=first),
        Installation("wheel", ".whl"),
        Installation("extras", ".whl", others, commands=first),
        Installation(
            "learners", ".whl", (*learners, LEARNERS), "constraints-baselines.txt", commands=first
        ),
    ]


def build(folder: Path) -> None:
    """Build the source archive, and the wheel from it."""
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "build", "-o", str(folder), str(ROOT)], check=True)


def require(command: Sequence[str | Path], folder: Path, python: Path) -> str:
    """Run a command without this environment's variables; return its output, or end with it."""
    hidden = ("PYTHONPATH", "VIRTUAL_ENV", "SUMO_HOME")
    variables = {key: value for key, value in os.environ.items() if key not in hidden}
    variables["PATH"] = os.pathsep.join([str(python.parent), variables.get("PATH", "")])
    done = subprocess.run(
        [str(word) for word in command],
        cwd=folder,
        env=variables,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        words = " ".join(str(word) for word in command)
        sys.exit(f"{done.stdout}\npackage: {words}: exit code {done.returncode}")
    return done.stdout


def check(given: Installation, file: Path, place: Path) -> None:
    """Install a file into a new environment and try it there."""
    shutil.rmtree(place, ignore_errors=True)
    venv.create(place, with_pip=True)
    python = place / "bin" / "python"
    install: list[str | Path] = [python, "-m", "pip", "install", "-q"]
    constraints = ROOT / given.constraints
    torch = next(
        line for line in constraints.read_text().splitlines() if line.startswith("torch==")
    )
    wanted = f"{file}[{','.join(given.extras)}]" if given.extras else str(file)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        require([*install, torch], folder, python)  # its build decides whether GPU libraries come
        require([*install, "-c", constraints, wanted], folder, python)
        require([python, "-P", "-c", LIBRARIES, *given.extras], folder, python)
        program = place / "bin" / "ugat-marl"
        for command in given.commands:
            said = require([program, *command.split()], folder, python)
            if command == "scenario list":
                lost = [scenario for scenario in SCENARIOS if scenario not in said]
                lost += (
                    ["resco:cologne3"] if "resco" in given.extras and "resco:" not in said else []
                )
                if lost:
                    sys.exit(f"{said}\npackage: scenario list does not name {', '.join(lost)}")
    shutil.rmtree(place)


def main() -> None:
    """Build, install, try, report."""
    known = {given.name: given for given in installations()}
    parser = argparse.ArgumentParser(description=__doc__, add_help=True)
    parser.add_argument("names", nargs="*", help=f"only these: {', '.join(known)}")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of both files")
    options = parser.parse_args()
    if unknown := [name for name in options.names if name not in known]:
        parser.error(f"{unknown[0]!r} is none of {', '.join(known)}")
    build(options.out)
    for name in options.names or known:
        given = known[name]
        file = next(options.out.glob(f"*{given.suffix}"))
        check(given, file.resolve(), ROOT / f".venv-package-{name}")
        extras = f" with {', '.join(given.extras)}" if given.extras else ""
        print(f"package: {file.name}{extras}: installed, and it works", flush=True)


if __name__ == "__main__":
    main()
