"""Errors of measurement of every kind are read off, and drivers are not taken for them."""

from __future__ import annotations

from pathlib import Path

import pytest

from ugat_marl.diagnosis import DiagnosisConfig, Study
from ugat_marl.diagnosis.thresholds import Effort
from ugat_marl.effects import load_scenario, parse_domain
from ugat_marl.experiments import policy_factory, record
from ugat_marl.progress import Silent

FAMILIES = {
    "extension": ("detector_extension=*,1,split", "detector_extension=*", 1.0),
    "delay": ("detector_extension=*,-0.2,split", "detector_extension=*", -0.2),
    "upstream": ("detector_offset=advance,-12", "detector_offset=advance", -12.0),
    "zone": ("detector_zone=stop,2", "detector_zone=stop", 2.0),
    "front": ("detector_speeds=*,front", "detector_speeds=*,front", None),
    "pulse": ("detector_pulse=*,0.15", "detector_pulse=", 0.15),
}
DRIVERS = ("acceleration=1.2", "headway=1.5", "desired_speed=0.8", "heavy_share=0.2")


SLOW_STARTERS = "acceleration=0.8"


def study_of(street, domain: str) -> Study:
    effort = Effort(base=32, bank=2, fit=5, test=16)
    config = DiagnosisConfig(effort=effort, cache=street.cache, budget_s=3600.0)
    study = Study.of(street.scenario, street.measure(domain, periods=3), config)
    return study.detectors_as_they_are(Silent())


def errors_in(study: Study) -> list[str]:
    return [str(error.effect) for error in study.detection]


def read_off(street, domain: str) -> list[str]:
    return errors_in(study_of(street, domain))


@pytest.mark.parametrize("family", FAMILIES)
def test_an_error_of_measurement_is_read_off(street, family: str) -> None:
    domain, text, value = FAMILIES[family]
    found = read_off(street, domain)
    assert found, "nothing was found"
    assert all(one.startswith(text) for one in found), found
    if value is not None:
        numbers = [float(one.split(",")[1]) for one in found]
        assert numbers == pytest.approx([value] * len(found), rel=0.1)


@pytest.mark.parametrize("domain", ["sim", *DRIVERS])
def test_drivers_are_no_error_of_measurement(street, domain: str) -> None:
    assert read_off(street, domain) == []


@pytest.mark.slow
def test_drivers_that_are_found_are_no_error_of_measurement(street) -> None:
    for domain in DRIVERS:
        study = study_of(street, domain)
        assert study.detectors_beside(parse_domain(domain), Silent()) is None, domain


def test_slow_drivers_hide_where_speeds_are_measured_until_they_are_found(street) -> None:
    domain = f"{SLOW_STARTERS}+detector_speeds=stop@S_C,front"
    study = study_of(street, domain)
    assert errors_in(study) == []
    beside = study.detectors_beside(parse_domain(SLOW_STARTERS), Silent())
    assert beside is not None
    assert errors_in(beside) == ["detector_speeds=stop@S_C,front"]
    # from here on they are known, and days are not seen by two of them
    assert beside.detectors_beside(parse_domain(SLOW_STARTERS), Silent()) is None


def test_splash_is_read_off_where_lanes_lie_side_by_side(street) -> None:
    scenario = load_scenario("single-v1")
    policy = policy_factory("fixed-time:30")
    domain = "detector_splash=stop,0.15"
    measured = record(scenario, domain, policy, periods=3, seed=5, duration_s=900.0)
    config = DiagnosisConfig(cache=street.cache, budget_s=3600.0)
    study = Study.of(scenario, measured, config).detectors_as_they_are(Silent())
    (found,) = (str(error.effect) for error in study.detection)
    name, _, values = found.partition("=")
    place, share = values.split(",")
    assert (name, place) == ("detector_splash", "stop")
    assert float(share) == pytest.approx(0.15, abs=0.05)


@pytest.mark.slow
def test_drivers_are_found_behind_an_error_of_measurement(street, tmp_path: Path) -> None:
    domain = "headway=1.4+detector_extension=*,1,split"
    found = street.diagnose(street.measure(domain), tmp_path)
    assert [effect["name"] for effect in found["effects"]] == ["headway", "detector_extension"]
    headway, extension = (effect["parameters"]["seconds"] for effect in found["effects"])
    assert headway["value"] == pytest.approx(1.4, rel=0.05)
    assert extension["value"] == pytest.approx(1.0, abs=0.05)
    assert extension["low"] < extension["value"] < extension["high"]
    assert found["sentence"].startswith("All detectors stay on 1 s")
    assert found["verdict"] == "explained", found["sentence"]


@pytest.mark.slow
def test_an_error_of_measurement_is_found_behind_slow_drivers(street, tmp_path: Path) -> None:
    data = street.measure(f"{SLOW_STARTERS}+detector_speeds=stop@S_C,front")
    found = street.diagnose(data, tmp_path)
    assert [effect["name"] for effect in found["effects"]] == ["acceleration", "detector_speeds"]
    assert found["effects"][0]["parameters"]["mps2"]["value"] == pytest.approx(0.8, rel=0.03)
    assert found["verdict"] == "explained", found["sentence"]
    assert found["sentence"].startswith("Stop detectors of approach S_C measure speeds")


@pytest.mark.slow
def test_an_error_of_measurement_alone_leaves_the_traffic_as_it_is(street, tmp_path: Path) -> None:
    found = street.diagnose(street.measure("detector_offset=advance,-12"), tmp_path)
    assert [effect["name"] for effect in found["effects"]] == ["detector_offset"]
    assert found["verdict"] == "explained", found["sentence"]
    assert "lie 1" in found["sentence"]
