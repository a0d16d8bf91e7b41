"""Checks of an environment: its declarations, its start and end, and its episodes."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from ugat_marl.envs import AnyParallelEnv
from ugat_marl.simulation import simulation_runs_here
from ugat_marl.testing.episodes import (
    EnvironmentCase,
    MakeEnv,
    StepReturn,
    begin,
    different,
    proceed,
    random_actions,
)
from ugat_marl.testing.results import (
    CheckResult,
    ConformanceError,
    Listening,
    require,
    run_checks,
    said,
)

COMMON = "__common__"
"""The only key of infos that is not an agent."""

_AGENT = re.compile(r"[A-Za-z][A-Za-z0-9-]*(_[A-Za-z0-9-]+)*_[0-9]+")

_PATIENCE_S = 5.0
"""Time that processes have to end after `close`, s."""


def an_episode_runs(case: EnvironmentCase) -> None:
    """`reset` and `step` work to the end of an episode with random allowed actions."""
    require(len(case.episode.moments) > 1, "the episode has no step")


def agents_stay_the_same(case: EnvironmentCase) -> None:
    """An episode does not change `possible_agents`."""
    case.need_episode()
    env = case.make()
    before = list(env.possible_agents)
    case.play(env, case.seed)
    now = list(env.possible_agents)
    require(
        now == before,
        f"possible_agents was {before} and is {now} after an episode; remove agents from `agents` "
        "only",
    )


def observations_lie_in_their_spaces(case: EnvironmentCase) -> None:
    """Every observation lies in its agent's space, and so does the last one."""
    for moment, when in _moments(case):
        for agent, seen in moment.observations.items():
            where = _outside(seen, case.fresh.observation_space(agent))
            require(
                not where,
                f"{when}, the observation of {agent} {where}; clip it, or widen the space",
            )


def _outside(value: Any, space: Any) -> str:
    """Return the reason why a vector is outside its space; "" if it is inside."""
    if not isinstance(value, np.ndarray):
        return f"is {type(value).__name__}, not a numpy array"
    if value.dtype != space.dtype or value.shape != space.shape:
        return f"is {value.dtype}{value.shape}, its space {space.dtype}{space.shape}"
    if hasattr(space, "low"):
        wrong = np.flatnonzero(~((value >= space.low) & (value <= space.high)))
        if wrong.size:
            i = int(wrong[0])
            return f"has [{i}] = {value[i]}, outside [{space.low[i]}, {space.high[i]}]"
    return "" if space.contains(value) else "is not in its space"


def state_lies_in_its_space(case: EnvironmentCase) -> None:
    """`state()` lies in `state_space` at every moment, also after the last step."""
    case.need_episode()
    env: Any = case.make()
    count = 0

    def watch() -> None:
        nonlocal count
        where = _outside(env.state(), env.state_space)
        require(
            not where,
            f"{_when(count)}, state() {where}; it must have one size and be valid at any time",
        )
        count += 1

    case.play(env, case.seed, watch=watch)


def infos_keep_their_keys(case: EnvironmentCase) -> None:
    """Infos have the same keys and shapes at `reset` and at every step."""
    agents = set(case.fresh.possible_agents)  # another check finds agents without an info
    first = {key: _shapes(info) for key, info in case.episode.moments[0].infos.items()}
    for moment, when in _moments(case):
        now = {key: _shapes(info) for key, info in moment.infos.items()}
        extra = sorted(map(str, (set(now) ^ set(first)) - agents))
        require(
            not extra,
            f"{when}, only one of infos and those after reset has the key {extra[:1]}; TorchRL and "
            "BenchMARL need the same keys always",
        )
        for key in set(now) & set(first):
            require(
                now[key] == first[key],
                f"{when}, infos[{key!r}] has {now[key]}, but after reset it had {first[key]}; "
                "TorchRL and BenchMARL need the same keys and shapes always",
            )


def _shapes(info: Any) -> dict[str, tuple[int, ...]]:
    """Return each key of an info with the shape of its value."""
    if not isinstance(info, Mapping):
        return {}
    return {str(key): np.shape(value) for key, value in sorted(info.items())}


def infos_hold_numbers(case: EnvironmentCase) -> None:
    """Infos map each agent (and ``__common__``) to a dict of numbers and numeric arrays."""
    agents = {*case.fresh.possible_agents, COMMON}
    for moment, when in _moments(case):
        strange = sorted(map(str, set(moment.infos) - agents))
        require(
            not strange,
            f"{when}, infos has the key {strange[:1]}; only agents and {COMMON!r} may be keys",
        )
        for key, info in moment.infos.items():
            require(
                isinstance(info, Mapping),
                f"{when}, infos[{key!r}] is {type(info).__name__}; make it a dict",
            )
            for name, value in info.items():
                require(
                    np.asarray(value).dtype.kind in "biuf",
                    f"{when}, infos[{key!r}][{name!r}] is {value!r}; infos may hold numbers and "
                    "arrays of numbers only, or TorchRL and BenchMARL fail",
                )


def masks_allow_something(case: EnvironmentCase) -> None:
    """Every info, also after `reset`, has an int8 `action_mask` of 0 and 1 with at least one 1."""
    for moment, when in _moments(case):
        for agent in _told(case, moment):
            count = int(getattr(case.fresh.action_space(agent), "n", 0))
            mask = _entry(moment, agent, "action_mask")
            require(
                isinstance(mask, np.ndarray) and mask.dtype == np.int8 and mask.shape == (count,),
                f"{when}, infos[{agent!r}]['action_mask'] is {mask!r}; make it an int8 array of "
                f"shape ({count},)",
            )
            require(
                mask.any() and not set(mask.tolist()) - {0, 1},
                f"{when}, the action mask of {agent} is {mask}; 1 is allowed, 0 is not, and "
                "something must be allowed",
            )


def executed_actions_are_told(case: EnvironmentCase) -> None:
    """Every info has `executed_action`: the phase that the lights really served."""
    for moment, when in _moments(case):
        for agent in _told(case, moment):
            executed = _entry(moment, agent, "executed_action")
            count = int(getattr(case.fresh.action_space(agent), "n", 0))
            require(
                isinstance(executed, int | np.integer)
                and not isinstance(executed, bool)
                and 0 <= executed < count,
                f"{when}, infos[{agent!r}]['executed_action'] is {executed!r}; tell which of the "
                f"{count} phases was served",
            )


def _told(case: EnvironmentCase, moment: StepReturn) -> list[str]:
    """Return the agents that have an info; another check finds agents without one."""
    return [agent for agent in case.fresh.possible_agents if agent in moment.infos]


def _entry(moment: StepReturn, agent: str, key: str) -> Any:
    info = moment.infos.get(agent)
    return info.get(key) if isinstance(info, Mapping) else None


def everybody_acts_to_the_end(case: EnvironmentCase) -> None:
    """All agents act to the end and are truncated together; after that `agents` is empty."""
    everybody = tuple(case.fresh.possible_agents)
    last = len(case.episode.moments) - 1
    for step, (moment, when) in enumerate(_moments(case)):
        for name, part in moment.parts.items():
            missing = [agent for agent in everybody if agent not in part]
            require(
                not missing,
                f"{when}, {name} has nothing for {missing}; every agent is there to the end, or "
                "SuperSuit, skrl and AgileRL fail",
            )
        expected = () if step == last else everybody
        require(
            moment.agents == expected,
            f"{when}, env.agents is {list(moment.agents)}; it must be "
            f"{'empty after the last step' if step == last else 'possible_agents until the end'}",
        )
        if step:
            ended = [a for a in everybody if moment.parts["terminations"][a]]
            require(
                not ended,
                f"{when}, {ended} terminated; traffic has no end of its own: truncate",
            )
            cut = [a for a in everybody if moment.parts["truncations"][a]]
            require(
                len(cut) == (len(everybody) if step == last else 0),
                f"{when}, {cut or 'nobody'} truncated; truncate all agents together, and in the "
                "last step only",
            )


def values_are_plain(case: EnvironmentCase) -> None:
    """Rewards are finite Python floats; terminations and truncations are Python bools."""
    for moment, when in _moments(case):
        for agent, reward in moment.parts.get("rewards", {}).items():
            require(
                type(reward) is float and np.isfinite(reward),
                f"{when}, the reward of {agent} is {reward!r}; return a finite Python float",
            )
        for name in ("terminations", "truncations"):
            for agent, flag in moment.parts.get(name, {}).items():
                require(
                    type(flag) is bool,
                    f"{when}, {name}[{agent!r}] is {flag!r} of type {type(flag).__name__}; return "
                    "a Python bool",
                )


def results_are_fresh(case: EnvironmentCase) -> None:
    """The environment neither returns an object twice nor changes it later."""
    previous: StepReturn | None = None
    for moment, when in _moments(case):
        for name, part in moment.given.items():
            where = different(moment.parts[name], part)
            require(
                not where,
                f"{name} given {when} changed afterwards ({where}); return fresh dicts and arrays",
            )
            before = previous.given.get(name) if previous else None
            again = before is not None and (before is part or _shares_an_array(before, part))
            require(
                not again,
                f"{when}, {name} is the object of the step before; return fresh dicts and arrays",
            )
        previous = moment


def what_was_given_may_be_changed(case: EnvironmentCase) -> None:
    """Changes to returned observations, infos and results do not change the environment."""
    is_repeatable = case.is_repeatable
    env = case.make()
    moment = begin(env, case.seed)
    choose = random_actions(case.seed)
    moments = case.episode.moments
    for step, expected in enumerate(moments[:-1]):
        if is_repeatable:
            _require_the_same(expected, moment, step)
        state = np.array(env.state())
        actions = choose(step, env, moment.infos)
        for agent in env.agents:
            _overwrite(moment.given["observations"][agent])
            _overwrite(moment.given["infos"][agent].get("action_mask"))
        for part in moment.given.values():
            part.clear()
        require(
            np.array_equal(state, env.state()),
            f"{_when(step)}, overwriting the observations that were given changed state(); "
            "learners scale in place, so keep copies",
        )
        require(
            tuple(env.agents) == expected.agents,
            f"{_when(step)}, clearing what was given changed env.agents; keep copies",
        )
        moment = proceed(env, actions)
    if is_repeatable:
        _require_the_same(moments[-1], moment, len(moments) - 1)


def _require_the_same(expected: StepReturn, moment: StepReturn, step: int) -> None:
    """Compare a moment with that of the episode in which nothing was overwritten."""
    if where := different(expected.parts, moment.parts):
        raise ConformanceError(
            f"overwriting what was given before changed what is given {_when(step)}: {where}; "
            "return fresh arrays, and keep copies"
        )


def _overwrite(array: Any) -> None:
    if isinstance(array, np.ndarray) and array.flags.writeable:
        array.fill(0)


def _shares_an_array(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    return any(
        isinstance(value, np.ndarray | dict) and before.get(key) is value
        for key, value in now.items()
    )


def _moments(case: EnvironmentCase) -> Iterator[tuple[StepReturn, str]]:
    for index, moment in enumerate(case.episode.moments):
        yield moment, _when(index)


def _when(index: int) -> str:
    return f"after step {index}" if index else "after reset"


def pictures_are_pictures(case: EnvironmentCase) -> None:
    """With render mode "rgb_array", `render` returns uint8 pixels, ``(height, width, 3)``."""
    case.need_episode()
    env = case.make()
    if getattr(env, "render_mode", None) != "rgb_array":
        return
    env.reset(seed=case.seed)
    frame = env.render()
    require(
        isinstance(frame, np.ndarray)
        and frame.dtype == np.uint8
        and frame.ndim == 3
        and frame.shape[2] == 3,
        f"render() gave {type(frame).__name__} {getattr(frame, 'dtype', '')}"
        f"{getattr(frame, 'shape', '')}; give uint8 pixels of shape (height, width, 3)",
    )


def wrong_actions_are_refused(case: EnvironmentCase) -> None:
    """An action out of range, or a missing one, is an error; after it the episode goes on.

    It goes on as if nothing had been asked.
    """
    case.need_episode()
    is_repeatable = case.is_repeatable
    env = case.make()
    _, infos = env.reset(seed=case.seed)
    right = random_actions(case.seed)(0, env, infos)
    agent = env.agents[-1]
    space: Any = env.action_space(agent)
    too_small, too_large = int(space.start) - 1, int(space.start + space.n)
    wrongs = {
        f"the action {too_large} of {agent}": {**right, agent: too_large},
        f"the action {too_small} of {agent}": {**right, agent: too_small},
        f"a missing action of {agent}": {a: right[a] for a in right if a != agent},
    }
    for kind, actions in wrongs.items():
        with Listening() as heard:
            env.step(actions)
        if heard.error is None:
            raise ConformanceError(
                f"{kind} was accepted; raise ugat_marl.errors.ActionError before anything moves"
            )
    moments: list[StepReturn] = []
    with Listening() as heard:
        moments.append(proceed(env, right))
    require(
        heard.error is None,
        f"after a refused action a right one fails too ({heard.error}); check all actions before "
        "anything moves",
    )
    where = different(case.episode.moments[1].parts, moments[0].parts)
    require(
        not (is_repeatable and where),
        f"a refused action changed the step after it: {where}; check all actions before anything "
        "moves",
    )


BEHAVIOUR = (
    agents_stay_the_same,
    observations_lie_in_their_spaces,
    state_lies_in_its_space,
    infos_keep_their_keys,
    infos_hold_numbers,
    masks_allow_something,
    executed_actions_are_told,
    everybody_acts_to_the_end,
    values_are_plain,
    results_are_fresh,
    what_was_given_may_be_changed,
    pictures_are_pictures,
    wrong_actions_are_refused,
)


def agents_are_named(case: EnvironmentCase) -> None:
    """Agents are known before `reset` and named ``<group>_<n>``."""
    agents: Any = getattr(case.fresh, "possible_agents", None)
    require(
        isinstance(agents, list) and agents,
        f"possible_agents is {agents!r} before reset(); make it a list of names in __init__",
    )
    require(len(set(agents)) == len(agents), f"possible_agents has a name twice: {agents}")
    for agent in agents:
        require(
            isinstance(agent, str) and _AGENT.fullmatch(agent),
            f"the agent {agent!r} is not called <group>_<n>, like 'signal_0'; TorchRL and AgileRL "
            "group agents by that, and break on dots",
        )


def groups_have_equal_spaces(case: EnvironmentCase) -> None:
    """Agents whose names share a prefix have equal spaces."""
    env = case.fresh
    first: dict[str, str] = {}
    for agent in env.possible_agents:
        other = first.setdefault(agent.rpartition("_")[0], agent)
        for kind in ("observation_space", "action_space"):
            a, b = getattr(env, kind)(other), getattr(env, kind)(agent)
            require(
                a == b,
                f"{other} and {agent} share a prefix, but their {kind}s differ: {a} and {b}; "
                "give unequal agents different prefixes",
            )


def groups_are_listed(case: EnvironmentCase) -> None:
    """`unwrapped.agent_groups` maps each prefix to its agents."""
    expected: dict[str, list[str]] = {}
    for agent in case.fresh.possible_agents:
        expected.setdefault(agent.rpartition("_")[0], []).append(agent)
    groups: Any = getattr(case.fresh.unwrapped, "agent_groups", None)
    listed = {k: list(v) for k, v in groups.items()} if isinstance(groups, Mapping) else groups
    require(
        listed == expected,
        f"unwrapped.agent_groups is {listed!r}; make it {expected!r}",
    )


def agents_have_traffic_lights(case: EnvironmentCase) -> None:
    """`unwrapped.intersection_of` maps every agent to a traffic light of its own."""
    lights: Any = getattr(case.fresh.unwrapped, "intersection_of", None)
    agents = set(case.fresh.possible_agents)
    require(
        isinstance(lights, Mapping) and set(lights) == agents,
        "unwrapped.intersection_of must map every agent to SUMO's id of its traffic light; "
        f"it is {lights!r}",
    )
    require(
        len(set(lights.values())) == len(agents),
        f"two agents have the same traffic light in unwrapped.intersection_of: {lights!r}",
    )


def spaces_are_the_same_objects(case: EnvironmentCase) -> None:
    """A space is the same object at each call; otherwise seeding it would have no effect."""
    env = case.fresh
    for agent in env.possible_agents:
        for kind in ("observation_space", "action_space"):
            ask = getattr(env, kind)
            require(
                ask(agent) is ask(agent),
                f"{kind}({agent!r}) makes a new space at each call; make it once, in __init__",
            )


def spaces_are_listed(case: EnvironmentCase) -> None:
    """`unwrapped` has `observation_spaces` and `action_spaces` (skrl and EPyMARL read them)."""
    env = case.fresh
    for kind in ("observation_space", "action_space"):
        listed: Any = getattr(env.unwrapped, f"{kind}s", None)
        require(
            isinstance(listed, Mapping) and set(listed) == set(env.possible_agents),
            f"unwrapped.{kind}s must be a dict with the space of every agent; skrl and EPyMARL "
            "read it",
        )
        for agent in env.possible_agents:
            require(
                listed[agent] == getattr(env, kind)(agent),
                f"unwrapped.{kind}s[{agent!r}] is not what {kind}({agent!r}) returns",
            )


def observation_spaces_are_bounded(case: EnvironmentCase) -> None:
    """Observations are float32 vectors with finite bounds."""
    for agent in case.fresh.possible_agents:
        _require_bounded(case.fresh.observation_space(agent), f"the observation space of {agent}")


def _require_bounded(space: Any, space_name: str) -> None:
    require(
        isinstance(space, Box) and space.dtype == np.float32 and len(space.shape) == 1,
        f"{space_name} is {space}; make it a one-dimensional float32 Box",
    )
    for side, bound in (("low", space.low), ("high", space.high)):
        wrong = np.flatnonzero(~np.isfinite(bound))
        if wrong.size:
            raise ConformanceError(
                f"{space_name} has the bound {side}[{wrong[0]}] = {bound[wrong[0]]}; scale "
                "observations into finite bounds, best [0, 1]"
            )
    wrong = np.flatnonzero(space.low >= space.high)
    require(
        not wrong.size,
        f"{space_name} has low >= high at {wrong[:3].tolist()}; leave constants out of the "
        "observation",
    )


def action_spaces_count_from_zero(case: EnvironmentCase) -> None:
    """Actions are the whole numbers from 0 to n - 1, with n > 1."""
    for agent in case.fresh.possible_agents:
        space: Any = case.fresh.action_space(agent)
        require(
            isinstance(space, Discrete) and space.start == 0 and space.n > 1,
            f"the action space of {agent} is {space}; use Discrete(n) with n > 1 green phases, "
            "and no agent where there is nothing to choose",
        )


def state_space_is_bounded(case: EnvironmentCase) -> None:
    """`state_space` exists before `reset`, is float32 and has finite bounds."""
    space = getattr(case.fresh, "state_space", None)
    require(space is not None, "state_space is missing; skrl and QMIX read it before reset()")
    _require_bounded(space, "state_space")


def metadata_is_complete(case: EnvironmentCase) -> None:
    """`metadata` and `render_mode` follow PettingZoo's rules."""
    env: Any = case.fresh
    metadata: Any = getattr(env, "metadata", None)
    require(isinstance(metadata, Mapping), f"metadata is {metadata!r}; make it a dict")
    name, modes = metadata.get("name"), metadata.get("render_modes")
    require(
        isinstance(name, str) and name,
        f"metadata['name'] is {name!r}; give the environment a name that ends in _v<N>",
    )
    require(
        isinstance(modes, list | tuple) and all(isinstance(mode, str) for mode in modes),
        f"metadata['render_modes'] is {modes!r}; make it a list of names, maybe empty",
    )
    require(
        metadata.get("is_parallelizable") is True,
        "metadata['is_parallelizable'] is not True; PettingZoo's conversions refuse such a "
        "parallel environment",
    )
    require(
        hasattr(env.unwrapped, "render_mode"),
        "the attribute render_mode is missing; set it in __init__, to None if nothing is drawn",
    )
    mode = env.unwrapped.render_mode
    require(
        mode is None or mode in modes,
        f"render_mode is {mode!r}, which metadata['render_modes'] {list(modes)} does not list",
    )


def attributes_do_not_mislead(case: EnvironmentCase) -> None:
    """There is no attribute `num_envs` or `device`, which other libraries would misread."""
    for env in (case.fresh, case.fresh.unwrapped):
        for name in ("num_envs", "device"):
            require(
                not hasattr(env, name),
                f"the environment has the attribute {name!r}, from which skrl concludes that it "
                "is a vector environment of another library; rename it",
            )


DECLARED = (
    agents_are_named,
    agents_have_traffic_lights,
    groups_are_listed,
    groups_have_equal_spaces,
    spaces_are_the_same_objects,
    spaces_are_listed,
    observation_spaces_are_bounded,
    action_spaces_count_from_zero,
    state_space_is_bounded,
    metadata_is_complete,
    attributes_do_not_mislead,
)


def nothing_starts_before_reset(case: EnvironmentCase) -> None:
    """The constructor of an environment starts neither SUMO nor a process."""
    before, simulated = descendants(), simulation_runs_here()
    case.make()
    require(
        simulation_runs_here() == simulated and descendants() <= before,
        "making the environment started a simulation or a process; start it in reset(), since "
        "environments are made to look at their spaces, and copied to other processes",
    )


def environments_can_be_sent(case: EnvironmentCase) -> None:
    """Before `reset` an environment can be pickled, and its copy works."""
    case.need_episode()
    env = case.make()
    # A worker process does the same. The bytes are our own: nothing foreign is unpickled.
    copy: AnyParallelEnv | None = None
    with Listening() as heard:
        copy = ForkingPickler.loads(ForkingPickler.dumps(env))  # pyright: ignore[reportAttributeAccessIssue]
    if heard.error is not None:
        raise ConformanceError(
            f"the environment cannot be pickled before reset() ({said(heard.error)}), so no vector "
            "environment can send it to a process; make files, sockets and lambdas in reset()"
        )
    assert copy is not None
    try:
        require(
            copy.possible_agents == env.possible_agents,
            f"the pickled copy has the agents {copy.possible_agents}; pickle the whole environment",
        )
        _attempt("reset() of a pickled copy", lambda: _a_step(copy, case.seed))
    finally:
        copy.close()


def reset_and_close_repeat(case: EnvironmentCase) -> None:
    """`reset` and `close` may be called at any time and any number of times."""
    case.need_episode()
    env = case.make()
    _attempt("close() before reset()", env.close)
    _attempt("reset() after close()", lambda: _a_step(env, case.seed))
    _attempt("reset() during an episode", lambda: env.reset(seed=case.seed))
    _attempt("reset() directly after reset()", lambda: _a_step(env, None))
    _attempt("close() during an episode", env.close)
    _attempt("close() after close()", env.close)
    _attempt("reset() after a second close()", lambda: _a_step(env, case.seed))
    env.close()


def _attempt(description: str, action: Callable[[], object]) -> None:
    with Listening() as heard:
        action()
    if heard.error is not None:
        raise ConformanceError(
            f"{description} fails: {said(heard.error)}; RLlib and TorchRL do that, so let it work"
        )


def _a_step(env: AnyParallelEnv, seed: int | None) -> None:
    _, infos = env.reset(seed=seed)
    env.step(random_actions(0)(0, env, infos))


def reset_takes_seed_and_options(case: EnvironmentCase) -> None:
    """`reset` takes the keywords `seed` and `options`, and accepts unknown options."""
    case.need_episode()
    env = case.make()
    with Listening() as heard:
        env.reset(seed=case.seed, options={"unknown": 1})
    if heard.error is not None:
        raise ConformanceError(
            f"reset(seed=..., options={{...}}) fails: {said(heard.error)}; accept both keywords "
            "and ignore options you do not know"
        )


def close_ends_processes(case: EnvironmentCase) -> None:
    """After `close`, no process that `reset` started still runs."""
    case.need_episode()
    before = descendants()
    env = case.make()
    env.reset(seed=case.seed)
    env.close()
    deadline = time.monotonic() + _PATIENCE_S
    while left := descendants() - before:
        if time.monotonic() > deadline:
            raise ConformanceError(
                f"{len(left)} process(es) {sorted(left)} still run {_PATIENCE_S:g} s after "
                "close(); end them there"
            )
        time.sleep(0.05)


def descendants() -> set[int]:
    """Return ids of running descendants of this process; none if the system has no ``/proc``."""
    pids: set[int] = set()
    unseen = [os.getpid()]
    while unseen:
        process = unseen.pop()
        tasks: list[Path] = []
        with Listening():  # the process or one of its tasks may have ended
            tasks += Path(f"/proc/{process}/task").glob("*/children")
        for task in tasks:
            with Listening():
                children = {int(child) for child in task.read_text().split()}
                unseen += children - pids
                pids |= children
    return {process for process in pids if not _zombie(process)}


def _zombie(process: int) -> bool:
    with Listening():
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    return True


LIFE = (
    nothing_starts_before_reset,
    environments_can_be_sent,
    reset_takes_seed_and_options,
    reset_and_close_repeat,
    close_ends_processes,
)


ENVIRONMENT_CHECKS = (an_episode_runs, *LIFE, *DECLARED, *BEHAVIOUR)
"""All checks of an environment; each takes an `EnvironmentCase`."""


def check_environment(make_env: MakeEnv, seed: int = 1) -> list[CheckResult]:
    """Check an environment: one of the suite, a wrapped one, or a third-party one.

    The checks play four or more whole episodes, so use an environment with short episodes.

    Args:
        make_env: Function that returns a new environment.
        seed: Seed of the episodes.
    """
    case = EnvironmentCase(make_env, seed)
    try:
        return run_checks(ENVIRONMENT_CHECKS, case)
    finally:
        case.close()
