"""Digests of behaviour, which must stay equal bit for bit while the package is rearranged.

    python -m studies.behaviour_digests write FILE     # plays every part twice
    python -m studies.behaviour_digests check FILE     # one line per part
    python -m studies.behaviour_digests check FILE --only episodes/single-v1 train/phase

The committed file is studies/behaviour_digests.json.

Parts play episodes in process, in worker processes and in vectors, visit named domains of every
kind, and train, record and diagnose by the command line. They use only public names and the command
line, so that modules may move.

A part has *values* (label to a list of numbers and short texts) and *names* (further texts). The
digest of a part is the SHA-256 over its sorted values, without labels and names. If only labels or
names have changed, `check` reports it and continues. Wall times, paths, versions and dates are no
values. Each part runs in its own interpreter, on one thread, without the processor instructions in
which mathematical libraries differ most. The numbers still belong to the versions in `made_with`.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import importlib.metadata
import importlib.util
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ugat_marl
from ugat_marl.cli import guarded
from ugat_marl.errors import OptionError
from ugat_marl.files import read_json, write_whole
from ugat_marl.parallel import import_path

Values = dict[str, list[Any]]
"""Label to numbers and short texts."""

ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "ATEN_CPU_CAPABILITY": "default",
    "MKL_CBWR": "COMPATIBLE",
    "ONEDNN_MAX_CPU_ISA": "SSE41",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "COLUMNS": "100",
}
PACKAGES = ("eclipse-sumo", "gymnasium", "numpy", "pettingzoo", "polars", "torch")
EPISODES = ("single-v1", "mixed-v1", "resco:cologne1")
"""Scenarios whose whole episodes are played."""
IN_A_VECTOR_S = 900.0
"""Seconds of an episode in a vector."""
SEED = 11
MEASURES = ("att_s", "throughput", "queue", "delay", "reward", "delay_s", "due", "departed")

DOMAINS = """
sim noise-3 noise-20 zone-10 zone-50 failure-20 combined-1 combined-4 noise-10-percent
late-counts-10 late-counts-30 lost-readings-20 coarse-counts-5 delay-20 delay-60 flexible cyclic
barrier-leading barrier-lagging barrier-both lost-commands-30 long-greens V1 V2 V3 V4 trucks-30
headway-2 lost-time-2 demand-80 demand-120 late-demand careless idm eidm w99 incident fog downpour
blizzard meso want-efficiency want-emissions want-fairness want-safety want-person-delay reach=100
reaction_step=2 gap_acceptance=2+min_gap=4 yellow_running=3+red_running=2 blocker_patience=60
V4+combined-2 V1+late_green=*,1.5
"""
"""Named domains and effects."""
BEGINNING_LATE = ("late-demand", "incident")
"""Domains in which nothing happens in the first minutes."""

VARIANTS: dict[str, dict[str, Any]] = {
    **{f"observation {name}": {"observation": name} for name in ("queue", "pressure", "waiting")},
    "observation density": {"observation": "density", "reward": "pressure"},
    "observation movements": {"observation": "movements", "reward": "waiting"},
    "neighbours": {"neighbours": 1},
    "programme": {"signals": "programme"},
    "crossings": {"crossings": True},
    "spawn": {"simulator": "spawn"},
}
"""Options of an environment that differ from the defaults."""

RULES = """
fixed-time:30 webster actuated:40 delay-actuated sotl largest-queue:20 longest-waiting
max-pressure:10 max-pressure-loss:20 green-wave programme random
"""

TRAINING = """
--learner dqn --real V4 --seed 3 --duration-s 900 --pretrain-episodes 4 --iterations 2
--grounded-episodes 2 --sim-rollouts 2 --real-rollouts 2 --evaluation-seeds 2 --tuning-seeds 1
--fit.epochs 20 --least-accuracy None
"""

UNEXAMINED = """
emergency_deceleration min_gap imperfection reaction_step desired_speed speed_spread yellow_running
red_running gap_acceptance lane_discipline heavy_share driver_model demand_surge demand_timing
turning lane_closure parking local_speed clock_drift stuck dropout swapped
"""
"""Effects that a diagnosis leaves out; with them it would take minutes."""

WORDS = frozenset({"sentence", "findings", "next_measurement", "ruled_out", "untried", "left_out"})
"""Keys of a diagnosis whose values are sentences."""
OF_THE_RUN = frozenset(
    {"hashes", "versions", "budget_h", "budget_s", "policy_gap", "schema", "scenario", "corrected"}
)
"""Keys of a diagnosis about the run, not about its result."""


class NotInstalled(Exception):
    """Something that a part needs is not installed."""


# --- episodes -----------------------------------------------------------------------------------


class Watched:
    """Record of an episode: digests of all bytes, and lists of sums.

    Args:
        label: Label of its values.
    """

    def __init__(self, label: str) -> None:
        self._label = label
        self._digests: defaultdict[str, Any] = defaultdict(hashlib.sha256)
        self._sums: defaultdict[str, list[float]] = defaultdict(list)
        self._scores: dict[str, Any] = {}

    def see(self, name: str, value: Any) -> None:
        """Add a value to the digest of its kind, and its sum to the list of sums."""
        self._digests[name].update(json.dumps(canonical(value)).encode())
        if name in ("observations", "rewards"):
            arrays = value.values() if isinstance(value, Mapping) else [value]
            self._sums[name].append(math.fsum(float(x) for a in arrays for x in np.ravel(a)))

    def score(self, scores: Any) -> None:
        """Keep the measures of the finished episode."""
        self._scores = dataclasses.asdict(scores)

    def values(self) -> Values:
        """Return measures, sums per decision, and digests."""
        numbers: Values = {f"{self._label}: scores": list(flat_numbers(self._scores))}
        for name, sums in self._sums.items():
            numbers[f"{self._label}: sum of {name}"] = list(sums)
        for name, digest in self._digests.items():
            numbers[f"{self._label}: bytes of {name}"] = [digest.hexdigest()]
        return numbers


def canonical(value: Any) -> Any:
    """Return a value as JSON; two values that differ in a bit give different JSON."""
    if isinstance(value, Mapping):
        return {str(key): canonical(value[key]) for key in sorted(value, key=str)}
    if isinstance(value, np.ndarray):
        return [value.dtype.str, list(value.shape), np.ascontiguousarray(value).tobytes().hex()]
    if isinstance(value, np.generic):
        return canonical(value.item())
    if isinstance(value, list | tuple):
        return [canonical(entry) for entry in value]
    if isinstance(value, float):
        return value.hex()
    if value is None or isinstance(value, bool | int | str):
        return value
    return [str(type(value).__name__), str(value)]


def flat_numbers(value: Any) -> Iterator[Any]:
    """Yield the numbers of nested tables, in their order."""
    if isinstance(value, Mapping):
        for entry in value.values():
            yield from flat_numbers(entry)
    else:
        yield value


def drawn(mask: NDArray[Any], rng: np.random.Generator) -> int:
    """Return a random action that the mask allows."""
    allowed = np.flatnonzero(mask)
    return int(allowed[int(rng.integers(len(allowed)))])


def play(label: str, env: Any, seed: int = SEED, *, late: bool = False) -> Values:
    """Play a whole episode with random allowed actions and return its values.

    Args:
        label: Label of the values.
        env: A parallel environment; it is closed at the end.
        seed: Seed of the episode and of the actions.
        late: True to delay greens by random times.
    """
    rng, watched = np.random.default_rng(seed), Watched(label)
    watched.see("spaces", [[a, str(env.observation_space(a))] for a in env.possible_agents])
    watched.see("scenario", [env.scenario.id, env.scenario.hash, env.domain])
    observations, infos = env.reset(seed=seed)
    watched.see("observations", observations)
    watched.see("infos", infos)
    while env.agents:
        if late:
            env.delay_greens({agent: float(rng.random() * 3.0) for agent in env.agents})
        actions = {agent: drawn(infos[agent]["action_mask"], rng) for agent in env.agents}
        observations, rewards, ended, truncated, infos = env.step(actions)
        watched.see("observations", observations)
        watched.see("rewards", rewards)
        watched.see("ends", [ended, truncated])
        watched.see("infos", infos)
        watched.see("state", env.state())
    watched.score(env.scores())
    env.close()
    return watched.values()


def take_turns(label: str, env: Any) -> Values:
    """Play an episode of an AEC environment and return its values."""
    rng, watched = np.random.default_rng(SEED), Watched(label)
    env.reset(seed=SEED)
    for agent in env.agent_iter():
        observation, reward, ended, truncated, info = env.last()
        watched.see("observations", observation)
        watched.see("rewards", float(reward))
        watched.see("infos", [agent, bool(ended), bool(truncated), info])
        env.step(None if ended or truncated else drawn(info["action_mask"], rng))
    watched.score(env.unwrapped.scores())
    env.close()
    return watched.values()


def step_together(scenario: str) -> Values:
    """Play two environments in a vector: an episode, and the beginning of the next."""
    domains, values = ["sim", "V4"], {}
    with ugat_marl.vector_env(scenario, 2, domains, duration_s=IN_A_VECTOR_S) as env:
        batch = env.reset(seed=SEED)
        rngs = [np.random.default_rng(SEED + i) for i in range(2)]
        watched = [Watched(domain) for domain in domains]
        after = 0
        while after < 5:
            actions = [[drawn(mask, rngs[i]) for mask in batch.masks[i]] for i in range(2)]
            batch = env.step(np.array(actions))
            after += bool(batch.ended) or after > 0
            for i, one in enumerate(watched):
                one.see("agents", list(env.agents))
                one.see("observations", batch.observations[i])
                one.see("rewards", batch.rewards[i])
                one.see("infos", [batch.masks[i], batch.executed[i], bool(batch.truncated[i])])
                episode = env.episodes[i]
                assert episode is not None
                one.see("seeds", [episode.seed, episode.domain])
            for end in batch.ended:
                watched[end.environment].see("last", [end.observations, end.masks])
                watched[end.environment].score(end.scores)
        for one in watched:
            values |= one.values()
    return values


def episodes(scenario: str) -> tuple[Values, Values]:
    """Return the values of a scenario's episodes in a worker process."""
    values = play("V4", ugat_marl.parallel_env(scenario, "V4"), SEED + 1)
    values |= play("sim", ugat_marl.parallel_env(scenario))
    if scenario == "single-v1":
        values |= take_turns("in turns", ugat_marl.env(scenario, duration_s=300.0))
    return values, {}


def episodes_in_process(scenario: str) -> tuple[Values, Values]:
    """Return the values of a scenario's episode in this process."""
    return play("sim", ugat_marl.parallel_env(scenario, simulator="inprocess")), {}


def episodes_in_a_vector(scenario: str) -> tuple[Values, Values]:
    """Return the values of a scenario's episodes in a vector of two."""
    return step_together(scenario), {}


def domains() -> tuple[Values, Values]:
    """Return the values of short episodes in many domains, and the hashes of their scenarios."""
    values: Values = {}
    for domain in DOMAINS.split():
        duration_s = 700.0 if domain in BEGINNING_LATE else 200.0
        values |= play(domain, ugat_marl.parallel_env("mixed-v1", domain, duration_s=duration_s))
    return values, {}


def variants() -> tuple[Values, Values]:
    """Return the values of short episodes with other options, and with delayed greens."""
    values: Values = {}
    for name, options in VARIANTS.items():
        values |= play(name, ugat_marl.parallel_env("mixed-v1", duration_s=300.0, **options))
    late = ugat_marl.parallel_env("mixed-v1", "V2", duration_s=300.0)
    return values | play("late greens", late, late=True), {}


def scenarios() -> tuple[Values, Values]:
    """Return id, hash and number of decisions of the scenarios."""
    names = ("single-v1", "grid2x2-v1", "grid4x4-v1", "arterial1x5-v1", "mixed-v1")
    loaded = {name: ugat_marl.load_scenario(name) for name in names}
    return {name: [one.id, one.hash, one.decisions] for name, one in loaded.items()}, {}


# --- the command line ---------------------------------------------------------------------------


def command(*arguments: str | Path) -> None:
    """Run ``ugat-marl`` with the arguments.

    Raises:
        RuntimeError: The command failed; the message quotes the end of its output.
    """
    # -P: the package of this process, not one in the working directory
    line = [sys.executable, "-P", "-m", "ugat_marl", *map(str, arguments)]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(line)}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")


def table_of(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a ``.parquet`` or ``.csv`` file."""
    import polars as pl

    read = pl.read_parquet if path.suffix == ".parquet" else pl.read_csv
    return read(path).to_dicts()


def training(grounding: str, *more: str) -> tuple[Values, Values]:
    """Train; return scores per policy, domain and seed, and all logged numbers."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command(
            "train", "single-v1", "--grounding", grounding, *TRAINING.split(), *more, "--out", out
        )
        table = json.loads((out / "table.json").read_text(encoding="utf-8"))
        logged, queues = table_of(out / "metrics.parquet"), table_of(out / "queues.parquet")
    values: Values = {}
    for row in table["episodes"]:
        scores = {**row, **row.get("scores", {})}
        label = f"{row['policy']}, {row['domain']}, seed {row['seed']}"
        values[label] = [scores[measure] for measure in MEASURES]
    for row in sorted(logged, key=lambda row: (row["stage"], row["name"], row["step"])):
        values.setdefault(f"{row['stage']}: {row['name']}", []).append(row["value"])
    for row in queues:
        label = f"queue, {row['policy']}, {row['domain']}, {row['intersection']}"
        values.setdefault(label, []).append(row["queue"])
    return values, {key: [text] for key, text in table["notes"].items()}


def measured_values(folder: Path, label: str) -> Values:
    """Return the number of rows, the sums of columns and a digest of measured data."""
    values: Values = {}
    for path in sorted(path for path in folder.iterdir() if path.suffix in (".csv", ".parquet")):
        rows = table_of(path)
        values[f"{label}{path.stem}: rows"] = [len(rows)]
        for name in rows[0] if rows else ():
            column = [row[name] for row in rows]
            digest = hashlib.sha256(json.dumps(canonical(column)).encode()).hexdigest()
            numbers = [x for x in column if isinstance(x, int | float) and math.isfinite(x)]
            values[f"{label}{path.stem}: {name}"] = [math.fsum(numbers), digest]
    return values


def recorded_rules() -> tuple[Values, Values]:
    """Record measured data under each rule and return their values."""
    values: Values = {}
    for rule in RULES.split():
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "measured"
            options = ["--policy", rule, "--periods", "1", "--duration-s", "600", "--workers", "1"]
            command("record", "mixed-v1", *options, "--seed", "5", "--out", out)
            values |= measured_values(out, f"{rule}, ")
    return values, {}


def diagnosis(domain: str) -> tuple[Values, Values]:
    """Return measured data of a domain, and the result of a diagnosis of them.

    The budget is a day, so that time never ends the diagnosis.
    """
    with tempfile.TemporaryDirectory() as folder:
        data, out = Path(folder) / "measured", Path(folder) / "found"
        days = ["--periods", "2", "--duration-s", "600", "--workers", "1", "--seed", "0"]
        command("record", "single-v1", "--domain", domain, *days, "--out", data)
        options = ["--cache", Path(folder) / "cache", "--budget-s", "86400", "--workers", "1"]
        options += ["--seed", "0", "--no-report", "--leave-out", *UNEXAMINED.split()]
        command("diagnose", "single-v1", data, "--out", out, *options)
        record = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
        values = measured_values(data, "measured ")
    if not record["complete"]:
        raise RuntimeError(f"the diagnosis of {domain} is not complete")
    names: Values = {}
    first = ("verdict", "effects", "heldout", "evidence")
    for key in sorted(record.keys() - OF_THE_RUN, key=lambda key: (key not in first, key)):
        for path, value in leaves(key, record[key]):
            words = isinstance(value, str) and key not in ("verdict", "effects")
            (names if words or key in WORDS else values).setdefault(path, []).append(value)
    return values, names


def leaves(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the leaves of nested JSON with their paths; ``[]`` means each entry of a list."""
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from leaves(f"{path}.{key}", entry)
    elif isinstance(value, list):
        for entry in value:
            yield from leaves(f"{path}[]", entry)
    else:
        yield path, value


# --- parts --------------------------------------------------------------------------------------


def needing(scenario: str, part: Callable[[str], tuple[Values, Values]]) -> tuple[Values, Values]:
    """Return a part of a scenario, if its network is installed."""
    if scenario.startswith("resco:") and importlib.util.find_spec("sumo_rl") is None:
        raise NotInstalled(f"{scenario}: the networks of sumo-rl are not installed")
    return part(scenario)


def parts() -> dict[str, Callable[[], tuple[Values, Values]]]:
    """Return all parts by their names."""
    parts_by_name: dict[str, Callable[[], tuple[Values, Values]]] = {"scenarios": scenarios}
    ways = {"worker": episodes, "in-process": episodes_in_process, "vector": episodes_in_a_vector}
    for scenario in EPISODES:
        for way, part in ways.items():
            parts_by_name[f"episodes/{scenario}/{way}"] = lambda s=scenario, p=part: needing(s, p)
    return parts_by_name | {
        "variants": variants,
        "domains": domains,
        "rules": recorded_rules,
        "train/phase": lambda: training("phase"),
        "train/timed": lambda: training("timed", "--timed.match"),
        "diagnose/nothing": lambda: diagnosis("sim"),
    }


def played(name: str) -> dict[str, Any]:
    """Play a part in another interpreter; return its digest, values and names.

    Raises:
        NotInstalled: The part needs something that is not installed.
        RuntimeError: The part failed.
    """
    done = subprocess.run(
        [sys.executable, __file__, "play", name],
        env={**os.environ, **ENVIRONMENT, "PYTHONPATH": import_path()},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"{name} failed:\n{done.stderr[-4000:]}")
    answer = json.loads(done.stdout.splitlines()[-1])
    if "missing" in answer:
        raise NotInstalled(answer["missing"])
    if (package := answer.pop("package")) != ugat_marl.__file__:
        raise RuntimeError(f"{name} was played with {package}, not with {ugat_marl.__file__}")
    return answer


def plain(values: Values) -> Values:
    """Return values that JSON can hold: numbers that are not finite become texts."""
    return {
        label: [str(x) if isinstance(x, float) and not math.isfinite(x) else x for x in entries]
        for label, entries in values.items()
    }


def digest_of(values: Values) -> str:
    """Return the SHA-256 of the values; labels and their order do not count."""
    lines = sorted(json.dumps(entries) for entries in values.values())
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def answer(name: str) -> int:
    """Print a part as one line of JSON."""
    try:
        values, names = parts()[name]()
    except NotInstalled as error:
        print(json.dumps({"missing": str(error)}))
        return 0
    values = plain(values)
    said = {"sha256": digest_of(values), "values": values, "names": plain(names)}
    print(json.dumps({**said, "package": ugat_marl.__file__}))
    return 0


# --- write and check ----------------------------------------------------------------------------


def read_digests(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the parts of a file, and the versions they were made with.

    Raises:
        OptionError: There is no such file, or it holds no digests.
    """
    content = read_json(path, OptionError)
    if not (isinstance(content, dict) and {"parts", "made_with"} <= content.keys()):
        raise OptionError(f"{path}: holds no digests; name a file that `write` made")
    return content["parts"], content["made_with"]


def write(path: Path, chosen: Sequence[str]) -> int:
    """Play every part twice and write the parts that are equal; return 1 if some differ.

    Raises:
        SystemExit: The parts that would stay in the file were made with other versions.
    """
    held: dict[str, Any] = {}
    if path.exists():
        held, made_with = read_digests(path)
        if others := other_versions(made_with):
            if not set(held) <= set(chosen):
                raise SystemExit(f"{path} was made with other versions ({others}); write all parts")
            held = {}
    bad = 0
    for name in chosen:
        began = time.monotonic()
        try:
            first, second = played(name), played(name)
        except NotInstalled as error:
            say("skipped", name, f"{error}")
            continue
        except RuntimeError as error:
            bad += 1
            held.pop(name, None)
            say("left out", name, f"{error}")
            continue
        took = f"twice in {time.monotonic() - began:.0f} s"
        if first != second:
            bad += 1
            held.pop(name, None)
            say("left out", name, f"{took}; the second time: {difference(first, second)}")
            continue
        held[name] = first
        say("written", name, took)
        save(path, held)
    save(path, held)
    return int(bad > 0)


def other_versions(made_with: Mapping[str, str]) -> str:
    """Return which versions are installed instead of those of some numbers; empty if none."""
    return "; ".join(
        f"{name} {installed}, not {made_with.get(name)}"
        for name, installed in versions().items()
        if installed != made_with.get(name)
    )


def versions() -> dict[str, str]:
    """Return the installed versions to which numbers belong."""
    python = ".".join(map(str, sys.version_info[:3]))
    return {"python": python} | {name: importlib.metadata.version(name) for name in PACKAGES}


def save(path: Path, held: Mapping[str, Any]) -> None:
    """Write the parts in their usual order, one line per label."""
    held = {name: held[name] for name in parts() if name in held}
    lines = ["{", f' "made_with": {json.dumps(versions())},', ' "parts": {']
    for name, part in held.items():
        lines += [f"  {json.dumps(name)}: {{", f'   "sha256": "{part["sha256"]}",']
        for kind in ("values", "names"):
            rows = [f"    {json.dumps(k)}: {json.dumps(v)}" for k, v in part[kind].items()]
            lines += [f'   "{kind}": {{', ",\n".join(rows), "   }" + "," * (kind == "values")]
        lines.append("  }" + "," * (name != list(held)[-1]))
    lines += [" }", "}", ""]
    write_whole(path, "\n".join(line for line in lines if line) + "\n")


def check(path: Path, chosen: Sequence[str]) -> int:
    """Play the parts again and print one line for each; return 1 if one differs."""
    (held, made_with), different = read_digests(path), 0
    if others := other_versions(made_with):
        print(f"note: numbers may differ because of {others}", flush=True)
    for name in chosen:
        began = time.monotonic()
        try:
            now = played(name)
        except NotInstalled as error:
            say("skipped", name, f"{error}")
            continue
        except RuntimeError as error:
            different += 1
            say("DIFFERENT", name, f"it fails: {error}")
            continue
        took = f"{time.monotonic() - began:.0f} s"
        if name not in held:
            different += 1
            say("not held", name, took)
        elif now["sha256"] == held[name]["sha256"] and not moved(held[name], now):
            said = "" if now == held[name] else f"; other words: {difference(held[name], now)}"
            say("same", name, took + said)
        else:
            different += 1
            say("DIFFERENT", name, f"{took}; {difference(held[name], now)}")
    return int(different > 0)


def moved(before: Mapping[str, Any], after: Mapping[str, Any]) -> bool:
    """Return true if the same labels have exchanged their values."""
    was, now = before["values"], after["values"]
    return was.keys() == now.keys() and was != now


def difference(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Return the first difference of two parts in words; a difference of numbers comes first."""
    for kind in ("values", "names"):
        was, now = before[kind], after[kind]
        for label in [key for key in was if key in now]:
            for place, (old, new) in enumerate(zip(was[label], now[label], strict=False)):
                if old != new:
                    return f"{label} [{place}] was {old!r} and is {new!r}"
            if len(was[label]) != len(now[label]):
                return f"{label} had {len(was[label])} values and has {len(now[label])}"
        if gone := list(was.keys() - now.keys()) or list(now.keys() - was.keys()):
            return f"{min(gone)!r} is {'gone' if min(gone) in was else 'new'}"
    return "none"


def say(verdict: str, name: str, text: str) -> None:
    """Print a line."""
    print(f"{verdict:10} {name:32} {text}", flush=True)


def selected(wanted: Iterable[str], names: Iterable[str]) -> list[str]:
    """Return the names that begin with one of the wanted ones; all if none is wanted.

    Raises:
        SystemExit: No name begins with a wanted one.
    """
    wanted, names = list(wanted), list(names)
    for begin in wanted:
        if not any(name.startswith(begin) for name in names):
            raise SystemExit(f"no part begins with {begin!r}; there are: {', '.join(names)}")
    return [name for name in names if not wanted or name.startswith(tuple(wanted))]


def main() -> int:
    """Run the script; see its docstring."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.behaviour_digests", description=__doc__
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("verb", choices=("write", "check", "play"))
    parser.add_argument("file", help="the file of digests; for play, the name of a part")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="how names begin")
    given = parser.parse_args()
    if given.verb == "play":
        return answer(given.file)
    print(f"package: {Path(ugat_marl.__file__).parent}", flush=True)
    chosen = selected(given.only, parts())
    return (write if given.verb == "write" else check)(Path(given.file), chosen)


if __name__ == "__main__":
    sys.exit(guarded("python -m studies.behaviour_digests", main))
