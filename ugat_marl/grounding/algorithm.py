"""Base of the algorithms that train across a gap: plain training, learning with checkpoints."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from ugat_marl.data import Run
from ugat_marl.envs import AnyParallelEnv
from ugat_marl.grounding.config import UgatConfig
from ugat_marl.grounding.gate import Gate
from ugat_marl.grounding.state import RunState, is_kept
from ugat_marl.grounding.worlds import TransitionSource
from ugat_marl.policies import Learner, Policy, attended, has_first_lessons

CHECKPOINT_EPISODES = 10
"""Episodes of plain training between two checkpoints."""

DIRECT_LEARNER = "direct-learner.pt"
"""File of the learner after plain training, in the run's folder; controls start from it."""

Probe = Callable[[Policy], Mapping[str, float]]
"""Measurement of a policy between iterations; the numbers are only logged."""


@dataclass(frozen=True, kw_only=True)
class Algorithm:
    """Training of a policy in a simulation, for a real domain.

    Attributes:
        env: E_sim for the training.
        real: E_real, or a log of it, for the roll-outs of D_real.
        config: Settings.
        seed: Root of every random choice.
        run: Folder of metrics and checkpoints.
        probe: Measurement of the policy after every iteration.
    """

    env: AnyParallelEnv
    real: TransitionSource
    config: UgatConfig
    seed: int
    run: Run
    probe: Probe | None = None

    def _pretrain(self, state: RunState[Any]) -> None:
        """Train in plain E_sim for M episodes; keep the policy as direct transfer (line 1)."""
        wanted = self.config.pretrain_episodes
        if state.pretrained == 0 < wanted and has_first_lessons(state.learner):
            self._attend(state.learner, self.env, "plain sim")
        while state.pretrained < wanted:
            episodes = min(CHECKPOINT_EPISODES, wanted - state.pretrained)
            numbers = f"{state.pretrained + 1}-{state.pretrained + episodes}"
            self._learn(state.learner, self.env, episodes, f"plain sim, episode {numbers}")
            state.pretrained += episodes
            if state.pretrained < wanted:
                state.save(self.run)
        if state.direct is None:
            state.direct = state.learner.policy()
            if is_kept(state.learner):
                state.learner.save(self.run.directory / DIRECT_LEARNER)
            if self.probe is not None:
                self.run.log("iteration", 0, self.probe(state.direct))
            state.save(self.run)

    def _attend(
        self,
        learner: Learner,
        env: AnyParallelEnv,
        title: str,
        best: str | None = None,
        gate: Gate | None = None,
    ) -> Policy | None:
        """Let the learner watch the rule that is good in an environment, if it has a teacher.

        Args:
            learner: The learner.
            env: The environment.
            title: Name of the environment in messages.
            best: The best rule there, if it is known.
            gate: Gate of the environment, if it has one; lessons do not count there.

        Returns:
            The policy after the lessons; None without a teacher.
        """
        reporter = self.run.reporter
        with contextlib.nullcontext() if gate is None else gate.uncounted():
            name = attended(learner, env, self.seed, reporter, f"lessons, {title}", best)
        if name is None:
            return None
        reporter.say(f"{title}: {name} teaches")
        return learner.policy()

    def _learn(
        self,
        learner: Learner,
        env: AnyParallelEnv,
        episodes: int,
        title: str,
        stage: str = "episode",
        earlier: int = 0,
    ) -> None:
        """Let the learner train in an environment; log every episode.

        Args:
            learner: The learner.
            env: The environment.
            episodes: Number of episodes.
            title: Name of the progress bar.
            stage: Stage of the metrics.
            earlier: Episodes in this stage before the learner's first one.
        """
        with self.run.reporter.task(title, episodes) as advance:

            def on_episode(number: int, numbers: Mapping[str, float]) -> None:
                self.run.log(stage, earlier + number, numbers)
                advance(note=f"return {numbers['return']:.0f}" if "return" in numbers else "")

            learner.learn(env, episodes, self.seed, on_episode)


def iteration_name(state: RunState[Any]) -> str:
    """Return the name of the current iteration, for progress bars."""
    return f"iteration {state.iteration + 1}"
