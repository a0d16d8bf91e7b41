"""Makes `.venv` fit to run the suite, with nothing but Python: create, install, repair.

Run by `make`: ``python .ci/environment.py [extra ...]``. The dependencies come from the wheel
built from this checkout, in the versions of ``constraints.txt``. What was installed is written down
in ``.venv/ugat-marl.json`` as the very last step, so that a second run with nothing changed does
nothing, a changed source only replaces the wheel, and an interrupted run is started afresh.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import TypedDict

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
RECORD = VENV / "ugat-marl.json"
UNFINISHED = VENV / "ugat-marl.unfinished"
WHEELS = VENV / "wheel"
LOCK = ROOT / ".cache" / "environment.lock"
OLDEST = (3, 11)
PROBE = """
import gymnasium, jinja2, lazy_loader, libsumo, matplotlib, numpy, pettingzoo, polars, pydantic
import rich, scipy, sumo, supersuit, tensorboard, torch, tyro
import ugat_marl
"""
PROBES = {
    "dev": "import hatchling, hypothesis, pytest, pytest_timeout, sklearn, xdist\n"
    "import stable_baselines3\n",
    "osm": "import osmium\n",
}
"""Imports by the extra that brings what they name."""


class Record(TypedDict):
    """Contents of `.venv`: where it was made, from which files, with which extras."""

    root: str
    requirements: str
    source: str
    extras: list[str]


def digest(paths: Sequence[Path]) -> str:
    """A hash over the names and contents of files, and of all files below directories."""
    result = hashlib.sha256()
    for path in paths:
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in files:
            if file.is_file() and "__pycache__" not in file.parts:
                content = file.read_bytes()
                result.update(f"{file.relative_to(ROOT)}\0{len(content)}\0".encode())
                result.update(content)
    return result.hexdigest()


def wanted(extras: Sequence[str]) -> Record:
    """The record a finished environment for this checkout has."""
    return Record(
        root=str(ROOT),
        requirements=digest([ROOT / "pyproject.toml", ROOT / "constraints.txt"]),
        source=digest(
            [ROOT / name for name in ("ugat_marl", "scenarios", "baselines", "README.md")]
        ),
        extras=sorted(extras),
    )


def found() -> Record | None:
    """The record left by the last finished run, or None."""
    try:
        return json.loads(RECORD.read_text())
    except (FileNotFoundError, NotADirectoryError, json.JSONDecodeError):
        return None


def environment() -> dict[str, str]:
    """The variables subprocesses run with: nothing that lets another installation shine through."""
    return {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}


def run(*command: str | Path, quiet: bool = False) -> bool:
    """Runs a command without stdin and says whether it succeeded; `quiet` hides its words."""
    silence = subprocess.DEVNULL if quiet else None
    finished = subprocess.run(
        [str(part) for part in command],
        cwd=ROOT,
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=silence,
        stderr=silence,
        check=False,
    )
    return finished.returncode == 0


@contextlib.contextmanager
def stage(text: str) -> Generator[None]:
    """Prints what is being done and how long it took."""
    print(f"environment: {text} ...", flush=True)
    began = time.monotonic()
    yield
    print(f"environment: {text}: done in {time.monotonic() - began:.0f} s", flush=True)


def pip(*arguments: str | Path, failure: str) -> None:
    """Installs into `.venv`; the tested versions are always in force.

    On a terminal one line shows what pip is at; everything it said is shown only if it fails.
    """
    constraints = ROOT / "constraints.txt"
    options = ("install", "--disable-pip-version-check", "--no-input", "-c", constraints)
    said: list[str] = []
    with subprocess.Popen(
        [str(part) for part in (PYTHON, "-m", "pip", *options, *arguments)],
        cwd=ROOT,
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            said.append(line)
            if sys.stdout.isatty() and line.startswith(("Collecting", "Downloading", "Installing")):
                print(f"\r\033[K  {line.strip()[:76]}", end="", flush=True)
    if sys.stdout.isatty():
        print("\r\033[K", end="", flush=True)
    if process.returncode != 0:
        sys.exit("".join([*said[-30:], f"environment: {failure}"]))


def create() -> None:
    """Replaces `.venv` by an empty one of this interpreter."""
    shutil.rmtree(VENV, ignore_errors=True)
    with stage(f"creating .venv with Python {sys.version.split()[0]}"):
        if not run(sys.executable, "-m", "venv", VENV):
            sys.exit(
                "environment: Python's venv module does not work here; on Debian and Ubuntu "
                "install the package python3-venv, then run the same command again"
            )


def build_requirements() -> list[str]:
    """Return what pyproject.toml asks for to build the wheel."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        return tomllib.load(file)["build-system"]["requires"]


def build() -> Path:
    """Builds the wheel with what is in `.venv`: no isolated environment, nothing downloaded."""
    shutil.rmtree(WHEELS, ignore_errors=True)
    command = (PYTHON, "-m", "hatchling", "build", "-t", "wheel", "-d", WHEELS)
    if not run(*command, quiet=True) and not run(*command):
        sys.exit("environment: the wheel could not be built, see above")
    return next(WHEELS.glob("*.whl"))


def install(goal: Record) -> None:
    """Installs the wheel and all that it depends on."""
    unreachable = "installing failed, see above; pip needs to reach a package index"
    with stage("installing dependencies (the first time this takes minutes)"):
        pip(*build_requirements(), failure=unreachable)
        wheel = build()
        extras = f"[{','.join(goal['extras'])}]" if goal["extras"] else ""
        pip(f"{wheel}{extras}", failure=unreachable)
    replace_package(wheel)


def replace_package(wheel: Path) -> None:
    """Installs the wheel over the package that is there, whatever its version."""
    pip("--no-deps", "--force-reinstall", wheel, failure="installing the wheel failed")


def runs() -> bool:
    """Return whether `.venv` holds a Python that starts, is new enough and has pip."""
    check = f"import pip, sys; sys.exit(sys.version_info < {OLDEST})"
    return PYTHON.exists() and run(PYTHON, "-c", check, quiet=True)


def imports(goal: Record, *, quiet: bool) -> bool:
    """Return whether what was installed can be imported."""
    probe = PROBE + "".join(PROBES.get(extra, "") for extra in goal["extras"])
    return run(PYTHON, "-P", "-c", probe, quiet=quiet)


def prepare(extras: Sequence[str]) -> None:
    """Brings `.venv` to the state asked for, doing as little as possible."""
    goal, record = wanted(extras), found()
    if record is not None:
        goal["extras"] = sorted({*extras, *record["extras"]})
        if record == goal and runs():
            return
    usable = runs() and not UNFINISHED.exists()
    only_source = usable and record is not None and {**record, "source": goal["source"]} == goal
    if not usable:
        create()
    RECORD.unlink(missing_ok=True)
    UNFINISHED.touch()
    if only_source:
        with stage("installing the changed package"):
            replace_package(build())
    else:
        install(goal)
    if not imports(goal, quiet=True):
        print("environment: .venv is damaged; starting afresh", flush=True)
        create()
        UNFINISHED.touch()
        install(goal)
        if not imports(goal, quiet=False):
            sys.exit("environment: the installed packages do not import, see above")
    RECORD.write_text(json.dumps(goal, indent=1))
    UNFINISHED.unlink()


def main() -> None:
    """Parses the extras and prepares the environment, one process at a time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("extras", nargs="*", help="extras of pyproject.toml, e.g. dev osm resco")
    extras = parser.parse_args().extras
    LOCK.parent.mkdir(exist_ok=True)
    with LOCK.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            prepare(extras)
        except KeyboardInterrupt:
            sys.exit("\nenvironment: interrupted; the same command starts it afresh")


if __name__ == "__main__":
    main()
