"""Uncertainty-aware Grounded Action Transformation (UGAT), network-wide: Algorithm 1 of the paper.

Da, Mei, Sharma, Wei: Uncertainty-aware Grounded Action Transformation towards Sim-to-Real Transfer
for Traffic Signal Control, CDC 2023.

    Input: policy pi, forward model f, inverse model h, data D_real and D_sim, threshold alpha

     1  pre-train pi for M episodes in E_sim
     2  for i = 1, ..., I:
     3      roll pi out in E_sim, add the transitions to D_sim
     4      roll pi out in E_real, add the transitions to D_real
     5      update f with D_real
     6      update h with D_sim
     7      reset the list U of uncertainties
     8      for e = 1, ..., E episodes:
     9          for each step t:
    10              a_t = pi(s_t)
    11              s'_(t+1) = f(s_t, a_t)                  the next state in E_real
    12              a'_t, u_t = h(s'_(t+1), s_t)            the action that leads to it in E_sim
    13              if u_t >= alpha: a'_t = a_t             reject
    14              execute a'_t in E_sim
    15              append u_t to U
    16              update pi
    17      alpha = mean of U

The comments below give these line numbers. The learner does lines 8 and 16. The environment it
trains in (`wrappers.GroundedEnv`) does lines 9 to 15; it asks the transform (`phase`, `timed`) and
its gate.

The default options differ from the listing; the values named here restore it. `config.as_published`
sets all of them, and the numbers of the paper (docs/explanation/departures.md).

- Roll-outs take random phases now and then (lines 3 and 4): `rollout_epsilon` 0.
- h is also trained to be unsure far from its data (line 6): `fit.off_data_weight` 0.
- s' holds the traffic without the phase (lines 11 and 12): `forward.include_phase` and
  `inverse.include_phase` True.
- U keeps the last 20 episodes, also those of earlier iterations (line 7): `gate.window_epochs` E.
- Every intersection has its own alpha (line 17): `gate.scope` "pooled".
- Actions of an intersection are grounded only if f and h are better there than trivial answers,
  such as "no change" or the most frequent phase (line 13): `least_accuracy` None.

Alpha, an input of the listing, begins at infinity: the first iteration takes every grounded action.
D_real may also be a log that was recorded earlier (line 4).
"""

from __future__ import annotations

import concurrent.futures
from dataclasses import dataclass

import numpy as np
import torch

from ugat_marl.data import TransitionLog
from ugat_marl.errors import OptionError
from ugat_marl.grounding.algorithm import Algorithm, iteration_name
from ugat_marl.grounding.delays import EpisodeRewards, episode_rewards
from ugat_marl.grounding.fitting import Fitter
from ugat_marl.grounding.gate import GateReport
from ugat_marl.grounding.reports import FitReport
from ugat_marl.grounding.state import RunState
from ugat_marl.grounding.transform import Transform
from ugat_marl.grounding.worlds import SimulatedWorld, TransitionSource
from ugat_marl.grounding.wrappers import GroundedEnv
from ugat_marl.policies import Policy, device_of
from ugat_marl.seeding import derive_seed


@dataclass(frozen=True, kw_only=True)
class Ugat(Algorithm):
    """Algorithm 1 on one network.

    Attributes:
        sim: E_sim for the roll-outs of D_sim.
        device: Device for the fit of f and h (`policies.device_of`); the learner has its own.
    """

    sim: SimulatedWorld
    device: str = "cpu"

    def train(self, state: RunState[Transform]) -> Policy:
        """Run Algorithm 1 to its end.

        Args:
            state: A fresh state, or one restored from a checkpoint.

        Returns:
            The policy after the last iteration.

        Raises:
            OptionError: Rewards are to be matched, and the street is a log.
        """
        device = device_of(self.device)  # refuses a missing GPU before anything runs
        if self.config.matches and self.real.replay() is not None:
            raise OptionError(
                "timed match compares the rewards of one policy in both worlds, and the street's "
                "log is of another policy; leave the match or the log out"
            )
        self._pretrain(state)  # line 1
        grounded_env = GroundedEnv(self.env, state.transform)
        while state.iteration < self.config.iterations:  # line 2
            policy = state.learner.policy()
            self._roll_out(state, policy)  # lines 3 and 4
            rewards = self._rewards_under_delays(state, policy) if self.config.matches else None
            report = self._fit(state, device, rewards)  # lines 5 and 6
            self._prepare_gate(state, report)  # input alpha, line 13
            title = f"grounded, {iteration_name(state)}"
            self._attend(state.learner, grounded_env, title, gate=state.transform.gate)
            episodes = self.config.grounded_episodes
            self._learn(state.learner, grounded_env, episodes, title)  # lines 8 to 16
            gate = self._update_alpha(state)  # line 17
            self._log(state, report, gate)
            state.iteration += 1
            state.save(self.run)
        return state.learner.policy()

    def _roll_out(self, state: RunState[Transform], policy: Policy) -> None:
        """Roll the policy out in both worlds at the same time (lines 3 and 4)."""
        worlds: tuple[TransitionSource, TransitionSource] = (self.sim, self.real)
        with (
            self.run.reporter.task(f"roll-outs, {iteration_name(state)}", len(worlds)) as advance,
            concurrent.futures.ThreadPoolExecutor(len(worlds)) as pool,
        ):
            running = [
                pool.submit(world.collect, policy, state.iteration, self.seed) for world in worlds
            ]
            left, first = set(running), concurrent.futures.FIRST_EXCEPTION
            try:
                while left:  # a timeout lets Ctrl-C interrupt the wait
                    done, left = concurrent.futures.wait(left, timeout=0.2, return_when=first)
                    for future in done:
                        future.result()  # a failed roll-out ends the other one
            except BaseException:
                while concurrent.futures.wait(running, timeout=0.2).not_done:
                    for world in worlds:  # repeated, because a roll-out may begin only now
                        world.stop()
                raise
            for future, data in zip(running, (state.simulated, state.real), strict=True):
                log = future.result()
                if log is not None:
                    data.append(log)
                advance()

    def _rewards_under_delays(self, state: RunState[Transform], policy: Policy) -> EpisodeRewards:
        """Run the policy in E_sim under each delay; return its rewards there and in E_real.

        Only timed grounding with matched rewards needs this; it is not part of Algorithm 1.
        """
        agents = state.transform.stack.agents
        number = self.sim.roll_outs_under_delays
        with self.run.reporter.task(f"under delays, {iteration_name(state)}", number) as advance:
            logs = self.sim.under_delays(policy, state.iteration, self.seed, advance)
        *earlier, latest = [episode_rewards(log, agents) for log in state.real]
        simulated = np.array([episode_rewards(log, agents) for log in logs])
        return EpisodeRewards(latest, simulated, earlier)

    def _fit(
        self, state: RunState[Transform], device: torch.device, rewards: EpisodeRewards | None
    ) -> FitReport:
        """Update f with D_real and h with D_sim (lines 5 and 6); print warnings of the fit."""
        d_real, d_sim = map(TransitionLog.concatenate, (state.real, state.simulated))
        config, seed = self.config.fit, derive_seed(self.seed, "fit", state.iteration)
        most_epochs = 3 * config.epochs  # f, a model of the simulation, and h
        title = f"fitting f and h, {iteration_name(state)}"
        with self.run.reporter.task(title, most_epochs) as advance:

            def on_epoch(model: str, _epoch: int, loss: float) -> None:
                advance(note=f"{model} {loss:.2g}")

            fitter = Fitter(config, seed, on_epoch, device)
            report = state.transform.fit(d_real, d_sim, fitter, rewards)
        for warning in report.warnings:
            self.run.reporter.say(f"{iteration_name(state)}: {warning}")
        return report

    def _prepare_gate(self, state: RunState[Transform], report: FitReport) -> None:
        """Give the gate the trusted agents and the u to expect (the input alpha, line 13)."""
        gate = state.transform.gate
        if self.config.least_accuracy is not None:
            gate.trust(report.trusted(self.config.least_accuracy))
        gate.begin(report.expected_u)

    def _update_alpha(self, state: RunState[Transform]) -> GateReport:
        """Set alpha for the next iteration (line 17); warnings are shown beside the bars."""
        report = state.transform.gate.update()
        if report.warning:
            self.run.reporter.say(report.warning)
        return report

    def _log(self, state: RunState[Transform], report: FitReport, gate: GateReport) -> None:
        """Log the numbers of an iteration."""
        numbers = {**report.as_dict(), **{f"gate/{k}": v for k, v in gate.as_dict().items()}}
        if self.probe is not None:
            numbers |= self.probe(state.learner.policy())
        self.run.log("iteration", state.iteration + 1, numbers)
