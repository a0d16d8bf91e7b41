"""Videos: every second a frame, the same episode as without a camera, two policies side by side."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image

from ugat_marl.__main__ import main
from ugat_marl.envs import TrafficEnv, parallel_env
from ugat_marl.errors import OptionError, OutputError
from ugat_marl.parallel import DEADLINE_VARIABLE
from ugat_marl.policies import make_rule, roll_out
from ugat_marl.reporting import film_episode, film_frames, require_video, write_video
from ugat_marl.reporting import video as filming
from ugat_marl.reporting.video import Filmed, between
from ugat_marl.simulation import ProcessSimulator


def made(rule: str = "max-pressure:20", duration_s: float = 300) -> tuple[TrafficEnv, Any]:
    policy = make_rule(rule, parallel_env("single-v1", duration_s=duration_s))
    return parallel_env("single-v1", duration_s=duration_s, **policy.env_options), policy


def test_plans_are_cut_where_seconds_end() -> None:
    plans = {"a": [(3.0, "y"), (2.0, "r"), (5.0, "G")], "b": [(10.0, "r")], "c": []}
    assert between(plans, 0, 1) == {"a": [(1.0, "y")], "b": [(1.0, "r")]}
    assert between(plans, 2.5, 5.5) == {
        "a": [(0.5, "y"), (2.0, "r"), (0.5, "G")], "b": [(3.0, "r")],
    }  # fmt: skip
    whole = [between(plans, k, k + 1)["a"] for k in range(10)]
    assert [state for part in whole for _, state in part] == [*"yyyrr", *"GGGGG"]
    assert between(plans, 10, 11) == {}


def test_the_camera_changes_nothing() -> None:
    env, policy = made()
    plain, plain_policy = made()
    camera = Filmed(ProcessSimulator(), 55, 170)
    env.simulate_with(camera)
    try:
        assert roll_out(env, policy, 5).steps == roll_out(plain, plain_policy, 5).steps == 30
        assert env.scores() == plain.scores()
    finally:
        env.close()
        plain.close()
    times = [scene.time_s for scene in camera.scenes]
    assert times == [float(second) for second in range(56, 171)]
    counts = [len(scene.vehicles.speed_mps) for scene in camera.scenes]
    assert max(counts) > 5
    way = [np.abs(a - b).sum() for a, b in zip(counts, counts[1:], strict=False)]
    assert max(way) <= 8  # a second, not a decision, lies between two scenes


def test_scenes_are_a_second_apart_whatever_a_decision_takes() -> None:
    inner: Any = SimpleNamespace(
        start=lambda launch: None, advance=lambda *_: None, vehicles=list, signals=dict
    )
    camera = Filmed(inner, 60.0, 90.0)
    camera.start(cast("Any", SimpleNamespace(begin_s=100.0)))
    for _ in range(16):
        camera.advance(7.5, {})
    assert [scene.time_s for scene in camera.scenes] == [160.0 + k for k in range(1, 31)]


def test_two_policies_stand_side_by_side(tmp_path: Path) -> None:
    films = []
    for rule in ("fixed-time:30", "max-pressure:20"):
        env, policy = made(rule)
        films.append(film_episode(env, policy, 3, 100, 20, rule))
        env.close()
    pictures = list(film_frames(films, 300))
    assert len(pictures) == 20
    single = next(film_frames(films[:1], 300))
    assert pictures[0].shape == (single.shape[0], 2 * single.shape[1], 3)
    assert (pictures[0] != pictures[-1]).any()
    left, right = np.split(pictures[-1], 2, axis=1)
    assert (left[46:] != right[46:]).any()  # other signals, other queues
    assert (left[:46] != right[:46]).any()  # and other titles
    for ending in (".gif", ".webp"):
        path = tmp_path / f"both{ending}"
        write_video(iter(pictures), path, 10)
        with Image.open(path) as video:
            assert getattr(video, "n_frames", 1) >= 15  # equal frames are one, shown longer
            assert video.size == pictures[0].shape[1::-1]
            video.load()
            assert video.info["duration"] % 100 == 0


@pytest.mark.parametrize(("per_second", "frames"), [(30, 60), (50, 60), (60, 30), (7, 60)])
def test_a_gif_lasts_as_long_as_its_pictures(per_second: int, frames: int, tmp_path: Path) -> None:
    pictures = [np.full((8, 8, 3), 4 * k, np.uint8) for k in range(60)]
    write_video(iter(pictures), tmp_path / "a.gif", per_second)
    with Image.open(tmp_path / "a.gif") as video:
        assert getattr(video, "n_frames", 1) == frames
        shown = []
        for number in range(frames):
            video.seek(number)
            shown.append(video.info["duration"])
    assert sum(shown) == pytest.approx(1000 * 60 / per_second, abs=5)
    assert min(shown) >= 20


def test_what_cannot_be_filmed_is_said_first() -> None:
    env, policy = made()
    for begin_s, length_s in ((250, 100), (-1, 10), (0, 0)):
        with pytest.raises(OptionError, match="the episode has 300 s"):
            film_episode(env, policy, 3, begin_s, length_s, "x")
    env.close()


def test_endings_and_ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OptionError, match=r"ends in one of \.mp4.*not '\.avi'"):
        require_video(tmp_path / "a.avi")
    monkeypatch.setattr(filming, "_ffmpeg", lambda: None)
    with pytest.raises(OptionError, match=r"pip install .imageio-ffmpeg.*out\.gif"):
        require_video(tmp_path / "out.mp4")
    require_video(tmp_path / "out.gif")


PROGRAM = """#!{python}
import sys
data = sys.stdin.buffer.read()
if {fail}:
    sys.exit("no such codec")
open(sys.argv[-1], "wb").write(str(len(data)).encode() + b" " + " ".join(sys.argv).encode())
"""


@pytest.mark.parametrize("fail", [False, True])
def test_ffmpeg_gets_all_frames_and_its_words_are_kept(
    fail: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "ffmpeg"
    program.write_text(PROGRAM.format(python=sys.executable, fail=fail))
    program.chmod(0o755)
    monkeypatch.setattr(filming, "_ffmpeg", lambda: str(program))
    pictures = [np.full((20, 30, 3), k, np.uint8) for k in range(4)]
    video = tmp_path / "out.mp4"
    if fail:
        with pytest.raises(OutputError, match=r"^out\.mp4: ffmpeg failed: no such codec"):
            write_video(pictures, video, 10)
        assert not video.exists()
        return
    write_video(pictures, video, 10)
    assert video.read_text().split()[0] == str(4 * 20 * 30 * 3)
    assert "30x20" in video.read_text() and "-r 10" in video.read_text()


@pytest.mark.parametrize("reads", [0, 1])
def test_a_stopped_ffmpeg_is_killed(
    reads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "ffmpeg"
    program.write_text(
        f"#!{sys.executable}\nimport os, signal, sys\n"
        f"{'sys.stdin.buffer.read()' if reads else ''}\nos.kill(os.getpid(), signal.SIGSTOP)\n"
    )
    program.chmod(0o755)
    monkeypatch.setattr(filming, "_ffmpeg", lambda: str(program))
    monkeypatch.setenv(DEADLINE_VARIABLE, "1.5")
    pictures = [np.zeros((400, 400, 3), np.uint8)] * 3  # more than a pipe holds
    with pytest.raises(OutputError, match=r"^out\.mp4: ffmpeg did not go on for 1.5 s and was"):
        write_video(pictures, tmp_path / "out.mp4", 10)
    assert not (tmp_path / "out.mp4").exists()


@pytest.mark.skipif(filming._ffmpeg() is None, reason="no ffmpeg to write a video with")
def test_a_real_mp4(tmp_path: Path) -> None:
    pictures = [np.full((64, 96, 3), 8 * k, np.uint8) for k in range(20)]
    write_video(pictures, tmp_path / "out.mp4", 10)
    assert b"ftyp" in (tmp_path / "out.mp4").read_bytes()[:16]


def test_the_command_films(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video = tmp_path / "new" / "both.gif"
    call = ["rollout", "single-v1", "--domain", "V4", "--duration-s", "200", "--policy",
            "fixed-time:20", "--beside", "max-pressure:20", "--video", str(video),
            "--film.from-s", "100", "--film.length-s", "12", "--film.size", "240"]  # fmt: skip
    assert main(call) == 0
    assert "12 s of traffic in 1 s of video" in capsys.readouterr().out
    with Image.open(video) as image:
        assert image.size[0] == 2 * 220 and image.is_animated
    for wrong, message in (
        (["rollout", "single-v1"], "--out FILE.parquet, --video FILE, or both"),
        (["rollout", "single-v1", "--out", str(tmp_path / "a"), "--beside", "x"], "needs --video"),
        ([*call, "--film.size", "10"], "from 200 to 4000"),
        ([*call, "--domain", "meso"], "mesoscopic model, in which vehicles have no position"),
    ):
        assert main(wrong) == 2
        assert message in capsys.readouterr().err
