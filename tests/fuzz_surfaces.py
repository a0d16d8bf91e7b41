"""What the suite reads of others, with sound files of each kind, for `tests.fuzzing`."""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import shlex
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from tests.data import measured_atspm_test as atspm
from tests.data import measured_fuzz_test as measured
from tests.data import measured_sums_test as measured_sums
from tests.data import transitions_test as transitions
from tests.fuzzing import (
    Surface,
    damage_bytes,
    damage_checkpoint,
    damage_json,
    damage_packed,
    damage_table,
    damage_token,
)
from tests.policies import export_test
from tests.reporting import report_runs_test as runs
from tests.scenarios import cityflow_test as cityflow
from ugat_marl.__main__ import main
from ugat_marl.cli.report import again
from ugat_marl.data import (
    CSV_HASHES,
    Metrics,
    TransitionLog,
    import_atspm,
    read_measured,
    write_measured,
)
from ugat_marl.diagnosis import Diagnosis
from ugat_marl.effects import load_scenario, parse_domain, scenario_in_domain
from ugat_marl.envs import parallel_env
from ugat_marl.errors import UgatMarlError
from ugat_marl.experiments.jobs import JobRecord
from ugat_marl.experiments.scores import Evaluation
from ugat_marl.policies import DQN, DQNConfig, NetworkPolicy, export_policy, load_baseline
from ugat_marl.policies.export import NumpyPolicy
from ugat_marl.policies.rules.catalogue import parse_rule
from ugat_marl.progress import Silent
from ugat_marl.reporting import read_records, runs_page
from ugat_marl.scenarios import Network, check_demand, from_cityflow, from_osm, read_scenario
from ugat_marl.scenarios.importers.counts import read_rows
from ugat_marl.scenarios.settings import parse_decimal, parse_time
from ugat_marl.testing import ToyTraffic

FIXTURES = Path(__file__).parent / "fixtures"
CROSSING = FIXTURES / "crossing"
ADDITIONAL = """<additional>
    <vType id="slow" maxSpeed="5" accel="1.5" sigma="0.4" speedFactor="normc(1,0.1,0.5,1.5)"/>
    <laneAreaDetector id="d" lane="W_C_0" pos="5" length="9" freq="9" file="NUL"/>
    <tlLogic id="C" type="static" programID="p" offset="0">
        <phase duration="9" state="Gr"/><phase duration="9" state="rG"/>
    </tlLogic>
    <edgeData id="e" file="NUL" begin="0" end="100"/>
</additional>
"""
DEMAND = """<routes>
    <vType id="car" length="5" minGap="2.5" accel="2.5" decel="4.5" sigma="0" speedDev="0.1"/>
    <vTypeDistribution id="mix"><vType id="a" probability="0.4"/><vType id="b" probability="0.6"/>
    </vTypeDistribution>
    <route id="north" edges="S_C C_N"/>
    <vehicle id="v0" type="car" depart="0" route="north" departSpeed="max" departLane="best"/>
    <vehicle id="v1" type="mix" depart="0:00:05"><route edges="W_C C_E"/></vehicle>
    <flow id="f0" type="car" begin="6" end="60" number="4" route="north"/>
    <flow id="f1" begin="7" end="90" period="exp(0.1)" from="W_C" to="C_E"/>
    <trip id="t" depart="8" from="S_C" to="C_N" departPos="random"/>
</routes>
"""
CONFIGURATION = """<configuration>
    <input><net-file value="network.net.xml"/><route-files value="demand.rou.xml"/>
        <additional-files value="more.add.xml"/></input>
    <time><begin value="0"/><end value="120"/><step-length value="1"/></time>
    <processing><time-to-teleport value="300"/><scale value="1.0"/></processing>
    <random_number><seed value="3"/></random_number>
</configuration>
"""
TEXTS = """late_green=*,2
startup_delay=0.5
lane_closure=W_C_0,10,60
demand_level=1.2
undercount=a,0.2
V1 V2 V3 V4 sim
acceleration=1.2+deceleration=3
largest-queue:20
fixed-time:30
0:10:20
12.5
"""
COMMANDS = """scenario list
domains
domains V4
scenario check none-v1
scenario draw none-v1 --out pictures
train none-v1 --real V4 --out run --duration-s 100 --seed 3
evaluate none-v1 --domains sim V4 --seeds 2 --policies fixed-time:20
record none-v1 --domain late_green=*,2 --periods 2 --out measured
diagnose none-v1 measured --out out --budget-h 0.1
export none.pt --out policy.npz
report none
"""
OD = "from,to,count,begin_s,end_s\nW_C,C_E,100,0,900\nS_C,C_N,40.5,900,1800\n"
STATE = {"iteration": 2, "pretrained": 14}
DIAGNOSIS: dict[str, Any] = {
    "schema": "ugat-marl/diagnosis/3", "scenario": "single-v1", "seed": 1, "alpha": 0.05,
    "budget_h": None, "budget_s": 9.5, "left_out": ["min_gap"], "ruled_out": [], "findings": ["x"],
    "periods": {"fit": ["a"], "heldout": ["b"]}, "verified_on_fitted_periods": False,
    "hashes": {"scenario": "h"}, "versions": {"sumo": "1"}, "verdict": "unknown", "sentence": "x",
    "effects": [], "where": [], "left": [], "alternatives": [], "best": None, "heldout": None,
    "evidence": None, "statistics": [], "lanes": [], "criteria": None, "travel_time": None,
    "next_measurement": None, "complete": True, "untried": [], "corrected": None,
    "policy_gap": None,
}  # fmt: skip


def build_scenario(folder: Path) -> None:
    shutil.copytree(CROSSING, folder, dirs_exist_ok=True)
    (folder / "demand.rou.xml").write_text(DEMAND)
    (folder / "more.add.xml").write_text(ADDITIONAL)
    (folder / "x.sumocfg").write_text(CONFIGURATION)
    toml = (folder / "scenario.toml").read_text()
    (folder / "scenario.toml").write_text(f'additional = ["more.add.xml"]\n{toml}')


def build_packed(folder: Path) -> None:
    build_scenario(folder)
    network = folder / "network.net.xml"
    (folder / "network.net.xml.gz").write_bytes(gzip.compress(network.read_bytes()))
    network.unlink()
    toml = (folder / "scenario.toml").read_text()
    (folder / "scenario.toml").write_text(toml.replace(".net.xml", ".net.xml.gz"))


def use_scenario(folder: Path) -> None:
    """Read a scenario as `scenario check` does before it simulates, and add effects to it."""
    whole = load_scenario(folder)
    network = Network.read(whole)
    check_demand(whole, network)
    assert whole.hash
    changed = scenario_in_domain(whole, "V4")
    Network.read(changed)
    check_demand(changed, network)


def use_configuration(folder: Path) -> None:
    found = read_scenario(folder / "x.sumocfg")
    check_demand(found, Network.read(found))


def play(folder: Path) -> None:
    """Simulate half a minute, with effects, in a process of its own."""
    env = parallel_env(folder, "V4")
    try:
        env.reset(seed=1)
        for _ in range(3):
            if env.agents:
                env.step(dict.fromkeys(env.agents, 0))
    finally:
        env.close()


def build_measured(folder: Path, *, csv: bool, by_hand: bool = False) -> None:
    shutil.copytree(CROSSING, folder / "scenario")
    write_measured(measured.recording(), folder / "street", csv=csv)
    if by_hand:
        (folder / "street" / CSV_HASHES).unlink()


def build_sums(folder: Path) -> None:
    """Write counts with occupancies and mean speeds, turning counts and travel times."""
    shutil.copytree(CROSSING, folder / "scenario")
    write_measured(measured_sums.sums(), folder / "street", csv=True)
    (folder / "street" / CSV_HASHES).unlink()


def build_tracks(folder: Path) -> None:
    """Write trajectories and no detections."""
    shutil.copytree(CROSSING, folder / "scenario")
    second = np.arange(0.0, 50.0)
    vehicles = pl.DataFrame(
        {
            "period_id": "p0", "vehicle_id": "v", "time_s": second, "lane_id": "S_C_0",
            "position_m": 10.0 * second, "speed_mps": 10.0, "length_m": 4.5,
        }
    )  # fmt: skip
    day = measured.recording()
    alone = replace(day.periods[0], passages={})
    write_measured(replace(day, periods=(alone,), trajectories=vehicles), folder / "street",
                   csv=True)  # fmt: skip
    (folder / "street" / "detections.csv").unlink()
    (folder / "street" / CSV_HASHES).unlink()


def use_measured(folder: Path) -> None:
    assert read_measured(folder / "street", *crossing()).hash


@cache
def crossing() -> tuple[Any, Network]:
    found = read_scenario(CROSSING)
    return found, Network.read(found)


def build_atspm(folder: Path) -> None:
    (folder / "mapping.toml").write_text(atspm.MAPPING)
    atspm.log(atspm.LOG).write_csv(folder / "events.csv")
    atspm.log(atspm.LOG).write_parquet(folder / "events.parquet")


def use_atspm(folder: Path) -> None:
    with contextlib.suppress(UgatMarlError):
        import_atspm(folder / "events.csv", folder / "mapping.toml", *crossing())
    import_atspm(folder / "events.parquet", folder / "mapping.toml", *crossing())


def build_log(folder: Path) -> None:
    transitions.recorded().write(folder / "log.parquet")


def use_log(folder: Path) -> None:
    log = TransitionLog.read(folder / "log.parquet")
    for agent in log.agents:
        log.transitions(agent)


def build_policy(folder: Path) -> None:
    export_test.policy_of(False).save(folder / "policy.pt")


def use_policy(folder: Path) -> None:
    policy = NetworkPolicy.load(folder / "policy.pt")
    if policy.agents == export_test.AGENTS:
        observations, infos = export_test.inputs(np.random.default_rng(0))
        policy.act(observations, infos)


def learner() -> DQN:
    return DQN(export_test.AGENTS, DQNConfig(hidden=(8,)), seed=1)


def build_learner(folder: Path) -> None:
    learner().save(folder / "learner.pt")


def use_learner(folder: Path) -> None:
    learner().load(folder / "learner.pt")


def ippo() -> Any:
    module: Any = load_baseline("ippo")
    return module.IPPO(ToyTraffic(), module.IPPOConfig(hidden=(8,)), seed=1)


def build_ippo(folder: Path) -> None:
    ippo().save(folder / "ippo.pt")


def use_ippo(folder: Path) -> None:
    ippo().load(folder / "ippo.pt")


def build_export(folder: Path) -> None:
    export_policy(export_test.policy_of(False), folder / "policy.npz")


def use_export(folder: Path) -> None:
    policy = NumpyPolicy.load(folder / "policy.npz")
    agents = policy.agents
    policy.values(np.zeros((len(agents), agents.widest_observation), np.float32))


def build_cityflow(folder: Path) -> None:
    cityflow.write(folder, cityflow.crossroads())


def use_cityflow(folder: Path) -> None:
    source = from_cityflow(
        folder / "roadnet.json", folder / "flow.json", 0.0, 600.0, own_vehicles=True, exact=False
    )
    source(folder, Silent())


def build_osm(folder: Path) -> None:
    shutil.copy(FIXTURES / "town.osm", folder / "town.osm")


def use_osm(folder: Path) -> None:
    from_osm(folder / "town.osm", guess=True)(folder, Silent())


def build_counts(folder: Path) -> None:
    (folder / "od.csv").write_text(OD)


def use_counts(folder: Path) -> None:
    read_rows(folder / "od.csv", 0.0, 1800.0, Silent(), pairs=True)


def build_run(folder: Path) -> None:
    runs.make_run(folder / "run")


def use_run(folder: Path) -> None:
    records = read_records([folder / "run"])
    with pictures_of_no_size():
        runs_page(records, {record.directory: again(record) for record in records})


@contextlib.contextmanager
def pictures_of_no_size() -> Any:
    """Pictures are drawn, and not written into pages: their writing takes most of the time."""
    from ugat_marl.reporting.figures import NamedFigure

    before = NamedFigure.for_page
    NamedFigure.for_page = lambda _: "<svg></svg>"
    try:
        yield
    finally:
        NamedFigure.for_page = before


def build_records(folder: Path) -> None:
    runs.evaluation().write(folder / "table.json")
    runs.metrics().write(folder / "metrics.parquet")
    (folder / "diagnosis.json").write_text(json.dumps(DIAGNOSIS))
    JobRecord({(0, "sim", 1): runs.scores(100.0)}, 3, 1.5, 0.5).write(folder)


def use_records(folder: Path) -> None:
    """Read all, and raise the last refusal."""
    refusal: UgatMarlError | None = None
    for read in (
        lambda: Evaluation.read(folder / "table.json"),
        lambda: Metrics.read(folder / "metrics.parquet"),
        lambda: JobRecord.read(folder),
        lambda: _diagnosis(folder),
    ):
        try:
            read()
        except UgatMarlError as error:
            refusal = error
    if refusal is not None:
        raise refusal


def _diagnosis(folder: Path) -> None:
    try:
        Diagnosis.read(folder)
    except UgatMarlError:
        raise
    except ValueError:  # no diagnosis of this version; pydantic says so
        pass


def build_texts(folder: Path) -> None:
    (folder / "texts.txt").write_text(TEXTS)


def use_texts(folder: Path) -> None:
    """Parse every line as everything that a user may write."""
    for line in (folder / "texts.txt").read_bytes().decode("utf-8", "surrogateescape").split("\n"):
        for parse in (parse_domain, parse_rule):
            with contextlib.suppress(UgatMarlError):
                parse(line)
        for number in (parse_decimal, parse_time):
            with contextlib.suppress(ValueError):
                assert np.isfinite(number(line))


def build_commands(folder: Path) -> None:
    (folder / "commands.txt").write_text(COMMANDS)


def use_commands(folder: Path) -> None:
    """Call commands that end before they simulate; each ends with a code, and one line at most."""
    for line in (folder / "commands.txt").read_bytes().decode("utf-8", "replace").split("\n"):
        try:
            words = shlex.split(line)
        except ValueError:
            continue
        if any(word in ("train", "evaluate", "record", "diagnose") for word in words[:1]) and (
            "none-v1" not in words
        ):
            continue  # another scenario, which would be simulated
        said = io.StringIO()
        with (
            contextlib.chdir(folder),
            contextlib.redirect_stderr(said),
            contextlib.redirect_stdout(io.StringIO()),
        ):
            try:
                code = main(words)
            except SystemExit as end:
                code = end.code
        if code not in (0, None, 2) or len(said.getvalue().splitlines()) > 1:
            raise AssertionError(f"{line!r} ended with {code}:\n{said.getvalue()}")


TEXT = (damage_bytes, damage_token)
TABLE = (damage_bytes, damage_table, damage_table)
SURFACES = (
    Surface("scenario.toml", build_scenario, use_scenario, TEXT, "scenario.toml"),
    Surface("network", build_scenario, use_scenario, TEXT, "network.net.xml"),
    Surface("demand", build_scenario, use_scenario, TEXT, "demand.rou.xml"),
    Surface("additional file", build_scenario, use_scenario, TEXT, "more.add.xml"),
    Surface("packed network", build_packed, use_scenario, (damage_packed,), "*.gz"),
    Surface("SUMO configuration", build_scenario, use_configuration, TEXT, "x.sumocfg"),
    Surface("played", build_scenario, play, TEXT, "*.xml", share=0.3),
    Surface("measured", lambda f: build_measured(f, csv=False), use_measured, TABLE, "street/*"),
    Surface(
        "measured CSV",
        lambda f: build_measured(f, csv=True, by_hand=True),
        use_measured,
        TEXT,
        "street/*",
    ),
    Surface("measured sums", build_sums, use_measured, TEXT, "street/*"),
    Surface("measured tracks", build_tracks, use_measured, TEXT, "street/*"),
    Surface("hashed CSV", lambda f: build_measured(f, csv=True), use_measured, TEXT, "street/*"),
    Surface("ATSPM log", build_atspm, use_atspm, TABLE),
    Surface("transition log", build_log, use_log, TABLE),
    Surface("policy", build_policy, use_policy, (damage_bytes, damage_checkpoint)),
    Surface("learner", build_learner, use_learner, (damage_bytes, damage_checkpoint)),
    Surface("IPPO", build_ippo, use_ippo, (damage_bytes, damage_checkpoint)),
    Surface("exported policy", build_export, use_export, (damage_bytes, damage_json)),
    Surface("CityFlow", build_cityflow, use_cityflow, (damage_bytes, damage_json), share=0.5),
    Surface("OpenStreetMap", build_osm, use_osm, TEXT, share=0.2),
    Surface("counts", build_counts, use_counts, TEXT),
    Surface("run", build_run, use_run, (damage_bytes, damage_json, damage_table), "run/**/*.*"),
    Surface("records", build_records, use_records, (damage_bytes, damage_json, damage_table)),
    Surface("texts", build_texts, use_texts, TEXT),
    Surface("commands", build_commands, use_commands, TEXT, share=0.3),
)
