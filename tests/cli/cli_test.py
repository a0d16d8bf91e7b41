"""The command line as a user meets it: help, errors in one line, commands in sequence."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.runs import search_few_rules
from ugat_marl.__main__ import COMMANDS, main
from ugat_marl.cli.evaluate import names_of
from ugat_marl.data import TransitionLog
from ugat_marl.files import without_empty_folders, write_whole


def complaint(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line on standard error of a call that must be refused."""
    assert main(list(arguments)) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    lines = err.strip().splitlines()
    assert len(lines) == 1, err
    assert lines[0].startswith("ugat-marl: error: ")
    return lines[0]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["trian", "single-v1"], "'train'"),
        (["paper", "mian"], "'main'"),
        (["train", "singel-v1"], "'single-v1'"),
        (["train", "single-v1", "--real", "V44"], "'V4'"),
        (["train", "single-v1", "--real", "sim"], "the simulation itself"),
        (["train", "single-v1", "--rael", "V4"], "'--real'"),
        (["train", "single-v1", "--real", "undercount=*,0.2"], "which agents do not see"),
        (["train", "single-v1", "--iteratoins", "4"], "'--iterations'"),
        (["train", "single-v1", "--gate.moed", "static"], "'--gate.mode'"),
        (["train", "single-v1", "--seed", "one"], "--seed 'one': not a whole number"),
        (["train", "single-v1", "--observation", "cuont"], "'count'"),
        (["train", "single-v1", "--iterations", "-1"], "at least 0"),
        (["train"], "error: train needs SCENARIO; see ugat-marl train --help"),
        (
            ["train", "single-v1", "--rule-budget", "none"],
            "--rule-budget none: not a whole number, nor None; see ugat-marl train --help-all",
        ),
        (
            ["train", "single-v1", "--gate.mode", "static", "--gate.static-alpha", "0.3"],
            "error: --gate.mode static counts with the grounding phase or timed",
        ),
        (
            ["train", "single-v1", "--grounding", "phase", "--timed.most-s", "3"],
            "error: --timed.most-s 3 counts with the grounding timed",
        ),
        (["import-log"], "import-log needs SCENARIO, MEASURED and --out PATH; see"),
        (
            ["train", "x", "--grounding", "foo"],
            "--grounding 'foo': must be one of 'phase', 'timed'",
        ),
        (["train", "single-v1", "--seed"], "--seed needs a value"),
        (["train", "single-v1", "--rollout-epsilon", "z"], "--rollout-epsilon 'z': not a number"),
        (
            ["scenario", "new", "x", "--begin-s", "7:05"],
            "nor None; this time of day is 25500 s",
        ),
        (
            ["train", "single-v1", "--rollout-epsilon", "7:00:10"],
            "not a number; this time of day is 25210 s",
        ),
        (["train", "single-v1", "extra"], "'extra'"),
        (["train", "single-v1", "--real-log", "nowhere.parquet"], "nowhere.parquet"),
        (["evaluate", "single-v1", "--policies", "largst-queue:20"], "'largest-queue'"),
        (["evaluate", "single-v1", "--policies", "nowhere.pt"], "nowhere.pt"),
        (["evaluate", "single-v1", "--domains", "sim", "snwo"], "'snow'"),
        (["evaluate", "single-v1", "--domains", "startup_dealy=1"], "'startup_delay'"),
        (["evaluate", "single-v1", "--domains", "startup_delay=-1"], "[0, 10] s"),
        (["evaluate", "single-v1", "--seeds", "0"], "at least 1"),
        (["evaluate", "single-v1", "--domains", "V4", "snow"], "listed twice"),
        (["evaluate", "single-v1", "--policies", "random", "random"], "twice"),
        (["check", "nowhere.sumocfg"], "nowhere.sumocfg"),
        (["rollout", "single-v1"], "--out"),
        (["rollout", "single-v1", "--out", "."], "is a folder"),
        (["evaluate", "single-v1", "--out", "/dev/null/x.json"], "cannot be written"),
        (["evaluate", "single-v1", "--first-seed", "-5"], "--first-seed -5: must be at least 0"),
        (["evaluate", "single-v1", "--policies", "."], "is a folder"),
        (["train", "single-v1", "--out", "/dev/null/run"], "cannot be written"),
        (["train", "single-v1", "--out", ""], "empty"),
        (
            ["train", "single-v1", "--fit.learning-rate=inf"],
            "error: --fit.learning-rate inf; allowed: > 0, finite",
        ),
        (["train", "single-v1", "--street.simulations", "1"], "error: --street.simulations 1;"),
        (["train", "single-v1", "--dqn.batch-size", "0"], "error: --dqn.batch-size 0: must be"),
        (["train", "single-v1", "--rollout-epsilon", "2"], "error: --rollout-epsilon 2: must be"),
        (
            ["evaluate", "single-v1", "--duration-s", "inf"],
            "scenario 'single-v1': --duration-s inf: input should be a finite number",
        ),
        (["train", "single-v1", "--fit.uncertainty", "ensembel"], "ensemble"),
        (["train", "single-v1", "--fit.members", "0"], "1 to 100"),
        (["train", "single-v1", "--workers", "0"], "--workers 0: must be at least 1"),
        (["scenario", "new", "x", "--grid", "1x1", "--vph", "9", "--duration-s", "nan"], "seconds"),
        (["scenario", "new", "x", "--grid", "1x1", "--vph", "9", "--begin-s", "inf"], "--begin-s"),
        (["record", "single-v1", "--out", "x", "--periods", "0"], "--periods 0: must be at least"),
        (["train", "single-v1", "--seed", "-1"], "error: --seed -1: must be at least 0"),
        (["paper", "main", "--first-seed", "-1"], "error: --first-seed -1: must be at least 0"),
        (["rollout", "single-v1", "--out", "x", "--seed", "-1"], "--seed -1: must be at least 0"),
        (["scenario", "new", "x", "--draw", "-1"], "--draw -1: must be at least 0"),
        (
            ["scenario", "new", "x", "--grid", "1x1", "--vph", "9", "--seed", "-1"],
            "--seed -1: must be at least 0",
        ),
        (["scenario", "check", "nowhere", "--seed", "-1"], "--seed -1: must be at least 0"),
    ],
)
def test_a_wrong_call_is_one_line_with_the_nearest_name(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert says in complaint(capsys, *arguments)


@pytest.mark.parametrize("value", ["24:30", "-7:05", "7:75", "1:2:3:04"])
def test_what_is_no_time_of_day_is_not_translated(
    value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    said = complaint(capsys, "train", "single-v1", f"--rollout-epsilon={value}")
    assert "not a number" in said
    assert "time of day" not in said


@pytest.mark.parametrize(
    ("arguments", "unused"),
    [
        ("scenario check single-v1 --conformance --headroom 2 --json", "--headroom, --json"),
        ("scenario check single-v1 --observation queue", "--observation"),
        ("plan single-v1 --out p --lights 1=A1", "--lights"),
        ("plan single-v1 --out p --seeds 5", "--seeds"),
        ("plan single-v1 --out p --apply p.csv --domain V4 --first-seed 3", "--domain, --first-"),
        ("rollout single-v1 --video f.gif --episodes 5 --workers 2", "--episodes, --workers"),
        ("rollout single-v1 --out l.parquet --film.speed 5", "--film"),
        ("scenario new x --grid 1x1 --vph 100 --left-hand --link", "--left-hand"),
        ("scenario new x --grid 1x1 --counts c.csv --turns 0.1 0.8 0.1", "--turns"),
        ("scenario new x --draw 3 --vph 100", "--vph"),
    ],
)
def test_options_that_would_do_nothing_are_refused(
    arguments: str, unused: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert f"; leave out {unused}" in complaint(capsys, *arguments.split())


@pytest.mark.parametrize(
    "command",
    [
        ["evaluate", "single-v1"],
        ["tune", "single-v1"],
        ["rollout", "single-v1"],
        ["import-log", "single-v1", "measured"],
        ["compare", "single-v1", "--name", "mine", "--policies", "random"],
    ],
    ids=lambda command: command[0],
)
def test_a_file_of_another_kind_is_not_replaced(
    command: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    policy = tmp_path / "policy.pt"
    policy.write_bytes(b"weights")
    assert "give a name that ends in" in complaint(capsys, *command, "--out", str(policy))
    assert policy.read_bytes() == b"weights"


def test_one_light_has_one_intersection(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    table = tmp_path / "synchro.csv"
    table.write_text("[Network]\nNetwork Settings\nRECORDNAME,DATA\n")
    words = ["plan", "single-v1", "--out", "p", "--apply", str(table), "--lights", "1=A1", "2=A1"]
    assert "2=A1: intersection or light is given twice" in complaint(capsys, *words)


def test_policies_of_an_unknown_scenario_are_not_an_empty_list(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert "Did you mean 'single-v1'" in complaint(
        capsys, "policy", "list", "--scenario", "singel-v1"
    )


@pytest.mark.parametrize("command", list(COMMANDS))
def test_every_command_explains_itself(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    # under pytest tyro draws when to compare its cache with a fresh answer: here, always
    monkeypatch.setattr("random.random", lambda: 0.0)
    with pytest.raises(SystemExit) as end:
        main([*command.split(), "--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: ugat-marl {command}" in text
    assert f"    ugat-marl {command}" in text, "no example"


@pytest.mark.parametrize("flag", ["--help", "--help-all"])
@pytest.mark.parametrize("command", list(COMMANDS))
def test_help_fits_a_terminal_and_says_what_defaults_mean(
    command: str, flag: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main([*command.split(), flag])
    lines = capsys.readouterr().out.splitlines()
    assert command in lines[0]
    assert max(map(len, lines)) <= 80
    assert not [line for line in lines if "(default: )" in line]
    if flag == "--help":  # among all options of a training some have the value None
        assert not [line for line in lines if "None" in line]


def test_help_of_a_group_is_about_the_group(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["paper", "--help"]) == 0
    text = capsys.readouterr().out
    assert "usage: ugat-marl paper COMMAND [options]" in text
    assert "ugat-marl paper COMMAND --help" in text
    assert "train" not in text


def test_help_names_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for command in COMMANDS:
        assert all(word in text for word in command.split())
    assert main([]) == 2


def test_scenarios_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenarios"]) == 0
    text = capsys.readouterr().out
    for name in ("single-v1", "grid2x2-v1", "grid4x4-v1", "arterial1x5-v1", "mixed-v1", "snow"):
        assert name in text


@pytest.mark.parametrize(("content", "beside"), [("{}", ""), ('{"a": 1}', ""), (None, "run.json")])
def test_evaluate_replaces_its_own_tables_only(
    content: str | None, beside: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "table.json"
    call = ["evaluate", "single-v1", "--policies", "random", "--domains", "sim", "--seeds", "1"]
    call += ["--duration-s", "30", "--out", str(out)]
    if content is not None:
        out.write_text(content)
    else:
        assert main(call) == 0
        assert main(call) == 0
        (tmp_path / beside).write_text("{}")
    link = tmp_path / "link.json"
    link.symlink_to(out)
    before = out.read_bytes()
    for place in (out, link):
        assert main([*call[:-1], str(place)]) == 2
        assert "would be lost" in " ".join(capsys.readouterr().err.split())
        assert out.read_bytes() == before


def test_evaluate_prints_and_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    out = tmp_path / "table.json"
    call = ["evaluate", "single-v1", "--policies", "largest-queue:20", "programme", "--domains"]
    call += ["sim", "V4", "--seeds", "2", "--duration-s", "300", "--out", str(out)]
    assert main(call) == 0
    text = capsys.readouterr().out
    for word in ("single-v1 in sim", "single-v1 in V4", "gap to sim", "95 % interval", "regret"):
        assert word in text
    table = [line for line in text.splitlines() if not line.startswith("table: ")]
    assert max(map(len, table)) <= 80
    content = json.loads(out.read_text())
    assert len(content["episodes"]) == 2 * 2 * 2


@pytest.mark.slow
def test_a_recorded_log_trains(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    search_few_rules(monkeypatch, "largest-queue:20", "programme")
    log = tmp_path / "v4.parquet"
    short = ["--duration-s", "200"]
    call = ["rollout", "single-v1", "--domain", "V4", "--episodes", "2", "--out", str(log)]
    assert main([*call, *short]) == 0
    assert TransitionLog.read(log).provenance.domain == "V4"
    call = ["train", "single-v1", "--real", "none", "--real-log", str(log), "--out"]
    call += [str(tmp_path / "run"), "--pretrain-episodes", "1", "--iterations", "1"]
    call += ["--grounded-episodes", "1", "--tuning-seeds", "1"]
    call += ["--dqn.teacher", "None", "--street.simulations", "20", "--street.judged", "1"]
    assert main([*call, "--evaluation-seeds", "1", "--no-control", *short]) == 0
    assert "direct transfer" in capsys.readouterr().out
    picture = (tmp_path / "run" / "gap.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) > 10_000


def test_a_sound_scenario_passes_the_check(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "single-v1", "--duration-s", "100"]) == 0
    assert "single-v1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("policies", "names"),
    [
        (("random", "largest-queue:20"), ["random", "largest-queue:20"]),
        (("policies/ugat.pt", "policies/direct.pt"), ["ugat", "direct"]),
        (("a/x/ugat.pt", "a/y/ugat.pt", "random"), ["x/ugat", "y/ugat", "random"]),
    ],
)
def test_policies_in_a_table_have_short_names_that_differ(
    policies: tuple[str, ...], names: list[str]
) -> None:
    assert names_of(policies) == names


def test_a_refused_command_leaves_no_empty_folder(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    for out in (mine / "log.parquet", tmp_path / "new" / "too" / "log.parquet"):
        words = ["rollout", "single-v1", "--policy", "no-such-rule", "--out", str(out)]
        assert main(words) == 2
    assert list(tmp_path.iterdir()) == [mine]
    with without_empty_folders():
        write_whole(tmp_path / "new" / "file", "")
    assert (tmp_path / "new" / "file").exists()


def test_tune_replaces_no_file_of_another_kind(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "t.json"
    words = ["tune", "single-v1", "--rules", "fixed-time", "--budget", "3", "--out", str(out)]
    out.write_text('{"mine": 1}')
    assert main(words) == 2
    assert "is no table of `ugat-marl tune`, and would be lost" in capsys.readouterr().err
    assert out.read_text() == '{"mine": 1}'


@pytest.mark.parametrize("kind", [[], ["--counts-every-s", "5"]])
def test_a_recording_in_which_nobody_came_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: list[str]
) -> None:
    out = tmp_path / "r"
    words = ["record", "single-v1", "--periods", "1", "--duration-s", "10", "--out", str(out)]
    assert main([*words, *kind]) == 2
    assert "nobody came over a detector in 1 period ('day1')" in capsys.readouterr().err
    assert not out.exists()
