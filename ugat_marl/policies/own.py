"""Learners and policies of users, adapted to the protocols of the suite.

A learner of a user needs ``learn(env, episodes)`` and ``policy()``. A policy needs
``act(observations, infos)``, or is a function of the same arguments; ``infos`` may be left out.
`own_names` finds them by their names.

With ``save(path)`` and ``load(path)`` a learner can also be resumed, and trainings can start from
what it has learnt.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import inspect
import io
import json
import sys
import tempfile
import warnings
import zipfile
from collections import deque
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from pathlib import Path
from types import CellType, FunctionType, MethodType, ModuleType
from typing import Any, get_type_hints

from pettingzoo.utils import BaseParallelWrapper

from ugat_marl.envs import (
    Actions,
    AnyParallelEnv,
    Infos,
    Observations,
    ResetResult,
    StepResult,
    as_traffic_env,
    checked_phases,
)
from ugat_marl.errors import ActionError, CheckpointError, OptionError, UgatMarlError
from ugat_marl.files import (
    MALFORMED,
    OWN_COUNTERS,
    parse_json,
    require_checkpoint,
    require_stored,
    write_whole,
)
from ugat_marl.policies.learner_settings import parsed_settings, setting_name
from ugat_marl.policies.own_names import last_line, line_in, load_own
from ugat_marl.policies.protocols import EpisodeCallback, Policy
from ugat_marl.policies.saved_options import other_observation, plain_options
from ugat_marl.seeding import derive_seed

NEEDED = {"learn": ("env", "episodes"), "policy": ()}
"""Methods that a learner must have, and their arguments."""

_STATE = "learner.pt"

_FILES = "files"
"""Folder of the user's files in a checkpoint; in version 1 they stood beside the counters."""

_INFOS = ("infos", "info")
"""Names of the argument with a default that is given the infos."""
_MASKS = ("mask", "masks", "action_mask", "action_masks")
"""Names of arguments that are meant for masks, which stand in the infos."""

OF_POLICIES = ("observation", "neighbours", "commands", "signals")
"""Options of an environment that a policy may ask for: what it sees, and how signals are shown."""
OF_LEARNERS = ("observation", "commands", "signals")
"""The same for a learner; neighbours are an option of the command that trains it."""


def asked_options(given: Any, name: str) -> dict[str, Any]:
    """Return the ``env_options`` of a user's policy.

    Raises:
        OptionError: They are no mapping, or hold what the evaluation decides, such as the length of
            an episode.
    """
    return _options_among(OF_POLICIES, given, name, "policy", "evaluation")


def _options_among(
    known: Sequence[str], given: Any, name: str, what: str, decides: str
) -> dict[str, Any]:
    """Return the ``env_options`` of an object of a user, which may hold the known ones only.

    Args:
        known: Names of the options that it may ask for.
        given: The object.
        name: Its name for messages.
        what: Kind of object for messages.
        decides: What decides the other options, for messages.

    Raises:
        OptionError: They are no mapping, or hold other options.
    """
    asked = _env_options(given, f"{what} {name!r}")
    for key in asked:
        if key not in known:
            raise OptionError(
                f"{what} {name!r}: its env_options hold {key!r}, which the {decides} decides; a "
                f"{what} may ask for {', '.join(known)}"
            )
    return asked


def _env_options(given: Any, what: str) -> dict[str, Any]:
    """Return the ``env_options`` of an object of a user; `what` names it in an error."""
    asked = getattr(given, "env_options", {})
    if not isinstance(asked, Mapping):
        raise OptionError(
            f"{what}: its env_options are a {type(asked).__name__}; they must be a "
            'dictionary such as {"observation": "movements"}'
        )
    return dict(asked)


class _Raised(OptionError):
    """An object of a user raised an exception, which is the cause of this one."""


@contextlib.contextmanager
def _naming_errors(given: Any, what: str, env: CountedEnv | None = None) -> Iterator[None]:
    """Name an object of a user, and the line of it, in what it raises.

    Args:
        given: The object.
        what: Its name.
        env: Environment in which it learns; the exception by which its callback ended the training
            passes through.
    """
    try:
        yield
    except (UgatMarlError, MemoryError):
        raise
    except Exception as error:
        if env is not None and error is env.ended_by:
            raise
        made = given.func if isinstance(given, functools.partial) else given
        kind = made if inspect.isroutine(made) or inspect.isclass(made) else type(made)
        said = f"{type(error).__name__}: {error}{_last_line_in(kind, error)}"
        if (raised := last_line(error)) not in said:
            said += f", raised in {raised}"
        raise _Raised(f"{what}: {said}") from error


class OwnPolicy:
    """A policy of a user, as a `Policy`.

    Args:
        given: Object with ``act``, or a function of the observations and, if it takes them, the
            infos.
        name: Name for messages.
        env_options: Options of the environment that the policy was made for.
        state: Content of the file that `save` writes; None if the learner cannot be saved.
        shared: Objects that copies of the policy share, such as the environment of its training.

    Raises:
        OptionError: `given` can neither act nor be called, or asks for masks in place of infos.
    """

    def __init__(
        self,
        given: Any,
        name: str,
        env_options: Mapping[str, Any],
        state: bytes | None = None,
        shared: Sequence[Any] = (),
    ) -> None:
        act = getattr(given, "act", given)
        if not callable(act):
            raise OptionError(
                f"policy {name!r}: a {type(given).__name__} has no act(observations, infos) and "
                "cannot be called; give it that method, or give a function"
            )
        asked = _env_options(given, f"policy {name!r}")  # its own policy, the learner trained so
        shown = {key: asked[key] for key in OF_POLICIES if key in asked}
        self.env_options: Mapping[str, Any] = {**env_options, **shown}
        self._given, self._name, self._state, self._shared = given, name, state, shared
        self._infos_name = _infos_name(act)
        if not (self._infos_name or _takes(act, 1) or _takes(act, 2)):
            raise OptionError(
                f"policy {name!r} takes {inspect.signature(act)}, and is called with the "
                "observations and the infos, or with the observations alone"
            )
        self._sees_infos = _sees_infos(act)
        asks = [argument for argument in _MASKS if argument in _arguments(act)]
        if asks and not (self._infos_name or self._sees_infos):
            warnings.warn(
                f"policy {name!r}: its argument {asks[0]!r} is never given; take the infos, as "
                "act(observations, infos), in which infos[agent]['action_mask'] is the mask",
                stacklevel=2,
            )

    @property
    def savable(self) -> bool:
        """True if `save` writes a file from which the learner can be restored."""
        return self._state is not None

    def reset(self, seed: int) -> None:
        """Tell the user's policy that an episode begins, if it has a method ``reset``.

        Raises:
            OptionError: It raised an exception.
        """
        reset = getattr(self._given, "reset", None)
        if reset is not None:
            with _naming_errors(self._given, f"policy {self._name!r}"):
                reset(*[seed] if _takes(reset, 1) else [])

    def act(self, observations: Observations, infos: Infos) -> Actions:
        """Return the actions of the user's policy as whole numbers.

        Raises:
            OptionError: It raised an exception, or returned no mapping from every agent to a phase
                that the agent has.
        """
        act = getattr(self._given, "act", self._given)
        by_name = {self._infos_name: infos} if self._infos_name else {}
        in_place = [infos] if self._sees_infos else []
        with _naming_errors(self._given, f"policy {self._name!r}"):
            chosen = act(observations, *in_place, **by_name)
        if not isinstance(chosen, Mapping):
            raise OptionError(
                f"policy {self._name!r} returned {type(chosen).__name__}; it must return a "
                "dictionary from every agent to the number of a phase"
            )
        actions: dict[str, int] = {}
        for agent, action in chosen.items():
            try:
                actions[agent] = _whole(action)
            except (AttributeError, TypeError, ValueError, OverflowError, RuntimeError):
                raise OptionError(
                    f"policy {self._name!r} returned {action!r} for {agent!r}; it must be the "
                    "number of a phase, one whole number"
                ) from None
        self._require_phases(actions, observations, infos)
        return actions

    def _require_phases(self, actions: Actions, observations: Observations, infos: Infos) -> None:
        if unknown := sorted(map(repr, actions.keys() - observations.keys())):
            raise OptionError(
                f"policy {self._name!r} returned a phase for {', '.join(unknown)}; agents: "
                f"{', '.join(observations)}"
            )
        for agent in observations:
            if agent not in actions:
                raise OptionError(
                    f"policy {self._name!r} returned no phase for {agent!r}; every agent needs one"
                )
            mask = infos.get(agent, {}).get("action_mask")
            if mask is not None and not 0 <= actions[agent] < len(mask):
                raise OptionError(
                    f"policy {self._name!r} returned {actions[agent]} for {agent!r}; its phases "
                    f"are 0 to {len(mask) - 1}"
                )

    def save(self, path: Path) -> None:
        """Write the state of the learner that made the policy atomically."""
        assert self._state is not None, "ask savable first"
        write_whole(path, self._state)

    def __deepcopy__(self, memo: dict[int, Any]) -> OwnPolicy:
        """Copy the user's policy, but not the environments that it may hold."""
        given = _copied(self._given, self._shared, self._name, memo)
        return OwnPolicy(given, self._name, self.env_options, self._state, self._shared)


def own_policy(given: Any, name: str, env: AnyParallelEnv) -> Policy:
    """Return the policy that a user gives for an environment.

    Args:
        given: An object or a function as for `OwnPolicy`, or what makes one: a class, or a function
            whose first argument is called ``env``. A class is given the environment if its first
            argument is called so, or has no default.
        name: Name for messages.
        env: The environment.

    Raises:
        OptionError: It cannot be made so, raised an exception, or is a learner.
    """
    if inspect.isclass(given):
        if not (_takes(given, 1) or _takes(given, 0)):
            raise OptionError(_not_made(given, name))
        with _naming_errors(given, f"policy {name!r}"):
            given = given(*[env] if _wants_env(given) else [])
    elif _is_maker(given):
        with _naming_errors(given, f"policy {name!r}"):
            given = given(env)
    if not callable(getattr(given, "act", given)) and _is_learner(given):
        raise OptionError(_in_place_of_policy(name))
    asked_options(given, name)
    return OwnPolicy(given, name, {})


def _is_maker(given: Any) -> bool:
    """Return True for a function, also with some arguments filled in, that takes ``env`` first."""
    function = isinstance(given, functools.partial) or inspect.isroutine(given)
    return function and _first_argument(given) == "env"


def _not_made(given: Any, name: str) -> str:
    """Return the reason why a class cannot be made into a policy, with the way out."""
    if _is_learner(given):
        return _in_place_of_policy(name)
    return (
        f"policy {name!r}: the class is made as {given.__name__}(env) or {given.__name__}(), and "
        f"takes {inspect.signature(given)}; give further arguments defaults"
    )


def _is_learner(given: Any) -> bool:
    """Return True if an object, or a class, has the methods of a learner."""
    return all(hasattr(given, method) for method in NEEDED)


def _in_place_of_policy(name: str) -> str:
    """Return that a learner is no policy, with the way out."""
    return (
        f"policy {name!r} is a learner: train it with --learner {name}, and give the file of "
        f"its policy, as {name}@FILE"
    )


class OwnLearner:
    """A learner of a user, as a `Learner`.

    Every episode is seeded by its number, so that a training can be repeated.

    Args:
        given: The user's learner.
        name: Name for messages.
        env: Environment with the agents of the learner.
        settings: ``NAME=VALUE`` with which it was made; they stand in the files of `save`.
    """

    def __init__(
        self, given: Any, name: str, env: AnyParallelEnv, settings: Sequence[str] = ()
    ) -> None:
        self.episodes = 0
        self._given, self._name, self._settings = given, name, list(settings)
        self._env_options = dict(getattr(env.unwrapped, "env_options", {}))
        self._made_for = [env, env.unwrapped]  # its class may keep them, whatever it learns in
        self._shared: list[Any] = self._made_for

    @property
    def savable(self) -> bool:
        """True if the user's learner has ``save`` and ``load``."""
        return is_savable(self._given)

    def learn(
        self,
        env: AnyParallelEnv,
        episodes: int,
        seed: int,
        on_episode: EpisodeCallback | None = None,
    ) -> OwnPolicy:
        """Let the user's learner train for `episodes` more episodes.

        Raises:
            OptionError: It played fewer episodes, or raised an exception.
        """
        if episodes > 0:
            counted = CountedEnv(env, self.episodes, seed, on_episode)
            self._shared = [*self._made_for, counted, env, env.unwrapped]
            try:
                with _naming_errors(self._given, f"learner {self._name!r}", counted):
                    self._given.learn(counted, episodes)
            except ActionError as error:
                line = _last_line_in(type(self._given), error)
                raise ActionError(f"learner {self._name!r}{line}: {error}") from error
            played, self.episodes = counted.episodes - self.episodes, counted.episodes
            if played < episodes:
                raise OptionError(
                    f"learner {self._name!r}: learn(env, {episodes}) played {played} whole "
                    f"episodes; it has to play {episodes}, each from env.reset() until env.agents "
                    "is empty"
                )
            if played > episodes:
                warnings.warn(
                    f"learner {self._name!r}: learn(env, {episodes}) played {played} episodes; "
                    "rows of a table are comparable if all play what they are asked",
                    stacklevel=2,
                )
        return self.policy()

    def policy(self) -> OwnPolicy:
        """Return a copy of the user's current policy.

        Raises:
            OptionError: The user's ``policy`` or ``save`` raised an exception.
        """
        with _naming_errors(self._given, f"learner {self._name!r}"):
            current = self._given.policy()
        given = _copied(current, self._shared, self._name, {})
        try:
            state = self._packed() if self.savable else None
        except CheckpointError:  # a function as observation: the policy can be played, not saved
            state = None
        return OwnPolicy(given, self._name, self._env_options, state, self._shared)

    def save(self, path: Path) -> None:
        """Write what the user's ``save`` writes, and the number of episodes, as one file."""
        write_whole(path, self._packed())

    def load(self, path: Path) -> None:
        """Restore the state from a file of `save`.

        Raises:
            CheckpointError: The file is missing, damaged, of a learner that saw other observations,
                or the user's ``load`` refuses it.
        """
        counters = _counters(path)
        if other := other_observation(counters["env_options"], self._env_options):
            raise CheckpointError(f"{path}: its learner was trained with {other}")
        with tempfile.TemporaryDirectory() as folder:
            files = Path(folder, _FILES if counters["version"] > 1 else "")
            try:
                with zipfile.ZipFile(path) as packed:
                    packed.extractall(folder)
                self._given.load(files / _STATE)
            except Exception as error:
                written = ", ".join(sorted(file.name for file in files.glob("*"))) or "nothing"
                raise CheckpointError(
                    f"{path}: the learner {self._name!r} cannot load it "
                    f"({type(error).__name__}: {error}); its save(path), with a path that ends in "
                    f"{_STATE}, wrote {written}"
                ) from error
        self.episodes = counters["episodes"]

    def _packed(self) -> bytes:
        """Return the files that the user's ``save`` writes, and the counters, as a zip file.

        Raises:
            CheckpointError: An option of the environment is not plain data.
            OptionError: ``save`` writes no file, or raised an exception.
        """
        memory = io.BytesIO()
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(memory, "w") as packed:
            files = Path(folder, _FILES)
            files.mkdir()
            with _naming_errors(self._given, f"learner {self._name!r}"):
                self._given.save(files / _STATE)
            if not any(files.iterdir()):
                raise OptionError(
                    f"learner {self._name!r}: save(path) wrote nothing, neither at the path nor "
                    "beside it; without load and save the learner cannot go on, so write there, "
                    "or leave both methods out"
                )
            for file in sorted(Path(folder).rglob("*")):
                packed.write(file, file.relative_to(folder))
            counters = {
                "version": 2,
                "episodes": self.episodes,
                "env_options": json.loads(plain_options(self._env_options)),
                "settings": self._settings,
            }
            packed.writestr(OWN_COUNTERS, json.dumps(counters))
        return memory.getvalue()


class CountedEnv(BaseParallelWrapper[str, Any, Any]):
    """Environment that counts the whole episodes of a learner and seeds them by their number.

    Attributes:
        episodes: Number of whole episodes so far, those of earlier calls included.
        ended_by: Exception that `on_episode` raised to end the training; None if it raised none.

    Args:
        env: The environment.
        episodes: Number of episodes in earlier calls.
        seed: Root of the seeds of all episodes.
        on_episode: Called after each episode with its number and ``return`` (sum of the rewards,
            mean over agents).
    """

    def __init__(
        self, env: AnyParallelEnv, episodes: int, seed: int, on_episode: EpisodeCallback | None
    ) -> None:
        super().__init__(env)
        self.episodes = episodes
        self.ended_by: Exception | None = None
        self._root, self._on_episode, self._return = seed, on_episode, 0.0

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> ResetResult:
        """Start the next episode; its number decides the seed unless one is given."""
        if seed is None:
            seed = derive_seed(self._root, "learner", "episode", self.episodes)
        self._return = 0.0
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: dict[str, Any]) -> StepResult:
        """Execute the actions; count the episode if it ends."""
        running = bool(self.env.agents)
        result = self.env.step(actions)
        if running and result[1]:
            self._return += sum(map(float, result[1].values())) / len(result[1])
        if running and not self.env.agents:
            self.episodes += 1
            if self._on_episode is not None:
                try:
                    self._on_episode(self.episodes - 1, {"return": self._return})
                except Exception as error:
                    self.ended_by = error
                    raise
        return result

    def close(self) -> None:
        """Leave the environment open, because a learner may close what it was given."""


class OwnLearnerFactory:
    """Maker of the learner that a user names.

    The user's class or function gets the environment and the seed if it has arguments of the names
    ``env`` and ``seed``. Settings are further keywords.

    Attributes:
        name: ``module:name`` of the class or function.

    Args:
        name: The same.
        settings: ``NAME=VALUE``, converted to the annotated type of the argument.

    Raises:
        OptionError: It does not exist, makes no learners, or a value is impossible.
        UnknownNameError: It has no argument of that name.
    """

    def __init__(self, name: str, settings: Sequence[str] = ()) -> None:
        self.name, self._make = name, load_own(name, "learner")
        if inspect.isclass(self._make):
            _require_methods(self._make, name)
        elif hasattr(self._make, "learn"):
            raise OptionError(
                f"learner {name!r} is one learner already; give its class or a function that "
                "makes it, because every row of the table trains a new one"
            )
        elif not callable(self._make):
            raise OptionError(
                f"learner {name!r} is of the kind {type(self._make).__name__}; give a class with "
                "learn(env, episodes) and policy(), or a function that makes such an object"
            )
        self._texts = tuple(settings)
        self._settings = _converted(self._make, settings, name)

    def __call__(self, env: AnyParallelEnv, seed: int) -> OwnLearner:
        """Make a learner for the agents of an environment."""
        offered = _offered(self._make, {"env": env, "seed": seed})
        if lacking := _lacking(self._make, {*self._settings, *offered}):
            settings = " ".join(f"{argument}=VALUE" for argument in lacking)
            raise OptionError(
                f"learner {self.name!r} needs {' and '.join(lacking)}; it is given env and seed, "
                f"if it takes them; give --learner-settings {settings}, or defaults to the others"
            )
        given = self._make(**self._settings, **offered)
        _require_methods(given, self.name)
        return OwnLearner(given, self.name, env, self._texts)

    def read_policy(self, make_env: Callable[..., AnyParallelEnv], path: Path) -> OwnPolicy:
        """Return the policy of a file that `OwnPolicy.save` or `OwnLearner.save` wrote.

        Args:
            make_env: Makes an environment of the scenario with given options.
            path: The file.

        Raises:
            CheckpointError: The file cannot be read, or is of another learner.
        """
        counters = _counters(path)
        with contextlib.closing(make_env(**counters["env_options"])) as env:
            settings = {setting_name(one): one for one in (*counters["settings"], *self._texts)}
            learner = OwnLearnerFactory(self.name, [*settings.values()])(env, 0)
            learner.load(path)
            return learner.policy()


def own_learner_options(name: str) -> dict[str, Any]:
    """Return the options of the environment that a user's learner asks for (``env_options``).

    Raises:
        OptionError: They hold what the command decides, or an observation that is no name.
    """
    asked = _options_among(OF_LEARNERS, load_own(name, "learner"), name, "learner", "command")
    if callable(asked.get("observation")):
        raise OptionError(
            f"learner {name!r}: its env_options have a function as observation, which no run can "
            "write down; name an observation of the suite, or compute yours in the learner and in "
            "its policy"
        )
    return asked


def is_savable(given: Any) -> bool:
    """Return True if a learner or its class has ``save(path)`` and ``load(path)``."""
    return all(callable(getattr(given, method, None)) for method in ("save", "load"))


def check_own_learner(
    make: Callable[[AnyParallelEnv, int], Any], env: AnyParallelEnv, seed: int
) -> Any:
    """Make a learner and let it act once, so that what it lacks is said before any training.

    Args:
        make: Maker of the learner.
        env: The environment; it is reset.
        seed: Seed of the learner and of the episode.

    Returns:
        The learner.

    Raises:
        OptionError: It cannot be made, has no policy before its training, or the policy fails.
        ActionError: Its policy chooses a phase that does not exist.
    """
    name = getattr(make, "name", "")
    try:
        learner = make(env, seed)
        policy = learner.policy()
        observations, infos = env.reset(seed=seed)
        policy.reset(seed)
        actions = policy.act(observations, infos)
    except Exception as error:
        is_told = isinstance(error, UgatMarlError)
        if is_told and not isinstance(error, _Raised):
            raise
        said = str(error) if is_told else f"{type(error).__name__}: {error}"
        raise OptionError(
            f"learner {name!r} failed before its training ({said}); "
            "policy() is asked before the first learn(), too, and has to act in the environment"
        ) from error
    checked_phases(actions, env.agents, as_traffic_env(env).action_spaces)
    return learner


def _counters(path: Path) -> dict[str, Any]:
    """Return the counters in a file of `OwnLearner.save`."""
    require_checkpoint(path)
    try:
        with zipfile.ZipFile(path) as packed:
            require_stored(packed)
            if OWN_COUNTERS not in packed.namelist():
                raise CheckpointError(
                    f"{path}: not the state of a learner of a user; only a file that a run of the "
                    "suite wrote is read: train with --learner MODULE:CLASS"
                )
            text = packed.read(OWN_COUNTERS).decode("utf-8")
            counters = parse_json(text, f"{path}, {OWN_COUNTERS}", CheckpointError)
            episodes = int(counters["episodes"])
            if episodes < 0:
                raise ValueError(f"{episodes} episodes")
            return {
                "version": int(counters.get("version", 1)),
                "episodes": episodes,
                "env_options": dict(counters["env_options"]),
                "settings": [str(setting) for setting in counters["settings"]],
            }
    except (OSError, zipfile.BadZipFile, *MALFORMED) as error:
        raise CheckpointError(f"{path}: not the state of a learner of a user ({error})") from None


def _require_methods(given: Any, name: str) -> None:
    """Refuse a learner that lacks a method, or whose method takes other arguments."""
    for method, arguments in NEEDED.items():
        own = getattr(given, method, None)
        wanted = f"{method}({', '.join(arguments)})"
        if not callable(own):
            raise OptionError(
                f"learner {name!r} has no method {wanted}; a learner needs "
                "learn(env, episodes) and policy()"
            )
        self_argument = 1 if inspect.isclass(given) and inspect.isfunction(own) else 0
        if not _takes(own, len(arguments) + self_argument):
            raise OptionError(
                f"learner {name!r}: its method {method}{inspect.signature(own)} is called as "
                f"{wanted}; give further arguments defaults"
            )


def _takes(function: Callable[..., Any], number: int, *names: str) -> bool:
    """Return True if a function can be called with so many positional and these named arguments."""
    try:
        inspect.signature(function).bind(*range(number), **dict.fromkeys(names))
    except TypeError:
        return False
    except ValueError:  # a function in C without a signature
        return True
    return True


def _last_line_in(kind: Any, error: BaseException) -> str:
    """Return where in the file of a class or function an error came up, as " (FILE, line 7)".

    It is "" if the file had no part in it.
    """
    try:
        file = inspect.getsourcefile(kind)
    except TypeError:  # a class without a source
        return ""
    line = line_in(file, error)
    return line and f" ({line})"


def _sees_infos(act: Callable[..., Any]) -> bool:
    """Return True if a policy's second argument is the infos, not an option of its own."""
    if not _takes(act, 2):
        return False
    second = [*_arguments(act).values()][1:2]
    return all(one.default is one.empty or one.name in _INFOS for one in second)


def _infos_name(act: Callable[..., Any]) -> str:
    """Return the name by which alone a policy takes infos, ``act(seen, *, infos)``; "" if none."""
    for name, one in _arguments(act).items():
        if name in _INFOS and one.kind is one.KEYWORD_ONLY and _takes(act, 1, name):
            return name
    return ""


def _wants_env(made: Callable[..., Any]) -> bool:
    """Return True if a class is to be made with the environment as its first argument."""
    if not _takes(made, 1):
        return False
    return not _takes(made, 0) or _first_argument(made) == "env"


def _whole(action: Any) -> int:
    """Return an action as a whole number.

    Raises:
        ValueError: It is none, such as 0.9.
    """
    if action != int(action):
        raise ValueError(action)
    return int(action)


def _arguments(function: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    """Return the arguments by name; none for a function in C without a signature."""
    try:
        return inspect.signature(function).parameters
    except (TypeError, ValueError):
        return {}


def _first_argument(function: Callable[..., Any]) -> str:
    return next(iter(_arguments(function)), "")


def _offered(make: Callable[..., Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of the values that a class or function has arguments for."""
    return {name: values[name] for name in _arguments(make) if name in values}


def _lacking(make: Callable[..., Any], given: Container[str]) -> list[str]:
    """Return the arguments without a default that a class or function is not given."""
    return [
        name
        for name, argument in _arguments(make).items()
        if name not in given
        and argument.default is argument.empty
        and argument.kind in (argument.POSITIONAL_OR_KEYWORD, argument.KEYWORD_ONLY)
    ]


def _converted(make: Callable[..., Any], settings: Sequence[str], name: str) -> dict[str, Any]:
    """Return the settings of a user's learner in the types of its arguments."""
    names = [key for key in _arguments(make) if key not in ("env", "seed")]
    return parsed_settings(settings, names, argument_types(make) if settings else {}, name)


def argument_types(make: Callable[..., Any]) -> dict[str, Any]:
    """Return the annotated types of the arguments of a class or function, by name."""
    hints: dict[str, Any] = {}
    function: Any = make.__init__ if inspect.isclass(make) else make
    for key, hint in getattr(function, "__annotations__", {}).items():
        with contextlib.suppress(NameError):  # a name that only checkers of types import
            hints |= _resolved(function, key, hint)
    return hints


def _resolved(function: Any, key: str, hint: Any) -> dict[str, Any]:
    """Return the type of one argument of a function by its name.

    Raises:
        NameError: The hint is a text with unknown names.
    """
    holder = type("holder", (), {"__annotations__": {key: hint}})
    return get_type_hints(holder, getattr(function, "__globals__", {}))


def _copied(given: Any, shared: Sequence[Any], name: str, memo: dict[int, Any]) -> Any:
    """Return a deep copy of a user's policy in which the shared objects stay the same."""
    try:
        return _copy(given, {**memo, **{id(item): item for item in shared}})
    except Exception as error:
        raise OptionError(
            f"policy of {name!r} cannot be copied ({type(error).__name__}: {error}); let policy() "
            "return an object that holds only what it needs to act"
        ) from error


def _captures(given: Any) -> bool:
    """Return True for a function that holds values: those of a closure, or defaults."""
    if not isinstance(given, FunctionType):
        return False
    return bool(given.__closure__ or given.__defaults__ or given.__kwdefaults__)


def _copy(given: Any, memo: dict[int, Any]) -> Any:
    """Return a deep copy, also of the functions in it that hold values.

    `copy.deepcopy` shares functions, so a policy would go on learning with its learner. Those with
    closures or defaults are copied first and put into its memo.
    """
    if _captures(given):
        _copy_function(given, memo)
        return memo[id(given)]
    for function in _functions_in(given, set(memo)):
        try:
            _copy_function(function, memo)
        except Exception:  # noqa: BLE001 - what it holds cannot be copied, such as a lock
            memo.pop(id(function), None)
    return copy.deepcopy(given, memo)


def _functions_in(given: Any, seen: set[int]) -> Iterator[FunctionType]:
    """Find the functions that hold values in an object: its attributes, members and arguments.

    Functions of modules, such as those of torch, stay what they are. What the others hold is not
    looked into, and neither are objects that are copied in a way of their own.

    Args:
        given: The object.
        seen: Identities of what is left out; those of all that was looked at are added.
    """
    if id(given) in seen or isinstance(given, (type, ModuleType)):
        return
    seen.add(id(given))
    if isinstance(given, FunctionType):
        module = sys.modules.get(given.__module__)
        if _captures(given) and getattr(module, given.__qualname__, None) is not given:
            yield given
        return
    if hasattr(type(given), "__deepcopy__"):
        return
    held: list[Any] = [*getattr(given, "__dict__", {}).values()]
    for slots in (getattr(kind, "__slots__", ()) for kind in type(given).__mro__):
        names = (slots,) if isinstance(slots, str) else slots
        held += [getattr(given, name, None) for name in names]
    if isinstance(given, functools.partial):
        held += [given.func, *given.args, *given.keywords.values()]
    elif isinstance(given, Mapping):
        held += given.values()
    elif isinstance(given, (list, tuple, set, frozenset, deque)):
        held += given
    elif isinstance(given, MethodType):
        held.append(given.__self__)
    for one in held:
        yield from _functions_in(one, seen)


def _copy_function(given: FunctionType, memo: dict[int, Any]) -> None:
    """Put a copy of a function into the memo, with copies of the values that it holds."""
    if id(given) in memo:
        return
    cells = tuple(CellType() for _ in given.__closure__ or ())
    made = FunctionType(given.__code__, given.__globals__, given.__name__, None, cells)
    memo[id(given)] = made  # before its values, which may hold the function itself
    for cell, old in zip(cells, given.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # an empty cell
            cell.cell_contents = _copy(old.cell_contents, memo)
    made.__defaults__ = _copy(given.__defaults__, memo)
    made.__kwdefaults__ = _copy(given.__kwdefaults__, memo)
    made.__dict__.update(given.__dict__)
