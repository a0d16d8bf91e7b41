"""Exported policies act as the originals do, and wrong files are refused."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ugat_marl
from tests.runs import q_values
from ugat_marl.__main__ import main
from ugat_marl.envs import AgentSet
from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.policies import DQN, NetworkPolicy, export_policy, load_policy
from ugat_marl.policies.export import FORMATS, NumpyPolicy, portable_network
from ugat_marl.policies.learners.dqn import DQNConfig
from ugat_marl.policies.portable import PortableLayers
from ugat_marl.testing import ToyTraffic, check_policy, check_report, failed_checks

PAGE = (Path(__file__).parents[2] / "docs" / "how-to" / "export.md").read_text(encoding="utf-8")
AGENTS = AgentSet(("a_0", "b_0", "a_1", "c_0"), (7, 5, 7, 2), (3, 2, 3, 6))
SECTIONS = {".onnx": "ONNX", ".ts": "TorchScript", ".npz": "numpy"}
KINDS = pytest.mark.parametrize(
    ("shared", "hidden"),
    [(False, (16, 16)), (True, (16, 16)), (False, (8,)), (True, (8,)), (False, ()), (True, ())],
)

Act = Callable[[Any, Any], dict[str, int]]


def policy_of(
    shared: bool,
    hidden: tuple[int, ...] = (16, 16),
    agents: AgentSet = AGENTS,
    ceiling: float | None = None,
) -> NetworkPolicy:
    """A policy of random weights, drawn wider than a learner begins with."""
    learner = DQN(agents, DQNConfig(hidden=hidden, shared=shared), seed=4)
    size = learner.policy().parameters.size
    weights = np.random.default_rng(7).normal(size=size).astype(np.float32)
    held = None
    if ceiling is not None:
        held = np.full((len(agents), agents.widest_observation), ceiling, np.float32)
    return NetworkPolicy(agents, hidden, weights, {"observation": "queue"}, shared, None, held)


def page_loader(suffix: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Act:
    """`act` as the loader on the page makes it."""
    if suffix == ".onnx":
        pytest.importorskip("onnxruntime")
    section = PAGE.partition(f"\n## {SECTIONS[suffix]}\n")[2]
    example = re.search(r"```python\n(.*?)```", section, flags=re.DOTALL)
    assert example is not None
    assert len([line for line in example[1].splitlines() if line]) <= 10
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        exec(example[1], names)
    return names["act"]


def exported(policy: NetworkPolicy, suffix: str, folder: Path, env: Any = None) -> Path:
    if suffix == ".onnx":
        pytest.importorskip("onnx")
    path = folder / f"policy{suffix}"
    export_policy(policy, path, env)
    return path


def inputs(
    rng: np.random.Generator, agents: AgentSet = AGENTS
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Random observations of the agents, and masks that allow about half of the actions."""
    observations, infos = {}, {}
    for name, size, count in zip(
        agents.names, agents.observation_sizes, agents.action_counts, strict=True
    ):
        mask = rng.integers(0, 2, count).astype(np.int8)
        mask[rng.integers(count)] = 1
        observations[name] = rng.normal(size=size).astype(np.float32)
        infos[name] = {"action_mask": mask}
    return observations, infos


# --- the same actions ---------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("ceiling", [None, 0.3])
@KINDS
def test_random_inputs_give_the_same_actions(
    suffix: str,
    shared: bool,
    hidden: tuple[int, ...],
    ceiling: float | None,
    tmp_path: Path,
    monkeypatch: Any,
) -> None:
    policy = policy_of(shared, hidden, ceiling=ceiling)
    exported(policy, suffix, tmp_path)
    act = page_loader(suffix, tmp_path, monkeypatch)
    rng, masked = np.random.default_rng(0), 0
    free = {name: {"action_mask": np.ones(n, np.int8)} for name, n in _counts().items()}
    for _ in range(200):
        observations, infos = inputs(rng)
        actions = policy.act(observations, infos)
        assert act(observations, infos) == actions
        masked += actions != policy.act(observations, free)
    assert masked > 100  # the masks mattered


def _counts() -> dict[str, int]:
    return dict(zip(AGENTS.names, AGENTS.action_counts, strict=True))


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("shared", [False, True])
def test_an_episode_is_the_same(
    suffix: str, shared: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = ToyTraffic(steps=30)
    policy = policy_of(shared, agents=AgentSet.of(env))
    exported(policy, suffix, tmp_path, env)
    act = page_loader(suffix, tmp_path, monkeypatch)
    scores = []
    for who in (policy.act, act):
        observations, infos = env.reset(seed=2)
        while env.agents:
            observations, _, _, _, infos = env.step(who(observations, infos))
        scores.append(env.scores())
    assert scores[0] == scores[1]


@KINDS
def test_numpy_has_the_same_values(shared: bool, hidden: tuple[int, ...]) -> None:
    policy = policy_of(shared, hidden)
    numpy_policy = NumpyPolicy(AGENTS, portable_network(policy), {})
    rng = np.random.default_rng(1)
    for _ in range(20):
        observations, _ = inputs(rng)
        values = numpy_policy.values(AGENTS.stack(observations))
        for row, own in zip(values, q_values(policy, observations).values(), strict=True):
            np.testing.assert_allclose(row[: own.size], own, rtol=1e-4, atol=1e-4)


def test_a_value_by_hand() -> None:
    """Two agents of one input, one hidden unit: relu(x w + b) v + c."""
    agents = AgentSet(("a_0", "b_0"), (1, 1), (2, 2))
    first = np.float32([[[2]], [[-1]]]), np.float32([[[1]], [[0]]])
    second = np.float32([[[1, -1]]]), np.float32([[[0, 5]]])
    policy = NumpyPolicy(agents, PortableLayers.of([first, second]), {})
    values = policy.values(np.float32([[3], [4]]))
    assert values.tolist() == [[7, -2], [0, 5]]
    observations = {"a_0": np.float32([3]), "b_0": np.float32([4])}
    assert policy.act(observations, {}) == {"a_0": 0, "b_0": 1}
    only = {"a_0": {"action_mask": np.int8([0, 1])}}
    assert policy.act(observations, only) == {"a_0": 1, "b_0": 1}


def test_an_exported_policy_is_a_policy(tmp_path: Path) -> None:
    policy = policy_of(False, agents=AgentSet.of(ToyTraffic()))
    policy.env_options = {}
    loaded = NumpyPolicy.load(exported(policy, ".npz", tmp_path))
    results = check_policy(loaded, ToyTraffic)
    assert not failed_checks(results), check_report(results).plain


def test_numpy_policies_do_not_load_torch(tmp_path: Path) -> None:
    path = exported(policy_of(True), ".npz", tmp_path)
    code = (
        "import sys; from pathlib import Path; from ugat_marl.policies.export import NumpyPolicy; "
        f"p = NumpyPolicy.load(Path({str(path)!r})); "
        "import numpy as np; "
        "p.act({n: np.zeros(s, np.float32) for n, s in "
        "zip(p.agents.names, p.agents.observation_sizes)}, {}); sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_two_formats_share_their_side_car(tmp_path: Path) -> None:
    policy = policy_of(False)
    path = exported(policy, ".npz", tmp_path)
    exported(policy, ".ts", tmp_path)
    assert NumpyPolicy.load(path).agents == AGENTS
    other = policy_of(False, agents=AgentSet.of(ToyTraffic()))
    with pytest.raises(OptionError, match=r"policy.json belongs to another policy.*policy.npz"):
        exported(other, ".ts", tmp_path)
    assert NumpyPolicy.load(path).agents == AGENTS
    mixed_with(other, path)


def mixed_with(other: NetworkPolicy, path: Path) -> None:
    """Puts the side-car of another policy beside a model, which is refused."""
    (path.parent / "other").mkdir()
    shutil.copy(exported(other, ".ts", path.parent / "other").with_suffix(".json"), path.parent)
    with pytest.raises(CheckpointError, match="belongs to another model"):
        NumpyPolicy.load(path)


def test_a_format_that_knows_the_site_leaves_the_others_readable(tmp_path: Path) -> None:
    env = ToyTraffic()
    env.decision_interval_s = 10.0
    policy = policy_of(False, agents=AgentSet.of(env))
    path = exported(policy, ".npz", tmp_path)
    export_policy(policy, path.with_suffix(".ts"), env)
    assert NumpyPolicy.load(path).agents == policy.agents


@pytest.mark.parametrize("changed", ["weights", "ceiling"])
def test_files_of_two_policies_of_one_shape_do_not_belong_together(
    tmp_path: Path, changed: str
) -> None:
    policy = policy_of(False, ceiling=5.0)
    path = exported(policy, ".npz", tmp_path)
    other = policy_of(False, ceiling=5.0 if changed == "weights" else 6.0)
    if changed == "weights":
        arguments = (other.agents, other.hidden, -policy.parameters, other.env_options)
        other = NetworkPolicy(*arguments, False, None, policy.ceiling)
    mixed_with(other, path)


# --- the side-car -------------------------------------------------------------------------------


def test_the_side_car_says_what_the_rows_are(tmp_path: Path) -> None:
    env = ToyTraffic()
    policy = policy_of(False, agents=AgentSet.of(env))
    path = tmp_path / "deep" / "policy.npz"
    about = json.loads(export_policy(policy, path, env).read_text())
    assert about.pop("kind") == "ugat_marl.exported_policy" and [
        len(each) for each in (about.pop("parameters"), *about.pop("sha256").values())
    ] == [64, 64, 64]
    assert about == {
        "network": "mlp",
        "agents": ["cross_0", "tee_0", "cross_1"],
        "observation_sizes": [7, 5, 7],
        "action_counts": [3, 2, 3],
        "observation_width": 7,
        "action_width": 3,
        "env_options": {"observation": "queue"},
        "decision_interval_s": 10.0,
        "intersections": {"cross_0": "A", "tee_0": "B", "cross_1": "C"},
    }
    keys = re.findall(r"`(\w+)`", PAGE.partition("| key of")[2].partition("\n\n")[0])
    assert {*about, "kind", "sha256", "parameters"} <= set(keys)
    again = json.loads(export_policy(policy, path.with_suffix(".ts")).read_text())
    assert again["decision_interval_s"] == 10.0  # what is known of the site stays
    without = json.loads(export_policy(policy, tmp_path / "policy.npz").read_text())
    assert without["decision_interval_s"] is without["intersections"] is None


def test_every_format_is_on_the_page() -> None:
    assert set(re.findall(r"^\| `(\.\w+)` \|", PAGE, flags=re.MULTILINE)) == set(FORMATS)


def test_what_cannot_be_exported_is_refused(tmp_path: Path) -> None:
    policy = policy_of(False)
    with pytest.raises(OptionError, match=r"'\.pt2' is not a format.*\.onnx"):
        export_policy(policy, tmp_path / "policy.pt2")
    with pytest.raises(OptionError, match=r"a_0 \(7 numbers, 3 actions\).*cross_0"):
        export_policy(policy, tmp_path / "policy.npz", ToyTraffic())
    policy.env_options = {"observation": len}
    with pytest.raises(CheckpointError, match="plain data"):
        export_policy(policy, tmp_path / "policy.npz")
    assert not list(tmp_path.iterdir())


def test_onnx_without_its_extra_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(OptionError, match=r"pip install 'onnx"):
        export_policy(policy_of(False), tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


# --- damage -------------------------------------------------------------------------------------


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    path = exported(policy_of(False), ".npz", tmp_path)
    side_car = path.with_suffix(".json")
    model, about = path.read_bytes(), side_car.read_text()

    def refused(says: str, model: bytes = model, about: str = about) -> None:
        path.write_bytes(model)
        side_car.write_text(about)
        with pytest.raises(CheckpointError, match=says):
            NumpyPolicy.load(path)

    refused("another model", model=model[:-9])
    refused("another model", about=about.replace("exported_policy", "network_policy"))
    for text in ("", "[]", "{", about.replace('"sha256"', '"sum"'), about[: len(about) // 2]):
        refused("export it again", about=text)
    for sums in ('"0f"', "3", "null"):  # before each format had a sum of its own, it was text
        refused("export it again", about=re.sub(r'"sha256": \{[^}]*\}', f'"sha256": {sums}', about))
    refused("was changed", about=about.replace('"queue"', '"count"'))
    refused("was changed", about=about.replace('"a_1",', ""))
    for name in ('"universal"', '"frap"', "null", "[]"):
        refused("export it again", about=about.replace('"mlp"', name))
    refused("export it again", about=about.replace('"env_options": {', '"env_option": {'))
    path.unlink()
    with pytest.raises(CheckpointError, match="No such file"):
        NumpyPolicy.load(path)


def test_a_file_of_something_else_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "my.json").write_text('"precious"')
    with pytest.raises(OptionError, match="describes no exported policy"):
        export_policy(policy_of(False), tmp_path / "my.npz")
    assert (tmp_path / "my.json").read_text() == '"precious"'
    assert not (tmp_path / "my.npz").exists()


@pytest.mark.parametrize("suffix", [".npz", ".ts"])
def test_a_model_of_something_else_is_not_replaced(tmp_path: Path, suffix: str) -> None:
    mine = tmp_path / f"my{suffix}"
    mine.write_bytes(b"precious")
    with pytest.raises(OptionError, match=r"my.json tells of no model in it"):
        export_policy(policy_of(False), mine)
    assert mine.read_bytes() == b"precious" and not (tmp_path / "my.json").exists()


def test_what_has_no_network_or_is_a_model_says_so(tmp_path: Path) -> None:
    path = exported(policy_of(False), ".npz", tmp_path)
    for name, says in (
        ("largest-queue:20", "is a rule"), (str(tmp_path), "a folder; name a file"),
        (str(path), r"an exported model.*give the \.pt"),
    ):  # fmt: skip
        with pytest.raises(CheckpointError, match=says):
            load_policy(name)


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    """An array of objects with the right check sum."""
    path = exported(policy_of(False), ".npz", tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(FORMATS, ".npz", ("matrices", lambda _: _pickled(tmp_path)))
        export_policy(policy_of(False), path)
    with pytest.raises(CheckpointError, match="allow_pickle=False"):
        NumpyPolicy.load(path)


def _pickled(folder: Path) -> bytes:
    np.savez(folder / "objects.npz", weight_0=np.array([print]), bias_0=np.array([print]))
    return (folder / "objects.npz").read_bytes()


@pytest.mark.parametrize(
    ("says", "change"),
    [
        ("NaN", lambda w, b: [(w[0] * np.nan, b[0]), (w[1], b[1])]),
        ("infinite", lambda w, b: [(w[0], b[0]), (w[1], b[1] + np.inf)]),
        ("inputs", lambda w, b: [(w[1], b[1])]),
        ("outputs", lambda w, b: [(w[0], b[0])]),
        ("outputs", lambda w, b: []),
        ("inputs", lambda w, b: [(w[0][:3], b[0]), (w[1], b[1])]),
        ("inputs", lambda w, b: [(w[0], b[0][..., :2]), (w[1], b[1])]),
        ("inputs", lambda w, b: [(w[0][0], b[0]), (w[1], b[1])]),
    ],
)
def test_layers_that_do_not_fit_are_refused(says: str, change: Any) -> None:
    arrays = portable_network(policy_of(False, (8,))).arrays
    weights, biases = ([arrays[f"{kind}_{i}"] for i in range(2)] for kind in ("weight", "bias"))
    with pytest.raises(ValueError, match=says):
        NumpyPolicy(AGENTS, PortableLayers.of(change(weights, biases)), {})


def test_layers_are_refused_if_one_lacks_its_bias_or_holds_other_numbers() -> None:
    arrays = dict(portable_network(policy_of(False, (8,))).arrays)
    for says, changed in (
        ("bias_1", {name: array for name, array in arrays.items() if name != "bias_1"}),
        ("odd", {**arrays, "odd": arrays["bias_0"]}),
        ("float64", {**arrays, "bias_0": arrays["bias_0"].astype(np.float64)}),
    ):
        with pytest.raises(ValueError, match=says):
            NumpyPolicy(AGENTS, PortableLayers(changed), {})


@pytest.mark.parametrize("suffix", FORMATS)
def test_files_hold_no_path_of_the_machine(suffix: str, tmp_path: Path) -> None:
    path = exported(policy_of(False), suffix, tmp_path)
    contents = [path.read_bytes()]
    if suffix != ".onnx":
        with zipfile.ZipFile(path) as archive:
            contents += [archive.read(name) for name in archive.namelist()]
    for place in (Path(ugat_marl.__file__).parent, Path(torch.__file__).parent, tmp_path):
        assert not [True for content in contents if str(place).encode() in content]


# --- the command --------------------------------------------------------------------------------


def test_the_command_exports_with_a_scenario(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    env = ugat_marl.parallel_env("mixed-v1")
    learner = DQN.of(env, DQNConfig(hidden=(4,)))
    learner.policy().save(tmp_path / "policy.pt")
    call = ["export", str(tmp_path / "policy.pt"), "--out", str(tmp_path / "out.ts")]
    assert main([*call, "--scenario", "mixed-v1"]) == 0
    assert "out.json" in capsys.readouterr().out
    about = json.loads((tmp_path / "out.json").read_text())
    assert about["intersections"] == env.intersection_of and about["decision_interval_s"] == 10
    assert about["env_options"] == env.env_options
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        model = torch.jit.load(tmp_path / "out.ts")
    agents = AgentSet.of(env)
    seen = torch.zeros(len(agents), agents.widest_observation)
    allowed = torch.zeros(len(agents), agents.most_actions, dtype=torch.bool)
    allowed[:, 1] = True
    assert model(seen, allowed).tolist() == [1] * len(agents)
    assert main([*call, "--scenario", "single-v1"]) == 2
    assert "give the scenario it was trained in" in capsys.readouterr().err
