"""The PettingZoo environment: one agent per signalised intersection."""

from __future__ import annotations

import copy
import operator
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex, Unpack

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from ugat_marl.data import AgentLayout, EpisodeRecorder, Scores
from ugat_marl.effects import (
    ControllerPart,
    Domain,
    controller_effects,
    domain_label,
    late_greens,
    load_scenario,
    refuse_service,
    scenario_in_domain,
    service_of,
    with_late_green_programmes,
    withheld,
)
from ugat_marl.envs.actions import checked_delays, checked_phases, require_mapping
from ugat_marl.envs.actuators import Actuators
from ugat_marl.envs.objectives import Objectives
from ugat_marl.envs.observations import Observer, joint_space
from ugat_marl.envs.options import EnvKeywords, EnvOptions, with_env_keywords
from ugat_marl.envs.registration import register_single
from ugat_marl.envs.rendering import NetworkRenderer
from ugat_marl.envs.rewards import Rewarder
from ugat_marl.envs.sensors import Sensors
from ugat_marl.envs.signal_programmes import ProgrammePhases
from ugat_marl.envs.types import AnyParallelEnv, ResetResult, StepResult
from ugat_marl.errors import EpisodeError, OptionError
from ugat_marl.files import OwnDirectory
from ugat_marl.scenarios import Network, Scenario, check_demand, signals
from ugat_marl.simulation import (
    SignalPlans,
    Simulator,
    Snapshot,
    launch_of,
    refuse_in_queues,
    simulator_of,
)

if TYPE_CHECKING:
    from ugat_marl.envs.description import Description

register_single()


class TrafficEnv(ParallelEnv[str, Any, Any]):
    """Traffic signals of a road network, one agent per intersection.

    An action is the green phase of the next decision interval. Yellow, all-red and minimum green
    are always kept. Episodes end by truncation, for all agents at once. `reset` starts SUMO.

    Args:
        scenario: Road network, demand and signals.
        domain: Domain of the simulation: ``"sim"``, ``"V1"``..``"V4"``, effects such as
            ``"headway=1.4"``, or a directory.
        options: Options of the environment.

    Attributes:
        scenario: The scenario in its domain.
        domain: Name of the domain.
        options: Options of the environment.
        render_mode: ``"human"``, ``"rgb_array"`` or None.
        demand: Vehicles that are due, from the files of the scenario.
        decision_interval_s: Seconds between decisions.
        network: Lanes and intersections of the road network.
        layouts: Agent to the parts of its observation.
        recorded_layouts: The same without the memory of commands; logs record these.
        intersection_of: Agent to SUMO's id of its traffic light.
        agent_groups: Group to its agents; agents of one group have the same spaces.
        np_random: Generator of the seeds of episodes; SuperSuit's frame_skip uses it, too.
    """

    observation_spaces: dict[str, Box]
    action_spaces: dict[str, Discrete]

    metadata: dict[str, Any] = {  # noqa: RUF012 - PettingZoo's own convention
        "name": "ugat_marl_v1",
        "render_modes": ["human", "rgb_array"],
        "is_parallelizable": True,
        "render_fps": 1,
    }

    def __init__(self, scenario: Scenario, domain: Domain, options: EnvOptions) -> None:
        self.scenario = scenario_in_domain(scenario, domain, duration_s=options.duration_s)
        self.domain = domain_label(domain)
        self.options = options
        self.render_mode = options.render_mode
        self.network = Network.read(self.scenario)
        self.demand = check_demand(self.scenario, self.network, whole=False)
        self.decision_interval_s = self.scenario.control.decision_interval_s
        self._timing = self.scenario.timing
        self._lanes = self.network.lane_table()
        self._observer = Observer(
            self.network, options.observation, options.neighbours, options.commands
        )
        self._memory = self._observer.memory(self.decision_interval_s)
        self._rewarder = Rewarder(self.network, options.reward)
        effects = controller_effects(self.scenario)
        parts: tuple[ControllerPart, ...] = (*effects, *options.fitted)
        self._sensors = Sensors.of(parts, self.network, self.decision_interval_s)
        refuse_in_queues(
            self.scenario,
            crossings=options.crossings,
            zone=self._sensors is not None and self._sensors.zone_m > 0,
            pictures=options.render_mode is not None,
        )
        interval_s = self.decision_interval_s
        self._actuators = Actuators.of(parts, self.network, self._timing, interval_s)
        refuse_service(self.network, effects)
        self._withheld = withheld(self.network, service_of(effects, options.fitted))
        self._objectives = Objectives.of(effects, self.scenario)
        self._name_agents()
        self._states = [signals.initial_state(self._timing) for _ in self.possible_agents]
        own = options.signals == "programme"
        self._programmes = ProgrammePhases(self.network) if own else None
        self._state_space = joint_space(list(self.observation_spaces.values()))
        self._simulator: Simulator | None = None
        self._directory = OwnDirectory()
        self.np_random = np.random.default_rng()
        self.agents: list[str] = []
        self._scores: Scores | None = None
        self._renderer: NetworkRenderer | None = None
        self._recorded: tuple[Observer, ...] = ()
        self._meanwhile: Callable[[], object] | None = None
        self._watch: Callable[[float, SignalPlans], object] | None = None

    # --- spaces -------------------------------------------------------------------------------

    def observation_space(self, agent: str) -> Box:
        """The space of an agent's observations, the same object at each call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete:
        """The space of an agent's actions, the same object at each call."""
        return self.action_spaces[agent]

    @property
    def state_space(self) -> Box:
        """The space of `state`: all observations, one after the other."""
        return self._state_space

    @property
    def env_options(self) -> dict[str, Any]:
        """Options with which another environment gives the same observations."""
        shown = {"observation": self.options.observation, "neighbours": self.options.neighbours}
        return shown | ({"commands": self.options.commands} if self.options.commands else {})

    @property
    def snapshot(self) -> Snapshot:
        """Measured lanes after the last decision interval, or after the reset."""
        self._require_reset("snapshot")
        return self._snapshot

    @property
    def seen(self) -> Snapshot:
        """The `snapshot` after the sensors of effects, as controllers see it."""
        self._require_reset("seen")
        return self._seen

    @property
    def phases(self) -> list[int]:
        """Phase of each intersection that is green or about to be, in the order of the agents.

        Under the network's own programmes -1 is a green that is none of the light's phases.
        """
        if self._programmes is not None:
            return list(self._programmes.shown)
        return [state.phase for state in self._states]

    def describe(self) -> Description:
        """Return tables of the observed numbers and of the phases; ``print`` shows them whole."""
        from ugat_marl.envs.description import describe  # loads polars, which no episode needs

        return describe(self.scenario.id, self.network, self._observer, self.possible_agents)

    # --- episode ------------------------------------------------------------------------------

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, dict[str, Any]]]:
        """Start an episode in a fresh simulation.

        Args:
            seed: Seed that makes the simulation exactly repeatable; without it, the next seed is
                drawn from `np_random`.
            options: Not used.
        """
        if seed is not None:
            self.np_random = np.random.default_rng(_whole(seed))
        self._scores, self.agents = None, []  # if SUMO does not start, no episode has begun
        self._start(int(self.np_random.integers(2**31)))
        try:
            return self._begun()
        except BaseException:  # of an observation of the user
            self.agents = []
            raise

    def _begun(self) -> ResetResult:
        """Prepare for an episode whose simulation has started; return the results of `reset`."""
        self.agents = self.possible_agents[:]
        self._decision, self._remembered = 0, None
        self._states = [signals.initial_state(self._timing) for _ in self.agents]
        if self._programmes is not None:
            self._programmes.reset()
            self._look_at_programmes()
        if self._memory is not None:
            self._memory.reset(self.phases)
        lights = self.network.intersections
        self._delays = signals.GreenDelays(
            {intersection.id: intersection.phases[0] for intersection in lights},
            late_greens(self.scenario),
            self.scenario.settings.step_length_s,
            self._withheld,
        )
        self._recorder = EpisodeRecorder(
            self._lanes,
            [self._lanes.indices(intersection.incoming_lanes) for intersection in lights],
        )
        return self._observe(), self._infos()

    def step(
        self, actions: Mapping[str, int]
    ) -> tuple[
        dict[str, NDArray[np.float32]],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Show the chosen phases for one decision interval.

        Args:
            actions: A green phase for every agent; a phase that its mask forbids is not shown.

        Returns:
            Observations, rewards, terminations, truncations and infos of all agents.

        Raises:
            ActionError: An action is missing, unknown or out of range; nothing was simulated.
            EpisodeError: The episode has not begun or is over.
            SimulatorError: SUMO failed.
        """
        require_mapping("actions", actions, self.agents)
        if not actions and self._scores is not None:  # after the end; SuperSuit's black_death asks
            return {}, {}, {}, {}, {}
        if not self.agents:
            raise EpisodeError("step() needs a running episode; call reset() first")
        asked = requested = checked_phases(actions, self.agents, self.action_spaces)
        if self._actuators is not None:
            requested = self._actuators.obey(requested, self._states)
        try:
            return self._stepped(asked, requested)
        except BaseException:  # of SUMO, or of a reward of the user: the interval has passed
            self.agents = []
            raise

    def _stepped(self, asked: list[int], requested: list[int]) -> StepResult:
        """Simulate a decision interval; return the results of `step`."""
        before = self._snapshot
        self._advance(requested)
        if self._memory is not None:
            self._memory.add(self._remembered or asked, self.phases)
            self._remembered = None
        rewards = self._rewarder.rewards(before, self._snapshot)
        self._recorder.add(self._snapshot, sum(rewards) / len(rewards))
        self._decision += 1
        self._warn_if_empty()
        over = self._decision == self.scenario.decisions
        agents = self.agents
        result = (
            self._observe(),
            dict(zip(agents, rewards, strict=True)),
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, over),
            self._infos(),
        )
        if over:
            self._finish()
        return result

    def measure_for(self, *observers: Observer) -> None:
        """Measure from the next episode on what these observers read, too; none measures less."""
        self._recorded = observers

    def simulate_with(self, simulator: Simulator) -> None:
        """Simulate with this simulator from the next reset on; `close` closes it."""
        if self._simulator is not None:
            self._simulator.close()
        self._simulator = simulator

    def watch_plans(self, look: Callable[[float, SignalPlans], object] | None) -> None:
        """Let a function see the signals that each step plans.

        Args:
            look: Called with the start of the step in s, and the signals of each light, before late
                greens hold them back; not with `signals="programme"`. None for nobody.
        """
        self._watch = look

    def remember(self, commands: Mapping[str, int]) -> None:
        """Let observations show these commands for the next step, and not the actions of `step`.

        A wrapper that executes other phases than the policy asked for calls this, because a policy
        sees its own commands (`commands`).

        Args:
            commands: A green phase for every agent.

        Raises:
            ActionError: A command is missing, unknown or out of range.
            EpisodeError: The episode has not begun or is over.
        """
        if not self.agents:
            raise EpisodeError("remember() needs a running episode; call reset() first")
        self._remembered = checked_phases(commands, self.agents, self.action_spaces)

    def do_meanwhile(self, work: Callable[[], object] | None) -> None:
        """Do some work in the next step while SUMO simulates; `step_meanwhile` uses this.

        Args:
            work: Called once, before the step has its results, and cannot ask the environment
                anything; None for no work.
        """
        self._meanwhile = work

    def delay_greens(self, seconds: Mapping[str, float]) -> None:
        """Delay the greens that begin in the next step; ends of greens do not change.

        Observations and infos do not show these delays, nor a late green of the scenario. Lights
        that run SUMO's own programmes (`signals="programme"`) have no such delays.

        Args:
            seconds: Agent to the additional red of its links, in s. Greens begin at whole
                simulation steps; the remainder is added to the delay of the link's next green.

        Raises:
            ActionError: A delay is of an unknown agent, negative or not finite.
            EpisodeError: The episode has not begun or is over.
        """
        if not self.agents:
            raise EpisodeError("delay_greens() needs a running episode; call reset() first")
        delays = checked_delays(seconds, self.agents)
        lights = {self.intersection_of[agent]: delay for agent, delay in delays.items()}
        self._delays.ask(lights)

    def state(self) -> NDArray[np.float32]:
        """Return all observations, one after the other; also after the last step."""
        self._require_reset("state()")
        return np.concatenate(self._observer.observe(self._seen, self.phases, self._memory))

    def scores(self) -> Scores:
        """Return the measures of the episode that has ended.

        Raises:
            EpisodeError: No episode has ended since the last reset.
        """
        if self._scores is None:
            raise EpisodeError(
                f"scores() needs a whole episode of {self.scenario.decisions} steps; "
                "set duration_s for shorter ones"
            )
        return self._scores

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture of the network with vehicles and signals, uint8 ``(height, width, 3)``.

        Return None in render mode "human", in which SUMO draws its own window, and without one.
        """
        if self.render_mode is None:
            warnings.warn(
                "render() draws nothing without a render mode; make the environment with "
                'render_mode="rgb_array" (a picture) or render_mode="human" (sumo-gui)',
                stacklevel=2,
            )
        if self.render_mode != "rgb_array":
            return None
        if self._renderer is None:
            self._renderer = NetworkRenderer(self.network, self.intersection_of)
        if self._simulator is not None and self.agents:
            self._renderer.draw(self._simulator.vehicles(), self._simulator.signals())
        return self._renderer.pixels()

    def close(self) -> None:
        """End the simulation and its process and remove its files; a second call does nothing."""
        simulator, self._simulator = self._simulator, None
        self.agents = []
        if simulator is not None:
            simulator.close()
        self._directory.remove()

    def __getstate__(self) -> dict[str, Any]:
        """Refuse to copy a running simulation: two environments would step and close it."""
        if self._simulator is not None:
            raise EpisodeError(
                "an environment cannot be copied after reset(), as its simulation cannot; make "
                "another one, or copy it before"
            )
        return {**self.__dict__, "_renderer": None}  # a drawing cannot be copied; it is made anew

    def __copy__(self) -> TrafficEnv:
        """Return a deep copy: two environments do not share files and sensors."""
        return copy.deepcopy(self)

    def __del__(self) -> None:
        if getattr(self, "_simulator", None) is not None:
            self.close()

    # --- parts --------------------------------------------------------------------------------

    def _name_agents(self) -> None:
        """Set names and spaces of the agents; agents of one group have the same spaces."""
        observer, items = self._observer, self.network.intersections
        agents = self.possible_agents = list(observer.agents)
        self.agent_groups = {
            group: [agents[place] for place in members]
            for group, members in observer.groups.items()
        }
        self.intersection_of = {
            a: intersection.id for a, intersection in zip(agents, items, strict=True)
        }
        self.layouts: dict[str, AgentLayout] = dict(zip(agents, observer.layouts, strict=True))
        self.recorded_layouts = dict(zip(agents, observer.recorded, strict=True))
        self.observation_spaces = dict(zip(agents, observer.spaces, strict=True))
        phases = self._phase_counts = [len(intersection.phases) for intersection in items]
        actions = {count: Discrete(count) for count in phases}
        self.action_spaces = {a: actions[count] for a, count in zip(agents, phases, strict=True)}

    def _start(self, seed: int) -> None:
        if self._simulator is None:
            self._simulator = simulator_of(self.options.simulator, self.options.deadline_s)
        readers = (self._rewarder, self._observer, *self._recorded)
        launch = launch_of(
            with_late_green_programmes(self.scenario, self._withheld if self._programmes else None),
            seed,
            self._directory.fresh(),
            self._lanes.ids,
            waiting=any(reader.needs_waiting for reader in readers),
            crossings=self.options.crossings,
            gui=self.render_mode == "human",
            pictures=self.render_mode is not None,
            zone_m=self._sensors.zone_m if self._sensors else 0.0,
            persons=self._objectives.persons if self._objectives else None,
            behind=self._lanes.behind,
            turns=self._lanes.turns if any(reader.needs_upstream for reader in readers) else (),
        )
        for part in (self._sensors, self._actuators):
            if part is not None:
                part.reset(seed)
        self._look(self._simulator.start(launch))

    def _advance(self, requested: list[int]) -> None:
        assert self._simulator is not None
        plans: dict[str, list[signals.Segment]] = {}
        states: list[signals.SignalState] = []
        for intersection, state, phase in zip(
            self.network.intersections, self._states, requested, strict=True
        ):
            after, plans[intersection.id] = signals.advance(
                intersection.phases, state, phase, self.decision_interval_s, self._timing
            )
            states.append(after)
        if self._programmes is not None:
            plans = {}
        elif self._watch is not None:
            self._watch(self._snapshot.time_s, plans)
        plans = self._delays.hold(plans)
        work, self._meanwhile = self._meanwhile, None
        self._look(self._simulator.advance(self.decision_interval_s, plans, work))
        self._states = states
        self._look_at_programmes()

    def _look_at_programmes(self) -> None:
        """Take over the phases of lights that run SUMO's own programmes."""
        assert self._simulator is not None
        if self._programmes is not None:
            self._programmes.look(self._simulator.signals())
            start = signals.initial_state(self._timing)
            self._states = [start._replace(phase=p, origin=p) for p in self._programmes.latest]

    def _look(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot
        seen = snapshot.with_blockers()
        self._seen = seen if self._sensors is None else self._sensors.see(seen)

    def _require_reset(self, what: str) -> None:
        if not hasattr(self, "_seen"):
            raise EpisodeError(f"{what} has no meaning before the first reset()")

    def _observe(self) -> dict[str, NDArray[np.float32]]:
        seen = self._observer.observe(self._seen, self.phases, self._memory)
        return dict(zip(self.agents, seen, strict=True))

    def _infos(self) -> dict[str, dict[str, Any]]:
        states, interval_s = self._states, self.decision_interval_s
        if self._actuators is not None:
            masks = self._actuators.masks(states)
        else:
            free = [signals.free_to_change(x, self._timing, interval_s) for x in states]
            lights = zip(self._phase_counts, states, free, strict=True)
            masks = [signals.phase_mask(n, x.phase, free=may) for n, x, may in lights]
        return {
            agent: {"action_mask": mask, "executed_action": state.phase}
            for agent, mask, state in zip(self.agents, masks, states, strict=True)
        }

    def _warn_if_empty(self) -> None:
        if self._decision == max(1, self.scenario.decisions // 10) and not self._snapshot.departed:
            due = self._snapshot.backlog
            reason = f"{due} are waiting to; check routes" if due else "none is due yet"
            warnings.warn(
                f"scenario {self.scenario.id!r}: no vehicle has entered the network in the first "
                f"{self._decision * self.decision_interval_s:g} s ({reason}); check departures",
                stacklevel=4,
            )

    def _finish(self) -> None:
        assert self._simulator is not None
        if self.render_mode == "rgb_array":
            self.render()
        self.agents = []
        trips = self._simulator.finish()
        scores = self._recorder.scores(trips)
        self._scores = self._objectives.judged(scores, trips) if self._objectives else scores


def _whole(seed: SupportsIndex) -> int:
    try:
        whole = operator.index(seed)
    except TypeError:
        whole = -1
    if whole < 0:
        raise OptionError(f"seed = {seed!r}: must be a whole number from 0 on")
    return whole


def step_meanwhile(
    env: AnyParallelEnv, actions: Mapping[str, int], work: Callable[[], object]
) -> StepResult:
    """Step an environment, and do some work while SUMO simulates.

    The work is done at the same time where the environment, below its wrappers, is a `TrafficEnv`
    whose SUMO has its own process. Everywhere else it is done before or after.

    Args:
        env: Any parallel environment.
        actions: A green phase for every agent.
        work: Called once, unless the step is refused. It cannot know the results of the step, and
            cannot ask the environment anything.
    """
    left = [work]

    def once() -> None:
        if left:
            left.pop()()

    inner = env.unwrapped
    inner = getattr(inner, "base", inner)  # wrappers of the suite are their own `unwrapped`
    if not isinstance(inner, TrafficEnv):
        result = env.step(dict(actions))
    else:
        inner.do_meanwhile(once)
        try:
            result = env.step(dict(actions))
        finally:
            inner.do_meanwhile(None)
    once()
    return result


@with_env_keywords
def parallel_env(
    scenario: str | Path | Scenario, domain: Domain = "sim", **options: Unpack[EnvKeywords]
) -> TrafficEnv:
    """Make an environment as a PettingZoo `ParallelEnv`.

    Args:
        scenario: Id of a shipped scenario, a scenario directory, a ``.sumocfg``, ``resco:<map>``,
            or a loaded scenario.
        domain: ``"sim"``, ``"V1"``..``"V4"`` or an alias, ``"effect=value+..."``, the path of
            another scenario on the same network, or a list of effects.
        **options: The keywords below.

    Raises:
        UnknownNameError: No such scenario, domain or option.
        ScenarioError: The scenario's files are missing or contradict each other.
    """
    given = EnvOptions.of(options)
    return TrafficEnv(load_scenario(scenario, given.duration_s), domain, given)


@with_env_keywords
def env(
    scenario: str | Path | Scenario, domain: Domain = "sim", **options: Unpack[EnvKeywords]
) -> Any:
    """Make an environment as a PettingZoo `AECEnv`; the arguments are those of `parallel_env`."""
    from pettingzoo.utils import parallel_to_aec

    return parallel_to_aec(parallel_env(scenario, domain, **options))
