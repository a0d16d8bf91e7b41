"""A SUMO of one's own that listens for TraCI, to show the loop where there is no street."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from ugat_marl.effects import late_greens
from ugat_marl.errors import OptionError
from ugat_marl.scenarios import Scenario, sumo_program
from ugat_marl.simulation import Trips, launch_of, read_trips

_PATIENCE_S = 10.0
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of <linux/prctl.h>


class StartedSumo:
    """Runs a scenario in ``sumo --remote-port``, from entering the block to leaving it.

    SUMO ends when its one client hangs up, or (under Linux) when this process dies before.

    Args:
        scenario: What to run, in its domain.
        seed: SUMO's seed.
        port: Where it listens; None for a free port.

    Attributes:
        port: Where it listens.
        process: The process.

    Raises:
        OptionError: The scenario's lights turn green late, which SUMO does not do by itself.
    """

    def __init__(self, scenario: Scenario, seed: int, port: int | None = None) -> None:
        if late := late_greens(scenario):
            raise OptionError(
                f"scenario {scenario.id!r}: traffic light {next(iter(late))!r} turns green late, "
                "which only the environments do; start SUMO in another domain"
            )
        self.port = port or _free_port()
        self._scenario, self._seed = scenario, seed

    def __enter__(self) -> StartedSumo:
        self._directory = tempfile.TemporaryDirectory(prefix="ugat_marl-field-")
        place = Path(self._directory.name)
        launch = launch_of(self._scenario, self._seed, place, ())
        launch.write()
        self._trips = place / Path(_value_of("--tripinfo-output", launch.arguments)).name
        self.process: subprocess.Popen[bytes] = subprocess.Popen(
            [str(sumo_program("sumo")), *launch.arguments, "--remote-port", str(self.port)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for this process, which ends the other by itself
            preexec_fn=_tied_to(os.getpid()) if sys.platform == "linux" else None,
        )
        return self

    def trips(self) -> Trips:
        """What became of every vehicle due, once the client has hung up.

        Raises:
            SimulatorError: SUMO has not written it.
        """
        self._wait()
        return read_trips(self._trips)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.process.kill()  # its files go with it
        self._wait()
        self._directory.cleanup()

    def _wait(self) -> None:
        try:
            self.process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def _value_of(option: str, arguments: tuple[str, ...]) -> str:
    return arguments[arguments.index(option) + 1]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return int(probe.getsockname()[1])


def _tied_to(parent: int) -> Callable[[], None]:
    """What the child calls before it becomes SUMO: to be killed when `parent` dies."""
    prctl: Any = ctypes.CDLL(None).prctl  # loaded before the fork, where little is allowed

    def tie() -> None:
        prctl(_DIE_WITH_PARENT, int(signal.SIGKILL))
        if os.getppid() != parent:
            os._exit(1)

    return tie
