"""Specification of the environments of a vector, in plain values to send to a process."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from ugat_marl.effects import (
    Domain,
    domain_path,
    effect_from_record,
    is_one_domain,
    load_scenario,
    parse_domain,
    scenario_in_domain,
)
from ugat_marl.envs.agents import AgentSet
from ugat_marl.envs.options import EnvOptions
from ugat_marl.envs.traffic_env import parallel_env
from ugat_marl.envs.types import AnyParallelEnv
from ugat_marl.errors import OptionError
from ugat_marl.scenarios import Scenario

DomainOf = Callable[[int, int], Domain]
"""Function ``(number of the environment, number of its episode) -> domain``."""

Wrap = Callable[[Any], AnyParallelEnv] | str
"""An importable function from environment to environment, or its ``"module:name"``."""

Wraps = Wrap | Sequence[Wrap] | None
"""One wrapper, a list of wrappers with the innermost first, or none."""


@dataclass(frozen=True)
class Spec:
    """Specification of an environment.

    Attributes:
        scenario: Folder of the scenario.
        applied: Effects in the scenario; some of them are in no file.
        options: Options of `EnvOptions`.
        functions: Option to ``"module:name"``, for a reward or an observation that is a function.
        fitted: ``"module:name"`` of each fitted change, with its values.
        wraps: ``"module:name"`` of each wrapper.
        modules: Modules of the user that these names are in, each with `file_version`.
    """

    scenario: str
    applied: Sequence[str]
    options: Mapping[str, Any]
    functions: Mapping[str, str]
    fitted: Sequence[tuple[str, Mapping[str, Any]]]
    wraps: Sequence[str]
    modules: Mapping[str, Sequence[int]] = field(default_factory=dict[str, Sequence[int]])

    @classmethod
    def of(cls, scenario: Scenario, options: Mapping[str, Any], wraps: Wraps) -> Spec:
        """Return the specification of an environment; its scenario still has to be written."""
        plain = dict(options)
        plain.pop("deadline_s", None)  # the user's process keeps it
        functions = {
            name: spelling(name, plain.pop(name))
            for name in ("reward", "observation")
            if callable(plain.get(name))
        }
        fitted = [
            (spelling("fitted", type(part)), part.state_dict()) for part in plain.pop("fitted", ())
        ]
        around = [spelling("wrap", each) for each in listed(wraps)]
        names = [*functions.values(), *(name for name, _ in fitted), *around]
        modules = {name.partition(":")[0] for name in names}
        versions = {
            module: file_version(module)
            for module in sorted(modules)
            if module.partition(".")[0] != "ugat_marl"
        }
        return cls("", scenario.applied, plain, functions, fitted, around, versions)

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return asdict(self)

    def environment(self, domain: Any) -> AnyParallelEnv:
        """Make the environment in a domain of `sent`, with the simulator in this process."""
        options = dict(self.options)
        options |= {name: imported(text) for name, text in self.functions.items()}
        options["fitted"] = tuple(imported(text).from_state(state) for text, state in self.fitted)
        options["simulator"] = "inprocess"
        scenario = load_scenario(self.scenario, options.get("duration_s"))
        scenario = replace(scenario, applied=tuple(self.applied))
        env: AnyParallelEnv = parallel_env(scenario, received(domain), **options)
        for wrap in self.wraps:
            env = imported(wrap)(env)
        return env


def checked_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options as plain values; refuse those that have no meaning in a vector.

    Raises:
        UnknownNameError: An option does not exist.
        OptionError: An option chooses the simulator or a render mode.
    """
    checked = EnvOptions.of(options)
    for name in ("simulator", "render_mode"):
        if options.get(name) is not None:
            raise OptionError(
                f"{name} = {options[name]!r}: the simulations of a vector_env run in processes of "
                "their own and draw nothing; use parallel_env for that"
            )
    return {name: getattr(checked, name) for name in options}


def listed(wraps: Wraps) -> list[Wrap]:
    """Return wrappers as a list, the innermost first.

    Raises:
        OptionError: It is neither a wrapper nor a list of them.
    """
    if wraps is None:
        return []
    if isinstance(wraps, str) or callable(wraps):
        return [wraps]
    given: Any = wraps
    if not isinstance(given, Sequence):
        raise OptionError(f"wrap = {given!r}: must be a wrapper or a list of wrappers")
    return list(wraps)


def spelling(option: str, function: Callable[..., Any] | str) -> str:
    """Return the ``"module:name"`` with which a worker imports a function.

    Raises:
        OptionError: A worker cannot import the function.
    """
    if isinstance(function, str):
        imported(function)
        return function
    module, name = getattr(function, "__module__", None), getattr(function, "__qualname__", "<")
    if module in (None, "__main__") or "<" in name:
        raise OptionError(
            f"{option} = {function!r}: the workers of a vector_env import it by its name, which a "
            "lambda, an inner function and one of the program itself do not have; move it to a "
            "module, at its top level"
        )
    text = f"{module}:{name}"
    if imported(text) != function:  # such as a decorated one that has the name of the original
        raise OptionError(
            f"{option} = {function!r}: the workers of a vector_env import it as {text!r}, which is "
            "another function; give it a name of its own at the top level of a module (a decorator "
            "with functools.wraps copies the name of what it decorates)"
        )
    return text


def imported(text: str) -> Any:
    """Return the function of a ``"module:name"``.

    Raises:
        OptionError: The function does not exist.
    """
    module, _, name = text.partition(":")
    try:
        imported_object: Any = importlib.import_module(module)
        for part in name.split("."):
            imported_object = getattr(imported_object, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise OptionError(
            f"{text!r} cannot be imported ({error}); write module:name, such as "
            "ugat_marl.envs.wrappers:pad_spaces"
        ) from None
    return imported_object


def file_version(module: str) -> list[int]:
    """Return time of change, ns, and size of an imported module's file; nothing without a file."""
    file = getattr(sys.modules.get(module), "__file__", None)
    try:
        status = Path(file).stat() if file else None
    except OSError:
        status = None
    return [] if status is None else [status.st_mtime_ns, status.st_size]


def sent(domain: Domain) -> Any:
    """Return a domain in values for JSON, without loss of digits."""
    if not isinstance(domain, str):
        return [effect.record() for effect in parse_domain(domain)]
    path = domain_path(domain)
    return domain if path is None else str(path.resolve())


def received(domain: Any) -> Domain:
    """Return the domain from the values of `sent`."""
    return domain if isinstance(domain, str) else [effect_from_record(record) for record in domain]


def domain_chooser(
    scenario: Scenario,
    domains: Domain | Sequence[Domain] | DomainOf,
    n: int,
    duration_s: float | None = None,
) -> DomainOf:
    """Return the function that gives the domain of each episode.

    Args:
        scenario: Scenario of the environments.
        domains: One domain, a list of `n`, or a function.
        n: Number of environments.
        duration_s: Length of their episodes, s; None for that of the scenario.

    Raises:
        OptionError: The list has another length, or mixes domains and single effects.
        UnknownNameError: A domain does not exist.
    """
    if callable(domains):
        return domains
    given: Any = domains
    if is_one_domain(given):
        scenario_in_domain(scenario, given, duration_s=duration_s)
        return lambda environment, episode: given
    listed: list[Any] = list(given)
    if len(listed) != n:
        raise OptionError(
            f"domains has {len(listed)} entries for {n} environments: give one for each, or "
            "ugat_marl.envs.vector.spec.in_turn(domains), which goes through a list of any length"
        )
    for domain in {str(sent(domain)): domain for domain in listed}.values():
        scenario_in_domain(scenario, domain, duration_s=duration_s)
    return lambda environment, episode: listed[environment]


def in_turn(domains: Domain | Sequence[Domain]) -> DomainOf:
    """Return a domain randomisation in which each environment goes through a list.

    Episode ``k`` of environment ``i`` is in domain ``(i + k) mod len(domains)``, for any number of
    environments.

    Args:
        domains: List of at least one domain; one domain stands for a list of it.

    Raises:
        OptionError: The list is empty, or it is no list.
    """
    given: Any = domains
    if not isinstance(given, Iterable):
        raise OptionError(f"in_turn({given!r}): give a list of domains")
    given = given if isinstance(given, Sequence) else list(given)
    listed: list[Any] = [given] if given and is_one_domain(given) else list(given)
    if not listed:
        raise OptionError("in_turn() needs at least one domain")
    return lambda environment, episode: listed[(environment + episode) % len(listed)]


def agents_of(env: AnyParallelEnv) -> dict[str, list[Any]]:
    """Return the agents of an environment with their sizes, for JSON."""
    return {name: list(values) for name, values in asdict(AgentSet.of(env)).items()}
