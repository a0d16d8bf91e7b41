"""The machine and the versions a figure was taken with."""

from __future__ import annotations

import datetime
import os
import platform
import shlex
import sys
from pathlib import Path
from typing import Any

from ugat_marl.data import versions_of
from ugat_marl.parallel import usable_cores

_LIBRARIES = (
    "ugat-marl", "eclipse-sumo", "libsumo", "numpy", "torch", "gymnasium", "pettingzoo",
)  # fmt: skip


def machine_facts() -> dict[str, Any]:
    """Return CPU, cores, load, memory, system, Python, library versions, date and command line."""
    return {
        "cpu": cpu_model(),
        "cores": usable_cores(),
        "load_1min": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "memory_gib": memory_gib(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": versions_of(*_LIBRARIES),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": shlex.join([*_program(), *sys.argv[1:]]),
    }


def _program() -> list[str]:
    """Return the words to type for the running program; of an absolute path only the name."""
    path = Path(sys.argv[0])
    if path.name == "__main__.py":
        return ["ugat-marl"]
    if path.suffix == ".py":
        return ["python", path.name if path.is_absolute() else path.as_posix()]
    return [path.name]


def cpu_model() -> str:
    """Return the processor's name, as the system calls it."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def memory_gib() -> float | None:
    """Return the physical memory in GiB, or None where the system does not say."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, ValueError, OSError):
        return None
