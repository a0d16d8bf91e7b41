"""Curves of a training run, in a file that TensorBoard reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

CURVES_FILE = Path("tensorboard") / "events.out.tfevents.run"


class EventFile:
    """Event file of TensorBoard that depends on the numbers of a run alone.

    TensorBoard's own writer puts the clock, the host and the process into the file and its name, so
    that a resumed run never has the file of an unbroken one. Here the step stands for the time.

    Args:
        path: The file; an earlier one is replaced.
    """

    def __init__(self, path: Path) -> None:
        # Both take a while to import, and most commands draw no curve.
        from tensorboard.compat.proto import event_pb2
        from tensorboard.summary.writer.record_writer import RecordWriter

        generated: Any = event_pb2  # its classes are made when it is imported
        self._event: Any = generated.Event
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("wb")
        self._records: Any = RecordWriter(self._file)
        self._write(self._event(wall_time=0.0, file_version="brain.Event:2"))
        self.flush()

    def add_scalar(self, tag: str, value: float, step: int) -> None:
        """Append a point to the curve named `tag`."""
        summary = {"value": [{"tag": tag, "simple_value": value}]}
        self._write(self._event(wall_time=float(step), step=step, summary=summary))

    def flush(self) -> None:
        """Make all points visible to other processes."""
        self._file.flush()

    def close(self) -> None:
        """End the file."""
        self._file.close()

    def _write(self, event: Any) -> None:
        self._records.write(event.SerializeToString())
