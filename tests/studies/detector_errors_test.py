"""A case is right if kinds, places and forms of its errors are, and drivers are left alone."""

from __future__ import annotations

import pytest

from studies.detector_errors import Case


@pytest.mark.parametrize(
    ("domain", "found", "right"),
    [
        ("sim", (), True),
        ("V4", ("detector_speeds=*,mean",), False),
        ("detector_offset=advance,-10", ("detector_offset=advance,-9.7",), True),
        ("detector_offset=advance,-10", ("detector_offset=stop,-9.7",), False),
        ("detector_offset=advance,-10", (), False),
        ("headway=1.4+detector_speeds=*,front", ("detector_speeds=*,front",), True),
        ("headway=1.4+detector_speeds=*,front", ("detector_speeds=*,mean",), False),
        ("detector_extension=*,1.5,merged", ("detector_extension=*,1.4,merged",), True),
        ("detector_extension=*,1.5,merged", ("detector_extension=*,1.5,split",), False),
        ("detector_extension=*,1.5,merged", ("detector_extension=*,1.5,unknown",), True),
        ("detector_extension=*,1.5,unknown", ("detector_extension=*,1.5,split",), True),
    ],
)
def test_right_and_wrong(domain: str, found: tuple[str, ...], right: bool) -> None:
    assert Case(domain, found, 0.0).right == right
