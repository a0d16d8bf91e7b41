"""Diagnosis of a gap: places where simulation and data disagree, and the effects that are missing.

`diagnose` runs all stages, from measured data to a corrected scenario. Each stage hands a record to
the next one: Located, Proposed, Fitted, Selected, Verified. The result is a `Diagnosis`, the
content of ``diagnosis.json``.

    records        the records, and the form of ``diagnosis.json``
    thresholds     every number of the method, with its unit and its reason
    site           measured lanes, their signals and their detectors
    features       features of one period, from detections or from counts
    statistics     statistics of several periods, their noise, distances, whitening
    replay         simulated days under the measured signals, with measured arrivals
    engine         simulated days in parallel, with a cache, within a budget of time
    hypotheses     the library of effects, and sets of them
    locate         disagreements by place, regime and window
    propose        sets of effects, from simulated changes of the statistics
    places         effects at places, in windows and of detectors
    fit            values of a set of effects, and their errors
    residual       the test of the difference that a model leaves
    select         the search, round by round
    verify         both models on held-out periods, side by side
    criteria       GEH and the criteria of FHWA
    verdict        one of five verdicts, in words
    signal_timing  yellow and all-red times, read off the signal log
    study          scenario, data and engine of one diagnosis
    workflow       all stages in their order
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
