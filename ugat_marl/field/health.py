"""State of the field loop for others: a file, and messages to systemd."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from ugat_marl.files import require_writable

State = Literal["looking", "driving", "ended"]
"""State of the loop: it looks for its street, it drives the lights, or it has ended."""


class Health:
    """Teller of the loop's state.

    Messages to systemd go to the socket that it names in the variable ``NOTIFY_SOCKET``. Neither a
    full disk nor a missing socket disturbs the loop.

    Args:
        path: JSON file, replaced as a whole at each call; None for no file. Its folder is made.

    Raises:
        OutputError: The file cannot be written.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        self._path = None if path is None else Path(path)
        if self._path is not None:
            require_writable(self._path)
        self._ready = False

    def tell(self, state: State, **facts: Any) -> None:
        """Write the state, the time and further facts; tell systemd that the loop is alive.

        Args:
            state: State of the loop.
            facts: Values for JSON.
        """
        if self._path is not None:
            now = datetime.now(UTC).isoformat(timespec="milliseconds")
            content = {"state": state, "written_at": now, "pid": os.getpid(), **facts}
            # One name, not a new one each time: what a killed loop leaves is used up by the next.
            temporary = self._path.with_name(f".{self._path.name}.tmp")
            with contextlib.suppress(OSError):
                temporary.parent.mkdir(parents=True, exist_ok=True)  # somebody may have removed it
                temporary.write_text(json.dumps(content, indent=1) + "\n")
                temporary.replace(self._path)
        lines = [f"STATUS={state}", "STOPPING=1" if state == "ended" else "WATCHDOG=1"]
        if state == "driving" and not self._ready:
            lines.insert(0, "READY=1")
            self._ready = True
        _notify("\n".join(lines))


def _notify(message: str) -> None:
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address or not hasattr(socket, "AF_UNIX"):
        return
    if address.startswith("@"):  # systemd's way to write an abstract address
        address = "\0" + address[1:]
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.setblocking(False)
        line.sendto(message.encode(), address)
