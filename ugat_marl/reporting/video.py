"""Episodes as videos: one frame per second of traffic, several policies side by side."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import itertools
import math
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ugat_marl.envs import NetworkRenderer, TrafficEnv
from ugat_marl.errors import OptionError, OutputError, install_command
from ugat_marl.files import replacing
from ugat_marl.parallel import DEADLINE_VARIABLE, usual_deadline_s
from ugat_marl.policies import Policy, RollOutStopped, roll_out
from ugat_marl.simulation import (
    HALTING_MPS,
    Launch,
    ProcessSimulator,
    SignalPlans,
    Simulator,
    Snapshot,
    Trips,
    VehiclePositions,
    refuse_in_queues,
)

if TYPE_CHECKING:
    from PIL import Image

Frame = NDArray[np.uint8]
_PILLOW = {".gif": "GIF", ".webp": "WEBP"}
_FFMPEG = {".mp4": "mp4", ".mkv": "matroska", ".mov": "mov"}
_CAPTION_PX = 46
_GIF_PER_S = 50
_MOMENT_S = 1e-6
"""Largest difference of two equal times, s."""
_WIDE = 1.6
"""Ratio of width to height above which pictures stand below each other, not side by side."""


@dataclass(frozen=True)
class Scene:
    """One instant of an episode.

    Attributes:
        time_s: Time on the scenario's clock, s.
        vehicles: Positions and speeds of all vehicles.
        states: Traffic light to the state that it shows.
    """

    time_s: float
    vehicles: VehiclePositions
    states: dict[str, str]


@dataclass(frozen=True)
class Film:
    """A filmed episode with its caption.

    Attributes:
        title: Name of the policy.
        domain: Name of the domain.
        env: Environment whose network is drawn.
        scenes: One scene per second.
    """

    title: str
    domain: str
    env: TrafficEnv
    scenes: Sequence[Scene]


class Filmed:
    """A simulator that keeps a scene of every second in one stretch of the episode.

    Args:
        inner: Simulator that does the work.
        begin_s: Start of the stretch, in s from the beginning of the episode.
        end_s: End of the stretch, in s from the beginning of the episode.
    """

    def __init__(self, inner: Simulator, begin_s: float, end_s: float) -> None:
        self._inner = inner
        self._stretch = begin_s, end_s
        self._start_s = self._now_s = 0.0
        self.scenes: list[Scene] = []

    def start(self, launch: Launch) -> Snapshot:
        """Start a simulation; see `Simulator`."""
        self._start_s = self._now_s = launch.begin_s
        self.scenes = []
        return self._inner.start(launch)

    def advance(
        self, seconds: float, plans: SignalPlans, meanwhile: Callable[[], object] | None = None
    ) -> Snapshot:
        """Simulate `seconds`: in one call outside of the stretch, second by second inside.

        See `Simulator`.
        """
        begin_s, end_s = (self._start_s + edge for edge in self._stretch)
        if self._now_s + seconds <= begin_s or self._now_s >= end_s:
            self._now_s += seconds
            return self._inner.advance(seconds, plans, meanwhile)
        done = 0.0
        while True:
            passed = self._now_s - self._start_s
            whole = math.floor(passed + _MOMENT_S) + 1.0 - passed  # until the next whole second
            length = min(whole, seconds - done)
            plan = between(plans, done, done + length)
            snapshot = self._inner.advance(length, plan, None if done else meanwhile)
            done += length
            self._now_s += length
            is_whole = abs(length - whole) < _MOMENT_S
            if is_whole and begin_s < self._now_s <= end_s + _MOMENT_S:
                self.scenes.append(Scene(self._now_s, self.vehicles(), self.signals()))
            if done >= seconds - _MOMENT_S:
                return snapshot

    def vehicles(self) -> VehiclePositions:
        """See `Simulator`."""
        return self._inner.vehicles()

    def signals(self) -> dict[str, str]:
        """See `Simulator`."""
        return self._inner.signals()

    def finish(self) -> Trips:
        """See `Simulator`."""
        return self._inner.finish()

    def close(self) -> None:
        """See `Simulator`."""
        self._inner.close()


def between(plans: SignalPlans, begin_s: float, end_s: float) -> dict[str, list[tuple[float, str]]]:
    """Return the part of signal plans between two times, in s from the beginning of the plans."""
    parts: dict[str, list[tuple[float, str]]] = {}
    for tls, segments in plans.items():
        start, shown_states = 0.0, list[tuple[float, str]]()
        for duration, state in segments:
            shown = min(start + duration, end_s) - max(start, begin_s)
            if shown > 0:
                shown_states.append((shown, state))
            start += duration
        if shown_states:
            parts[tls] = shown_states
    return parts


def film_episode(
    env: TrafficEnv, policy: Policy, seed: int, begin_s: float, length_s: float, title: str
) -> Film:
    """Play an episode up to the end of a stretch and keep a scene of every second in it.

    Args:
        env: An environment made with the policy's `env_options`, not yet reset.
        policy: Policy that acts.
        seed: Seed of the episode.
        begin_s: Start of the stretch, in s from the beginning of the episode.
        length_s: Length of the stretch, s.
        title: Name of the policy in the caption.

    Raises:
        OptionError: The stretch does not lie within the episode, or is shorter than 1 s. Or the
            scenario has SUMO's mesoscopic model, in which vehicles have no positions.
    """
    refuse_in_queues(env.scenario, pictures=True)
    duration_s = env.scenario.decisions * env.decision_interval_s
    if begin_s < 0 or length_s < 1 or begin_s + length_s > duration_s:
        raise OptionError(
            f"a video of {length_s:g} s from second {begin_s:g} on: the episode has "
            f"{duration_s:g} s; choose a shorter or earlier stretch"
        )
    filmed = Filmed(ProcessSimulator(), begin_s, begin_s + length_s)
    env.simulate_with(filmed)

    def on_step(step: int) -> None:
        if step * env.decision_interval_s >= begin_s + length_s:
            raise RollOutStopped

    with contextlib.suppress(RollOutStopped):
        roll_out(env, policy, seed, on_step=on_step)
    return Film(title, env.domain, env, filmed.scenes)


def film_frames(films: Sequence[Film], size_px: int) -> Iterator[Frame]:
    """Yield the frames of one film, or of several films in one picture.

    Films of wide networks stand below each other, other films side by side.

    Args:
        films: Films of the same stretch of the same network.
        size_px: Longer side of each picture, in pixels.
    """
    pictures = [
        NetworkRenderer(each.env.network, each.env.intersection_of, size_px) for each in films
    ]
    write = _Captions()
    for scenes in zip(*(each.scenes for each in films), strict=True):
        shown: list[Frame] = []
        for each, picture, scene in zip(films, pictures, scenes, strict=True):
            picture.draw(scene.vehicles, scene.states)
            shown.append(write(picture.pixels(), each, scene))
        wide = shown[0].shape[1] > _WIDE * shown[0].shape[0]
        yield np.concatenate(shown, axis=0 if wide else 1)


def require_video(path: Path) -> None:
    """Refuse the name of a file that cannot become a video on this machine.

    Raises:
        OptionError: The ending is unknown, or it needs ffmpeg and there is none.
    """
    ending = path.suffix.lower()
    if ending not in (*_PILLOW, *_FFMPEG):
        known = ", ".join([*_FFMPEG, *_PILLOW])
        raise OptionError(f"{path}: a video's name ends in one of {known}, not {ending!r}")
    if ending in _FFMPEG and _ffmpeg() is None:
        other = path.with_suffix(".gif").name
        raise OptionError(
            f"{path}: {ending} needs ffmpeg, which is not here; {install_command('video')} brings "
            f"it, or write {other}, which needs nothing"
        )


def write_video(pictures: Iterable[Frame], path: Path, per_second: float) -> None:
    """Write frames of one size as a video atomically.

    Args:
        pictures: Frames, uint8 ``(height, width, 3)``; height and width are even.
        path: File to write. Its ending decides the format: .mp4, .mkv and .mov are made by ffmpeg,
            .gif and .webp by Pillow.
        per_second: Frames per second.

    Raises:
        OptionError: See `require_video`.
        OutputError: ffmpeg failed; the message holds its own error text.
    """
    require_video(path)
    with replacing(path) as temporary:
        if path.suffix.lower() in _PILLOW:
            _by_pillow(pictures, temporary, _PILLOW[path.suffix.lower()], per_second)
        else:
            form = _FFMPEG[path.suffix.lower()]
            _by_ffmpeg(pictures, temporary, form, per_second, path.name)


class _Captions:
    """Write above each picture the policy, the domain, the time and the number of vehicles."""

    def __init__(self) -> None:
        import matplotlib as mpl
        from PIL import ImageFont

        fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
        self._bold = ImageFont.truetype(str(fonts / "DejaVuSans-Bold.ttf"), 16)
        self._plain = ImageFont.truetype(str(fonts / "DejaVuSans.ttf"), 13)

    def __call__(self, picture: Frame, film: Film, scene: Scene) -> Frame:
        from PIL import Image, ImageDraw

        band = Image.new("RGB", (picture.shape[1], _CAPTION_PX), "white")
        draw = ImageDraw.Draw(band)
        clock = f"{int(scene.time_s) // 3600}:{int(scene.time_s) // 60 % 60:02}"
        clock += f":{int(scene.time_s) % 60:02}"
        standing = int((scene.vehicles.speed_mps < HALTING_MPS).sum())
        numbers = f"{len(scene.vehicles.speed_mps)} vehicles, {standing} standing"
        draw.text((12, 6), film.title, font=self._bold, fill="#1b2430")
        text = f"{film.domain} · {clock} · {numbers}"
        draw.text((12, 27), text, font=self._plain, fill="#5a6675")
        return np.concatenate([np.asarray(band), picture])


def _by_pillow(pictures: Iterable[Frame], path: Path, form: str, per_second: float) -> None:
    from PIL import Image

    duration: dict[str, int] = {"duration": round(1000 / per_second)}
    images = (Image.fromarray(picture) for picture in pictures)
    if form == "GIF":
        images, duration = _timed(images, per_second), {}
    first = next(images)
    first.save(path, format=form, save_all=True, append_images=images, loop=0, **duration)


def _timed(images: Iterable[Image.Image], per_second: float) -> Iterator[Image.Image]:
    """Yield pictures of a GIF, which counts in 10 ms; players show each for 20 ms or longer."""
    from PIL import Image

    every = math.ceil(per_second / _GIF_PER_S)
    shown = 0
    for number, image in enumerate(itertools.islice(images, 0, None, every), 1):
        # the pictures have few colours; dithering would make them flicker
        picture = image.quantize(256, dither=Image.Dither.NONE)
        ended = 10 * round(100 * number * every / per_second)
        picture.info["duration"], shown = ended - shown, ended
        yield picture


def _by_ffmpeg(
    pictures: Iterable[Frame], path: Path, form: str, per_second: float, name: str
) -> None:
    """Write a video to a temporary file; errors name the file `name`, which the user gave."""
    program = _ffmpeg()
    assert program is not None
    stream = iter(pictures)
    first = next(stream)
    height, width = first.shape[:2]
    command = [
        program, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s",
        f"{width}x{height}", "-r", f"{per_second:g}", "-i", "-", "-an", "-pix_fmt", "yuv420p",
        "-crf", "20", "-f", form, str(path),
    ]  # fmt: skip
    deadline_s = usual_deadline_s()
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    into, said = process.stdin, process.stderr
    assert into is not None
    assert said is not None
    killed = threading.Event()

    def kill() -> None:
        killed.set()
        process.kill()

    def write(picture: Frame) -> None:  # the making of a picture does not count
        with _at_most(deadline_s, kill):
            into.write(picture.tobytes())

    try:
        with contextlib.suppress(BrokenPipeError):  # it has ended; its error text is read below
            write(first)
            for picture in stream:
                write(picture)
        with _at_most(deadline_s, kill):
            with contextlib.suppress(BrokenPipeError):
                into.close()
            words = said.read().decode(errors="replace")
            status = process.wait()
    except BaseException:
        process.kill()
        process.wait()
        raise
    if killed.is_set():
        raise OutputError(
            f"{name}: ffmpeg did not go on for {deadline_s:g} s and was killed (stopped, or "
            f"too slow for these pictures: set {DEADLINE_VARIABLE})"
        )
    if status:
        raise OutputError(f"{name}: ffmpeg failed: {' '.join(words.split())[-300:]}")


@contextlib.contextmanager
def _at_most(seconds: float, too_late: Callable[[], object]) -> Iterator[None]:
    """Call a function if the block takes longer."""
    timer = threading.Timer(seconds, too_late)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _ffmpeg() -> str | None:
    """Return the ffmpeg of the package imageio-ffmpeg, or the system's own; None for none."""
    if importlib.util.find_spec("imageio_ffmpeg") is not None:
        module: Any = importlib.import_module("imageio_ffmpeg")
        with contextlib.suppress(RuntimeError):  # the package has no program for this system
            return str(module.get_ffmpeg_exe())
    return shutil.which("ffmpeg")
