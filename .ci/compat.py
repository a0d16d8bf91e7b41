"""Builds environments for the learners' libraries and runs `baselines/compat.py` in them.

Run by `make compat`: ``python .ci/compat.py WHEEL``. All libraries go into one environment, in the
versions of ``constraints-baselines.txt``. With ``--latest`` each extra gets an environment of its
own with the newest releases there are (torch aside), since together they would hold each other
back; what broke is in the last lines, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LEARNERS = {
    "": ["ippo", "mappo"],
    "sb3": ["sb3-ppo", "sb3-dqn", "maskable-ppo", "supersuit-ppo"],
    "torchrl": ["torchrl-mappo"],
    "skrl": ["skrl-ippo", "skrl-mappo"],
    "benchmarl": ["qmix", "vdn"],
    "rllib": ["rllib-ppo"],
}


def torch_of(constraints: Path) -> str:
    """The requirement of torch in a file of constraints."""
    found = re.search(r"^torch==.*$", constraints.read_text(), flags=re.MULTILINE)
    if found is None:
        raise SystemExit(f"{constraints} does not pin torch")
    return found.group()


def make(folder: Path, requirements: list[str], wheel: Path) -> Path:
    """An environment with torch, then the requirements; returns its interpreter.

    The wheel is installed once more by itself: of the same version, pip would keep the one there.
    """
    python = folder / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    torch = torch_of(ROOT / "constraints-baselines.txt")
    own = ["--no-deps", "--force-reinstall", str(wheel)]
    for wanted in ([torch], [torch, *requirements], own):  # torch first: its build decides on GPUs
        subprocess.run([str(python), "-m", "pip", "install", "-q", *wanted], check=True)
    return python


def matrix(python: Path, learners: list[str]) -> int:
    """Runs the learners; returns the exit code."""
    command = [str(python), "-P", str(ROOT / "baselines" / "compat.py"), "--need-all"]
    return subprocess.run([*command, "--learners", *learners], check=False, cwd=ROOT).returncode


def main() -> int:
    """Builds, runs, reports."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])  # pyright: ignore[reportOptionalMemberAccess]
    parser.add_argument("wheel", type=Path, help="the suite's wheel")
    parser.add_argument("--latest", action="store_true", help="the newest releases, one by one")
    parser.add_argument(
        "--extras", nargs="+", choices=list(LEARNERS), default=list(LEARNERS), help="only these"
    )
    parser.add_argument("--into", type=Path, default=ROOT / ".venv-compat", help="environments")
    given = parser.parse_args()
    if not given.latest:
        constraints = ["-c", str(ROOT / "constraints-baselines.txt")]
        requirements = [*constraints, f"{given.wheel}[baselines]"]
        python = make(given.into, requirements, given.wheel)
        return matrix(python, [name for extra in given.extras for name in LEARNERS[extra]])
    broken: list[str] = []
    for extra in given.extras:
        folder = given.into.with_name(f"{given.into.name}-latest-{extra or 'own'}")
        wheel = f"{given.wheel}[{extra}]" if extra else str(given.wheel)
        named = extra or "the suite alone"
        print(f"\n{named}:", flush=True)
        try:
            eager = ["--upgrade", "--upgrade-strategy", "eager", wheel]
            python = make(folder, eager, given.wheel)
        except subprocess.CalledProcessError as error:
            broken.append(f"{named}: cannot be installed ({error})")
            continue
        if matrix(python, LEARNERS[extra]):
            broken.append(f"{named}: see its matrix above")
    print("\n" + ("\n".join(["broken:", *broken]) if broken else "nothing is broken"))
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
