"""Keeps the process that forks simulators warm from one test to the next."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import ugat_marl


@pytest.fixture(scope="session", autouse=True)
def _warm() -> Iterator[None]:
    env = ugat_marl.parallel_env("single-v1", duration_s=60)
    env.reset(seed=0)
    yield
    env.close()
