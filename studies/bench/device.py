"""``bench device``: find the number of intersections from which on a GPU is faster."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from studies.bench.fresh_process import in_fresh_process
from studies.bench.report import Report, Spread, require_positive
from ugat_marl.errors import OptionError
from ugat_marl.policies import device_of
from ugat_marl.progress import Reporter, Silent

_PROGRAM = ["-m", "studies.bench.device_program"]


@dataclass(frozen=True)
class DeviceBench:
    """Time updates of DQN and fits of f and h on the CPU and on a GPU.

    Observations, transitions and the learner's rewards are random; nothing is simulated. Every
    round measures each size on the CPU and directly after it on the GPU. Times are wall time and
    include all transfers. The CPU computes on one thread, as in training.

    Examples:
        python -m studies.bench device --device cuda --out device.json
        python -m studies.bench device --device cuda:1 --sizes 64 256 --rounds 9

    Attributes:
        device: Device to compare with the CPU: cuda, or cuda:N.
        sizes: Numbers of intersections.
        rounds: Repetitions; medians and quartiles are over these.
        updates: Updates that are timed together.
        batch_size: Transitions per update and intersection.
        epochs: Passes over the rows in each of the three trainings of a fit.
        steps: Decisions in each of the four episodes of the log.
        seed: Seed of all random numbers.
        out: JSON file to write.
    """

    device: str = "cuda"
    sizes: tuple[int, ...] = (1, 4, 16, 64, 256)
    rounds: int = 5
    updates: int = 50
    batch_size: int = 32
    epochs: int = 10
    steps: int = 360
    seed: int = 1
    out: Path | None = None

    def __post_init__(self) -> None:
        if not self.sizes:
            raise OptionError("bench device: sizes is empty; name numbers of intersections")
        require_positive(
            "device",
            sizes=min(self.sizes),
            rounds=self.rounds,
            updates=self.updates,
            batch_size=self.batch_size,
            epochs=self.epochs,
            steps=self.steps,
        )
        if self.device == "cpu":
            raise OptionError(
                "bench device: device = 'cpu' is what it is compared with; name cuda, or cuda:N"
            )

    def run(self, reporter: Reporter | None = None) -> Report:
        """Measure size after size, and write `out`, if it is given, after each.

        Args:
            reporter: Reporter of the progress.

        Raises:
            OptionError: Torch finds no such GPU.
            MeasurementError: The measured process failed.
        """
        device_of(self.device)
        asked = {**asdict(self), "out": None}
        sizes = sorted(set(self.sizes))
        found: dict[int, dict[str, Any]] = {}
        task = (reporter or Silent()).task(f"updates and fits, cpu and {self.device}", len(sizes))
        with task as advance:
            for size in sizes:
                found[size] = in_fresh_process(
                    _PROGRAM, {**asked, "size": size}, timeout_s=6 * 3600.0
                )
                if self.out is not None:
                    compared(found, asked).write(self.out)
                advance(f"{size} intersections")
        return compared(found, asked)


def compared(found: Mapping[int, Mapping[str, Any]], settings: dict[str, Any]) -> Report:
    """Tabulate the times of both devices, and note from which size on the device is faster.

    Args:
        found: Result of `device_program.measure` for each size, in ascending order.
        settings: Options of the bench; of the sizes, those found are told.
    """
    sizes, device = list(found), settings["device"]
    settings = {**settings, "sizes": sizes}
    rows: list[dict[str, Any]] = []
    notes = [
        f"{device}: {found[sizes[0]]['name']}. Medians of {settings['rounds']} rounds, wall time."
    ]
    for what, unit in (("update of DQN", "ms"), ("fit of f and h", "s")):
        ratios: list[float] = []
        for size in sizes:
            own = found[size]["times"][what]
            ratio = Spread.of_ratios(own["cpu"], own["device"])
            ratios.append(ratio.median)
            rows.append(
                {
                    "what": f"{what} [{unit}]",
                    "intersections": size,
                    "cpu": Spread.of(own["cpu"]),
                    device: Spread.of(own["device"]),
                    f"cpu / {device}": ratio,
                }
            )
        first = pays_from(sizes, ratios)
        told = f"does not pay up to {sizes[-1]}" if first is None else f"pays from {first}"
        notes.append(f"{what}: {device} {told} intersections.")
    return Report("device", settings, rows, [], notes, by=("what",))


def pays_from(sizes: Sequence[int], ratios: Sequence[float]) -> int | None:
    """Return the smallest size from which on the device is faster; None if it never is.

    Args:
        sizes: Sizes in ascending order.
        ratios: For each size, time on the CPU / time on the other device.
    """
    first: int | None = None
    for size, ratio in zip(reversed(sizes), reversed(ratios), strict=True):
        if ratio <= 1:
            break
        first = size
    return first
