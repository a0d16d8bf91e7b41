"""Devices for learning: the processor, or a GPU that torch sees.

A GPU computes updates and fits, and nothing else. Random numbers are drawn on the CPU, so a GPU
learns from the same draws. Transitions, policies, roll-outs and checkpoints stay on the CPU, so a
run that began with a GPU can continue without it.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator

import torch
from torch import nn

from ugat_marl.errors import OptionError, counted

CPU = torch.device("cpu")
_NAMES = re.compile(r"cpu|cuda(?::(0|[1-9]\d*))?")


def require_device_name(name: str) -> None:
    """Refuse a name that is not a device's; this machine need not have the device.

    Raises:
        OptionError: The name is neither "cpu", "cuda" nor "cuda:N".
    """
    if not _NAMES.fullmatch(name):
        raise OptionError(f"device = {name!r}: must be cpu, cuda, or cuda:N for one GPU of several")


def device_of(name: str) -> torch.device:
    """Return the device of a name.

    Args:
        name: "cpu", "cuda" (torch's current GPU) or "cuda:N".

    Raises:
        OptionError: The name is not a device's, or torch finds no such GPU.
    """
    require_device_name(name)
    if name == "cpu":
        return CPU
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count == 0:
        built = torch.backends.cuda.is_built()
        why = "finds no GPU it can use" if built else "was built without CUDA"
        raise OptionError(f"device = {name!r}: torch {torch.__version__} {why}; leave it at cpu")
    number = name.partition(":")[2]
    if number and int(number) >= count:
        known = ", ".join(f"cuda:{index}" for index in range(count))
        raise OptionError(
            f"device = {name!r}: torch sees {counted(count, 'GPU')} here; name {known}"
        )
    return torch.device(name)


@contextlib.contextmanager
def on_device(device: torch.device, *modules: nn.Module) -> Iterator[None]:
    """Move modules to a device, and back to the CPU at the end (also after an error)."""
    try:
        for module in modules:
            module.to(device)
        yield
    finally:
        for module in modules:
            module.to(CPU)
