"""Limits of the system: a full disk, few descriptors, long names. Each ends in one line."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.experiments.driver_test import PLAIN
from ugat_marl.errors import OutputError
from ugat_marl.experiments.jobs import file_names
from ugat_marl.files import replacing, write_whole

LIMITED = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
kind, most = getattr(resource, sys.argv[1]), int(sys.argv[2])
resource.setrlimit(kind, (most, most))
"""
COMMAND = "from ugat_marl.__main__ import main; sys.exit(main(sys.argv[3:]))"
VECTOR = """
import ugat_marl
try:
    ugat_marl.vector_env("single-v1", 40).reset(seed=0)
except OSError as error:
    sys.exit(f"refused: {error}")
"""
TRAIN = (
    "train", "single-v1", "--real", "V4", "--duration-s", "60", "--learner", "dqn", "--grounding",
    "phase", "--pretrain-episodes", "1", "--iterations", "1", "--out", "run",
)  # fmt: skip
MANY_EFFECTS = (
    "startup_delay=0.5+late_green=*,2+acceleration=1.2+deceleration=3+min_gap=3+desired_speed=0.8+"
    "yellow_time=4+all_red_time=1+speed_spread=0.2+emergency_deceleration=5+yellow_running=0.5+"
    "gap_acceptance=2+lane_discipline=0.5+headway=1.5+imperfection=0.7+heavy_share=0.1"
)
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of Linux")


def limited(
    python: list[str], folder: Path, program: str, *words: str
) -> subprocess.CompletedProcess[str]:
    """Run a program under a limit of the system."""
    command = [*python, "-c", LIMITED + program, *words]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=200, check=False
    )


@linux
def test_a_full_disk_in_a_training_is_one_line(python: list[str], tmp_path: Path) -> None:
    """The limit of a file's size is met by the first checkpoint, as a full disk is."""
    done = limited(python, tmp_path, COMMAND, "RLIMIT_FSIZE", "20000", *TRAIN)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("ugat-marl: error: ") and last.endswith("File too large")
    assert ".pt: " in last
    assert not [*tmp_path.rglob("*.tmp")]


@linux
def test_a_full_folder_for_temporary_files_is_one_line(python: list[str], tmp_path: Path) -> None:
    words = ("evaluate", "single-v1", "--domains", "V4", "--seeds", "1", "--duration-s", "60")
    policies = ("--policies", "fixed-time:20")
    done = limited(python, tmp_path, COMMAND, "RLIMIT_FSIZE", "1000", *words, *policies)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith("ugat-marl: error: ")


@linux
def test_too_few_descriptors_are_an_error_of_the_system(python: list[str], tmp_path: Path) -> None:
    done = limited(python, tmp_path, VECTOR, "RLIMIT_NOFILE", "64")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("refused: [Errno 24] Too many open files")


def test_a_write_without_room_names_the_file(tmp_path: Path) -> None:
    def fill() -> None:
        with replacing(tmp_path / "a"):
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match=r"No space left on device: '.*a'"):
        fill()
    assert list(tmp_path.iterdir()) == []


def test_domains_of_many_effects_make_names_that_file_systems_take(tmp_path: Path) -> None:
    """The digest tells jobs apart whose names begin alike, a number tells policies apart."""
    jobs = [
        replace(PLAIN, setting=replace(PLAIN.setting, world=f"{MANY_EFFECTS}+min_green={least}"))
        for least in (5, 8)
    ]
    files = file_names([f"further in {job.setting.world}" for job in jobs])
    for name in (*files, *(job.name for job in jobs)):
        write_whole(tmp_path / f"{name}.parquet", "")
    assert len(list(tmp_path.iterdir())) == 4


def test_a_name_that_is_too_long_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises((OSError, OutputError), match="too long"):
        write_whole(tmp_path / ("x" * 300), "")
