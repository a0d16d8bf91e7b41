"""Whose code takes the time: known loads in known files."""

from __future__ import annotations

import importlib.util
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from studies.bench.scale_program import CpuShares, folder_of

pytestmark = pytest.mark.skipif(
    not hasattr(signal, "setitimer"), reason="needs a system with interval timers"
)

BURN = """
import time

def burn(seconds):
    began = time.process_time()
    while time.process_time() < began + seconds:
        pass

def one_call(seconds):
    began = time.process_time()
    while time.process_time() < began + seconds:
        sum(range(150_000))  # one call into C, longer than the interval of the samples
"""


def functions(folder: Path) -> tuple[Callable[[float], None], Callable[[float], None]]:
    folder.mkdir()
    (folder / "burning.py").write_text(BURN)
    spec = importlib.util.spec_from_file_location(f"burning_{folder.name}", folder / "burning.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.burn, module.one_call


def test_time_is_charged_to_the_package_that_uses_it(tmp_path: Path) -> None:
    burn, _ = functions(tmp_path / "one")
    _, one_call = functions(tmp_path / "two")
    other, _ = functions(tmp_path / "three")
    began = time.process_time()
    with CpuShares({"one": tmp_path / "one", "two": tmp_path / "two"}) as shares:
        for _ in range(5):
            burn(0.03)
            one_call(0.06)
            other(0.06)
    used = time.process_time() - began
    assert sum(shares.seconds.values()) == pytest.approx(used, abs=0.01)
    assert shares.seconds["one"] == pytest.approx(0.15, abs=0.04)
    assert shares.seconds["two"] == pytest.approx(0.30, abs=0.06)
    assert shares.seconds["rest"] == pytest.approx(0.30, abs=0.06)


def test_waiting_costs_nothing() -> None:
    with CpuShares({}) as shares:
        time.sleep(0.2)
    assert shares.seconds["rest"] < 0.05


def test_the_timer_is_put_back() -> None:
    before = signal.getsignal(signal.SIGPROF)
    with CpuShares({}):
        assert signal.getsignal(signal.SIGPROF) != before
    assert signal.getsignal(signal.SIGPROF) == before
    assert signal.getitimer(signal.ITIMER_PROF) == (0.0, 0.0)


def test_a_folder_beside_one_with_the_same_beginning_is_another(tmp_path: Path) -> None:
    burn, _ = functions(tmp_path / "torchless")
    with CpuShares({"torch": tmp_path / "torch"}) as shares:
        burn(0.02)
    assert shares.seconds["torch"] == 0
    assert folder_of("torch").name == "torch"
