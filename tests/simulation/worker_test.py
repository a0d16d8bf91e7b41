"""Processes that end with whoever started them."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from ugat_marl.simulation.channel import Message
from ugat_marl.simulation.worker import _answered

START = "from ugat_marl.simulation.worker import exit_when_input_ends; exit_when_input_ends(); "


def started(program: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", START + program]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)


def test_a_process_whose_work_is_done_ends_in_order_though_its_input_is_open() -> None:
    process = started("import time; time.sleep(0.2)")
    assert process.stderr is not None
    assert (process.wait(60), process.stderr.read()) == (0, b"")


def test_a_process_ends_with_its_input() -> None:
    process = started("import time; time.sleep(600)")
    process.communicate(timeout=60)
    assert process.returncode == 1


@pytest.mark.parametrize("redirected", ["</dev/null", "<&-"])
def test_a_command_without_an_input_is_not_ended(redirected: str) -> None:
    """As under nohup or cron."""
    program = START + "import time; time.sleep(0.5); print('done')"
    command = f'exec "$0" -c "$1" {redirected}'
    done = subprocess.run(
        ["sh", "-c", command, sys.executable, program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


def test_a_full_memory_is_told_as_what_it_is() -> None:
    def full(question: Message) -> Message:
        raise MemoryError

    said = _answered(full, Message({"what": "advance"}, [])).header
    assert said["kinds"] == ["SimulatorError"]
    assert re.match(r"it needs more memory than a simulation may use \(.* GB\)", said["error"])
