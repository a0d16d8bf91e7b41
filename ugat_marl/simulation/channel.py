"""Messages between a worker and its user: JSON, followed by float64 arrays.

Nothing is unpickled, so a message cannot run code.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

_LENGTHS = struct.Struct("<II")


class ChannelClosed(Exception):
    """The other end is gone."""


@dataclass(frozen=True)
class Message:
    """A JSON object and arrays.

    Attributes:
        header: The object; the channel reserves its key ``"shapes"``.
        arrays: float64 arrays of any shape.
    """

    header: dict[str, Any]
    arrays: list[NDArray[np.float64]]


class Channel:
    """One end of a two-way byte stream.

    Args:
        reader: Stream of bytes from the other end.
        writer: Stream of bytes to the other end.
        close_writer: Function that tells the other end that no more bytes will come.
    """

    def __init__(
        self, reader: BinaryIO | Any, writer: BinaryIO | Any, close_writer: Callable[[], None]
    ) -> None:
        self._reader = reader
        self._writer = writer
        self._close_writer = close_writer

    def send(self, message: Message) -> None:
        """Write one message."""
        shapes = [array.shape for array in message.arrays]
        header = json.dumps({**message.header, "shapes": shapes}).encode()
        bodies = [np.ascontiguousarray(array, dtype="<f8").tobytes() for array in message.arrays]
        body = b"".join(bodies)
        self._writer.write(_LENGTHS.pack(len(header), len(body)) + header + body)
        self._writer.flush()

    def receive(self) -> Message:
        """Wait for one message.

        Raises:
            ChannelClosed: The other end is gone.
        """
        n_header, n_body = _LENGTHS.unpack(self._exactly(_LENGTHS.size))
        header: dict[str, Any] = json.loads(self._exactly(n_header))
        body = self._exactly(n_body)
        arrays: list[NDArray[np.float64]] = []
        offset = 0
        for shape in header.pop("shapes"):
            size = math.prod(shape)
            array = np.frombuffer(body, dtype="<f8", count=size, offset=offset).reshape(shape)
            arrays.append(array)
            offset += 8 * size
        return Message(header, arrays)

    def fileno(self) -> int:
        """Return the descriptor of the stream from the other end, for `select.poll`."""
        return self._reader.fileno()

    def is_readable(self, patience_s: float) -> bool:
        """Return True if bytes, or the end of the stream, arrive within `patience_s` seconds.

        Call it only between messages, and not on Windows, which cannot wait on a pipe.
        """
        waiting = select.poll()
        waiting.register(self._reader.fileno(), select.POLLIN)
        return bool(waiting.poll(1000 * patience_s))

    def hang_up(self, patience_s: float) -> bool:
        """Close this end; return True if the other end closed within `patience_s` seconds.

        This uses no thread, because none can be started while the interpreter shuts down.
        """
        with contextlib.suppress(OSError, ValueError):
            self._writer.flush()
        with contextlib.suppress(OSError, ValueError):
            self._close_writer()
        gone = os.name == "nt" or self._closes(patience_s)  # Windows cannot wait on a pipe
        if gone:
            self._reader.close()
            with contextlib.suppress(OSError, ValueError):
                self._writer.close()
        return gone

    def _closes(self, patience_s: float) -> bool:
        """Read and discard until the other end closes."""
        deadline = time.monotonic() + patience_s
        with contextlib.suppress(OSError, ValueError):
            descriptor = self._reader.fileno()
            waiting = select.poll()  # select.select accepts no descriptor above 1023
            waiting.register(descriptor, select.POLLIN)
            while (left := deadline - time.monotonic()) > 0:
                if waiting.poll(1000 * left) and not os.read(descriptor, 65536):
                    return True
            return False
        return True

    def _exactly(self, count: int) -> bytes:
        data = self._reader.read(count)
        if data is None or len(data) < count:
            raise ChannelClosed
        return data
