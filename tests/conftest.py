"""What all tests share: a deterministic Hypothesis, and a word on which package is tested."""

from __future__ import annotations

import os
import sysconfig
from pathlib import Path

import hypothesis
import pytest

import ugat_marl

hypothesis.settings.register_profile(
    "suite",
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("suite")


def installed() -> bool:
    """Whether `ugat_marl` comes from site-packages, and not from a source tree."""
    return Path(ugat_marl.__file__).is_relative_to(sysconfig.get_paths()["purelib"])


def pytest_configure(config: pytest.Config) -> None:
    """Refuses to test the source tree where `make test` promised the installed wheel."""
    if os.environ.get("UGAT_MARL_TEST_INSTALLED") and not installed():
        raise pytest.UsageError(
            f"the tests would import {ugat_marl.__file__} and not the installed wheel"
        )


def pytest_report_header() -> str:
    """Says in the first lines which package is tested."""
    return f"ugat_marl {ugat_marl.__version__} from {Path(ugat_marl.__file__).parent}"
