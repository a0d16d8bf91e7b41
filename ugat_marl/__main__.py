"""The command line: ``ugat-marl COMMAND ...``."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import io
import os
import re
import sys
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints

from rich.console import Console

from ugat_marl.errors import UgatMarlError, UnknownNameError, nearest
from ugat_marl.progress import Bars, showing

COMMANDS: dict[str, tuple[str, str]] = {
    "train": ("commands.train:Train", "train by UGAT across the gap, print what was won"),
    "report": ("commands.report:Report", "trainings as one page: tables, curves, maps"),
    "evaluate": ("commands.evaluate:Evaluate", "policies and rules in any domains: measures, gaps"),
    "tune": ("commands.tune:Tune", "the settings with which each rule does best in a domain"),
    "rollout": ("commands.rollout:Rollout", "record transitions as a Parquet log"),
    "field": (
        "commands.field:Field",
        "drive the lights of a running SUMO as if it were the street",
    ),
    "record": ("commands.record:Record", "measure a domain as a street is measured"),
    "import-atspm": (
        "commands.import_atspm:ImportAtspm",
        "measured data from a signal controllers' log",
    ),
    "policy-gap": (
        "commands.policy_gap:PolicyGap",
        "what a diagnosis is worth: policies before, after",
    ),
    "diagnose": (
        "commands.diagnose:Diagnose",
        "where a simulation and measured data disagree, and why",
    ),
    "export": ("commands.export:Export", "a trained policy as TorchScript, ONNX or matrices"),
    "scenario list": (
        "commands.scenario_list:ScenarioList",
        "the networks and domains that can be named",
    ),
    "scenario new": (
        "commands.scenario_new:ScenarioNew",
        "a scenario from any road network and demand",
    ),
    "scenario check": (
        "commands.scenario_check:ScenarioCheck",
        "what a controller will face; is it sound?",
    ),
    "scenario draw": (
        "commands.scenario_draw:ScenarioDraw",
        "every intersection with its phases, as pictures",
    ),
    "domains": ("commands.domains:Domains", "the named domains: gap, effects, counterpart"),
    "paper main": ("commands.paper:Main", "UGAT and every control, with intervals over seeds"),
    "paper ablation": ("commands.paper:Ablation", "UGAT without its parts"),
    "paper alpha": ("commands.paper:Alpha", "static thresholds against the dynamic one"),
    "paper uncertainty": ("commands.paper:Uncertainty", "the methods of uncertainty compared"),
    "paper gap": ("commands.paper:Gap", "what direct transfer loses, as radar charts"),
    "blind generate": ("commands.blind:BlindGenerate", "hide effects, measure, seal the labels"),
    "blind run": ("commands.blind:BlindRun", "diagnose the cases of a blind test"),
    "blind visible": ("commands.blind:BlindVisible", "could the hidden effects be seen at all"),
    "blind grade": ("commands.blind:BlindGrade", "open the labels of diagnosed cases"),
    "blind table": ("commands.blind:BlindTable", "sum up graded blind tests"),
    "bench env": ("bench.speed:EnvBench", "speed against SUMO alone and sumo-rl"),
    "bench learning": ("bench.learning:LearningBench", "what learning adds to an episode"),
    "bench fitting": (
        "bench.fitting:FittingBench",
        "what each uncertainty costs and is worth",
    ),
    "bench strength": (
        "bench.strength:StrengthBench",
        "is the learner as good as the best rule where it was trained?",
    ),
    "bench memory": ("bench.memory:MemoryBench", "memory over many resets"),
    "bench scale": (
        "bench.scale:ScaleBench",
        "many simulations, large networks, processes that die",
    ),
    "bench device": (
        "bench.device:DeviceBench",
        "from how many intersections on a GPU pays for learning",
    ),
    "bench all": ("bench.everything:AllBench", "all but strength, scale and device"),
}

SHORT: dict[str, tuple[str, ...]] = {
    "scenarios": ("scenario", "list"),
    "check": ("scenario", "check", "--conformance"),
}
"""Short names of commands, and what they stand for."""

USAGE_ERROR = 2
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command.

    Returns:
        The exit code: 0, 1 (a check or target failed), 2 (a wrong call or input; one line says
        which), 130 (interrupted).
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    console = Console(highlight=False)
    shown = console if console.is_terminal else Console(stderr=True, highlight=False)
    try:
        with showing(Bars(shown)):
            return _run(given, console)
    except UgatMarlError as error:
        print(f"ugat-marl: error: {' '.join(str(error).split())}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt as stop:
        print("; ".join(["ugat-marl: interrupted", *map(str, stop.args)]), file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return USAGE_ERROR


def _run(given: list[str], console: Console) -> int:
    if not given or given[0] in ("-h", "--help", "help"):
        _print_help(console)
        return 0 if given else USAGE_ERROR
    if given[0] == "--version":
        from ugat_marl import __version__

        console.print(f"ugat-marl {__version__}")
        return 0
    given = [*SHORT.get(given[0], (given[0],)), *given[1:]]
    name, rest = given[0], given[1:]
    if parts := {key.split()[1] for key in COMMANDS if key.startswith(f"{name} ")}:
        if not rest or rest[0] in ("-h", "--help"):
            _print_help(console, f"{name} ")
            return 0 if rest else USAGE_ERROR
        if rest[0] not in parts:
            raise UnknownNameError(name, rest[0], parts)
        name, rest = f"{name} {rest[0]}", rest[1:]
    if name not in COMMANDS:
        names = {*(key.split()[0] for key in COMMANDS), *SHORT}
        raise UnknownNameError("command", name, names, "ugat-marl --help explains them.")
    command = _parse(name, rest)
    if name.startswith("bench "):
        return _bench(command, console)
    return command.run(console)


def _parse(name: str, rest: list[str]) -> Any:
    """The command's dataclass, filled in; what tyro has to say becomes one line."""
    import tyro

    module, _, attribute = COMMANDS[name][0].partition(":")
    kind = getattr(importlib.import_module(f"ugat_marl.{module}"), attribute)
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            command, unknown = tyro.cli(
                kind,
                args=_with_address(rest),
                prog=f"ugat-marl {name}",
                description=_description(kind),
                return_unknown_args=True,
            )
    except SystemExit as end:
        if not end.code:
            raise
        raise UgatMarlError(f"{_one_line(said.getvalue())}; see ugat-marl {name} --help") from None
    if unknown:
        first = unknown[0].partition("=")[0]
        if first.startswith("-"):
            options = sorted(_options(kind))
            guess = nearest(first, options)
            hint = f"Did you mean {guess!r}?" if guess else ""
            raise UgatMarlError(
                f"unknown option {first!r} of {name}. {hint} See ugat-marl {name} --help"
            )
        raise UgatMarlError(f"{name}: unexpected {first!r}; see ugat-marl {name} --help")
    return command


def _with_address(rest: list[str]) -> list[str]:
    """A bare ``--ray`` means the Ray of this machine."""
    followed = zip(rest, [*rest[1:], "--"], strict=False)
    bare = [word == "--ray" and after.startswith("-") for word, after in followed]
    return [
        part
        for word, b in zip(rest, bare, strict=True)
        for part in ((word, "local") if b else (word,))
    ]


def _description(kind: Any) -> str:
    """The docstring up to its list of attributes, examples included."""
    return (inspect.getdoc(kind) or "").partition("\nAttributes:")[0].strip()


def _options(kind: Any, prefix: str = "") -> set[str]:
    """The long options of a command, nested settings included."""
    found: set[str] = set()
    hints = get_type_hints(kind, include_extras=True)
    for item in fields(kind):
        hint = hints[item.name]
        inner = getattr(hint, "__origin__", hint)
        if isinstance(inner, type) and is_dataclass(inner):
            flat = any(
                getattr(extra, "name", None) == "" for extra in getattr(hint, "__metadata__", ())
            )
            found |= _options(inner, prefix if flat else f"{prefix}{item.name}.")
        else:
            found.add(f"--{prefix}{item.name}".replace("_", "-"))
    return found


def _one_line(box: str) -> str:
    """The message inside the frame that tyro draws."""
    lines = [re.sub(r"[│╭╮╰╯]", " ", line).strip() for line in box.splitlines()]
    until = next((i for i, line in enumerate(lines) if line.startswith("──")), len(lines))
    words = " ".join(re.sub(r"─+", " ", line) for line in lines[:until])
    words = re.sub(r"^\s*(Value error|Invalid choice|Required options)\s", "", words)
    words = re.sub(r"Error parsing config[\w.]*:", "", words)
    return " ".join(words.split()).rstrip(".")


def _bench(command: Any, console: Console) -> int:
    reports = command.run(Bars(console))
    reports = reports if isinstance(reports, list) else [reports]
    for report in reports:
        console.print(report.tables())
    return 0 if all(report.met for report in reports) else 1


def _print_help(console: Console, prefix: str = "") -> None:
    console.print("Traffic signals across the gap between simulation and street.\n")
    console.print(f"usage: ugat-marl {prefix}COMMAND [options]\n", markup=False)
    for name, (_, text) in COMMANDS.items():
        if name.startswith(prefix):
            console.print(f"  {name.removeprefix(prefix):<15} {text}")
    console.print(f"\nugat-marl {prefix}COMMAND --help shows options and examples of a command.")
    if not prefix:
        short = ", ".join(f"{name} = {' '.join(words)}" for name, words in SHORT.items())
        console.print(f"Short: {short}.\n")
        console.print(
            "A first try:\n\n"
            "  ugat-marl scenario list\n"
            "  ugat-marl evaluate single-v1 --domains sim V4 --seeds 2\n"
            "  ugat-marl train grid2x2-v1 --real V4"
        )
    console.print("\nExit codes: 0 done, 1 a check or target failed, 2 a wrong call or input.")


if __name__ == "__main__":
    sys.exit(main())
