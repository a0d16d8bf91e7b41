"""Facts of the machine and versions of the libraries, to store with measured results."""

from __future__ import annotations

import datetime
import os
import platform
import shlex
import sys
from pathlib import Path
from typing import Any

from ugat_marl.data import installed_versions
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
        "versions": installed_versions(*_LIBRARIES),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": shlex.join([*_program(), *sys.argv[1:]]),
    }


def _program() -> list[str]:
    """Return the words to type for the running program; an absolute path is cut to its name."""
    path = Path(sys.argv[0])
    if path.name == "__main__.py":
        package = path.parent.parts[-2:] if path.parent.parent.name == "studies" else ()
        return ["python", "-m", ".".join(package)] if package else ["ugat-marl"]
    if path.suffix == ".py":
        return ["python", path.name if path.is_absolute() else path.as_posix()]
    return [path.name]


def cpu_model() -> str:
    """Return the name of the processor as the system reports it."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def memory_gib() -> float | None:
    """Return the physical memory in GiB; None if the system does not report it."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, ValueError, OSError):
        return None
