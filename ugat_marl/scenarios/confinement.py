"""Confinement of a process by Linux (Landlock): what SUMO may read and write.

A scenario's files may name other files. `ugat_marl.scenarios.admission` lists what they may say;
beneath that list the kernel holds the process of a simulation to the scenario's own files, SUMO's
data and the folder of the simulation. It holds SUMO's converters to their folder in the same way.
None of them opens or reaches a TCP port, or takes more memory than a limit.

The file is a program too, for ``sumo``, ``netconvert`` and the like: it confines itself and becomes
the other program. It therefore imports nothing of the package.

The numbers are those of ``linux/landlock.h``.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import json
import os
import struct
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_VERSION = 1
_PATH_BENEATH = 1
_NO_NEW_PRIVILEGES = 38

MEMORY_VARIABLE = "UGAT_MARL_MEMORY_GB"
"""Environment variable with the most memory of a simulation, GB; by default half of the machine's.
With a quarter, honest cities would fail on a laptop."""

_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_DIR = (1 << bit for bit in range(4))
_BIND_TCP, _CONNECT_TCP = 1, 2
_SIGNALS_AND_SOCKETS = 3

_FILE_RIGHTS_OF_VERSION = {1: 13, 2: 14, 3: 15, 5: 16}
"""Version of Landlock to the number of rights on files that it knows."""
_RIGHTS_ON_FILES = _EXECUTE | _WRITE_FILE | _READ_FILE | 1 << 14 | 1 << 15
"""Rights that make sense for a file; the others are those of folders."""

_SYSTEM = (
    "/usr", "/lib", "/lib64", "/etc/ld.so.cache", "/etc/localtime", "/dev/urandom", "/dev/null",
    "/sys/devices/system/cpu",
)  # fmt: skip


@functools.cache
def confinement_missing() -> str:
    """Return why processes cannot be confined here; empty if they can."""
    if not sys.platform.startswith("linux"):
        return f"{sys.platform} has no Landlock"
    version = _system_call(_CREATE_RULESET, None, 0, _VERSION)
    return "" if version > 0 else "this Linux kernel has no Landlock (5.13 or later has)"


def confine(
    reads: Iterable[str],
    writes: Iterable[str],
    programs: Iterable[str] | None = None,
) -> str:
    """Confine the calling thread, and what it starts, for the rest of its life.

    Other threads that run already stay free.

    Args:
        reads: Files and folders to read, besides Python and SUMO themselves.
        writes: Folders to read and write.
        programs: Folders of Python, its packages and SUMO; None for those of this process.

    Returns:
        The reason why nothing was confined; empty after success.

    Raises:
        OSError: The kernel refused.
    """
    if reason := confinement_missing():
        return reason
    version = _system_call(_CREATE_RULESET, None, 0, _VERSION)
    bits = max(bits for since, bits in _FILE_RIGHTS_OF_VERSION.items() if since <= version)
    on_files = (1 << bits) - 1
    handled = struct.pack(
        "=QQQ",
        on_files,
        _BIND_TCP | _CONNECT_TCP if version >= 4 else 0,
        _SIGNALS_AND_SOCKETS if version >= 6 else 0,
    )
    size = 8 if version < 4 else 16 if version < 6 else 24
    ruleset = _checked(_CREATE_RULESET, handled, size, 0)
    try:
        reading = _READ_FILE | _READ_DIR
        known = _programs() if programs is None else programs
        _allow(ruleset, (*_SYSTEM, *known), (reading | _EXECUTE) & on_files)
        _allow(ruleset, ("/dev/null",), _READ_FILE | _WRITE_FILE)
        _allow(ruleset, reads, reading)
        _allow(ruleset, writes, on_files & ~_EXECUTE)
        libc = _libc()
        if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0):
            raise OSError(ctypes.get_errno(), "prctl")
        _checked(_RESTRICT_SELF, ruleset, 0)
    finally:
        os.close(ruleset)
    return ""


def most_memory() -> int:
    """Return the most bytes that a simulation may use.

    Raises:
        ValueError: The variable `MEMORY_VARIABLE` is not a number above 0; the message says so.
    """
    text = os.environ.get(MEMORY_VARIABLE, "")
    if text:
        with contextlib.suppress(ValueError):
            if 0 < (gigabytes := float(text)) < 1e9:
                return int(gigabytes * 1e9)
        raise ValueError(f"{MEMORY_VARIABLE} = {text!r}: give a number of gigabytes above 0")
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with contextlib.suppress(OSError, ValueError):  # "max" where a container has no limit
        machine = min(machine, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    return machine // 2


def limit_memory() -> None:
    """Limit the memory of this process, and of what it starts, to `most_memory`.

    A few bytes of a scenario can ask SUMO for any amount of memory. Not on Windows.

    Raises:
        ValueError: As for `most_memory`.
    """
    if os.name == "nt":
        return
    import resource

    most = most_memory()
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard != resource.RLIM_INFINITY:
        most = min(most, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))


def confined_command(
    command: Sequence[str], reads: Sequence[str], writes: Sequence[str]
) -> list[str]:
    """Return a command line that runs `command` confined; the command itself where that is missing.

    Args:
        command: A program and its options.
        reads: Files and folders to read.
        writes: Folders to read and write.
    """
    if confinement_missing():
        return [*command]
    # Without site, which takes most of its start, Python does not know its packages.
    rules = json.dumps([[*reads], [*writes], _programs()])
    return [sys.executable, "-I", "-S", __file__, rules, *command]


def _programs() -> list[str]:
    """Return the folders of Python, its packages and SUMO, without the user's own modules."""
    folders = [sys.prefix, sys.base_prefix, str(Path(__file__).resolve().parents[1])]
    folders += [entry for entry in sys.path if entry.endswith(("site-packages", "dist-packages"))]
    if home := os.environ.get("SUMO_HOME"):
        folders.append(home)
    return [folder for folder in folders if str(Path(folder).resolve()) != "/"]


def _allow(ruleset: int, paths: Iterable[str], rights: int) -> None:
    """Add a rule for each path that exists."""
    for path in paths:
        with contextlib.suppress(OSError):
            descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
            try:
                own = rights if Path(path).is_dir() else rights & _RIGHTS_ON_FILES
                rule = struct.pack("=Qi", own, descriptor)
                _checked(_ADD_RULE, ruleset, _PATH_BENEATH, rule, 0)
            finally:
                os.close(descriptor)


@functools.cache
def _libc() -> Any:
    return ctypes.CDLL(None, use_errno=True)


def _system_call(number: int, *arguments: Any) -> int:
    call = _libc().syscall
    call.restype = ctypes.c_long
    return int(call(ctypes.c_long(number), *arguments))


def _checked(number: int, *arguments: Any) -> int:
    result = _system_call(number, *arguments)
    if result < 0:
        raise OSError(ctypes.get_errno(), "Landlock: " + os.strerror(ctypes.get_errno()))
    return result


def _main(rules: str, *command: str) -> None:
    limit_memory()
    confine(*json.loads(rules))
    os.execv(command[0], command)


if __name__ == "__main__":
    _main(*sys.argv[1:])
