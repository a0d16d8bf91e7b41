"""The tutorial, command by command as it stands on its page: some four minutes of one core."""

from __future__ import annotations

import json
import os
import re
import subprocess
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = ROOT / "docs" / "tutorials"

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(3600)]


def play(page: str, python: list[str], tmp_path: Path) -> Path:
    """Run the commands of a page, and return the folder in which they ran."""
    program = tmp_path / "bin" / "ugat-marl"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {python[0]} -m ugat_marl "$@"\n')
    program.chmod(0o755)
    clone = tmp_path / "clone"
    clone.mkdir()
    for name in ("tests", "docs"):
        (clone / name).symlink_to(ROOT / name)
    environment = {**os.environ, "PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}"}
    begin = time.monotonic()
    text = (TUTORIALS / page).read_text(encoding="utf-8")
    for block in re.findall(r"```sh\n(.*?)```", text, flags=re.DOTALL):
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", block],
            cwd=clone, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{block}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    print(f"{time.monotonic() - begin:.0f} s without the installation")
    return clone


def test_from_clone_to_own_city(python: list[str], tmp_path: Path) -> None:
    clone = play("first-city.md", python, tmp_path)
    for left in ("runs/snow/report.html", "runs/snow/before-after.gif", "both.html",
                 "my-city/scenario.toml", "my-city-pictures"):  # fmt: skip
        assert (clone / left).exists(), left
    assert "Missing here" not in (clone / "both.html").read_text(encoding="utf-8")


def test_a_traffic_engineer_s_way(python: list[str], tmp_path: Path) -> None:
    clone = play("your-town.md", python, tmp_path)
    for left in ("town/counts-fit.csv", "found/report.html", "home.csv", "tomorrow/plans.add.xml"):
        assert (clone / left).exists(), left
    found = json.loads((clone / "found" / "diagnosis.json").read_text(encoding="utf-8"))
    assert found["verdict"] == "explained"
    assert [effect["name"] for effect in found["effects"]] == ["startup_delay"]
    page = " ".join((TUTORIALS / "your-town.md").read_text(encoding="utf-8").split())
    seconds = found["effects"][0]["parameters"]["seconds"]
    assert f'"{found["sentence"].partition(". ")[0].rstrip(".")}."' in page
    assert f"interval is {seconds['low']:.2f} to {seconds['high']:.2f} s" in page
