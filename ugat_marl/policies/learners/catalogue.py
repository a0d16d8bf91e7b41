"""Every learner by name: the suite's own two, those in the files of baselines/, and a user's.

"dqn" learns a network for each intersection. "universal" is the same algorithm with one network
that all share, whatever their lanes and phases.

A new learner needs a file in baselines/ and a row in `BASELINES`. The file holds a class that
follows the protocol `Learner` and is made as ``Learner(env, config, seed)``, and a dataclass of its
settings. Its policies are of class `NetworkPolicy`, which all commands read. A file of baselines/
is loaded at its first use.

A user's learner has the name ``module:name`` and needs no row here (`policies.own`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any, get_type_hints

from ugat_marl.data import installed_version
from ugat_marl.envs import AnyParallelEnv
from ugat_marl.errors import OptionError, UnknownNameError, install_command
from ugat_marl.policies.learner_settings import parsed_settings, setting_name, setting_text
from ugat_marl.policies.learners.dqn_config import DQNConfig, UsualValue
from ugat_marl.policies.own import OwnLearnerFactory, argument_types, own_learner_options
from ugat_marl.policies.own_names import is_own, load_own, module_of_file, require_unchanged
from ugat_marl.policies.protocols import Learner

LearnerFactory = Callable[[AnyParallelEnv, int], Learner]
"""Make a new learner for the agents of an environment; a seed fixes its initial weights."""

DQN_NAME = "dqn"
UNIVERSAL_NAME = "universal"

SUITE_LEARNERS: Mapping[str, DQNConfig] = {
    DQN_NAME: DQNConfig(),
    UNIVERSAL_NAME: DQNConfig(
        network="universal",
        hidden=(32, 32),
        steps=3,
        warmup_decisions=100,
        epsilon_decay_decisions=1_200,
        teacher="best",
    ),
}
"""The suite's own learners: settings of DQN by name."""

OBSERVED: Mapping[str, Mapping[str, Any]] = {
    UNIVERSAL_NAME: {"observation": "movements", "commands": 4}
}
"""Options of the environment that a learner needs, by its name."""


@dataclass(frozen=True)
class Baseline:
    """Source of a learner: its file, its classes, and the library it needs.

    Attributes:
        file: Name of the file in baselines/, without suffix.
        learner: Name of the learner's class in the file.
        config: Name of the settings' dataclass in the file.
        extra: Extra of the package that installs its libraries; "" for none.
        library: Name of the library on PyPI that does the learning; "" for none.
        settings: Settings that the learner's name fixes.
    """

    file: str
    learner: str
    config: str
    extra: str = ""
    library: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)


BASELINES: Mapping[str, Baseline] = {
    "ippo": Baseline("ippo", "IPPO", "IPPOConfig"),
    "mappo": Baseline("ippo", "IPPO", "IPPOConfig", settings={"centralised": True}),
    "sb3-ppo": Baseline(
        "sb3", "SB3", "SB3Config", "sb3", "stable-baselines3", {"algorithm": "ppo"}
    ),
    "sb3-dqn": Baseline(
        "sb3", "SB3", "SB3Config", "sb3", "stable-baselines3", {"algorithm": "dqn"}
    ),
    "maskable-ppo": Baseline(
        "sb3", "SB3", "SB3Config", "sb3", "sb3-contrib", {"algorithm": "maskable-ppo"}
    ),
    "supersuit-ppo": Baseline(
        "supersuit_ppo", "SuperSuitPPO", "SuperSuitConfig", "sb3", "supersuit"
    ),
    "torchrl-mappo": Baseline(
        "torchrl_mappo", "TorchRLMAPPO", "TorchRLConfig", "torchrl", "torchrl"
    ),
    "skrl-ippo": Baseline("skrl_ippo", "Skrl", "SkrlConfig", "skrl", "skrl"),
    "skrl-mappo": Baseline(
        "skrl_ippo", "Skrl", "SkrlConfig", "skrl", "skrl", {"centralised": True}
    ),
    "qmix": Baseline(
        "benchmarl_task",
        "BenchMARL",
        "BenchMARLConfig",
        "benchmarl",
        "benchmarl",
        {"algorithm": "qmix"},
    ),
    "vdn": Baseline(
        "benchmarl_task",
        "BenchMARL",
        "BenchMARLConfig",
        "benchmarl",
        "benchmarl",
        {"algorithm": "vdn"},
    ),
    "rllib-ppo": Baseline("rllib_ppo", "RLlib", "RLlibConfig", "rllib", "ray"),
}


def learner_factory(
    name: str,
    settings: Sequence[str] = (),
    dqn: DQNConfig | None = None,
    device: str = "cpu",
) -> LearnerFactory:
    """Return the maker of the named learner; its library is imported now.

    Args:
        name: One of `SUITE_LEARNERS` or of `BASELINES`, or ``module:name`` of a user's learner.
        settings: Settings of a baseline or of a user's learner, as ``NAME=VALUE``; commas separate
            the parts of a tuple.
        dqn: Settings of the suite's own learners that differ from the defaults; None for none.
        device: Device of the updates of the suite's own learners (`devices.device_of`); baselines
            stay on the CPU.

    Raises:
        UnknownNameError: There is no such learner, or no such setting.
        OptionError: A value is impossible, the library is not installed, or there is no such
            device.
        CheckpointError: The file of the first weights is missing or damaged.
    """
    from ugat_marl.policies.devices import device_of

    place = device_of(device)
    if is_own(name):  # an edit of its file does not end a run that has begun
        return OwnLearnerFactory(name, settings)
    require_known_learner(name)
    if name in SUITE_LEARNERS:
        if settings:
            raise OptionError(f"learner settings {' '.join(settings)}: those of {name} are --dqn.*")
        from ugat_marl.policies.learners.dqn import DQN
        from ugat_marl.policies.learners.initial_weights import InitialWeights
        from ugat_marl.policies.learners.lessons import BEST
        from ugat_marl.policies.rules.catalogue import parse_rule

        suite = suite_config(name, dqn)
        if suite.teacher and suite.teacher != BEST:
            parse_rule(suite.teacher)  # a slip is an error now
        if suite.start is not None:
            InitialWeights.load(Path(suite.start))  # a damaged file is an error now
        return lambda env, seed: DQN.of(env, suite, seed, device=place)
    config = _baseline_config(name, settings)
    make = getattr(load_baseline(name), BASELINES[name].learner)
    return lambda env, seed: make(env, config, seed)


def suite_config(name: str, given: DQNConfig | None = None) -> DQNConfig:
    """Return the settings of one of the suite's own learners.

    Args:
        name: One of `SUITE_LEARNERS`.
        given: Settings of the user; those that were given, or differ from the defaults of DQN, are
            taken.
    """
    usual = DQNConfig()
    given = given or usual
    own = SUITE_LEARNERS[name]
    values = {option.name: getattr(given, option.name) for option in fields(usual)}
    changed = {
        key: value
        for key, value in values.items()
        if value != getattr(usual, key)
        or (key in _OF_THE_NAME and not isinstance(value, UsualValue))
    }
    settled = {"teacher": own.teacher or None, "network": str(own.network)}
    return replace(own, **{**settled, **changed})


def lesson_episodes(name: str, given: DQNConfig | None = None, *, known: bool = False) -> int:
    """Return how many episodes the lessons of a learner play at most; 0 if it has none.

    Args:
        name: Name of the learner.
        given: Settings of the user, see `suite_config`.
        known: True if the best rule is known, so that none has to be looked for.
    """
    from ugat_marl.policies.learners.lessons import plays  # torch, which a list does without

    config = suite_config(name, given) if name in SUITE_LEARNERS else None
    if config is None or not config.teacher:
        return 0
    return config.lessons if known else plays(config.teacher, config.lessons)


_OF_THE_NAME = ("hidden", "network", "steps", "warmup_decisions", "epsilon_decay_decisions")
"""Settings that the name of a learner decides, unless they are given, even as DQN's defaults."""


def observed_options(name: str) -> dict[str, Any]:
    """Return the options of the environment that a learner needs; empty if any will do."""
    return own_learner_options(name) if is_own(name) else dict(OBSERVED.get(name, {}))


def baseline_settings(name: str, given: Sequence[str] = ()) -> dict[str, Any]:
    """Return all settings of a baseline.

    Args:
        name: One of `BASELINES`.
        given: Settings that differ from the defaults, as for `learner_factory`.

    Raises:
        UnknownNameError: There is no such setting.
        OptionError: A value is impossible, or the library is not installed.
    """
    return asdict(_baseline_config(name, given))


def setting_texts(name: str, settings: Mapping[str, Any]) -> tuple[str, ...]:
    """Return settings of a learner as ``NAME=VALUE``, as `learner_factory` takes them.

    Args:
        name: Name of the learner.
        settings: Values of Python, by name.

    Raises:
        OptionError: A value cannot be read from a text, the library is not installed, or a user's
            learner cannot be found.
    """
    hints: Mapping[str, Any] = {}
    if is_own(name):
        hints = argument_types(load_own(name, "learner"))
    elif name in BASELINES:
        hints = get_type_hints(getattr(load_baseline(name), BASELINES[name].config))
    return tuple(
        setting_text(key, value, hints.get(setting_name(key), Any))
        for key, value in settings.items()
    )


def _baseline_config(name: str, settings: Sequence[str]) -> Any:
    baseline = BASELINES[name]
    kind = getattr(load_baseline(name), baseline.config)
    return _configured(kind, baseline.settings, settings, name)


def require_known_learner(name: str) -> None:
    """Refuse the name of a learner that does not exist.

    Raises:
        UnknownNameError: It is neither one of `SUITE_LEARNERS` nor of `BASELINES`.
        OptionError: A user's learner cannot be found, or its file was changed after its import.
    """
    if is_own(name):
        require_unchanged(name)
    elif name not in SUITE_LEARNERS and name not in BASELINES:
        hint = "An algorithm of your own: --learner my_module:MyLearner."
        raise UnknownNameError("learner", name, (*SUITE_LEARNERS, *BASELINES), hint)


def learner_library(name: str) -> str:
    """Return a learner's library with its version; "" for the suite's own learners."""
    library = BASELINES[name].library if name in BASELINES else ""
    return library and f"{library} {installed_version(library) or '-'}"


def load_baseline(name: str) -> ModuleType:
    """Return the module of a baseline; all calls return the same object.

    Raises:
        OptionError: Its library is not installed.
    """
    baseline = BASELINES[name]
    path = baselines_folder() / f"{baseline.file}.py"
    if not path.is_file():
        raise OptionError(f"learner {name!r}: {path} is missing; install the package again")
    try:
        return module_of_file(path, f"ugat_marl_baseline_{baseline.file}")
    except ModuleNotFoundError as error:
        missing = str(error.name).partition(".")[0]
        if missing == "ugat_marl":
            raise
        raise OptionError(
            f"learner {name!r} needs {missing}, which is not installed; run "
            f"{install_command(baseline.extra)}, or in a checkout "
            f"pip install -c constraints-baselines.txt -e '.[{baseline.extra}]'"
        ) from None


def baselines_folder() -> Path:
    """Return the folder of baselines: beside the package in a checkout, inside it in a wheel."""
    package = Path(__file__).resolve().parents[2]
    inside = package / "_baselines"
    return inside if inside.is_dir() else package.parent / "baselines"


def _configured(kind: Any, preset: Mapping[str, Any], given: Sequence[str], name: str) -> Any:
    """Make the settings of a learner from those that its name fixes and those of the user."""
    names = [option.name for option in fields(kind) if option.name not in preset]
    return kind(**preset, **parsed_settings(given, names, get_type_hints(kind), name))
