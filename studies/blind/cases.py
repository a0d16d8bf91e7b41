"""Files of a blind test: a plan that the diagnosis may read, and labels that it may not.

A folder of a blind test holds ``plan.json``, one folder per case with its measured data and later
its diagnosis, and ``labels/<case>.json``, which only the grading and the test of visibility read.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from studies.errors import BlindTestError
from ugat_marl.data import MeasuredData, read_measured
from ugat_marl.effects import Effect, load_scenario
from ugat_marl.errors import UnknownNameError
from ugat_marl.files import write_whole
from ugat_marl.scenarios import Network, Scenario

PLAN, LABELS, GRADES, VISIBLE = "plan.json", "labels", "grades.json", "visible.json"
DIAGNOSIS, RUN, OPTIONS = "diagnosis.json", "run.json", "run-options.json"
SCHEMA = "ugat-marl/blind/1"

WINDOW = ("begin_s", "end_s")
"""Fields of effects that give a time, not a strength."""


@dataclass(frozen=True)
class Hidden:
    """One effect, in the form in which a diagnosis names it.

    Attributes:
        name: Name of the effect.
        place: Text fields of the effect, joined by ``>``; None if it has none.
        window: Begin and end, s; None for an effect without a window.
        parameters: Other numbers of the effect.
        nominal: Values of these numbers without the effect, if there are such values.
    """

    name: str
    place: str | None = None
    window: tuple[float, float] | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    nominal: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, effect: Effect, nominal: Mapping[str, float] | None = None) -> Hidden:
        """Return an effect of the library in the form of a diagnosis."""
        record = effect.record()
        texts = [str(record[key]) for key in effect.texts]
        window = None
        if all(key in record for key in WINDOW):
            window = (float(record["begin_s"]), float(record["end_s"]))
        numbers = {
            key: float(value)
            for key, value in record.items()
            if key not in ("name", *WINDOW, *effect.texts)
        }
        return cls(effect.name, ">".join(texts) or None, window, numbers, dict(nominal or {}))

    @classmethod
    def from_dict(cls, raw: Mapping[str, Any]) -> Hidden:
        """Read from JSON."""
        window = raw.get("window")
        return cls(
            str(raw["name"]),
            raw.get("place"),
            None if window is None else (float(window[0]), float(window[1])),
            dict(raw.get("parameters") or {}),
            dict(raw.get("nominal") or {}),
        )


@dataclass(frozen=True)
class Label:
    """Truth about one case.

    Attributes:
        case: Id of the case.
        scenario: Name of its scenario.
        group: ``none``, ``single``, ``measurement``, ``pair``, ``setting`` or ``outside``.
        hidden: Name of the hidden effects: an effect, two joined by ``+``, ``V3``, ``bus_stops``.
        strength: ``small``, ``medium`` or ``large``, for groups that have a strength.
        effects: Hidden effects that a diagnosis can name. In the group ``outside`` none explains
            the data.
        leave_out: Effects that the diagnosis may not use.
        lights: Traffic lights that agents control.
        begin_s: Start of the periods.
        end_s: End of the periods.
        periods: Number of periods.
        speeds: True if speeds were measured.
        policy: Controller of the signals.
        seed: Seed of the measured data.
        measured: Hash of the measured data.
        day_to_day: Variation of the demand from day to day, as a share.
    """

    case: str
    scenario: str
    group: str
    hidden: str
    strength: str
    effects: tuple[Hidden, ...]
    leave_out: tuple[str, ...]
    lights: tuple[str, ...]
    begin_s: float
    end_s: float
    periods: int
    speeds: bool
    policy: str
    seed: int
    measured: str
    day_to_day: float = 0.0

    @classmethod
    def from_dict(cls, raw: Mapping[str, Any]) -> Label:
        """Read from JSON."""
        values = {item.name: raw[item.name] for item in fields(cls) if item.name in raw}
        values["effects"] = tuple(Hidden.from_dict(item) for item in raw["effects"])
        for key in ("leave_out", "lights"):
            values[key] = tuple(raw[key])
        return cls(**values)


@dataclass(frozen=True)
class Case:
    """Facts about a case that the diagnosis may know.

    Attributes:
        case: Id of the case; it tells nothing about the hidden effects.
        scenario: Name of the scenario to diagnose.
        leave_out: Effects that the diagnosis may not use.
    """

    case: str
    scenario: str
    leave_out: tuple[str, ...] = ()


def write_plan(directory: Path, cases: tuple[Case, ...]) -> None:
    """Write the plan."""
    content = {"schema": SCHEMA, "cases": [asdict(case) for case in cases]}
    write_whole(directory / PLAN, json.dumps(content, indent=1) + "\n")


def read_plan(directory: Path) -> tuple[Case, ...]:
    """Read the plan.

    Raises:
        BlindTestError: The plan is missing or damaged.
    """
    raw = read_json(directory / PLAN)
    try:
        return tuple(
            Case(str(item["case"]), str(item["scenario"]), tuple(item["leave_out"]))
            for item in raw["cases"]
        )
    except (KeyError, TypeError) as error:
        raise BlindTestError(
            f"{directory / PLAN}: not the plan of a blind test ({error}); make one with "
            "python -m studies.blind generate"
        ) from None


def chosen(directory: Path, only: Sequence[str]) -> tuple[Case, ...]:
    """Return the cases with these ids; all cases without any.

    Raises:
        BlindTestError: The directory holds no blind test.
        UnknownNameError: There is no such case.
    """
    cases = read_plan(directory)
    known = [case.case for case in cases]
    for name in only:
        if name not in known:
            raise UnknownNameError("case", name, known)
    return tuple(case for case in cases if not only or case.case in only)


def read_street(name: str, measured: Path) -> tuple[Scenario, MeasuredData]:
    """Read the scenario of a case, and the measured data in a folder."""
    scenario = load_scenario(name)
    return scenario, read_measured(measured, scenario, Network.read(scenario))


def label_path(directory: Path, case: str) -> Path:
    """Return the path of the label of a case."""
    return directory / LABELS / f"{case}.json"


def write_label(directory: Path, label: Label) -> None:
    """Write the label of a case."""
    text = json.dumps(asdict(label), indent=1, allow_nan=False)
    write_whole(label_path(directory, label.case), text + "\n")


def read_label(directory: Path, case: str) -> Label:
    """Read the label of a case.

    Raises:
        BlindTestError: The label is missing or damaged.
    """
    path = label_path(directory, case)
    try:
        return Label.from_dict(read_json(path))
    except (KeyError, TypeError, ValueError) as error:
        raise BlindTestError(f"{path}: not a label ({error}); generate the case again") from None


def read_json(path: Path) -> dict[str, Any]:
    """Read the object in a JSON file.

    Raises:
        BlindTestError: The file is missing, cut short, or holds no object.
    """
    try:
        found: Any = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BlindTestError(
            f"{path}: no such file; python -m studies.blind generate, run and grade "
            "write them in turn"
        ) from None
    except (OSError, ValueError) as error:
        raise BlindTestError(
            f"{path}: cannot be read as JSON ({error}); it may be cut short"
        ) from None
    if not isinstance(found, dict):
        raise BlindTestError(f"{path}: holds {type(found).__name__}, not an object")
    return found
