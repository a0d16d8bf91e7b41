"""Limits of what a scenario's files may ask of SUMO.

A scenario may come from a stranger, and SUMO's files can name other files to read and to write. So
only listed options, elements and attributes are passed on, and none of them names a file. Outputs
are discarded, because many honest scenarios have some. Everything else is refused by name.

`ugat_marl.scenarios.confinement` holds beneath this list, as a rule of the operating system.
"""

from __future__ import annotations

import functools
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping

from ugat_marl.errors import ScenarioError, nearest
from ugat_marl.files import Document, Tag


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_SWITCHES = _words(
    """
    collision.check-junctions device.battery.deterministic device.battery.track-fuel
    device.bluelight.deterministic device.driverstate.deterministic
    device.elechybrid.deterministic device.emissions.deterministic device.friction.deterministic
    device.glosa.deterministic device.glosa.ignore-cfmodel device.glosa.override-safety
    device.glosa.use-queue device.rerouting.bike-speeds device.rerouting.deterministic
    device.rerouting.init-with-loaded-weights device.rerouting.invalidation
    device.rerouting.railsignal device.rerouting.synchronize device.rerouting.with-taz
    device.taxi.deterministic eager-insert emergency-insert emissions.volumetric-fuel
    extrapolate-departpos ignore-accidents ignore-route-errors junction-taz
    lanechange.overtake-right mapmatch.junctions mapmatch.taz meso-interpolate-pos
    meso-junction-control meso-junction-control.limited meso-lane-queue meso-ltm meso-multi-queue
    meso-overtaking mesosim no-internal-links overhead-wire.recuperation overhead-wire.solver
    overhead-wire.substation-current-limits parking.maneuver
    pedestrian.striping.legacy-departposlat person-device.rerouting.deterministic
    persontrip.ride-public-line railsignal-moving-block replay-rerouting slope-centered
    sloppy-insert step-method.ballistic time-to-teleport.remove time-to-teleport.remove-constraint
    tls.actuated.show-detectors tls.all-off use-stop-ended use-stop-started
    weights.random-factor.dynamic
    """
)
_NUMBERS = _words(
    """
    collision.check-junctions.mingap collision.mingap-factor default.action-step-length
    default.speeddev device.battery.probability device.bluelight.mingapfactor
    device.bluelight.probability device.bluelight.reactiondist
    device.driverstate.errorNoiseIntensityCoefficient device.driverstate.errorTimeScaleCoefficient
    device.driverstate.freeSpeedErrorCoefficient
    device.driverstate.headwayChangePerceptionThreshold device.driverstate.headwayErrorCoefficient
    device.driverstate.initialAwareness device.driverstate.maximalReactionTime
    device.driverstate.minAwareness device.driverstate.probability
    device.driverstate.speedDifferenceChangePerceptionThreshold
    device.driverstate.speedDifferenceErrorCoefficient device.elechybrid.probability
    device.emissions.probability device.friction.offset device.friction.probability
    device.friction.stdDev device.glosa.add-switchtime device.glosa.max-speedfactor
    device.glosa.min-speed device.glosa.probability device.glosa.range
    device.rerouting.adaptation-steps device.rerouting.adaptation-weight
    device.rerouting.cch-update-threshold.factor device.rerouting.probability
    device.rerouting.threshold.factor device.taxi.probability emergencydecel.warning-threshold
    lateral-resolution mapmatch.distance max-num-persons max-num-teleports max-num-vehicles
    meso-edgelength meso-jam-threshold meso-tls-flow-penalty meso-tls-penalty
    pedestrian.striping.dawdling pedestrian.striping.jamfactor
    pedestrian.striping.mingap-to-vehicle pedestrian.striping.reserve-oncoming
    pedestrian.striping.reserve-oncoming.junctions pedestrian.striping.reserve-oncoming.max
    pedestrian.striping.stripe-width pedestrian.striping.walkingarea-detail
    pedestrian.timegap-crossing person-device.rerouting.probability
    persontrip.walk-opposite-factor persontrip.walkfactor railsignal.max-block-length
    railsignal.moving-block.max-dist railway.max-train-length ride.stop-tolerance scale
    time-to-teleport.highways.min-speed tls.actuated.detector-length tls.actuated.jam-threshold
    tls.delay_based.detector-range tls.yellow.min-decel weights.minor-penalty
    weights.priority-factor weights.random-factor weights.reversal-penalty weights.separate-turns
    weights.tls-penalty weights.turnaround-penalty
    """
)
_TIMES = _words(
    """
    collision.stoptime device.rerouting.adaptation-interval
    device.rerouting.cch-update-threshold.constant device.rerouting.period
    device.rerouting.pre-period device.rerouting.threshold.constant
    device.taxi.dispatch-keep-unreachable device.taxi.dispatch-period ignore-junction-blocker
    intermodal-collision.stoptime keep-after-arrival lanechange.duration
    meso-minor-penalty meso-recheck meso-tauff meso-taufj meso-taujf meso-taujj
    pedestrian.striping.jamtime pedestrian.striping.jamtime.crossing
    pedestrian.striping.jamtime.narrow person-device.rerouting.period persontrip.taxi.waiting-time
    random-depart-offset route-steps startup-wait-threshold time-to-impatience
    time-to-teleport.bidi time-to-teleport.disconnected time-to-teleport.highways
    time-to-teleport.railsignal-deadlock time-to-teleport.ride waiting-time-memory
    """
)
_WORDS = _words(
    """
    collision.action default.carfollowmodel default.departlane default.departspeed
    default.emergencydecel device.battery.explicit device.bluelight.explicit
    device.driverstate.explicit device.elechybrid.explicit device.emissions.begin
    device.emissions.explicit device.emissions.period device.friction.explicit
    device.glosa.explicit device.rerouting.explicit device.rerouting.mode
    device.taxi.dispatch-algorithm device.taxi.explicit device.taxi.idle-algorithm
    device.taxi.vclasses insertion-checks intermodal-collision.action meso-ignore-lanes-by-vclass
    pedestrian.model person-device.rerouting.explicit person-device.rerouting.mode
    person-device.rerouting.scope persontrip.default.group persontrip.transfer.car-walk
    persontrip.transfer.taxi-walk persontrip.transfer.walk-taxi railsignal.default-classes
    railsignal.moving-block.default-classes routing-algorithm scale-suffix
    """
)
_OUTPUT_SWITCH = "whetherOutputState"
"""Parameter by which a NEMA light writes its state."""

OPTIONS = _SWITCHES | _NUMBERS | _TIMES | _WORDS
"""Options of SUMO that a scenario may set: they shape the traffic and name no file or port.

``max-depart-delay`` is none of them. It drops vehicles that find no space to enter. SUMO reports
them nowhere, so a full network would have shorter travel times.
"""

_BOUNDS: Mapping[str, tuple[float, float]] = {
    "scale": (0.0, 100.0),  # SUMO holds so many copies of every vehicle
    "lateral-resolution": (0.01, 100.0),  # metres; SUMO holds every lane in such strips,
    "pedestrian.striping.stripe-width": (0.01, 100.0),  # every path too,
    "meso-edgelength": (1.0, 1e6),  # and every road in such segments
}
"""Least and largest values of options for which SUMO takes memory or time."""
_OFF_BELOW_0: frozenset[str] = frozenset({"lateral-resolution"})
"""Options of these that 0 or less switches off."""
_MOST_OF: Mapping[str, int] = {
    "number": 10_000_000,
    "repeat": 10_000,
    "roadsideCapacity": 100_000,
    "personCapacity": 100_000,
}
"""Largest values of attributes for which SUMO takes memory or time: the vehicles of a flow, the
laps of a route, the spaces of a parking area, and the places of a stop."""

NO = frozenset({"0", "false", "no", "off", "f", "-"})
"""Words that SUMO reads as false, in small letters."""
_YES_OR_NO = NO | {"1", "true", "yes", "on", "t", "x"}
_PLAIN = re.compile(r"(?!-)[\w .,:;+*%#-]*", re.ASCII)

_DEVICES = _words(
    """
    battery bluelight driverstate elechybrid emissions friction glosa rerouting routing taxi
    tripinfo vehroute
    """
)
"""Devices that a vehicle may carry. The device ``ssm`` writes a file even if none is named."""

_ELEMENTS = _words(
    """
    WAUT access assignment bidiPredecessor busStop calibrator carFollowing-ACC
    carFollowing-BKerner carFollowing-CACC carFollowing-CC carFollowing-Daniel1 carFollowing-EIDM
    carFollowing-IDM carFollowing-IDMM carFollowing-Krauss carFollowing-KraussOrig1
    carFollowing-KraussPS carFollowing-KraussX carFollowing-PWagner2009 carFollowing-Rail
    carFollowing-SmartSK carFollowing-W99 carFollowing-Wiedemann chargingStation
    closingLaneReroute closingReroute condition conflict connection container containerFlow
    containerStop crossing deadlock delete destProbReroute detEntry detExit detectorDefinition
    e1Detector e2Detector e3Detector edge edgeData entryExitDetector flow foeInsertion function
    inductionLoop insertionOrder insertionPredecessor instantInductionLoop interval junction lane
    laneAreaDetector laneData laneType location meso neigh overheadWire overheadWireClamp
    overheadWireSegment overtakingReroute param parkingArea parkingAreaReroute person personFlow
    personTrip personinfo phase poi poly predecessor preference prohibition railSignalConstraints
    request rerouter rerouterValue restriction ride roundabout route routeDistribution
    routeProbReroute routeProbe space stationReroute step stop stopOffset taz tazSink tazSource
    timedEvent tlLogic tractionSubstation trainStop tranship transport trip type vType
    vTypeDistribution vTypeProbe vaporizer variableSpeedSign vehicle viaProbReroute walk
    wautJunction wautSwitch
    """
)
_ROOTS = _words(
    """
    additional additionals add detectors net routes route-alternatives tazs tlLogics trips flows
    """
)

_ATTRIBUTES = _words(
    """
    Mbegin Mflatness accel acceleration acceptedBadges actType actionStepLength active adaptFactor
    adaptTime aggregate aggregation allow angle apProb apparentDecel applyDriverState arrival
    arrivalEdge arrivalLane arrivalPos arrivalPosLat arrivalSpeed avoidOverlap begin bidi
    bikeLaneWidth boardingDuration boardingFactor busStop c1 carFollowModel cc1 cc2 cc3 cc4 cc5
    cc6 cc7 cc8 cc9 ccAccel ccDecel ccoolness center changeLeft changeRight chargeDelay
    chargeInTransit chargeType chargingStation check checkLaneFoesAll checkLaneFoesRoundabout
    clamps collision collisionAvoidanceGainGap collisionAvoidanceGainGapDot
    collisionAvoidanceGainSpace collisionAvoidanceGainSpeed collisionAvoidanceOverride
    collisionMinGapFactor color constSpacing cont contPos containerCapacity containerNumber
    containerStop containerTriggered containersPerHour convBoundary corner cost costs
    crossingEdges currentLimit curveIntegration curveResistance customShape cycleTime decel defer
    delta depart departEdge departLane departPos departPosLat departSpeed departed deprecated
    desAccelProfile desiredMaxSpeed detectPersons deterministic dir disallow discard distance
    duration earliestEnd earlyTarget edge edgeLength edges efficiency emergencyDecel emissionClass
    end endLane endOffset endPos ended epsilonacc estimation exceptions excludeEmpty exitTimes
    expectArrival expected expectedContainers extension fill finalTarget flatbedD flatbedH
    flatbedKa flatbedKp flatbedKv flow foes foeId forbiddenInnerLanes freq friction friendlyPos
    fringe from fromJunction fromLane fromLonLat fromTaz fromXY function gapClosingControlGainGap
    gapClosingControlGainGapDot gapClosingControlGainSpace gapClosingControlGainSpeed
    gapControlGainGap gapControlGainGapDot gapControlGainSpace gapControlGainSpeed geo group
    guiShape hasDriverState height icon id idAfter idBefore idSegmentEndClamp idSegmentStartClamp
    impatience incLanes index indirect insertionChecks intLanes intended internal
    internalJunctionsVehicleWidth jamThreshold jerkmax jmAdvance jmAllwayStopWait jmCrossingGap
    jmDriveAfterRedTime jmDriveAfterYellowTime jmDriveRedSpeed jmExtraGap jmIgnoreFoeProb
    jmIgnoreFoeSpeed jmIgnoreJunctionFoeProb jmIgnoreKeepClearTime jmSigmaMinor jmStopSignWait
    jmStoplineGap jmStoplineGapCrossingJunction jmStoplineGapMinor jmTimegapMinor join jump
    jumpUntil junction junctionControl junctionCornerDetail junctionHigherSpeed junctionID
    junctionLinkDetail junctionsEndpointShape junctionsMinimalShape k keepClear key kp lambda lane
    laneChangeModel lanes lanesCount last lat latAlignment latestEnd layer lcAccelLat lcAssertive
    lcContRight lcCooperative lcCooperativeHelpThreshold lcCooperativeHelpTime
    lcCooperativeMinSpeed lcCooperativeRoundabout lcCooperativeSpeed lcImpatience lcKeepRight
    lcKeepRightAcceptanceTime lcLaneDiscipline lcLookaheadLeft lcMaxDistLatStanding
    lcMaxSpeedLatFactor lcMaxSpeedLatStanding lcOpposite lcOvertakeDeltaSpeedFactor
    lcOvertakeRight lcPushy lcPushyGap lcSigma lcSpeedGain lcSpeedGainLookahead
    lcSpeedGainRemainTime lcSpeedGainRight lcSpeedGainUrgency lcStrategic lcStrategicLookahead
    lcSublane lcTimeToImpatience lcTurnAlignmentDistance left lefthand length limit limitTurnSpeed
    line lineWidth lines linkIndex linkIndex2 loadingDuration local locomotiveType lon main
    maneuverAngleTimes mass massFactor maxAccelProfile maxDur maxPower maxSpeed maxSpeedLat
    maxTraction maxTraveltime maxWidth maxvehpreview mesoTLS minDur minGap minGapLat minSamples
    minSaving minWidth minorPenalty modes name netOffset next nextEdges node nodes noise number
    numEdges numLanes occupancy off offset omegaN onDemand onRoad oneway openEntry optional
    origBoundary outlineShape overtaking parking parkingArea parkingBadges parkingLength pass
    perHour period permitted personCapacity personNumber personsPerHour phi ploegH ploegKd ploegKp
    pos posLat power prefer priorEdges priorEdgesLength priority probabilities probability
    procedure programID prohibited prohibitor projParameter radius reason rectangularLaneCut red
    refId refTime replacedAtTime replacedOnEdge replacedOnIndex replacedRouteIndex repeat reroute
    resCoef_constant resCoef_linear resCoef_quadratic reservable resistanceTable response
    rightOfWay roadsideCapacity roeckl_numerator roeckl_numerator_sharp roeckl_offset
    roeckl_offset_sharp roeckl_sharp_radius roundabout route routeLength routeProbe routes
    routingType saveConditions saveDetectors savings scale security segments shape show
    sidewalkWidth siding sigma sigmaStep sigmaerror sigmagap sigmaleader signals slope source
    speed speedControlGain speedControlGainCACC speedControlMinGap speedDev speedFactor
    speedFactorPremature speedTable speedThreshold speedThresholdRelative split spreadType
    startPos startProg started startupDelay state stateSwitch stepping substationId synchron
    synonymes tPersDrive tPersEstimate taccmax tau tauCACCToACC tauEngine tauLast tauff taufj
    taujf taujj tazs teleported time timeThreshold timeToTeleport timeToTeleportBidi tl tlType tls
    tlsFlowPenalty tlsIgnoreInternalJunctionJam tlsPenalty tmp1 tmp2 tmp3 tmp4 tmp5 to toJunction
    toLane toLonLat toTaz toXY totalPower tpreview trackVehicles tractionTable trainStop trainType
    treaction triggered tripId type uncontrolled until vClass vClasses vTypes value vehdynamics
    vehext vehicle vehicles vehsPerHour version via viaJunctions viaLonLat viaXY visibility
    visible voltage voltageSource waitingTime walkFactor walkingareas wautID weight width
    widthResolution withInternal writeAttributes x xi y yellow z
    """
)
"""Attributes that SUMO reads, without those that name files."""

_OUTPUTS = {
    "file": _words(
        """
    e1Detector e2Detector e3Detector edgeData entryExitDetector inductionLoop instantInductionLoop
    laneAreaDetector laneData routeProbe vTypeProbe
    """
    ),
    "output": frozenset({"calibrator"}),
    "dest": frozenset({"timedEvent"}),
}
"""Attribute to the elements in which it names a file that SUMO writes."""
_PICTURES = frozenset({"imgFile", "osgFile"})
"""Attributes that name pictures, which only SUMO's window draws."""
_DISCARD = "NUL"
"""File name with which SUMO discards an output."""

_OPEN_KEYS = _words(
    """
    access busStop chargingStation connection containerStop crossing edge junction lane location
    neigh parkingArea poi poly roundabout stop taz trainStop type phase route step
    """
)
"""Elements whose parameters are notes of the map's maker, with any key."""
_TO_FILES = re.compile(r"file|output|dest|path|prefix|dump|log", re.IGNORECASE)
_SCHEMA = re.compile(r"(https?://sumo[\w.-]*/xsd/)?[\w-]+\.xsd", re.ASCII)

DECIMAL = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
"""A number in plain digits. Python itself also reads ``1_000``, other scripts, ``nan``, ``inf``."""
_FINITE_DIGITS = 300
"""A number of so many digits without an exponent is finite."""
_NUMERIC = _words(
    """
    accel actionStepLength angle apparentDecel arrivalPos arrivalPosLat arrivalSpeed begin
    boardingDuration containerNumber containersPerHour decel depart departPos departPosLat
    departSpeed desiredMaxSpeed duration emergencyDecel end endPos fromLane height impatience index
    length linkIndex linkIndex2 loadingDuration mass maxDur maxSpeed maxSpeedLat minDur minGap
    minGapLat number numLanes offset period personNumber personsPerHour pos posLat priority
    probability repeat sigma speed speedDev speedFactor startPos tau toLane until vehsPerHour width
    x y z
    """
)
"""Attributes whose value is a number, or sometimes a word."""

_MOST_LINKS = 4096
"""Upper bound of the index of a <request>, a place in tables of this size. SUMO stops at 256."""


def option_fault(option: str, value: str) -> str:
    """Return what is wrong with the value of one of `OPTIONS`; empty if nothing is."""
    if option in _SWITCHES:
        return "" if value.lower() in _YES_OR_NO else "is neither true nor false"
    if option in _WORDS:
        return "" if _PLAIN.fullmatch(value) else "is not a plain word"
    if not re.fullmatch(r"[-+\d.:eE]+", value, re.ASCII):
        return "is not a number"
    if option in _TIMES and ":" in value:
        return (
            "" if re.fullmatch(r"-?\d+(:\d\d?){2,3}(\.\d*)?", value, re.ASCII) else "is not a time"
        )
    try:
        number = float(value)
    except ValueError:
        return "is not a number"
    if not math.isfinite(number):
        return "is not finite"
    if option in _OFF_BELOW_0 and number <= 0:
        return ""
    low, high = _BOUNDS.get(option, (-math.inf, math.inf))
    return "" if low <= number <= high else f"is not between {low:g} and {high:g}"


def admitted(document: Document) -> Document:
    """Return a file of a scenario as SUMO may read it: as it is, or with its outputs discarded.

    Raises:
        ScenarioError: The file contains something that is not allowed; the message has the line.
    """
    if document.path is None:
        return _without_outputs(document) if _has_outputs(document) else document
    try:
        status = document.path.stat()
    except OSError as error:
        raise ScenarioError(f"{document.path}: cannot be read: {error.strerror}") from None
    version = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
    return _without_outputs(document) if _file_has_outputs(document, version) else document


@functools.lru_cache(maxsize=256)
def _file_has_outputs(document: Document, version: tuple[int, ...]) -> bool:
    """Return `_has_outputs` of a file; a version of a long file is looked through once."""
    return _has_outputs(document)


def _has_outputs(document: Document) -> bool:
    """Return True if a document names outputs; refuse what is not allowed."""
    outputs = False
    for tag in document.scan():
        if fault := _fault(tag):
            raise ScenarioError(f"{document.source}, line {tag.line}: {fault}")
        outputs = outputs or bool(_outputs(tag.name, tag.attributes, tag.parent))
    return outputs


def _fault(tag: Tag) -> str:
    """Return the first thing in an element that is not allowed; empty if there is none."""
    name = tag.name
    if tag.section == "metadata" or (name == "metadata" and tag.parent in _ROOTS):
        return _metadata_fault(tag)
    if name not in _ELEMENTS and not (name in _ROOTS and not tag.parent):
        if name == "include":
            return "<include> reads another file; name that file in the scenario instead"
        guess = nearest(name, _ELEMENTS)
        hint = f"did you mean <{guess}>?" if guess else "leave it out"
        return f"<{name}> is not an element that a scenario may have; {hint}"
    for attribute, value in tag.attributes.items():
        if attribute in _ATTRIBUTES:
            continue
        if attribute.startswith(("xmlns", "xsi:")):
            if "ocation" in attribute and not _SCHEMA.fullmatch(value):
                return f"{attribute} = {value!r} is not a schema of SUMO; leave it out"
        elif name not in _OUTPUTS.get(attribute, ()) and attribute not in _PICTURES:
            return (
                f"<{name} {attribute}={value[:80]!r}> is not an attribute that a scenario may "
                "have; leave it out"
            )
    check = _CHECKS.get(name)
    return (check(tag) if check is not None else "") or _number_fault(tag)


def _metadata_fault(tag: Tag) -> str:
    """Return a fault of an element of ``<metadata>``, in which netconvert writes its options.

    SUMO reads elements that it knows there, too.
    """
    known = {"value", "created_at", "created_by"}
    others = {x for x in tag.attributes if not x.startswith(("xmlns", "xsi:"))} - known
    if tag.name in _ELEMENTS or tag.name in _ROOTS or others:
        return f"<{tag.name}> in <metadata> is not an option of netconvert; leave <metadata> out"
    return ""


def _number_fault(tag: Tag) -> str:
    for attribute in _NUMERIC.intersection(tag.attributes):
        value = tag.attributes[attribute]
        if _is_odd_number(value):
            return f"<{tag.name} {attribute}={value[:40]!r}> is not a finite number in plain digits"
    if tag.name == "phase" and _never_ends(tag.attributes.get("minDur", "1")):
        return (
            f"<phase minDur={tag.attributes['minDur'][:40]!r}> is not a time above 0; SUMO would "
            "change between such phases without end"
        )
    for attribute in _MOST_OF.keys() & tag.attributes.keys():
        value, most = tag.attributes[attribute], _MOST_OF[attribute]
        if DECIMAL.fullmatch(value) and float(value) > most:
            return f"<{tag.name} {attribute}={value[:40]!r}> is more than {most}"
    return ""


def _never_ends(duration: str) -> bool:
    """Return True for a duration that is 0 in SUMO's clock, which has milliseconds, or less."""
    return DECIMAL.fullmatch(duration) is not None and float(duration) < 0.001


def _parameter_fault(tag: Tag) -> str:
    key = tag.attributes.get("key", "")
    if tag.parent in _OPEN_KEYS or _is_output(tag.attributes, tag.parent) or key in OPTIONS:
        return ""
    device = re.fullmatch(r"has\.([\w-]+)\.device", key)
    if device is not None and device[1] == "tripinfo":
        return "the scores of an episode need the device tripinfo of every vehicle; leave it out"
    if device is not None:
        known = device[1] in _DEVICES or tag.attributes.get("value", "").lower() in ("false", "0")
        return "" if known else f"the device {device[1]!r} writes files; leave it out"
    if _TO_FILES.search(key) or key.startswith(("device.", "person-device.")):
        return f"<param key={key[:80]!r}> is not a parameter that a scenario may set; leave it out"
    return ""


def _request_fault(tag: Tag) -> str:
    index = tag.attributes.get("index", "")
    if re.fullmatch(r"\d{1,9}", index, re.ASCII) and int(index) < _MOST_LINKS:
        return ""
    return f"<request index={index[:20]!r}> is not a number from 0 to {_MOST_LINKS - 1}"


def _lane_fault(tag: Tag) -> str:
    for attribute in ("length", "speed"):
        text = tag.attributes.get(attribute)
        if text is not None and not _is_positive(text):
            lane = tag.attributes.get("id", "")
            return (
                f"lane {lane!r} has {attribute} = {text[:40]!r}, which is not a finite number "
                "above 0; build the network again with netconvert"
            )
    if "length" in tag.attributes and len(tag.attributes.get("shape", "").split()) < 2:
        return (
            f"lane {tag.attributes.get('id', '')!r} has no shape of two points or more; build the "
            "network again with netconvert"
        )
    return ""


def _is_odd_number(text: str) -> bool:
    """Return True if Python reads a number where SUMO and a person may read another or none."""
    plain = DECIMAL.fullmatch(text.strip())
    if plain and not plain[2] and len(text) < _FINITE_DIGITS:
        return False
    try:
        return not (math.isfinite(float(text)) and plain)
    except ValueError:  # a word, such as "max", or a time with colons
        return False


def _is_positive(text: str) -> bool:
    """Return True for a number above 0 as SUMO writes it, in ASCII digits without underscores."""
    return bool(DECIMAL.fullmatch(text)) and 0 < float(text) < math.inf


def _vaporizer_fault(tag: Tag) -> str:
    """Refuse every vaporizer, for the reason for which ``max-depart-delay`` is no option."""
    return (
        f"<{tag.name}> removes vehicles that SUMO reports nowhere, so that jams would have shorter "
        "travel times; leave it out"
    )


_CHECKS: Mapping[str, Callable[[Tag], str]] = {
    "lane": _lane_fault,
    "param": _parameter_fault,
    "request": _request_fault,
    "vaporizer": _vaporizer_fault,
}


def _is_output(attributes: Mapping[str, str], parent: str) -> bool:
    """Return True for a parameter of a light that names a file to write, or asks for one."""
    return parent == "tlLogic" and attributes.get("key") in ("file", _OUTPUT_SWITCH)


def _outputs(name: str, attributes: Mapping[str, str], parent: str) -> list[str]:
    """Return the attributes of an element that name files to write, or pictures."""
    if name == "param":
        return ["value"] if _is_output(attributes, parent) else []
    return [
        attribute
        for attribute in attributes
        if name in _OUTPUTS.get(attribute, ()) or attribute in _PICTURES
    ]


def _without_outputs(document: Document) -> Document:
    """Return the document with its outputs discarded; SUMO would write them beside user files."""

    def discard(part: ET.Element) -> None:
        for child in part:
            _discard_outputs(child, part.tag)

    return document.changed(discard)


def _discard_outputs(element: ET.Element, parent: str) -> None:
    for attribute in _outputs(element.tag, element.attrib, parent):
        if attribute in _PICTURES:
            del element.attrib[attribute]
        elif element.get("key") == _OUTPUT_SWITCH:
            element.set(attribute, "false")
        else:
            element.set(attribute, _DISCARD)
    for child in element:
        _discard_outputs(child, element.tag)
