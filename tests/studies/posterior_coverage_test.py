"""The study of coverage: its table by hand, and its other streets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from studies import posterior_coverage
from studies.posterior_coverage import VEHICLES, Asked, Network, draw_other, streets_of, table
from ugat_marl.effects import load_scenario
from ugat_marl.grounding import Simulation, WorldPrior

WORLDS = WorldPrior.of(tuple(f"lane_{k}" for k in range(6)))


def test_table_by_hand() -> None:
    asked = [
        Asked("prior", "headway", 1.5, 1.0, 1.4, 2.0, 1.0, 2.0),  # covered, error 0.1 for 0.5
        Asked("prior", "headway", 2.1, 1.0, 1.4, 2.0, 1.1, 2.0),  # missed, error 0.7 for 1.0
        Asked("alone", "headway", 2.0, 1.0, 1.5, 2.0, 2.0, 2.0),  # the end of an interval is in
    ]
    lines = table(asked).splitlines()
    assert "| prior | headway | 2 | 0.50 | 0.09–0.91 | 0.50 | 0.63 |" in lines
    assert "| alone | headway | 1 | 1.00 | 0.21–1.00 | 0.50 | – |" in lines
    assert (
        lines.index("| prior | headway | 2 | 0.50 | 0.09–0.91 | 0.50 | 0.63 |") < 4
    )  # worst first


def test_two_thirds_of_the_streets_are_not_of_the_prior() -> None:
    streets = streets_of(WORLDS, 600, 7)
    assert [kind for kind, _ in streets[:4]] == ["prior", "alone", "together", "prior"]
    late_s = np.stack([values.service_s[:, 0] for kind, values in streets if kind != "prior"])
    assert abs((late_s > 0).mean() - 1 / 3) < 0.05
    assert late_s[late_s > 0].min() >= 1.0
    again = draw_other(WORLDS, "alone", 3)
    assert np.array_equal(again.effects, draw_other(WORLDS, "alone", 3).effects)


def test_networks_have_streets_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds: list[int] = []
    monkeypatch.setattr(Network, "of", lambda *_: None)
    monkeypatch.setattr(
        posterior_coverage, "study", lambda *given: seeds.append(given[3]) or list[Asked]()
    )
    words = ["a", "b", "c", "--seed", "5", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", ["posterior_coverage", *words])
    posterior_coverage.main()
    assert seeds[0] == 5
    assert len(set(seeds)) == 3


def test_effects_alone_are_there_in_half_of_the_streets_and_together_change_by_one_number() -> None:
    library = WORLDS.library
    low, nominal, high = WORLDS.ends
    apart, joined = (
        np.stack([draw_other(WORLDS, kind, seed).effects for seed in range(400)])
        for kind in ("alone", "together")
    )
    assert (apart != nominal).mean(0) == pytest.approx(0.5, abs=0.08)
    places = [k for k, x in enumerate(library) if x.name in VEHICLES]
    farthest = np.where(nominal - low > high - nominal, low, high)
    shares = ((joined - nominal) / (farthest - nominal))[:, places]
    assert np.ptp(shares, axis=1).max() < 1e-9
    assert shares.min() >= 0.0 and shares.max() > 0.9


def test_statistics_are_kept_under_all_that_decides_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nobody: Any = None
    simulation = Simulation(load_scenario("single-v1"), {"observation": "movements"}, 0.1)
    network = Network("single-v1", WORLDS, nobody, "max-pressure:10", nobody, simulation)
    values = [WORLDS.draw(1)]

    def digest(network: Network = network) -> str:
        return posterior_coverage._digest(network, values, 0, 1)

    before = digest()
    assert digest() == before
    digests = {before, digest(replace(network, simulation=replace(simulation, epsilon=0.2)))}
    changed = tmp_path / "summaries.py"
    changed.touch()
    for name, value in (
        ("DURATION_S", 900.0),
        ("SOURCES", (*posterior_coverage.SOURCES[1:], changed)),
        ("installed_versions", lambda *_: {"eclipse-sumo": "0.1"}),
    ):
        with monkeypatch.context() as other:
            other.setattr(posterior_coverage, name, value)
            digests.add(digest())
    assert len(digests) == 5
    assert {source.name for source in posterior_coverage.SOURCES} == {
        "summaries.py", "posterior.py", "street.py", "worlds.py"
    }  # fmt: skip


def test_statistics_of_streets_are_kept_and_read_again(tmp_path: Path) -> None:
    network = Network.of("single-v1", "fixed-time:30", 1)
    with pytest.MonkeyPatch.context() as shorter:
        shorter.setattr(posterior_coverage, "DURATION_S", 200.0)
        values = [network.worlds.draw(seed) for seed in (1, 2)]
        first = network.summaries(values, 3, tmp_path, "streets", episodes=2)
        shorter.setattr(Network, "_play", lambda *_: pytest.fail("simulated again"))
        again = network.summaries(values, 3, tmp_path, "streets", episodes=2)
    assert len(first) == 2
    assert max(summary.rows.max() for summary in first) == 2 * 20  # every decision
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one.values, other.values, equal_nan=True)
        assert np.array_equal(one.rows, other.rows)
