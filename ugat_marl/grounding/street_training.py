"""Training in a fitted street: each episode in a world that the log of the street leaves possible.

    Input: policy pi, prior of worlds

     1  pre-train pi for M episodes in E_sim
     2  for i = 1, ..., I:
     3      roll pi out in E_real, add the transitions to D_real
     4      fit the street to D_real (`street`)
     5      for e = 1, ..., E episodes: draw a world of the street, update pi in it

If commands are late or lost, the policy needs to see its own last commands, which the pre-trained
one does not. If detectors are at fault, the numbers that it learnt to read mean something else. A
new policy then begins in the fitted street, with M episodes more.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from pathlib import Path

from ugat_marl.data import TransitionLog
from ugat_marl.grounding.algorithm import Algorithm, iteration_name
from ugat_marl.grounding.posterior import Worlds
from ugat_marl.grounding.state import RunState
from ugat_marl.grounding.street import (
    FittedStreet,
    Known,
    Simulation,
    episodes_of_fit,
    fit_street,
    street_env,
)
from ugat_marl.grounding.summaries import LaneView
from ugat_marl.policies import LearnerFactory, Policy
from ugat_marl.seeding import derive_seed


@dataclass
class StreetFit:
    """A fitted street, as a part of a checkpoint.

    Attributes:
        worlds: Prior of worlds.
        street: The street; None before the first fit.
        known: Results of earlier fits.
    """

    worlds: Worlds
    street: FittedStreet | None = None
    known: Known = field(default_factory=Known)

    @property
    def view(self) -> tuple[int, bool]:
        """Number of own commands that a policy sees, and True if detectors are at fault."""
        if self.street is None:
            return 0, False
        eyes = self.street.eyes
        return self.street.commands, eyes is not None and eyes.changes

    def save(self, path: Path) -> None:
        """Write the street to a file; nothing before the first fit."""
        if self.street is not None:
            self.street.save(path, self.known.simulated)

    def load(self, path: Path) -> None:
        """Restore a file of `save`; without one, nothing was fitted.

        Raises:
            CheckpointError: The file is unreadable, or of another network.
        """
        if path.exists():
            self.street, self.known = FittedStreet.load(path, self.worlds)


@dataclass(frozen=True, kw_only=True)
class StreetTraining(Algorithm):
    """Training in a fitted street.

    Attributes:
        simulation: The simulation in which worlds are drawn.
        make: Makes the learner.
        view: Lanes of the network.
    """

    simulation: Simulation
    make: LearnerFactory
    view: LaneView

    def train(self, state: RunState[StreetFit]) -> Policy:
        """Run the algorithm to its end.

        Args:
            state: A fresh state, or one restored from a checkpoint.

        Returns:
            The policy after the last iteration.
        """
        self._pretrain(state)  # line 1
        while state.iteration < self.config.iterations:  # line 2
            policy = state.learner.policy()
            self._roll_out(state, policy)  # line 3
            before = state.transform.view
            street = self._fit(state, policy)  # line 4
            episodes = self.config.grounded_episodes
            if state.transform.view != before:
                self.renew(state)
                episodes += self.config.pretrain_episodes
            title = f"fitted street, {iteration_name(state)}"
            env = street_env(street, self.simulation, street.commands)
            with contextlib.closing(env):
                self._learn(state, env, episodes, title)  # line 5
            numbers = street.as_dict()
            if self.probe is not None:
                numbers |= self.probe(state.learner.policy())
            self.run.log("iteration", state.iteration + 1, numbers)
            state.iteration += 1
            state.save(self.run)
        return state.learner.policy()

    def renew(self, state: RunState[StreetFit]) -> None:
        """Replace the learner by a new one, if policies see something else in the street."""
        commands, faulty = state.transform.view
        if commands or faulty:
            with contextlib.closing(self.simulation.plain(commands)) as env:
                state.learner = self.make(env, self.seed)

    def _roll_out(self, state: RunState[StreetFit], policy: Policy) -> None:
        """Roll the policy out on the street (line 3)."""
        with self.run.reporter.task(f"roll-outs, {iteration_name(state)}", 1) as advance:
            log = self.real.collect(policy, state.iteration, self.seed)
            if log is not None:
                state.real.append(log)
            advance()

    def _fit(self, state: RunState[StreetFit], policy: Policy) -> FittedStreet:
        """Fit the street to D_real, and say what was found (line 4)."""
        config, known = self.config.street, state.transform.known
        number = episodes_of_fit(config, known)
        with self.run.reporter.task(f"fitting, {iteration_name(state)}", number) as advance:
            street, state.transform.known = fit_street(
                TransitionLog.concatenate(state.real),
                self.simulation,
                policy,
                state.transform.worlds,
                self.view,
                config,
                derive_seed(self.seed, "fit", state.iteration),
                advance,
                known,
            )
        state.transform.street = street
        for line in street.describe():
            self.run.reporter.say(f"{iteration_name(state)}: {line}")
        return street
