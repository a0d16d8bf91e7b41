"""Checks of what an environment gives during an episode."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ugat_marl.testing.episodes import (
    EnvironmentCase,
    Moment,
    begin,
    different,
    proceed,
    random_actions,
)
from ugat_marl.testing.results import ConformanceError, Listening, require

COMMON = "__common__"
"""The only key of infos that is not an agent."""


def an_episode_runs(case: EnvironmentCase) -> None:
    """`reset` and `step` work to the end of an episode under random allowed actions."""
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
    """Every observation, also the last, is contained in its agent's space."""
    for moment, when in _moments(case):
        for agent, seen in moment.observations.items():
            where = _outside(seen, case.fresh.observation_space(agent))
            require(
                not where,
                f"{when}, the observation of {agent} {where}; clip it, or widen the space",
            )


def _outside(value: Any, space: Any) -> str:
    """How a vector is outside its space, in words; empty if it is inside."""
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
    """`state()` is in `state_space` at every moment, after the last step too."""
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
    first = {key: _shapes(info) for key, info in case.episode.moments[0].infos.items()}
    for moment, when in _moments(case):
        now = {key: _shapes(info) for key, info in moment.infos.items()}
        for key in set(now) & set(first):
            require(
                now[key] == first[key],
                f"{when}, infos[{key!r}] has {now[key]}, but after reset it had {first[key]}; "
                "TorchRL and BenchMARL need the same keys and shapes always",
            )


def _shapes(info: Any) -> dict[str, tuple[int, ...]]:
    """Keys of an info and the shape of what is there."""
    if not isinstance(info, Mapping):
        return {}
    return {str(key): np.shape(value) for key, value in sorted(info.items())}


def infos_hold_numbers(case: EnvironmentCase) -> None:
    """Infos are dicts of numbers and numeric arrays, by agent (and ``__common__``)."""
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
    """Every info has an int8 `action_mask` of zeros and ones with a one in it, at reset too."""
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
    """Every info has `executed_action`, the phase that was really served."""
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


def _told(case: EnvironmentCase, moment: Moment) -> list[str]:
    """Agents that have an info; who has none is for another check."""
    return [agent for agent in case.fresh.possible_agents if agent in moment.infos]


def _entry(moment: Moment, agent: str, key: str) -> Any:
    info = moment.infos.get(agent)
    return info.get(key) if isinstance(info, Mapping) else None


def everybody_acts_to_the_end(case: EnvironmentCase) -> None:
    """All agents live to the end, are truncated together, and then `agents` is empty."""
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
    """Rewards are finite Python floats, terminations and truncations Python bools."""
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
    """What was returned is neither returned again nor changed later."""
    previous: Moment | None = None
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
    """Overwriting observations, infos and results does not reach into the environment."""
    env = case.make()
    moment = begin(env, case.seed)
    choose = random_actions(case.seed)
    for step, expected in enumerate(case.episode.moments[:-1]):
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


def _overwrite(array: Any) -> None:
    if isinstance(array, np.ndarray) and array.flags.writeable:
        array.fill(0)


def _shares_an_array(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    return any(
        isinstance(value, np.ndarray | dict) and before.get(key) is value
        for key, value in now.items()
    )


def _moments(case: EnvironmentCase) -> Iterator[tuple[Moment, str]]:
    for index, moment in enumerate(case.episode.moments):
        yield moment, _when(index)


def _when(index: int) -> str:
    return f"after step {index}" if index else "after reset"


def pictures_are_pictures(case: EnvironmentCase) -> None:
    """With render mode "rgb_array", `render` gives uint8 pixels."""
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
    """An action out of range, or missing, is an error, after which the episode goes on."""
    case.need_episode()
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
    for what, actions in wrongs.items():
        with Listening() as heard:
            env.step(actions)
        if heard.error is None:
            raise ConformanceError(
                f"{what} was accepted; raise ugat_marl.errors.ActionError before anything moves"
            )
    with Listening() as heard:
        env.step(right)
    require(
        heard.error is None,
        f"after a refused action a right one fails too ({heard.error}); check all actions before "
        "anything moves",
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
