"""Content of a ``scenario.toml``, checked value by value."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import pydantic
from pydantic import Field

from ugat_marl.errors import ScenarioError, nearest, unknown_key
from ugat_marl.scenarios.admission import DECIMAL, OPTIONS, option_fault

PhaseSource = Literal["programme", "conflict-free", "permitted"] | tuple[str, ...]
"""Source of an intersection's green phases.

- ``programme``: the network's own signal programme.
- ``conflict-free``: all maximal sets of movements without conflicts.
- ``permitted``: the same, with left turns that give way to opposite traffic.
- A list: SUMO states.
"""

Real = Annotated[float, pydantic.Strict()]
"""A number of a file. Without this, ``true`` would be 1, and a text of digits a number."""


_STRICT = pydantic.ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ControlSettings(pydantic.BaseModel):
    """Signal timing of a scenario. Times are in seconds, the reach is in metres."""

    model_config = _STRICT

    decision_interval_s: Annotated[Real, Field(gt=0, le=600)] = 10.0
    yellow_s: Annotated[Real, Field(ge=0, le=60)] = 3.0
    all_red_s: Annotated[Real, Field(ge=0, le=60)] = 2.0
    min_green_s: Annotated[Real, Field(ge=0, le=600)] = 5.0
    phases: PhaseSource = "programme"
    late_green_s: Annotated[Real, Field(ge=0, le=60, exclude_if=lambda value: value == 0)] = 0.0
    """Seconds by which every green is shown late; agents do not see this delay."""
    reach_m: Annotated[Real, Field(ge=0, le=2000, exclude_if=lambda value: value == 0)] = 0.0
    """Distance upstream of a stop line, m, within which vehicles count beyond short lanes too."""


_IN_STEPS = ("decision_interval_s", "yellow_s", "all_red_s", "min_green_s")
"""Times of `ControlSettings` that have to be whole numbers of simulation steps."""


def usual_times(step_s: float) -> dict[str, float]:
    """Return the usual times that are no whole number of steps, in s, each made longer until it is.

    Args:
        step_s: Length of a simulation step, s.
    """
    usual = ControlSettings()
    times = {name: float(getattr(usual, name)) for name in _IN_STEPS}
    return {
        name: round(math.ceil(time_s / step_s - 1e-6) * step_s, 6)
        for name, time_s in times.items()
        if not _is_whole(time_s / step_s)
    }


def _is_whole(number: float) -> bool:
    return abs(number - round(number)) <= 1e-6


class IntersectionSettings(pydantic.BaseModel):
    """Settings of one traffic light that differ from `ControlSettings`."""

    model_config = _STRICT

    phases: PhaseSource | None = None
    late_green_s: Annotated[
        Real | None, Field(ge=0, le=60, exclude_if=lambda value: value is None)
    ] = None


class ScenarioFile(pydantic.BaseModel):
    """The content of a ``scenario.toml``."""

    model_config = _STRICT

    description: str = ""
    network: str
    routes: Annotated[tuple[str, ...], Field(min_length=1)]
    additional: tuple[str, ...] = ()
    begin_s: Annotated[Real, Field(ge=0)] = 0.0
    duration_s: Annotated[Real, Field(gt=0, le=1e7)] = 3600.0
    step_length_s: Annotated[Real, Field(ge=0.001, le=10)] = 1.0
    control: ControlSettings = ControlSettings()
    intersections: dict[str, IntersectionSettings] = {}
    effects: tuple[dict[str, Any], ...] = ()
    sumo: dict[str, str] = {}

    @property
    def is_mesoscopic(self) -> bool:
        """True if SUMO's mesoscopic model (``queue_model``) takes the place of car following."""
        return "mesosim" in self.sumo


def validate_settings(raw: Mapping[str, Any], source: str) -> ScenarioFile:
    """Check the content of a scenario file.

    Args:
        raw: Keys and values.
        source: Name of the file in errors.

    Raises:
        ScenarioError: A key is unknown or missing, a value is impossible, or values contradict each
            other.
    """
    try:
        settings = ScenarioFile.model_validate(raw)
    except pydantic.ValidationError as error:
        explained = dict.fromkeys(_explain(problem) for problem in error.errors())
        raise ScenarioError(f"{source}: {'; '.join(explained)}") from None
    for option, value in settings.sumo.items():
        if option not in OPTIONS:
            guess = nearest(option, OPTIONS)
            raise ScenarioError(
                f"{source}: sumo.{option} is set by the suite or names files, and cannot be given; "
                f"leave it out{f', or did you mean {guess!r}?' if guess else ''}"
            )
        if fault := option_fault(option, value):
            raise ScenarioError(f"{source}: sumo.{option} = {value!r} {fault}")
    control = settings.control
    step = settings.step_length_s
    times = {f"control.{name}": float(getattr(control, name)) for name in _IN_STEPS}
    for key, value in {"begin_s": settings.begin_s, **times}.items():
        if not _is_whole(value / step):
            raise ScenarioError(
                f"{source}: {key} = {value:g} is not a multiple of step_length_s = {step:g}; "
                "SUMO would cut it short"
            )
    if control.reach_m and settings.is_mesoscopic:
        raise ScenarioError(
            f"{source}: control.reach_m = {control.reach_m:g}, but in SUMO's mesoscopic model "
            "(queue_model) only lanes shorter than a vehicle are counted with those upstream of a "
            "lane; leave out one of the two"
        )
    model = settings.sumo.get("mesosim")
    if model is not None and (model != "true" or "meso-edgelength" not in settings.sumo):
        raise ScenarioError(
            f"{source}: sumo.mesosim = {model!r}: the mesoscopic model is 'true' with a "
            "meso-edgelength, as the effect queue_model sets them; leave it out for car following"
        )
    if settings.duration_s < control.decision_interval_s:
        raise ScenarioError(
            f"{source}: duration_s = {settings.duration_s:g} is shorter than one decision interval "
            f"({control.decision_interval_s:g} s)"
        )
    return settings


def parse_decimal(text: str) -> float:
    """Return the number in a text of a file, as every other program would read it.

    Python itself also reads ``1_000``, digits of other scripts, ``nan`` and ``inf``.

    Raises:
        ValueError: Not a number in plain digits, or one too large.
    """
    value = float(text) if DECIMAL.fullmatch(text.strip()) else math.nan
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def parse_time(text: str) -> float:
    """Return the seconds of a time as SUMO writes it: ``seconds``, ``h:m:s`` or ``days:h:m:s``.

    Raises:
        ValueError: Not a time, or one too large.
    """
    if ":" not in text:  # as in nearly every file
        return parse_decimal(text) + 0.0  # "-0" is 0
    parts = [parse_decimal(part) for part in text.split(":")]
    if len(parts) not in (3, 4):
        raise ValueError(text)
    seconds = 0.0
    for part, unit in zip(reversed(parts), (1, 60, 3600, 86400), strict=False):
        seconds += part * unit
    if not math.isfinite(seconds):  # each part may be finite, and their sum not
        raise ValueError(text)
    return seconds


def seconds_text(value: float) -> str:
    """Return a time in s as text for a file, rounded to 1 ms, the resolution of SUMO."""
    return f"{value:.3f}".rstrip("0").rstrip(".")


def _explain(problem: Any) -> str:
    """Return one error of pydantic in the terms of ``scenario.toml``."""
    names = [str(part) for part in problem["loc"]]
    table = names[0] if names else ""  # an error of the whole file has no place
    place = 1 if table == "control" else 2  # [control] phases, [intersections.A1] phases
    is_phases = table in ("control", "intersections") and names[place : place + 1] == ["phases"]
    if is_phases and problem["type"] != "extra_forbidden":
        key = ".".join(names[: place + 1])  # pydantic adds the alternatives of the union
        if problem["type"] == "missing":
            return f"key {key!r} is missing"
        allowed = "'programme', 'conflict-free', 'permitted', or a list of SUMO states in quotes"
        return f"{key}: give {allowed}"
    key = ".".join(names)
    if problem["type"] == "extra_forbidden":
        if len(names) == 1 and names[0] in ControlSettings.model_fields:
            return f"unknown key {key!r}; it belongs under [control]"
        return unknown_key(key, names[-1], _known_keys(names[:-1]))
    if problem["type"] == "missing":
        return f"key {key!r} is missing"
    return f"{key} = {problem['input']!r}: {problem['msg'][:1].lower()}{problem['msg'][1:]}"


def _known_keys(table: list[str]) -> list[str]:
    """Return the keys that the table of an unknown key allows."""
    if not table:
        return [*ScenarioFile.model_fields]
    if table[0] == "intersections":
        return [*IntersectionSettings.model_fields]
    return [*ControlSettings.model_fields]
