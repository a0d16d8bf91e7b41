"""Diagnosis of a gap: places where simulation and data disagree, and the effects that are missing.

`diagnose` runs all stages, from measured data to a corrected scenario. Each stage hands a record to
the next one: Located, Proposed, Fitted, Selected, Verified. The result is a `Diagnosis`, the
content of ``diagnosis.json``.

    workflow    all stages in their order, and what is written
    study       inputs of one diagnosis
    compared_detectors  detectors that are compared, and findings on the others
    demand_variation  variation of demand from day to day
    signal_timing  yellow and all-red times read off the signal log
    thresholds  every number of the method, with its unit and its reason
    records     the records of the stages, and the form of ``diagnosis.json``
    features    measured lanes, and the features of one period there
    intervals   counts, occupancies and mean speeds per interval
    supplementary_data  turning counts, travel times of probes and states of lanes
    journeys    travel times and queues between detectors, which no fit uses
    statistics  statistics of several periods, their noise, distances, whitening
    sightings   what single vehicles did at the detectors
    measurement errors of the detectors, read off sightings before all else
    splash      the share of the vehicles beside theirs that detectors report
    error_places  choice of the detectors that err: as few as the data ask for
    arrivals    the vehicles of a day at the times at which detectors saw the street's
    replay      one simulated day under the measured signals
    unmeasured  speeds and lengths that the street's detectors do not measure
    engine      simulated days in parallel, with a cache, within a budget
    locate      test of the scenario as it is, and the places that contradict it
    hypotheses  the library of effects, and sets of them
    places      effects proposed at places, in windows and of detectors
    propose     sets of effects, from simulated changes of the statistics
    fit         values of a set of effects, and their errors
    residual    the test of the difference that a model leaves
    select      the search, round by round
    prune       effects that do not matter, or that the explanation does not need, left out
    patterns    sparse regression on what is left, where no effect explains it
    verify      both models on held-out periods, side by side; the usual criteria
    traffic     both models in terms of traffic; the check of traffic
    verdict     one of six verdicts, in words
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
