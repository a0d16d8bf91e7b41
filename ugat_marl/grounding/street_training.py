"""Training in a fitted street: each episode in a world that the log of the street leaves possible.

    Input: policy pi, prior of worlds

     1  pre-train pi for M episodes in E_sim
     2  for i = 1, ..., I:
     3      roll the kept policy out in E_real (at first pi), add the transitions to D_real
     4      fit the street to D_real (`street`)
     5      roll it out in worlds of the street; fit f to D_real, h to these roll-outs (`residual`)
     6      find the rule that is best in worlds of the street; watch it, if the learner has a
            teacher; for e = 1, ..., E episodes: draw a world of the street, update pi in it; where
            f is trusted, ground its actions
     7      train rivals in E_sim with late greens, which begin with pi of line 1 (`rival`)
     8      keep the best of pi, pi after the lessons, the rivals, the rule, and the policy kept so
            far, in the same worlds of the street; training goes on from pi

Line 5 is an option. Where commands are late, a grounded action would be late as well, and none is
grounded. There are no rivals then, nor where detectors are at fault.

If commands are late or lost, the policy needs to see its own last commands. If detectors are at
fault, the numbers that it learnt to read mean something else. A policy that did not see commands,
or that learnt other numbers, begins anew in the fitted street, with M episodes more.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ugat_marl.data import TransitionLog
from ugat_marl.effects import late_greens
from ugat_marl.envs import as_traffic_env
from ugat_marl.grounding.algorithm import Algorithm, iteration_name
from ugat_marl.grounding.fitting import Fitter
from ugat_marl.grounding.oversaturation import Oversaturation
from ugat_marl.grounding.policy_race import race_policies
from ugat_marl.grounding.posterior import WorldPrior
from ugat_marl.grounding.residual import Residual
from ugat_marl.grounding.rival import ROLL_OUTS, Rival, judged_as, late_world, matched_delays
from ugat_marl.grounding.state import RunState
from ugat_marl.grounding.street import (
    ENOUGH,
    RIVALS,
    FitHistory,
    FittedStreet,
    Simulation,
    episodes_of_fit,
    fit_street,
    street_env,
    street_log,
)
from ugat_marl.grounding.summaries import LaneView
from ugat_marl.policies import (
    TUNED_RULES,
    LearnerFactory,
    NamedRule,
    Policy,
    Taught,
    device_of,
    race,
    race_fields,
    rule_settings,
)
from ugat_marl.seeding import derive_seed

RESIDUAL = "residual.pt"
"""File of the residual, beside that of the street."""

JUDGED = {
    "before": "the policy kept so far",
    "after_the_lessons": "the policy after the lessons",
    "after": "the policy after training",
    **dict(judged_as(late_s) for rivals in RIVALS.values() for late_s in rivals),
    "of_the_rule": "the rule",
}
"""Metrics ``judged/<name>`` of the policies that are compared in the fitted street, in words."""


@dataclass
class StreetFit:
    """A fitted street, as a part of a checkpoint.

    Attributes:
        worlds: Prior of worlds.
        street: The street; None before the first fit.
        history: Results of earlier fits.
        residual: f, h and gate on top of the street; None without.
        rivals: Further learners, which train with late greens.
    """

    worlds: WorldPrior
    street: FittedStreet | None = None
    history: FitHistory = field(default_factory=FitHistory)
    residual: Residual | None = None
    rivals: tuple[Rival, ...] = ()

    @property
    def view(self) -> tuple[int, bool]:
        """Number of own commands that a policy sees, and True if detectors are at fault."""
        if self.street is None:
            return 0, False
        eyes = self.street.eyes
        return self.street.commands, eyes is not None and eyes.changes

    def save(self, path: Path) -> None:
        """Write the street to a file, and the rest beside it; nothing before the first fit."""
        if self.street is not None:
            self.street.save(path, self.history.simulated)
            if self.residual is not None:
                self.residual.save(path.with_name(RESIDUAL))
            for rival in self.rivals:
                rival.save(path.parent)

    def load(self, path: Path) -> None:
        """Restore a file of `save`; without one, nothing was fitted.

        Raises:
            CheckpointError: A file is unreadable, or of another network.
        """
        if path.exists():
            self.street, self.history = FittedStreet.load(path, self.worlds)
            if self.residual is not None:
                self.residual.load(path.with_name(RESIDUAL))
            for rival in self.rivals:
                rival.load(path.parent)


@dataclass(frozen=True, kw_only=True)
class StreetTraining(Algorithm):
    """Training in a fitted street.

    Attributes:
        simulation: The simulation in which worlds are drawn.
        make: Makes the learner.
        view: Lanes of the network.
        device: Device for the fit of f and h (`policies.device_of`); the learner has its own.
    """

    simulation: Simulation
    make: LearnerFactory
    view: LaneView
    device: str = "cpu"

    def train(self, state: RunState[StreetFit]) -> Policy:
        """Run the algorithm to its end.

        Args:
            state: A fresh state, or one restored from a checkpoint.

        Returns:
            The policy that is kept.
        """
        device_of(self.device)  # refuses a missing GPU before anything runs
        self._pretrain(state)  # line 1
        while state.iteration < self.config.iterations:  # line 2
            policy = state.policy()
            self._roll_out(state, policy)  # line 3
            before = state.transform.view
            street = self._fit(state, policy)  # line 4
            episodes = self.config.grounded_episodes
            if self._begins_anew(before, state.transform.view):
                state.earlier += state.learner.episodes
                self._begin(state)
                episodes += self.config.pretrain_episodes
            agents = list(state.real[0].provenance.layouts)
            numbers = street.as_dict(self.view.lanes_of(agents))
            residual = state.transform.residual
            if residual is not None:
                numbers |= self._fit_residual(state, policy, street, residual)  # line 5
            title = f"fitted street, {iteration_name(state)}"
            env = street_env(street, self.simulation, street.commands)
            with contextlib.closing(env):
                grounded = env if residual is None else residual.around(env)
                rule = self._best_rule(state, street)  # line 6
                held = residual and residual.transform.gate
                taught = self._attend(state.learner, grounded, title, rule and rule.spec, held)
                self._learn(state.learner, grounded, episodes, title, earlier=state.earlier)
            if residual is not None and residual.acts:
                gate = residual.end_iteration().as_dict()
                numbers |= {f"residual/gate/{name}": value for name, value in gate.items()}
            rivals, told = self._train_rivals(state, street, policy)  # line 7
            numbers |= told | self._keep_better(state, street, taught, rivals, rule)  # line 8
            if self.probe is not None:
                numbers |= self.probe(state.policy())
            self.run.log("iteration", state.iteration + 1, numbers)
            state.iteration += 1
            state.save(self.run)
        return state.policy()

    def _best_rule(self, state: RunState[StreetFit], street: FittedStreet) -> NamedRule | None:
        """Return the rule that is best in worlds of the street; None if rules do not race.

        All settings of all rules that read the learner's observations race. Each rung has a world
        of its own, and all rules of a rung play in that world.
        """
        learner = state.learner
        taught = isinstance(learner, Taught) and learner.plays(self.env) > 0
        budget = self.config.street.budget_of_rules(taught=taught)
        if budget == 0:
            return None
        with contextlib.closing(self.simulation.plain(0)) as env:
            specs = (spec for name in TUNED_RULES for spec in rule_settings(name, budget))
            rules = {spec: NamedRule(spec, env) for spec in specs}
            rules = {spec: rule for spec, rule in rules.items() if rule.reads(env)}
        fields = race_fields(len(rules))
        with self.run.reporter.task(f"rules, {iteration_name(state)}", sum(fields)) as advance:

            def play(rung: int, running: Sequence[str]) -> list[list[float]]:
                seed = derive_seed(self.seed, "rules", state.iteration, rung)
                playing = [rules[spec] for spec in running]
                world = [street.world(seed)]
                return self.simulation.compare(world, playing, [seed], advance).tolist()

            return rules[next(iter(race(list(rules), len(fields), play)))]

    def _train_rivals(
        self, state: RunState[StreetFit], street: FittedStreet, policy: Policy
    ) -> tuple[dict[str, Policy], dict[str, float]]:
        """Train the rivals for an iteration, with greens that are late (line 7).

        Args:
            state: The state.
            street: The fitted street.
            policy: The policy of the latest log.

        Returns:
            The rivals' policies by their names in `JUDGED`, and numbers for the metrics. There is
            no policy without rivals, where commands are late or detectors at fault, and where no
            green has to be late nor is late in the simulation.
        """
        rivals, name = state.transform.rivals, iteration_name(state)
        _, detectors_at_fault = state.transform.view
        if not rivals or street.late or detectors_at_fault:
            return {}, {}
        with self.run.reporter.task(f"under delays, {name}", ROLL_OUTS) as advance:
            seed = derive_seed(self.seed, "rival", state.iteration)
            delay_s = matched_delays(state.real[-1], self.simulation, policy, seed, advance)
        numbers = {f"rival/late_s/{agent}": late_s for agent, late_s in delay_s.items()}
        plain = as_traffic_env(self.env)
        if not any(delay_s.values()) and not late_greens(plain.scenario):
            self.run.reporter.say(f"{name}: no green has to be late, so there is no rival")
            return {}, numbers
        policies: dict[str, Policy] = {}
        for rival in rivals:
            late_s = delay_s if rival.late_s is None else dict.fromkeys(delay_s, rival.late_s)
            learner, title = rival.begin(), f"{rival.title}, {name}"
            with contextlib.closing(
                self.simulation.env(late_world(late_s, plain.intersection_of))
            ) as env:
                self._attend(learner, env, title)
                episodes, stage = self.config.grounded_episodes, f"{rival.name} episode"
                self._learn(learner, env, episodes, title, stage)
            policies[rival.judged] = learner.policy()
        return policies, numbers

    def _keep_better(
        self,
        state: RunState[StreetFit],
        street: FittedStreet,
        taught: Policy | None,
        rivals: Mapping[str, Policy],
        rule: NamedRule | None,
    ) -> dict[str, float]:
        """Compare the new policies with the kept one in worlds of the street; keep the best.

        Args:
            state: The state, with the learner after its training.
            street: The fitted street.
            taught: Policy after the lessons; None if there were none.
            rivals: Policies of the rivals, by their names in `JUDGED`.
            rule: The best rule; None if rules are left out.

        Returns:
            Average travel times in s, for the metrics.
        """
        most = self.config.street.judged
        if most == 0:
            return {}
        kept = state.best or state.direct
        assert kept is not None  # plain training comes first
        known = {
            "before": kept,
            "after_the_lessons": taught,
            "after": state.learner.policy(),
            **rivals,
            "of_the_rule": rule,
        }
        policies = {name: policy for name, policy in known.items() if policy is not None}
        title = f"comparing, {iteration_name(state)}"
        with self.run.reporter.task(title, len(policies) * most) as advance:

            def play(running: Sequence[str], numbers: range) -> NDArray[np.float64]:
                seeds = [derive_seed(self.seed, "judged", state.iteration, k) for k in numbers]
                worlds = [street.world(seed) for seed in seeds]
                playing = [policies[name] for name in running]
                return self.simulation.compare(worlds, playing, seeds, advance)

            race = race_policies(list(policies), most, play)
        state.best = policies[race.best]
        told = ", ".join(f"{JUDGED[name]} {time_s:.1f} s" for name, time_s in race.times_s.items())
        named = JUDGED[race.best]
        if rule is not None and policies[race.best] is rule:
            named += f" {rule.spec}"
        self.run.reporter.say(
            f"{iteration_name(state)}: travel time in {race.worlds} worlds of the fitted street: "
            f"{told}; {named} is kept"
        )
        judged = {f"judged/{name}": time_s for name, time_s in race.times_s.items()}
        return {**judged, "judged_worlds": race.worlds}

    def renew(self, state: RunState[StreetFit]) -> None:
        """Replace the learner of a restored run, if policies see something else in the street."""
        if self._begins_anew((0, False), state.transform.view):
            self._begin(state)

    def _begin(self, state: RunState[StreetFit]) -> None:
        """Replace the learner by a new one for what policies see in the street."""
        commands, _ = state.transform.view
        with contextlib.closing(self.simulation.plain(commands)) as env:
            state.learner = self.make(env, self.seed)

    def _begins_anew(self, before: tuple[int, bool], now: tuple[int, bool]) -> bool:
        """Return True if a policy of the view `before` is of no use with the view `now`."""
        shown = self.simulation.shown
        return (shown(before[0]), before[1]) != (shown(now[0]), now[1])

    def _roll_out(self, state: RunState[StreetFit], policy: Policy) -> None:
        """Roll the policy out on the street (line 3)."""
        with self.run.reporter.task(f"roll-outs, {iteration_name(state)}", 1) as advance:
            log = self.real.collect(policy, state.iteration, self.seed)
            if log is not None:
                state.real.append(log)
            advance()

    def _fit(self, state: RunState[StreetFit], policy: Policy) -> FittedStreet:
        """Fit the street to D_real, and say what was found (line 4)."""
        real, history = TransitionLog.concatenate(state.real), state.transform.history
        config = self.config.street.of_log(real)
        number = episodes_of_fit(config, history)
        worlds = len(history.simulated) + history.new_worlds(config)
        if config.simulates and worlds < ENOUGH:
            self.run.reporter.say(
                f"{iteration_name(state)}: {worlds} simulations in all are few, so chances are "
                f"overconfident and intervals too narrow; --street.simulations {ENOUGH} or more"
            )
        agents = list(real.provenance.layouts)
        jams = Oversaturation.of(self.view, self.view.rows(real), agents)
        for line in jams.describe():
            self.run.reporter.say(f"{iteration_name(state)}: {line}")
        simulation, acting = self._as_recorded(policy)
        with self.run.reporter.task(f"fitting, {iteration_name(state)}", number) as advance:
            street, state.transform.history = fit_street(
                real,
                simulation,
                acting,
                state.transform.worlds,
                self.view,
                config,
                derive_seed(self.seed, "fit", state.iteration),
                advance,
                history,
            )
        state.transform.street = street
        for line in street.describe():
            self.run.reporter.say(f"{iteration_name(state)}: {line}")
        return street

    def _as_recorded(self, policy: Policy) -> tuple[Simulation, Policy]:
        """Return how simulated worlds are driven, so that their logs compare with the street's.

        A log of someone else's commands tells of the street only beside worlds that got them.
        """
        if (replay := self.real.replay()) is None:
            return self.simulation, policy
        return replace(self.simulation, epsilon=0.0), replay

    def _fit_residual(
        self, state: RunState[StreetFit], policy: Policy, street: FittedStreet, residual: Residual
    ) -> dict[str, float]:
        """Fit the residual to D_real and the fitted street, and say where it acts (line 5).

        Returns:
            Numbers for the metrics.
        """
        say, title = self.run.reporter.say, iteration_name(state)
        if street.late:
            residual.rest()
            say(f"{title}: residual: off, because a grounded action would be late, too")
            return {"residual/acting": 0.0}
        seed = derive_seed(self.seed, "residual", state.iteration)
        logs = self._street_logs(state, policy, street, residual.config.worlds, seed)
        # f, h, models of the world, that of trust, and in each fold f and its twin
        fits = 4 + (residual.config.kind == "phase") + 2 * residual.config.trust.folds
        with self.run.reporter.task(
            f"fitting the residual, {title}", fits * self.config.fit.epochs
        ) as advance:

            def on_epoch(model: str, _epoch: int, loss: float) -> None:
                advance(note=f"{model} {loss:.2g}")

            fitter = Fitter(self.config.fit, seed, on_epoch, device_of(self.device))
            *earlier, latest = state.real
            report = residual.fit(latest, logs[0], fitter, *logs[1:], earlier=earlier)
        say(f"{title}: {report.describe()}")
        for warning in report.fit.warnings if report.acting else ():
            say(f"{title}: residual: {warning}")
        return report.as_dict()

    def _street_logs(
        self,
        state: RunState[StreetFit],
        policy: Policy,
        street: FittedStreet,
        worlds: int,
        seed: int,
    ) -> list[TransitionLog]:
        """Roll the policy out in worlds of the street; for timed grounding, with delays, too."""
        longest_s = self.config.residual_delay_s
        delays_s = (0, longest_s) if longest_s else (0,)
        simulation, acting = self._as_recorded(policy)
        title = f"roll-outs in the street, {iteration_name(state)}"
        with self.run.reporter.task(title, worlds * len(delays_s)) as advance:
            return [
                street_log(
                    street,
                    replace(simulation, most_delay_s=most_s),
                    acting,
                    [derive_seed(seed, "world", most_s, k) for k in range(worlds)],
                    advance,
                )
                for most_s in delays_s
            ]
