"""Measured program: reset one environment many times and measure its processes."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ugat_marl.envs import parallel_env
from ugat_marl.seeding import numpy_generator

Process = tuple[int, int, float]
"""Process id, id of the parent, resident memory in MiB."""


def processes() -> list[Process]:
    """Return all processes that this one can see."""
    root = Path("/proc")
    if not (root / "self" / "statm").exists():
        listing = ["ps", "-A", "-o", "pid=,ppid=,rss="]
        said = subprocess.run(listing, capture_output=True, text=True, check=True).stdout
        rows = (line.split() for line in said.splitlines())
        return [(int(pid), int(parent), int(kib) / 1024) for pid, parent, kib in rows]
    page_mib = os.sysconf("SC_PAGE_SIZE") / 2**20
    found: list[Process] = []
    for folder in root.iterdir():
        if folder.name.isdecimal():
            with contextlib.suppress(OSError):  # the process may have ended meanwhile
                parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
                pages = (folder / "statm").read_text().split()[1]
                found.append((int(folder.name), int(parent), int(pages) * page_mib))
    return found


def family(table: Sequence[Process], root: int) -> dict[int, float]:
    """Return the resident memory in MiB of a process and all descendants, by process id."""
    members = {root}
    while more := {pid for pid, parent, _ in table if parent in members} - members:
        members |= more
    return {pid: mib for pid, _, mib in table if pid in members}


def open_files(pids: Iterable[int]) -> int:
    """Return the number of open files of processes; only of this one if others are hidden."""
    if Path("/proc/self/fd").exists():
        return sum(entries(Path("/proc", str(pid), "fd")) for pid in pids)
    return entries(Path("/dev/fd"))


def entries(folder: Path) -> int:
    """Return the number of entries of a folder."""
    return sum(1 for _ in folder.iterdir())


def look() -> dict[str, float]:
    """Return the numbers that must not grow: memory, processes and files."""
    members = family(processes(), os.getpid())
    return {
        "own memory [MiB]": members[os.getpid()],
        "memory of all processes [MiB]": sum(members.values()),
        "processes": len(members),
        "open files": open_files(members),
        "temporary files": entries(Path(tempfile.gettempdir())),
    }


def resets(request: Mapping[str, Any]) -> dict[str, Any]:
    """Reset and step; return the numbers early and late."""
    env = parallel_env(request["scenario"], simulator=request["simulator"])
    generator = numpy_generator(request["seed"], "bench", "memory")
    found: dict[str, dict[str, float]] = {}
    for number in range(1, request["resets"] + 1):
        env.reset(seed=request["seed"] + number)
        for _ in range(request["steps"]):
            env.step({a: int(generator.integers(int(env.action_space(a).n))) for a in env.agents})
        if number == request["settled"]:
            found["early"] = look()
    found["late"] = look()
    env.close()
    return found


if __name__ == "__main__":
    asked, found = map(Path, sys.argv[1:3])
    found.write_text(json.dumps(resets(json.loads(asked.read_text()))))
