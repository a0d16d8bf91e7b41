"""The driver: jobs in processes and here, taken up again, failing, ending with who started them."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from tests.interrupts import KillAfter, eventually, few_descriptors
from ugat_marl.data import Scores, lock_folder
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.envs import parallel_env
from ugat_marl.errors import CheckpointError, JobError, OptionError, UnknownNameError
from ugat_marl.experiments import (
    QUEUES,
    Job,
    JobRecord,
    LearnerSpec,
    Setting,
    driver,
    forked,
    perform_all,
    perform_here,
    read_queues,
    record_of,
)
from ugat_marl.experiments.driver import LOG
from ugat_marl.experiments.forked import SERVICE, jobs_fork_on, perform_forked
from ugat_marl.experiments.jobs import (
    JOB,
    LEARNER,
    POLICY,
    SCORES,
    evaluation_seeds,
    perform,
    perform_described,
)
from ugat_marl.experiments.paper import TABLES, settings_of
from ugat_marl.experiments.row_names import UNTRAINED
from ugat_marl.grounding import DIRECT_LEARNER, FitConfig, UgatConfig
from ugat_marl.parallel import DEADLINE_VARIABLE, Heartbeat, Stop
from ugat_marl.policies import (
    BASELINES,
    DQN_NAME,
    SUITE_LEARNERS,
    DQNConfig,
    NetworkPolicy,
    suite_config,
)
from ugat_marl.progress import Silent
from ugat_marl.simulation import kept_warm
from ugat_marl.simulation.host import _WarmParent

needs_forks = pytest.mark.skipif(not jobs_fork_on("cpu"), reason="jobs are not forked here")
QUICK = LearnerSpec(DQN_NAME, dqn=DQNConfig(warmup_decisions=5, epsilon_decay_decisions=50))
PLAIN = Job(
    Setting("direct transfer", "direct", learner=QUICK),
    "single-v1",
    seed=3,
    episodes=4,
    every=2,
    options={"duration_s": 100.0},
    domains=("sim", "V4"),
    evaluation_seeds=evaluation_seeds(2),
)
RULE = replace(
    PLAIN,
    setting=Setting("rule", "rule", rules=("fixed-time:30", "largest-queue:20")),
    seed=None,
    target="V4",
    episodes=0,
    every=0,
)
UGAT = UgatConfig(
    grounding="phase",
    pretrain_episodes=4,
    iterations=1,
    grounded_episodes=2,
    sim_rollouts=1,
    real_rollouts=2,
    least_accuracy=None,  # so little training proves nothing
    fit=FitConfig(epochs=2),
)
GROUNDED = replace(
    PLAIN,
    setting=Setting("UGAT", "grounded", learner=QUICK, ugat=UGAT),
    target="V4",
    episodes=6,
    every=0,
)


@pytest.fixture(scope="module", autouse=True)
def _one_warm_parent() -> Iterator[None]:
    """One process loads torch for the jobs of all tests here."""
    with kept_warm():
        yield


def after(base: Job, setting: Setting, episodes: int = 6) -> Job:
    """A job that goes on from plain training."""
    return replace(
        base,
        setting=setting,
        target="V4",
        episodes=episodes,
        every=0,
        start=f"{base.name}/{LEARNER}",
    )


def test_it_is_judged_every_few_episodes_and_at_the_end() -> None:
    assert PLAIN.marks == (2, 4)
    assert replace(PLAIN, episodes=5).marks == (2, 4, 5)
    assert replace(PLAIN, every=0).marks == (4,)
    assert replace(PLAIN, every=3, episodes=9, last=3).marks == (3, 6, 7, 8, 9)
    # More episodes of a training that is judged as it goes are the same training.
    assert replace(PLAIN, episodes=6).name == PLAIN.name
    assert replace(PLAIN, every=0, episodes=6).name != replace(PLAIN, every=0).name


@pytest.mark.parametrize("sim", ["sim", "meso"])
@pytest.mark.parametrize("table", TABLES)
def test_a_job_file_carries_the_setting_with_its_name(table: str, sim: str, tmp_path: Path) -> None:
    for row in settings_of(table, UgatConfig(), sim):
        job = replace(PLAIN, setting=row)
        job.write(tmp_path)
        content = (tmp_path / JOB).read_bytes()
        assert json.loads(content)["setting"]["name"] == row.name
        again = TypeAdapter(Job).validate_json(content)
        assert again == job and again.name == job.name


@pytest.mark.parametrize("name", SUITE_LEARNERS)
@pytest.mark.parametrize("given", [{}, {"steps": 1, "hidden": (48, 48)}, {"steps": 3}])
def test_a_job_file_keeps_what_the_learner_decides(
    name: str, given: dict[str, Any], tmp_path: Path
) -> None:
    """JSON does not tell a default from the same number that somebody gave."""
    spec = LearnerSpec(name, dqn=DQNConfig(**given))
    replace(PLAIN, setting=replace(PLAIN.setting, learner=spec)).write(tmp_path)
    read = TypeAdapter(Job).validate_json((tmp_path / JOB).read_bytes()).setting.learner
    assert read is not None and read.dqn == suite_config(name, DQNConfig(**given))
    assert read.identity == spec.identity


def test_a_setting_has_settings_of_ugat_if_it_is_grounded() -> None:
    for recipe, ugat in (("direct", UGAT), ("grounded", None)):
        with pytest.raises(OptionError, match="give ugat with recipe"):
            Setting("x", recipe, ugat=ugat)  # pyright: ignore[reportArgumentType]


def test_weights_that_are_not_trained_here_get_no_lessons(tmp_path: Path) -> None:
    learner = LearnerSpec(dqn=DQNConfig(lessons=1, lesson_updates=5))
    job = replace(
        PLAIN, setting=Setting(UNTRAINED, "untrained", learner=learner, lessons=False),
        episodes=0, every=0, domains=("sim",),
        options={**PLAIN.options, **learner.env_options(None)},
    )  # fmt: skip
    perform(job, tmp_path, Silent(), 1)
    env = parallel_env("single-v1", **job.options)
    fresh = learner.factory()(env, 3).policy()
    assert np.array_equal(NetworkPolicy.load(tmp_path / POLICY).parameters, fresh.parameters)


@pytest.mark.parametrize(("teacher", "same"), [("best", False), (None, True)])
def test_a_row_without_lessons_is_another_one_where_there_are_some(
    teacher: str | None, same: bool
) -> None:
    learner = LearnerSpec("universal", dqn=DQNConfig(teacher=teacher))
    setting = Setting("x", "further", learner=learner)
    assert (replace(setting, lessons=False).identity == setting.identity) == same


def test_the_digest_follows_the_files_of_the_scenario(tmp_path: Path) -> None:
    town = tmp_path / "town"
    load_scenario("single-v1").write(town)
    before = replace(PLAIN, scenario=str(town), options={}).digest
    load_scenario("single-v1").with_duration(1800).write(town)
    assert replace(PLAIN, scenario=str(town), options={}).digest != before


@pytest.mark.slow
def test_jobs_here_and_in_processes_have_the_same_numbers(tmp_path: Path) -> None:
    """Plain, grounded and fine-tuned; the rule of another folder has no learner."""
    plan = [
        PLAIN,
        after(PLAIN, Setting("UGAT", "grounded", learner=QUICK, ugat=UGAT)),
        after(PLAIN, Setting("fine-tuned", "further", learner=QUICK)),
        RULE,
    ]
    here = perform_here(plan, tmp_path / "here", reporter=Silent())
    assert (
        perform_all(plan[::-1], tmp_path / "apart", workers=2, reporter=Silent(), title="test")
        == {}
    )
    for job, record in zip(plan, here, strict=True):
        apart = record_of(job, tmp_path / "apart")
        assert apart is not None and record.is_whole(job)
        assert apart.scores == record.scores and len(record.scores) == 4 * len(job.marks)
    assert here[0].scores != here[1].scores
    assert JobRecord.read(tmp_path / "here" / PLAIN.name) == here[0]
    assert here[0].episodes == 4 and here[0].seconds > 0 < here[0].own_seconds


@pytest.mark.parametrize("grounded", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_killed_job_goes_on_and_ends_with_the_same_numbers(
    grounded: bool, tmp_path: Path
) -> None:
    job, title = replace(PLAIN, episodes=14, every=12), "training: direct transfer"
    if grounded:
        ugat = replace(UGAT, iterations=2)
        job = replace(
            PLAIN,
            setting=Setting("UGAT", "grounded", learner=QUICK, ugat=ugat),
            target="V4",
            episodes=8,
            every=0,
        )
        title = "grounded, iteration 2"
    whole = perform(job, tmp_path / "whole", Silent())
    with pytest.raises(KeyboardInterrupt):
        perform(job, tmp_path / "killed", KillAfter(title, 1 if grounded else 11))
    assert not JobRecord.read(tmp_path / "killed").is_whole(job)
    again = perform(job, tmp_path / "killed", Silent())
    assert again.scores == whole.scores
    played = (tmp_path / "killed" / SCORES).read_bytes()
    assert perform(job, tmp_path / "killed", Silent()).scores == whole.scores
    assert (tmp_path / "killed" / SCORES).read_bytes() == played


def test_queues_count_each_episode_once_after_the_scores_are_lost(tmp_path: Path) -> None:
    job = replace(
        RULE, setting=Setting("rule", "rule", rules=("fixed-time:30",)),
        options={"duration_s": 60.0}, domains=("V4",),
    )  # fmt: skip
    looks: list[set[int]] = []
    for damaged, seeds in ((False, 1), (False, 2), (True, 2), (True, 1)):
        if damaged:
            (tmp_path / SCORES).write_text("{")
        perform(replace(job, evaluation_seeds=evaluation_seeds(seeds)), tmp_path, Silent())
        looks.append(set(read_queues(tmp_path / QUEUES)["looks"]))
    assert looks == [{6}, {12}, {12}, {6}]  # six decisions in a minute


def test_scores_that_cannot_be_read_now_are_not_replaced(tmp_path: Path) -> None:
    """An empty record would be written over the scores of episodes that were played."""
    job = replace(PLAIN, episodes=2)
    perform(job, tmp_path, Silent())
    before = (tmp_path / SCORES).read_bytes()
    with few_descriptors(0), pytest.raises(OSError, match="Too many open files"):
        JobRecord.read(tmp_path)
    assert (tmp_path / SCORES).read_bytes() == before
    (tmp_path / SCORES).write_bytes(before[:-20])
    assert not JobRecord.read(tmp_path).scores


def test_more_episodes_train_only_those_and_fewer_are_refused(tmp_path: Path) -> None:
    perform(replace(PLAIN, episodes=2), tmp_path / "parts", Silent())
    parts = perform(PLAIN, tmp_path / "parts", Silent())
    whole = perform(PLAIN, tmp_path / "whole", Silent())
    assert parts.scores == whole.scores and parts.episodes == whole.episodes == 4
    with pytest.raises(OptionError, match="was trained past episode"):
        perform(replace(PLAIN, episodes=3), tmp_path / "parts", Silent())
    more = replace(PLAIN, episodes=4, every=0, evaluation_seeds=evaluation_seeds(3))
    assert len(perform(more, tmp_path / "parts", Silent()).scores) == 2 * 2 * 2 + 2


@pytest.mark.parametrize("name", [DQN_NAME, *BASELINES])
def test_every_learner_can_have_a_job(name: str, tmp_path: Path) -> None:
    learner = LearnerSpec(name)
    try:
        learner.factory()
    except OptionError as error:
        pytest.skip(str(error))
    job = replace(
        PLAIN,
        setting=Setting(name, "direct", learner=learner),
        episodes=1,
        every=0,
        domains=("sim",),
        evaluation_seeds=evaluation_seeds(1),
    )
    record = perform(job, tmp_path, Silent())
    assert record.is_whole(job) and len(record.scores) == 1


def test_a_failed_job_says_why_and_the_others_go_on_if_they_shall(tmp_path: Path) -> None:
    broken = replace(PLAIN, options={"observation": "conut"})
    with pytest.raises(JobError, match="conut"):
        perform_all([broken], tmp_path, workers=1, reporter=Silent(), title="test")
    assert "conut" in (tmp_path / broken.name / LOG).read_text()
    assert json.loads((tmp_path / broken.name / JOB).read_text())["setting"]["recipe"] == "direct"
    fine = replace(PLAIN, episodes=1, every=0)
    failures = perform_all(
        [broken, fine], tmp_path, workers=1, reporter=Silent(), title="test", keep_going=True
    )
    assert list(failures) == [broken.name] and "conut" in failures[broken.name]
    assert record_of(fine, tmp_path) is not None


@needs_forks
def test_jobs_beside_others_have_the_same_numbers(tmp_path: Path) -> None:
    """The fine-tuned job is begun beside the grounded one, and waits for its plain training."""
    tuned = after(GROUNDED, Setting("fine-tuned", "further", learner=QUICK))
    plan = [GROUNDED, replace(tuned, start=f"{GROUNDED.name}/{DIRECT_LEARNER}"), RULE]
    one = perform_here(plan, tmp_path / "one", reporter=Silent())
    two = perform_here(plan, tmp_path / "two", workers=3, reporter=Silent(), beside=plan[1:])
    assert [record.scores for record in one] == [record.scores for record in two]
    logs = [(tmp_path / "two" / job.name / LOG).exists() for job in plan]
    assert logs == [False, True, True], "the first is done here, the others beside it"


def test_a_learner_that_ends_while_its_job_is_wanted_is_not_overlooked(tmp_path: Path) -> None:
    """It ends between the look at it and the look at who wants the job."""
    wanted = threading.Event()
    wanted.set()
    job = replace(PLAIN, start=f"{GROUNDED.name}/{DIRECT_LEARNER}")
    assert not driver._is_ready(job, tmp_path, Stop(), wanted)

    class Ending(threading.Event):
        def is_set(self) -> bool:
            (tmp_path / GROUNDED.name).mkdir()
            (tmp_path / GROUNDED.name / DIRECT_LEARNER).touch()
            return True

    assert driver._is_ready(job, tmp_path, Stop(), Ending())


@needs_forks
def test_a_job_beside_does_not_wait_for_a_learner_that_is_lost(tmp_path: Path) -> None:
    perform_here([PLAIN], tmp_path, reporter=Silent())
    (tmp_path / PLAIN.name / LEARNER).unlink()
    waits = after(PLAIN, Setting("fine-tuned", "further", learner=QUICK))
    with pytest.raises(CheckpointError, match="no such"):
        perform_here([PLAIN, waits], tmp_path, workers=2, reporter=Silent(), beside=[waits])


@needs_forks
def test_a_job_that_fails_beside_others_says_why(tmp_path: Path) -> None:
    broken = replace(PLAIN, options={"observation": "conut"})
    with pytest.raises(UnknownNameError, match="conut"):
        perform_here([RULE, broken], tmp_path, workers=2, reporter=Silent(), beside=[broken])
    assert "conut" in (tmp_path / broken.name / LOG).read_text()
    assert record_of(RULE, tmp_path) is not None


@needs_forks
def test_jobs_beside_others_end_with_them(tmp_path: Path) -> None:
    long = replace(RULE, evaluation_seeds=evaluation_seeds(500))
    waits = after(long, Setting("fine-tuned", "further", learner=QUICK))
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        perform_here(
            [PLAIN, long, waits],
            tmp_path,
            workers=3,
            reporter=KillAfter("training: direct transfer", 2),
            beside=[long, waits],
        )
    assert time.monotonic() - begun < 60
    assert record_of(long, tmp_path) is None
    lock_folder(tmp_path).close()  # nobody works there any more


def test_two_drivers_do_not_train_in_one_folder(tmp_path: Path) -> None:
    lock = lock_folder(tmp_path)
    with pytest.raises(OptionError, match="another process"):
        perform_all([], tmp_path, workers=1, reporter=Silent(), title="test")
    lock.close()
    perform_all([], tmp_path, workers=1, reporter=Silent(), title="test")


def test_a_job_ends_with_whoever_started_it(tmp_path: Path) -> None:
    replace(PLAIN, episodes=10**6).write(tmp_path)
    process = subprocess.Popen(
        [sys.executable, "-m", "ugat_marl.experiments.jobs", str(tmp_path)],
        stdin=subprocess.PIPE,
    )
    assert process.stdin is not None
    process.stdin.close()
    assert process.wait(60) == 1


def writers(log: Path) -> set[str]:
    """Processes that have the file open."""
    found: set[str] = set()
    for process in Path("/proc").iterdir():
        with contextlib.suppress(OSError):  # a process may end, and a file be closed, meanwhile
            for descriptor in (process / "fd").iterdir() if process.name.isdigit() else ():
                with contextlib.suppress(OSError):
                    if descriptor.readlink() == log:
                        found.add(process.name)
    return found


@needs_forks
def test_a_forked_job_that_is_stopped_is_dead(tmp_path: Path) -> None:
    replace(PLAIN, episodes=10**6).write(tmp_path)
    stop = Stop()
    with ThreadPoolExecutor(1) as pool:
        with (tmp_path / LOG).open("wb") as log:
            job = pool.submit(perform_forked, tmp_path, log, stop)
            assert eventually((tmp_path / SCORES).exists, 60)
            assert not job.done()
            parent = _WarmParent._current[SERVICE]._process.pid
            if os.environ.get("OMP_NUM_THREADS", "1") == "1":  # else numpy's BLAS has some
                assert len(list(Path(f"/proc/{parent}/task").iterdir())) == 1
            stop.set()
            job.result()
        assert eventually(lambda: not writers(tmp_path / LOG), 20)


def job_of(log: Path) -> int:
    """The process that was started to write the log; others that write it are its children."""
    others = writers(log) - {str(os.getpid())}
    parents = {pid: Path(f"/proc/{pid}/stat").read_text().split()[3] for pid in others}
    (job,) = (pid for pid, parent in parents.items() if parent not in parents)
    return int(job)


@pytest.mark.slow
@pytest.mark.parametrize("forked", [pytest.param(True, marks=needs_forks), False])
def test_a_stopped_job_is_killed_and_taken_up_again_with_the_same_numbers(
    forked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = replace(PLAIN, episodes=30, every=10, evaluation_seeds=evaluation_seeds(1))
    perform_here([job], tmp_path / "here", reporter=Silent())
    monkeypatch.setattr(driver, "jobs_fork_on", lambda device: forked)
    monkeypatch.setenv(DEADLINE_VARIABLE, "15")  # an interpreter starts within it
    place = tmp_path / "apart" / job.name
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(perform_all, [job], tmp_path / "apart", 1, Silent(), "test")
        assert eventually((place / SCORES).exists, 60)
        stopped = job_of(place / LOG)
        os.kill(stopped, signal.SIGSTOP)
        assert done.result(120) == {}
    assert not Path(f"/proc/{stopped}/environ").exists()
    assert JobRecord.read(place).scores == JobRecord.read(tmp_path / "here" / job.name).scores


@needs_forks
def test_a_job_that_is_stopped_again_and_again_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Still(Heartbeat):
        def is_lost(self) -> bool:
            return True

    monkeypatch.setattr(forked, "Heartbeat", Still)
    with pytest.raises(JobError, match=r"did not run on for 900 s .* was killed"):
        perform_all([PLAIN], tmp_path, workers=1, reporter=Silent(), title="test")


@pytest.mark.slow
@needs_forks
def test_a_forked_job_ends_with_a_killed_driver(python: list[str], tmp_path: Path) -> None:
    replace(PLAIN, episodes=10**6).write(tmp_path)
    program = """
import sys
from pathlib import Path
from ugat_marl.experiments.forked import perform_forked
from ugat_marl.parallel import DEADLINE_VARIABLE, Heartbeat, Stop
with Path(sys.argv[2]).open("wb") as log:
    perform_forked(Path(sys.argv[1]), log, Stop())
"""
    with subprocess.Popen([*python, "-c", program, str(tmp_path), str(tmp_path / LOG)]) as driver:
        assert eventually((tmp_path / SCORES).exists, 60)
        assert len(writers(tmp_path / LOG)) >= 2
        driver.send_signal(signal.SIGKILL)
    assert eventually(lambda: not writers(tmp_path / LOG), 20)


SCORE = Scores(1, 1, 1, 1, 1, 1, 1, 1, 1, 1)


def whole_record() -> JobRecord:
    return JobRecord(
        {(m, d, s): SCORE for m in (2, 4) for d in ("sim", "V4") for s in (1000, 1001)}
    )


def test_what_was_played_in_a_street_that_has_changed_is_played_again(tmp_path: Path) -> None:
    street = str(tmp_path / "street")

    def job() -> Job:
        return replace(PLAIN, domains=("sim", street), every=0)

    def made(domain: str) -> None:
        scenario_in_domain(load_scenario("single-v1"), domain).write(tmp_path / "street")

    made("V1")
    record = JobRecord()
    for domain in job().domains:
        record.add_scores(job(), 4, domain, {1000: SCORE, 1001: SCORE})
    record.write(tmp_path)
    assert JobRecord.read(tmp_path).is_whole(job())
    shutil.rmtree(tmp_path / "street")
    made("V4")
    again = JobRecord.read(tmp_path)
    assert again.missing(job(), 4) == {street: [1000, 1001]}
    again.add_scores(job(), 4, street, {1000: SCORE})
    assert again.missing(job(), 4) == {street: [1001]}, "the old ones are dropped"
    assert "worlds" not in with_hashes_of(whole_record(), tmp_path), "other files are as ever"


def with_hashes_of(record: JobRecord, folder: Path) -> str:
    record.write(folder)
    return (folder / SCORES).read_text()


def test_what_a_killed_job_was_writing_is_cleared(tmp_path: Path) -> None:
    whole_record().write(tmp_path)  # nothing is left to do
    PLAIN.write(tmp_path)
    (tmp_path / ".learner.pt.x1y2z3.tmp").write_bytes(b"half")
    assert perform_described(tmp_path) == 0
    assert {path.name for path in tmp_path.iterdir()} == {SCORES, JOB}


@pytest.mark.parametrize("content", ["", "[]", '{"scenario": "single-v1"}'])
def test_a_broken_description_of_a_job_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str
) -> None:
    (tmp_path / JOB).write_text(content)
    assert perform_described(tmp_path) == 2
    assert str(tmp_path / JOB) in capsys.readouterr().err


@pytest.mark.parametrize(
    "content", ["", "[{}]", '{"episodes": [{"domain": "sim"}]}', '{"a": 1}', "[1]"]
)
def test_a_broken_record_is_an_empty_one(tmp_path: Path, content: str) -> None:
    (tmp_path / SCORES).write_text(content)
    assert JobRecord.read(tmp_path) == JobRecord()


def test_no_flipped_bit_of_a_record_is_read_as_another_one(tmp_path: Path) -> None:
    record = whole_record()
    record.write(tmp_path)
    file = tmp_path / SCORES
    content = file.read_bytes()
    for place in np.random.default_rng(5).integers(0, 8 * len(content), 400).tolist():
        flipped = bytearray(content)
        flipped[place // 8] ^= 1 << place % 8
        file.write_bytes(flipped)
        assert JobRecord.read(tmp_path) in (record, JobRecord())


def test_a_job_is_done_when_everything_was_played(tmp_path: Path) -> None:
    record = whole_record()
    record.write(tmp_path / PLAIN.name)
    assert record_of(PLAIN, tmp_path) == record
    for key in record.scores:
        part = JobRecord({other: SCORE for other in record.scores if other != key})
        part.write(tmp_path / PLAIN.name)
        assert record_of(PLAIN, tmp_path) is None, key
    assert asdict(record)["episodes"] == 0
