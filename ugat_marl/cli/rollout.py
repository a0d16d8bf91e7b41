"""``ugat-marl rollout``: record transitions of a policy in a domain, or film an episode."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.cli.arguments import (
    LengthS,
    RayAddress,
    Workers,
    refuse_options,
    require_numbers,
    workers_of,
)
from ugat_marl.cli.evaluate import names_of
from ugat_marl.data import require_log_place
from ugat_marl.effects import domain_label, load_scenario
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.experiments import policy_factory
from ugat_marl.files import require_writable
from ugat_marl.grounding import RollOutSettings, roll_outs
from ugat_marl.progress import Bars
from ugat_marl.reporting import Film, Frame, film_episode, film_frames, require_video, write_video
from ugat_marl.scenarios import Scenario
from ugat_marl.seeding import derive_seed

_RECORDED = (
    "episodes", "epsilon", "observation", "neighbours", "crossings", "workers", "ray",
)  # fmt: skip
"""Options of the recording alone."""


@dataclass(frozen=True)
class VideoConfig:
    """Part of an episode to film, and the form of the video.

    Attributes:
        from_s: Start of the film, in s from the start of the episode.
        length_s: Length of the film, in s of traffic.
        speed: Seconds of traffic per second of video. Each frame is one second of traffic.
        size: Longer side of the picture of a network, in pixels.
    """

    from_s: float = 600.0
    length_s: float = 300.0
    speed: int = 10
    size: int = 800

    def __post_init__(self) -> None:
        for name in ("from_s", "length_s"):
            if not math.isfinite(getattr(self, name)):
                raise OptionError(f"film.{name} = {getattr(self, name)}: must be a finite number")
        if not 1 <= self.speed <= 100:
            raise OptionError(f"film.speed = {self.speed}: must be from 1 to 100")
        if not 200 <= self.size <= 4000:
            raise OptionError(f"film.size = {self.size}: must be from 200 to 4000")


@dataclass(frozen=True)
class Rollout:
    """Record transitions (for example for `train --real-log`), or film an episode.

    Examples:
        ugat-marl rollout single-v1 --domain V4 --policy largest-queue:20 --out v4.parquet
        ugat-marl rollout grid4x4-v1 --domain V4 --policy max-pressure:20 --video out.mp4
        ugat-marl rollout grid2x2-v1 --domain V4 --policy runs/first/policies/direct-transfer.pt
        --beside runs/first/policies/fitted-street.pt --video before-after.gif

    Attributes:
        scenario: Id of a shipped scenario, directory, .sumocfg or resco:<map>.
        out: Parquet file to write.
        policy: A rule or the file of a trained policy.
        domain: Domain to record in.
        episodes: Number of episodes.
        seed: Root of the episodes' seeds.
        epsilon: Chance of a random phase. The log then also holds actions that the policy would not
            take.
        observation: Observation to record: movements, count, queue, pressure, waiting, density. The
            learner universal reads movements by default.
        neighbours: Agents also observe intersections up to this many roads away.
        duration_s: Length of an episode in s.
        crossings: Also record when vehicles cross the stop lines, which groundings of greens read.
        workers: Simulations at a time.
        ray: Record on Ray instead.
        video: Video to write: .mp4 (needs ffmpeg: pip install imageio-ffmpeg), .webp or .gif
            (need nothing). It shows a separate episode without random phases.
        beside: A second policy, filmed beside the first with the same seed.
        film: Part of the episode to film.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    out: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: nothing is recorded)")
    ] = None
    policy: str = "largest-queue:20"
    domain: str = "sim"
    episodes: int = 3
    seed: int = 0
    epsilon: float = 0.3
    observation: str = "movements"
    neighbours: int = 0
    duration_s: LengthS = None
    crossings: bool = True
    workers: Workers = None
    ray: RayAddress = None
    video: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: nothing is filmed)")
    ] = None
    beside: Annotated[str | None, arg(metavar="POLICY", help_behavior_hint="(default: none)")] = (
        None
    )
    film: VideoConfig = field(default_factory=VideoConfig)

    def run(self, console: Console) -> int:
        """Record, film and write."""
        require_numbers(1, episodes=self.episodes, workers=self.workers)
        require_numbers(0, seed=self.seed)
        if not 0 <= self.epsilon <= 1:
            raise OptionError(f"--epsilon {self.epsilon}: must be from 0 to 1")
        if self.out is None and self.video is None:
            raise OptionError("nothing to write: give --out FILE.parquet, --video FILE, or both")
        if self.beside is not None and self.video is None:
            raise OptionError("--beside needs --video, which shows both policies")
        if self.out is None:
            refuse_options(self, _RECORDED, "without --out nothing is recorded")
        if self.video is None:
            refuse_options(self, ("film",), "without --video nothing is filmed")
        if self.out is not None:
            require_log_place(self.out)
        if self.video is not None:
            require_writable(self.video)
            require_video(self.video)
        scenario = load_scenario(self.scenario, self.duration_s)
        if self.video is not None:  # first, as it shows its own faults sooner
            self._film(scenario, self.video, console)
        if self.out is not None:
            self._record(scenario, self.out, console)
        return 0

    def _record(self, scenario: Scenario, out: Path, console: Console) -> None:
        options = {"duration_s": self.duration_s, "crossings": self.crossings}
        make = policy_factory(self.policy)
        each = RollOutSettings(
            scenario, self.domain, options, make, self.epsilon, self.observation, self.neighbours
        )
        seeds = [derive_seed(self.seed, "rollout", episode) for episode in range(self.episodes)]
        title = f"{self.policy} in {domain_label(self.domain)}"
        with workers_of(self.workers, self.ray) as workers:
            log, _ = roll_outs(each, seeds, workers=workers, reporter=Bars(console), title=title)
        log.write(out)
        console.print(f"{len(log)} transitions: {out}", soft_wrap=True)

    def _film(self, scenario: Scenario, video: Path, console: Console) -> None:
        specs = [self.policy, *([self.beside] if self.beside is not None else [])]
        names = names_of(specs) if len(set(specs)) > 1 else specs
        films: list[Film] = []
        with Bars(console).task(f"filming in {self.domain}", len(specs)) as advance:
            for spec, name in zip(specs, names, strict=True):
                films.append(self._filmed(scenario, spec, name))
                advance()
        count = len(films[0].scenes)
        with Bars(console).task(f"writing {video.name}", count) as advance:

            def counted() -> Iterator[Frame]:
                for picture in film_frames(films, self.film.size):
                    yield picture
                    advance()

            write_video(counted(), video, self.film.speed)
        console.print(
            f"{count} s of traffic in {count / self.film.speed:.0f} s of video: {video}",
            soft_wrap=True,
        )

    def _filmed(self, scenario: Scenario, spec: str, name: str) -> Film:
        probe = parallel_env(scenario, self.domain, duration_s=self.duration_s)
        policy = policy_factory(spec)(probe)
        options: dict[str, Any] = {"duration_s": self.duration_s, **policy.env_options}
        env = parallel_env(scenario, self.domain, **options)
        seed = derive_seed(self.seed, "rollout", 0)
        try:
            return film_episode(env, policy, seed, self.film.from_s, self.film.length_s, name)
        finally:
            env.close()
