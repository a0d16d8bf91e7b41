"""Help that fits a screen, and what a shell completes."""

from __future__ import annotations

import importlib
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from ugat_marl.__main__ import COMMANDS, GROUPS, main
from ugat_marl.cli.help import is_positional, options_of

MANY = [name for name in COMMANDS if name == "train" or name.startswith("paper")]


def help_of(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The help that a call prints."""
    with pytest.raises(SystemExit) as end:
        main([*words])
    assert end.value.code == 0
    return capsys.readouterr().out


def options_in(text: str) -> list[str]:
    """The long options that a help text lists."""
    return re.findall(r"^[│ ] ?(?:-h, )?(--[a-z][\w.-]*)", text, flags=re.MULTILINE)


@pytest.mark.parametrize("command", MANY)
def test_the_first_screen_has_about_a_dozen_options_and_names_the_way_to_all(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    first = help_of(capsys, *command.split(), "--help")
    everything = help_of(capsys, *command.split(), "--help-all")
    assert 12 <= len(options_in(first)) <= 16
    assert f"ugat-marl {command} --help-all" in first
    assert len(options_in(everything)) > 90
    assert set(options_in(first)) < set(options_in(everything))
    lines = [line for line in first.splitlines() if not line.startswith("    ugat-marl")]
    assert max(map(len, lines)) <= 80
    assert len(lines) <= 80
    assert not [line for line in lines if "None" in line or "(default: )" in line]


@pytest.mark.parametrize("command", ["train", "paper main", "rollout", "scenario new", "field"])
def test_help_lists_what_the_command_takes(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    module, _, attribute = COMMANDS[command][0].partition(":")
    taken = options_of(getattr(importlib.import_module(module), attribute))
    named = {option for option, hint in taken.items() if not is_positional(hint)}
    listed = options_in(help_of(capsys, *command.split(), "--help-all"))
    assert set(listed) == {*named, "--help"}


def test_the_start_of_an_episode_is_told_as_a_time_of_day(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = " ".join(help_of(capsys, "scenario", "new", "--help-all").replace("│", "").split())
    assert "s after midnight: 25200 is 7:00" in words


def test_there_are_few_verbs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    listed = re.findall(r"^  ([a-z-]+)  +\S", capsys.readouterr().out, flags=re.MULTILINE)
    assert 10 <= len(listed) <= 20
    assert {name.split()[0] for name in COMMANDS} | {"completion"} == set(listed)
    # the commands of a group stand behind a colon, as below
    assert not [name for name, (_, purpose) in COMMANDS.items() if ":" in purpose]
    for group, text in GROUPS.items():
        assert main([group, "--help"]) == main([group, "--help-all"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert lines[: len(lines) // 2] == lines[len(lines) // 2 :]
        members = {name.split()[1] for name in COMMANDS if name.startswith(f"{group} ")}
        assert members == set(text.partition(": ")[2].split(", "))


def script(capsys: pytest.CaptureFixture[str], shell: str) -> str:
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "complete.bash"
    file.write_text(script(capsys, "bash"))

    def completed(*words: str) -> list[str]:
        typed = " ".join(f"'{word}'" for word in ("ugat-marl", *words))
        lines = [
            f"source '{file}'",
            f"COMP_WORDS=({typed}) COMP_CWORD={len(words)}",
            "_ugat_marl",
            'printf "%s\\n" "${COMPREPLY[@]}"',
        ]
        done = subprocess.run(
            ["bash", "-c", "\n".join(lines)], capture_output=True, text=True, check=True
        )
        assert not done.stderr
        return done.stdout.split()

    assert completed("tr") == ["train"]
    assert "scenario" in completed("") and "completion" in completed("")
    assert completed("scenario", "ch") == ["check"]
    assert completed("train", "gr") == ["grid2x2-v1", "grid4x4-v1"]
    assert completed("train", "single-v1", "--gr") == ["--grounding", "--grounded-episodes"]
    assert completed("train", "single-v1", "--grounding", "") == ["phase", "timed", "street"]
    assert "V4" in completed("evaluate", "single-v1", "--domains", "sim", "V")
    assert completed("evaluate", "single-v1", "--policies", "max-pressure-") == [
        "max-pressure-loss"
    ]
    networks = ["grid2x2-v1", "grid4x4-v1"]
    assert completed("train", "--real", "V4", "gr") == networks, "a value has been given"
    assert completed("train", "--no-control", "gr") == networks, "it takes no value"
    assert completed("scenario", "check", "--workers", "2", "gr") == networks
    assert completed("paper", "main", "--no-dqn") == []
    assert "--no-control" in completed("train", "single-v1", "--no")
    assert completed("report", "--ru") == [], "an argument without a name"
    assert completed("check", "gr") == networks, "a short name"
    assert completed("completion", "") == ["bash", "zsh", "fish"]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_have_all_verbs_and_options(
    shell: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    text = script(capsys, shell)
    for name in COMMANDS:
        assert all(word in text for word in name.split())
    assert "pretrain-episodes" in text and "grid4x4-v1" in text
    if shutil.which(shell) is not None:
        file = tmp_path / "complete"
        file.write_text(text)
        subprocess.run([shell, "-n", str(file)], check=True)


def test_completion_says_how_it_is_loaded(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "--help"]) == 0
    out = capsys.readouterr().out
    assert 'eval "$(ugat-marl completion bash)"' in out and "fish" in out
    assert main(["completion"]) == 2
    capsys.readouterr()
    assert main(["completion", "bsh"]) == 2
    assert "'bash'" in capsys.readouterr().err
