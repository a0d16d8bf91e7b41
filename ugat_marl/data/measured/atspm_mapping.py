"""Mapping file: from the numbers in a controller's log to lights, links and lanes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from datetime import date, datetime, time
from pathlib import Path
from typing import Annotated, Any

import pydantic
from pydantic import Field
from pydantic_core import PydanticCustomError

from ugat_marl.data.measured.local_time import require_time_zone
from ugat_marl.errors import MeasuredDataError, unknown_key
from ugat_marl.files import read_toml
from ugat_marl.scenarios import DetectorKind, Real, Split

_STRICT = pydantic.ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
_LARGEST = 2**31 - 1
"""Largest number of a channel, phase or link; logs have columns of no more bits."""
Index = Annotated[int, pydantic.Strict(), Field(ge=0, le=_LARGEST)]
Text = Annotated[str, Field(min_length=1)]


def _name(value: Any) -> Any:
    """Turn whole numbers into names, as in ``id = 1136``."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _digits(value: Any) -> Any:
    """Refuse a key such as ``1_0``, which Python would read as 10."""
    if isinstance(value, str) and not (value.isascii() and value.isdecimal()):
        raise ValueError(f"{value[:40]!r} is not a number; write plain digits")
    return value


def _no_number(value: Any) -> Any:
    """Refuse a number, in quotes or not: it would be read as seconds from 1970 on in UTC."""
    try:
        float(value)
    except (TypeError, ValueError):
        return value
    raise PydanticCustomError("datetime_number", "not a local time")


Number = Annotated[int, pydantic.BeforeValidator(_digits), Field(le=_LARGEST)]
"""Number of a phase, overlap or link that is the key of a table."""
Name = Annotated[Text, pydantic.BeforeValidator(_name)]
LocalTime = Annotated[datetime, pydantic.BeforeValidator(_no_number)]


class Links(pydantic.BaseModel):
    """Links of a phase or overlap, by their index in the signal state.

    Attributes:
        green: Links that are green with the phase. Their letter (``G`` or ``g``) comes from the
            network's programme.
        permissive: Links that are green with the phase but must yield (``g``).
        flashing: Links that may go but must yield (``g``) while the phase's arrow flashes yellow
            (events 32 and 33).
    """

    model_config = _STRICT

    green: tuple[Index, ...] = ()
    permissive: tuple[Index, ...] = ()
    flashing: tuple[Index, ...] = ()


def _as_links(value: Any) -> Any:
    return {"green": value} if isinstance(value, list) else value


LinksOf = Annotated[Links, pydantic.BeforeValidator(_as_links)]


class DetectorChannel(pydantic.BaseModel):
    """Detector channel of a controller, and its position on a lane."""

    model_config = _STRICT

    channel: Index
    lane: Text
    position_m: Real
    length_m: Real = 0.0
    kind: DetectorKind
    id: Name = ""
    latency_s: Annotated[Real, Field(ge=0, le=10)] = 0.0
    """Delay of the detector's time stamps, s; it is subtracted from them."""


class Device(pydantic.BaseModel):
    """Controller and its traffic light in the network.

    Attributes:
        id: Id in the log.
        tls: Traffic light.
        phases: Phase to its links.
        overlaps: Overlap to its links.
        constant: Link that always shows the same letter, to the letter.
        on_red: Links on which vehicles may go on red after a stop (``s`` in place of ``r``).
        detectors: Channels with detectors.
    """

    model_config = _STRICT

    id: Name
    tls: Text
    phases: dict[Number, LinksOf] = {}
    overlaps: dict[Number, LinksOf] = {}
    constant: dict[Number, Annotated[str, Field(pattern="^[rugGyYoOs]$")]] = {}
    on_red: tuple[Index, ...] = ()
    detectors: tuple[DetectorChannel, ...] = ()


class Span(pydantic.BaseModel):
    """A period of measurement; `zero` is the local time at which the scenario's clock is 0."""

    model_config = _STRICT

    id: Name = ""
    zero: LocalTime
    begin_s: Real | None = None
    end_s: Real | None = None
    split: Split | None = None


class AtspmMapping(pydantic.BaseModel):
    """The content of a mapping file."""

    model_config = _STRICT

    time_zone: str = ""
    zero: tuple[LocalTime, ...] = ()
    begin_s: Real | None = None
    end_s: Real | None = None
    periods: tuple[Span, ...] = ()
    devices: Annotated[tuple[Device, ...], Field(min_length=1)]

    def spans(self) -> tuple[Span, ...]:
        """Return all periods, with names."""
        given = self.periods or tuple(Span(zero=zero) for zero in self.zero)
        return tuple(
            span.model_copy(
                update={
                    "id": span.id or span.zero.strftime("%Y-%m-%dT%H%M"),
                    "begin_s": self.begin_s if span.begin_s is None else span.begin_s,
                    "end_s": self.end_s if span.end_s is None else span.end_s,
                }
            )
            for span in given
        )


def read_mapping(
    path: Path, widths: Mapping[str, int], driven: Mapping[str, Collection[int]]
) -> AtspmMapping:
    """Read and check a mapping file.

    Args:
        path: The TOML file.
        widths: Number of letters in the state of each traffic light of the network.
        driven: Traffic light to the indices of its letters for vehicles, which must be mapped.
            Other letters are red if they are not mapped. All letters of a traffic light that is not
            listed must be mapped.

    Raises:
        MeasuredDataError: The file is unreadable, has missing or unknown keys, or has no periods.
            Or a traffic light is unknown or mapped twice, or links are not mapped or unknown.
    """
    try:
        mapping = AtspmMapping.model_validate(read_toml(path, MeasuredDataError))
    except pydantic.ValidationError as error:
        said = "; ".join(_faults(error)[:4])
        raise MeasuredDataError(
            f"{path}: {said}; docs/reference/measured-data.md has the keys"
        ) from None
    if bool(mapping.zero) == bool(mapping.periods):
        raise MeasuredDataError(
            f"{path}: give zero (the local times at which the scenario's clock is 0), or "
            "[[periods]] with a zero each, and not both"
        )
    require_time_zone(mapping.time_zone, str(path))
    _check_devices(path, mapping.devices, widths, driven)
    return mapping


_TABLES: dict[str, type[pydantic.BaseModel]] = {
    "devices": Device, "detectors": DetectorChannel, "periods": Span,
    "phases": Links, "overlaps": Links,
}  # fmt: skip
"""Key of a table in the file to its content."""


def _faults(error: pydantic.ValidationError) -> list[str]:
    """Return the faults of a mapping file in its own terms."""
    problems = error.errors()
    # pydantic calls a list too short if its items have faults
    faulty = {
        problem["loc"][:length] for problem in problems for length in range(len(problem["loc"]))
    }
    return [_explain(problem) for problem in problems if problem["loc"] not in faulty]


def _explain(problem: Any) -> str:
    *table, name = problem["loc"] or ("",)
    key = ".".join(map(str, problem["loc"]))
    if problem["type"] == "extra_forbidden":
        inside = [part for part in table if part in _TABLES]
        known = (_TABLES[inside[-1]] if inside else AtspmMapping).model_fields
        return unknown_key(key, str(name), known)
    if problem["type"] == "missing":
        return f"key {key!r} is missing"
    given = problem["input"]
    if problem["type"].startswith("datetime"):
        return f"{key} = {given!r}: write a local time such as 2024-03-04 07:00:00"
    if problem["type"] == "tuple_type" and not isinstance(given, dict):
        shown = given.isoformat() if isinstance(given, date | time) else repr(given)
        return f"{key}: write a list, as in {name} = [{shown}]"
    return f"{key}: {problem['msg'][:1].lower()}{problem['msg'][1:]}"


def _check_devices(
    path: Path,
    devices: Sequence[Device],
    widths: Mapping[str, int],
    driven: Mapping[str, Collection[int]],
) -> None:
    for device in devices:
        where = f"{path}: device {device.id!r}"
        if device.tls not in widths:
            raise MeasuredDataError(
                f"{where}: {device.tls!r} is not a traffic light of the network; it has "
                f"{', '.join(sorted(widths)[:12])}"
            )
        if [other.tls for other in devices].count(device.tls) > 1:
            raise MeasuredDataError(
                f"{where}: the traffic light {device.tls!r} is mapped twice; map it once"
            )
        mapped: set[int] = set()
        for links in (*device.phases.values(), *device.overlaps.values()):
            mapped |= {*links.green, *links.permissive, *links.flashing}
        if both := sorted(mapped & set(device.constant)):
            raise MeasuredDataError(
                f"{where}: link {both[0]} is under [devices.constant] and in a phase or an "
                "overlap, which it would never follow; name it once"
            )
        mapped |= set(device.constant)
        width = widths[device.tls]
        named = mapped | set(device.on_red)
        if unknown := sorted(link for link in named if not 0 <= link < width):
            raise MeasuredDataError(
                f"{where}: link {unknown[0]} does not exist; {device.tls!r} has the links 0 to "
                f"{width - 1}"
            )
        if bare := sorted(set(driven.get(device.tls, range(width))) - mapped):
            raise MeasuredDataError(
                f"{where}: nothing says what the links {', '.join(map(str, bare))} of "
                f"{device.tls!r} show; add them to a phase or an overlap, or write them under "
                '[devices.constant], as in 3 = "g" for a right turn that always yields'
            )
        channels = [detector.channel for detector in device.detectors]
        if twice := [channel for channel in channels if channels.count(channel) > 1]:
            raise MeasuredDataError(f"{where}: channel {twice[0]} is mapped twice; map it once")
