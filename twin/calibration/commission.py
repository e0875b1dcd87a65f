"""Commissioning: fit a unit of unknown type, from a record and what a person can read off.

The record itself shows noise, thresholds, ambient pressure if the system is opened, rough flows
and delays. The fit starts from these and searches the range of all ejectors on the market.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from twin.calibration.calibrate import (
    MOST_FITTED,
    Calibration,
    complete,
    contradictions,
    like_these,
    scatter,
)
from twin.calibration.cycles import Cycles
from twin.calibration.doubts import Doubt, doubts_of_fit, doubts_of_type, measured_doubts
from twin.calibration.fit import Fitted
from twin.calibration.market_fit import judged, market_fit
from twin.calibration.parameters import AMBIENT, AMBIENT_TOLD, FREE_IN_MARKET, Free
from twin.calibration.readings import Readings, read, rows_by_phase
from twin.calibration.record_checks import Remark, checked, questions, refuse_insufficient
from twin.calibration.stationarity import check_one_group
from twin.calibration.thresholds import decided
from twin.calibration.verdict import Verdict
from twin.config import Config
from twin.diagnosis.text import listed, spoken
from twin.languages.texts import ntr, numeral, tr
from twin.model import theta as c
from twin.model.air import GAMMA, R
from twin.model.dataset import Ambient, DataSet, coefficients, sensor_place
from twin.model.effects import standing_for
from twin.model.parts import Cups, Part, Sensor, Tube, volume
from twin.monitor.cycles import FEWEST_ROWS
from twin.monitor.healthy import UNSEEN_LEVEL_MBAR, Healthy, Scatter
from twin.monitor.signal_checks import APART, Contradiction
from twin.monitor.statistics import LEVELS
from twin.signals import (
    MBAR,
    ML,
    MS,
    SL_MIN,
    ZERO_C,
    Reported,
    Samples,
)

COARSE = 2.05 * MS  # s between rows, above which the answer states what they cannot show
ROOM_TEMPERATURE = 293.15  # K, for a first guess
# Where fits start: the sensor's place along the line, and the share of all gas that is in the port.
PLACES, PORT_SHARES = (0.05, 0.95), (0.01, 0.1)
NEARLY = 0.95  # first guess of the end pressure, over the deepest pressure without air saving
# How cups give way: the share of their volume that is lost, softness, and stiff_mbar (System).
RIGID, LIPS, BELLOWS = (0.0, 5.0, 30.0), (0.03, 5.0, 30.0), (0.4, 10.0, 300.0)
# Growth time of suction (s) for which the jet is tried as the cause; its shortest response (ms).
SLOW_JET, SOONEST_MS = (12.0 * MS, 100.0 * MS), 2.0
_THRESHOLDS = ("h1_mbar", "h1_hysteresis_mbar", "h2_mbar")
_JET = ("ramp_up_ms", "ramp_down_ms", "response_ms", "response_off_ms")
SAGS = {"droop_bar": 0.1, "lag_ms": 50.0}  # first guess of the supply
CLEARLY = 15.0  # mbar: a threshold is reported if it differs by more
# A sensor is reported as misplaced beyond this share of the line, and beyond so many sigmas.
ELSEWHERE, SURELY = 0.6, 4.0
KNOWN_PLACE = 1e-3  # of the line, one sigma of the sensor's place where it is taken as configured
# A record that rises so far above ambient (mbar) has met a relief valve, which opens at about half
# of that.
RELIEVED, RELIEVES = 60.0, 0.5
# Diameters of tubes, over what is configured, from which a fit that leaves too much starts again;
# time constant with which blow-off then ends, over that of its begin.
OTHER_BORES, CLOSES_QUICKLY = (2.0, 0.5), 0.4
CREEPS = 0.3  # first guess of the share of the cups' yielding that comes later
FAR_WEAKER = 0.5  # of the guess of a blow-off, below which a fit does not reach the weaker one
PUSHED_OFF = 0.8  # of the highest pressure above ambient: there blow-off pushes a part off
DRAINS = 0.2  # rate at which blow-off drains its reservoir, over the rate at which it fills
COMES = 40.0  # ms after suction at which cups meet a part, if the record does not show it
AMBIENT_CLEARLY = 3.0  # mbar: ambient pressure is reported if it differs by more
# Relative difference from the configured volume above which that of the flow meter is used: nearly
# twice a flow meter's error on rigs whose truth is known.
VOLUME_CLEARLY = 0.15
LEAST_LEFT = 0.1  # least factor for the volume of all but tubes; below it the tubes are wrong
# Relative sigma of the optimum pressure if it is not configured. Suction then rises or falls by
# 6 % a bar about a supply of 5 bar; momentum theory of ejectors on the market has up to 12 %.
OPTIMUM_UNTOLD = 0.2
# mbar, one sigma of the hysteresis if no cycle shows it and it is not configured: ejectors on the
# market have 10 to 300.
HYSTERESIS_UNTOLD = 75.0
LEAST_OFFSET = 1.0  # mbar: a smaller difference from the barometer is no offset of the sensor


@dataclass(frozen=True)
class Commissioned:
    """A unit's calibration, its verdict, and the corrections that the record made."""

    calibration: Calibration
    readings: Readings
    remarks: tuple[Remark, ...]
    contradictions: tuple[Contradiction, ...]  # between reported signals and the pressure
    samples: Samples  # on which the twin was judged
    doubts: tuple[Doubt, ...] = ()  # that the record is of a healthy unit

    @property
    def verdict(self) -> Verdict:
        """How well the twin follows the record."""
        return self.calibration.verdict

    @property
    def assumed(self) -> list[str]:
        """Names of values that the record does not determine: they keep guess and width."""
        fitted = self.calibration.fitted
        determined = zip(fitted.free, fitted.determined, strict=True)
        return [free.name for free, is_determined in determined if not is_determined]

    @property
    def unseen(self) -> str:
        """What the record's cadence cannot show, without a full stop; empty if it shows all."""
        return "; ".join(filter(None, (self._coarse, self._short)))

    @property
    def _coarse(self) -> str:
        """What rows far apart cannot show."""
        if self.readings.period <= COARSE:
            return ""
        return tr(
            "with a row each {apart} ms, when valves and nozzle act and how the pressure begins to"
            " move is known to about {apart} ms; smaller delays are not told apart",
            apart=numeral(self.readings.period / MS, ".0f"),
        )

    @property
    def _short(self) -> str:
        """Which phases have too few rows for the monitor."""
        rows = rows_by_phase(self.samples["commands"])
        short = [phase for phase in sorted(rows) if rows[phase] < FEWEST_ROWS]
        if not short:
            return ""
        return ntr(
            "{phases} has fewer than {rows} rows in a cycle: no alarm judges so short a phase",
            "{phases} have fewer than {rows} rows in a cycle: no alarm judges so short a phase",
            len(short),
            phases=listed([spoken(phase.name.lower()) for phase in short]),
            rows=FEWEST_ROWS,
        )


def commission(
    config: Config, blocks: Iterable[Samples], progress: Callable[[str], None]
) -> Commissioned:
    """Fit a unit from its record; ``config`` describes roughly what hangs on the ejector.

    Raises ConfigError with the reason if the record does not suffice. The ``verdict`` says how
    well the twin follows the record; a caller must check it before storing the result.
    """
    progress("reading the record")
    record = checked(config, blocks)
    samples, readings = record.samples, record.readings
    optimum_is_told = "optimum_bar" in config.data.supply.model_fields_set
    hysteresis_is_told = "h1_hysteresis_mbar" in config.data.ejector.model_fields_set
    config = record.config
    guess, _ = guessed(config.data, readings)
    before = complete(guess, samples)
    refuse_insufficient(samples, before, "commissioning")
    switching_data = switching(guess, samples)
    contradictory = contradictions(
        before if switching_data is guess else complete(switching_data, samples), switching_data
    )
    wrong_signals = {contradiction.signal for contradiction in contradictory}
    if "nozzle" in wrong_signals:
        progress("the nozzle is not as reported: reading the pressure alone")
        samples = unreported(samples)
        readings = read(samples)
    if "pressure_2" in wrong_signals:
        samples = samples.copy()
        samples["pressure_2"] = 0.0  # so that the fit does not follow it
    metered, by_flow = config.data, list[Remark]()
    if "flow" not in wrong_signals:
        metered, by_flow = as_metered(config.data, readings)
    if "nozzle" in wrong_signals or by_flow:
        guess, _ = guessed(metered, readings)
        before = complete(guess, samples)
    samples = samples[samples["time_ns"] <= before[-1].end_ns]
    used = samples[samples["time_ns"] <= before[:MOST_FITTED][-1].end_ns]
    check_one_group(Cycles.found(samples, guess))
    free = free_of(config, readings)
    guesses = starts(
        guess,
        readings.meets,
        grows=readings.grows,
        into_hose=_into_hose(guess, readings),
        pushes=readings.pushes,
        suction_ends=readings.suction_ends,
    )
    fitted, found_cycles, verdict = _best(
        samples,
        readings.noise,
        guesses,
        lambda starting: market_fit(used, starting, free, progress),
        progress,
    )
    readings = as_switched(readings, found_cycles)
    if fitted.data.ambient != guess.ambient:  # thresholds count from ambient pressure
        metered = within(metered, fitted.data.ambient)
    fitted, remarks, readings = _deciding(fitted, found_cycles, metered, readings)
    known = with_known_place(free)
    of_fit = by_fit(
        config.data,
        fitted,
        verdict,
        lambda start: judged(
            samples, readings.noise, market_fit(used, [start], known, progress), progress
        )[-1],
    )
    remarks = [*record.remarks, *by_flow, *remarks, *of_fit]
    cycles = complete(fitted.data, samples)
    sigma = 0.0 if optimum_is_told else OPTIMUM_UNTOLD * fitted.data.supply.optimum_bar
    unseen_level = _unseen_level(readings, is_told=hysteresis_is_told)
    healthy = _healthy(
        config,
        fitted,
        _shown(scatter(fitted.data, cycles), readings),
        samples,
        sigma,
        unseen_level,
    )
    times = samples["host_ns"]
    ends = int(times[0]), int(times[-1])
    calibration = Calibration(fitted, verdict, healthy, len(cycles), *ends)
    doubts = _doubts(config, calibration, readings)
    return Commissioned(
        calibration, readings, tuple(remarks), tuple(contradictory), samples, doubts
    )


def _doubts(config: Config, calibration: Calibration, readings: Readings) -> tuple[Doubt, ...]:
    """Doubts that the record is of a healthy unit; the values of a bad fit are none."""
    fitted = calibration.fitted
    configured = within(config.data, fitted.data.ambient)
    measured = measured_doubts(configured, readings, calibration.healthy)
    if calibration.verdict.word == "refused":
        return tuple(measured)
    return *measured, *doubts_of_fit(fitted), *doubts_of_type(config, fitted)


def _healthy(
    config: Config,
    fitted: Fitted,
    figures: dict[str, Scatter],
    samples: Samples,
    optimum: float,
    unseen_level: float,
) -> Healthy:
    """The healthy scatter of a record whose cycles have these ``figures``.

    ``optimum`` is one sigma (bar) of the optimum pressure, 0 if it is configured; ``unseen_level``
    one sigma (mbar) of a switching level that no cycle shows.
    """
    untold = {"supply.optimum_bar": optimum} if optimum else {}
    as_fitted = replace(config, data=fitted.data)
    healthy = like_these(as_fitted, fitted, figures, samples, untold)
    return healthy.model_copy(update={"unseen_level_mbar": unseen_level})


def _shown(figures: dict[str, Scatter], readings: Readings) -> dict[str, Scatter]:
    """``figures`` without a level at which the nozzle goes on again that the whole record denies.

    While the twin runs, waves in a hose can look like it.
    """
    _, on_level = LEVELS
    shows_on = np.isfinite(readings.on)
    return {name: figure for name, figure in figures.items() if shows_on or name != on_level}


def _unseen_level(readings: Readings, *, is_told: bool) -> float:
    """One sigma (mbar) of the vacuum at which the nozzle goes on again, for later records.

    ``is_told`` says whether the hysteresis is configured.
    """
    return UNSEEN_LEVEL_MBAR if is_told or np.isfinite(readings.on) else HYSTERESIS_UNTOLD


def switching(data: DataSet, samples: Samples) -> DataSet:
    """``data`` with air saving on if the nozzle is reported, so that switchings are searched.

    The pressure may contradict a report that the nozzle never goes off.
    """
    if not (samples["reported"] & np.uint8(Reported.NOZZLE_KNOWN)).any():
        return data
    ejector = data.ejector.model_copy(update={"air_saving": "on"})
    return data.model_copy(update={"ejector": ejector})


def unreported(samples: Samples) -> Samples:
    """A copy without the reported nozzle."""
    samples = samples.copy()
    samples["reported"] &= ~np.uint8(Reported.NOZZLE_KNOWN | Reported.NOZZLE)
    return samples


def _best(
    samples: Samples,
    noise: float,
    guesses: Sequence[DataSet],
    fits: Callable[[Sequence[DataSet]], Fitted],
    progress: Callable[[str], None],
) -> tuple[Fitted, Cycles, Verdict]:
    """The fit from ``guesses``, with the cycles as it sees them and how well it follows them.

    If that is not good, it is the better one of this and of another from other tubes.
    """
    best = judged(samples, noise, fits(guesses), progress)
    if best[-1].word == "good":
        return best
    progress("more is left than the cycles differ: trying wider and narrower tubes")
    other = judged(samples, noise, fits(other_tubes(guesses, best[0].data)), progress)
    return min(best, other, key=lambda result: result[-1].worst)


def other_tubes(guesses: Sequence[DataSet], best: DataSet) -> list[DataSet]:
    """Those ``guesses`` that are most like the ``best`` fit, with wider and narrower tubes.

    A wide tube holds more gas, which is light to move. What rings in it as a valve closes has
    another height then, and no fit leads from one to the other. Valves may also close quicker.
    """

    def unlike(guess: DataSet) -> tuple[bool, float]:
        other_way = guess.system.part_leaves != best.system.part_leaves
        return other_way, abs(guess.system.part_meets_ms - best.system.part_meets_ms)

    nearest = min(map(unlike, guesses))
    tables = [guess.model_dump() for guess in guesses if unlike(guess) == nearest]
    others = []
    for factor, table in product(OTHER_BORES, tables):
        area = factor**2
        line = {"line_volume_factor": area, "line_inertia_factor": 1.0 / area}
        system = table["system"] | line | {"line_factor": 1.0 / area**2}
        ejector = table["ejector"] | {"blow_off_closing_factor": CLOSES_QUICKLY}
        others.append(DataSet.model_validate(table | {"system": system, "ejector": ejector}))
    return others


def as_switched(readings: Readings, cycles: Cycles) -> Readings:
    """``readings`` without air saving if no switching was found in ``cycles``.

    Where the supply sags, the pressure turns as by air saving, but slowly. The fit, which had no
    hold then, is of an ejector that never switches off.
    """
    if not readings.saves_air or len(cycles.switchings[0]):
        return readings
    return replace(readings, switches=0, off=np.nan, on=np.nan)


def _deciding(
    fitted: Fitted, cycles: Cycles, configured: DataSet, readings: Readings
) -> tuple[Fitted, list[Remark], Readings]:
    """The fit with thresholds where the control decides in ``cycles``, and remarks as ``guessed``.

    Until the fit they are where the pressure turns. The third value are the readings with these
    thresholds.
    """
    if readings.saves_air:
        readings = decided(readings, cycles, coefficients(fitted.data))
    guess, remarks = guessed(configured, readings)
    return replace(fitted, data=switching_as(guess, fitted.data)), remarks, readings


def switching_as(guess: DataSet, data: DataSet) -> DataSet:
    """``data`` with the air saving of ``guess`` and its thresholds."""
    thresholds = {key: getattr(guess.ejector, key) for key in ("air_saving", *_THRESHOLDS)}
    return data.model_copy(update={"ejector": data.ejector.model_copy(update=thresholds)})


def as_metered(data: DataSet, readings: Readings) -> tuple[DataSet, list[Remark]]:
    """``data`` with the volume by the flow meter, if it clearly differs from the configured one.

    Tubes keep their length and diameter. All other volumes behind the port get one common factor,
    so that the sum is that of the meter. If that factor is very small, the tubes must be wrong in
    an unknown way, and nothing is changed.
    """
    metered = readings.evacuated(data.ambient.temperature_c + ZERO_C)
    if np.isfinite(metered):
        data = _as_exact_as_a_meter(data)
    parts = data.system.parts
    configured = sum(volume(part) for part in parts)
    tubes = sum(volume(part) for part in parts if isinstance(part, Tube | Sensor))
    times = (metered - tubes) / (configured - tubes)
    if not abs(metered / configured - 1.0) > VOLUME_CLEARLY or times < LEAST_LEFT:
        return data, []
    scaled = tuple(_scaled(part, times) for part in parts)
    lines = (
        f'kind = "{part.kind}", volume_ml = {_rough(part.volume_ml)}'
        for part in scaled
        if not isinstance(part, Tube | Sensor) and part.volume_ml > 0.0
    )
    text = (
        f"by the flow meter {_rough(metered / ML)} ml are evacuated; the configuration says"
        f" {_rough(configured / ML)}"
    )
    line = f"[[data.system.parts]] {'; '.join(lines)}"
    system = data.system.model_copy(update={"parts": scaled})
    return data.model_copy(update={"system": system}), [Remark(text, line)]


def _as_exact_as_a_meter(data: DataSet) -> DataSet:
    """``data`` with volumes that are at least as exact as those by a flow meter."""
    within = min(data.system.volumes_within_factor, 1.0 + VOLUME_CLEARLY)
    system = data.system.model_copy(update={"volumes_within_factor": within})
    return data.model_copy(update={"system": system})


def _scaled(part: Part, factor: float) -> Part:
    """A part with its volume times ``factor``; tubes keep theirs, from length and diameter."""
    if isinstance(part, Tube | Sensor):
        return part
    return part.model_copy(update={"volume_ml": factor * part.volume_ml})


def _rough(volume_ml: float) -> str:
    """A volume as text, as precise as a flow meter is."""
    return f"{round(volume_ml, 0 if volume_ml >= 100.0 else 1):g}"


def guessed(data: DataSet, readings: Readings) -> tuple[DataSet, list[Remark]]:
    """``data`` with the values that the record shows, and remarks on those that differ."""
    tables = data.model_dump()
    ambient, remarks = _ambient(tables, readings)
    tables["sensor"]["noise_mbar"] = max(readings.noise / MBAR, 0.05)
    remarks += [*_air_saving(tables["ejector"], readings, ambient), *questions(readings)]
    tables["system"].update(free_convection=0.5, forced_convection=1.0, leak_critical_ratio=0.4)
    tables["system"]["creep_share"] = CREEPS
    tables["supply"].update(SAGS)
    _flows(tables["ejector"], readings, _volume(data), ambient * MBAR)
    return DataSet.model_validate(tables), remarks


def _ambient(tables: dict[str, dict[str, Any]], readings: Readings) -> tuple[float, list[Remark]]:
    """Set ambient pressure and the sensor's offset if they show.

    Returns the reading (mbar) at zero vacuum, and remarks.
    """
    configured = float(tables["ambient"]["pressure_mbar"])
    if not readings.opened:
        return configured, []
    offset = (readings.idle - readings.barometer) / MBAR
    if abs(offset) <= APART / MBAR:  # within the error of a sensor
        tables["ambient"]["pressure_mbar"] = round(readings.barometer / MBAR, 1)
        if abs(offset) > LEAST_OFFSET:
            zero_error, parameter = standing_for(c.SENSOR_OFFSET)
            tables["effects"][zero_error.name] = {parameter.name: round(offset, 1)}
        return readings.idle / MBAR, []
    measured = round(readings.idle / MBAR, 1)
    tables["ambient"]["pressure_mbar"] = measured
    if abs(measured - configured) <= AMBIENT_CLEARLY:
        return measured, []
    text = f"the opened system stands at {measured:g} mbar; the configuration says {configured:g}"
    return measured, [Remark(text, f"[data.ambient] pressure_mbar = {measured:g}")]


def _air_saving(ejector: dict[str, Any], readings: Readings, ambient: float) -> list[Remark]:
    """Set air saving and its thresholds; ``ambient`` in mbar."""
    configured = ejector["air_saving"]
    if readings.saves_air:
        ejector["air_saving"] = "on" if configured == "off" else configured
        return _thresholds(ejector, readings, ambient)
    ejector["air_saving"] = "off"
    remarks = []
    if configured != "off":
        text = "in no suction the nozzle goes off by itself; the configuration has air saving on"
        remarks.append(Remark(text, '[data.ejector] air_saving = "off"'))
    return [*remarks, *_part_present(ejector, readings, ambient)]


def _flows(ejector: dict[str, Any], readings: Readings, evacuated: float, ambient: float) -> None:
    """Set first guesses of flows, from how fast ``evacuated`` (m³) empties and fills."""
    ejector["jet_depth"] = 0.5
    if not readings.saves_air:  # so suction goes on nearly to its end pressure
        ejector["end_pressure_mbar"] = float(np.clip(NEARLY * readings.deepest / MBAR, 10.0, 690.0))
    ejector["cracking_pressure_mbar"] = 5.0
    capacity = readings.capacity(evacuated, ambient, ROOM_TEMPERATURE) / SL_MIN
    if np.isfinite(capacity):
        ejector["suction_capacity_sl_min"] = float(np.clip(capacity, 1.0, 1000.0))
    blow_off = readings.blow_off(evacuated, ambient, ROOM_TEMPERATURE) / SL_MIN
    if np.isfinite(blow_off):
        ejector.update(_blow_off(blow_off))
        ejector["blow_off_drain_per_s"] = DRAINS * readings.fill_rate
    if np.isfinite(readings.blow_off_ends):
        ejector["blow_off_response_off_ms"] = max(readings.blow_off_ends / MS - SOONEST_MS, 0.0)
    highest = (readings.highest - ambient) / MBAR
    relieved = RELIEVES * highest if highest > RELIEVED else ejector["cracking_pressure_mbar"]
    ejector["relief_pressure_mbar"] = relieved
    back = readings.back_flow(evacuated, ambient, ROOM_TEMPERATURE) / SL_MIN
    if np.isfinite(back):
        ejector["back_flow_sl_min"] = float(np.clip(back, 0.0, 2000.0))


def _blow_off(flow: float) -> dict[str, float]:
    """First guess of a blow-off of ``flow`` (sl/min), and of what it leaves through."""
    flow = float(np.clip(flow, 1.0, 2000.0))
    return {"blow_off_sl_min": flow, "exhaust_sl_min": flow, "relief_sl_min": 0.3 * flow}


def _into_hose(data: DataSet, readings: Readings) -> float:
    """Blow-off (sl/min) that lifts the pressure at a hose's end as far as the record shows.

    A flow m into a hose lifts the pressure there by m c / A at once (its wave impedance), long
    before what hangs on the hose is filled. NaN without a hose.
    """
    bores = [
        volume(part) / (part.length_mm * 1e-3)
        for part in data.system.parts
        if isinstance(part, Tube)
    ]
    rise = data.ambient.pressure_mbar * MBAR - readings.deepest
    speed_of_sound = math.sqrt(GAMMA * R * ROOM_TEMPERATURE)
    return min(bores, default=np.nan) * rise / speed_of_sound / SL_MIN


def starts(
    data: DataSet,
    meets: float,
    grows: float = np.nan,
    into_hose: float = np.nan,
    pushes: float = np.nan,
    suction_ends: float = np.nan,
) -> list[DataSet]:
    """Starts of a fit: ``data`` in variants that no fit reaches from each other.

    They differ in the sensor's place along the line, the gas at the port, how a part leaves, and
    whether cups spread or fold. Cups may be on the next part when suction is commanded, or meet it
    ``meets`` seconds later (NaN: not shown by the record). If the fall ``grows`` slowly (s), the
    jet may be the reason, or the sensor. If a blow-off ``into_hose`` (sl/min) is far weaker than
    one that fills all, the pressure may show the hose alone. If no vacuum is left as blow-off
    begins, it may be what pushes the part off, up to ``pushes`` (Pa) above ambient. Suction may go
    on beside blow-off until ``suction_ends`` (s after its command).
    """
    as_guessed = {key: getattr(data.ejector, key) for key in _blow_off(1.0)}
    flows = [as_guessed]
    if into_hose < FAR_WEAKER * data.ejector.blow_off_sl_min:
        flows.append(_blow_off(into_hose))
    of_cups = [part for part in data.system.parts if isinstance(part, Cups)]
    cups = sum(map(volume, of_cups)) / ML
    shift = data.system.release_shift_mbar
    leaves = [(data.system.part_leaves, shift)]
    if cups:
        leaves = [("in_blow_off", shift), ("after_blow_off", shift)]
    if cups and np.isfinite(pushes):
        off_at = min(cup.release_mbar for cup in of_cups) + PUSHED_OFF * pushes / MBAR
        leaves.append(("in_blow_off", -off_at))
    comes = meets / MS if np.isfinite(meets) else COMES
    waits = (0.0, comes) if cups else (0.0,)
    tables = data.model_dump()
    configured_place = sensor_place(data)
    total_volume = _volume(data) / ML
    usual_wall = LIPS if cups else RIGID
    softer = (BELLOWS,) if cups else (LIPS, BELLOWS)  # a vessel may be cups on a part that stays
    quick = {key: tables["ejector"][key] for key in _JET}
    slow = _slow(quick, grows / MS) if SLOW_JET[0] < grows < SLOW_JET[1] else quick
    inside = [
        (PORT_SHARES[0], usual_wall, slow),
        (PORT_SHARES[1], usual_wall, slow),
        *((PORT_SHARES[0], wall, slow) for wall in softer),
    ]
    if slow is not quick:
        inside.append((PORT_SHARES[0], usual_wall, quick))
    if np.isfinite(suction_ends):
        goes_on = quick | {"response_off_ms": max(suction_ends / MS - SOONEST_MS, SOONEST_MS)}
        inside += [(share, usual_wall, goes_on) for share in PORT_SHARES]
    guesses = []
    for flow, wait, (leaving, shift), place, (share, wall, jet) in product(
        flows, waits, leaves, PLACES, inside
    ):
        shrinks, softness, stiff = wall
        port = share * total_volume
        tables["system"].update(part_leaves=leaving, release_shift_mbar=shift, rim="turbulent")
        tables["system"].update(sensor_shift=place - configured_place)
        tables["system"].update(part_meets_ms=wait, shrinks_ml=shrinks * (cups or total_volume))
        tables["system"].update(softness=softness, stiff_mbar=stiff)
        tables["ejector"].update(jet, port_volume_ml=port, **flow)
        guesses.append(DataSet.model_validate(tables))
    return guesses


def _slow(jet: Mapping[str, float], ramp_ms: float) -> dict[str, float]:
    """A jet with ramps of ``ramp_ms`` that reaches half its strength when ``jet`` does."""
    sooner_up, sooner_down = (
        0.5 * (ramp_ms - jet[f"ramp_{direction}_ms"]) for direction in ("up", "down")
    )
    return {
        "ramp_up_ms": ramp_ms,
        "ramp_down_ms": ramp_ms,
        "response_ms": max(jet["response_ms"] - sooner_up, SOONEST_MS),
        "response_off_ms": max(jet["response_off_ms"] - sooner_down, SOONEST_MS),
    }


def within(data: DataSet, ambient: Ambient) -> DataSet:
    """``data`` with another ambient."""
    return data.model_copy(update={"ambient": ambient})


def free_of(config: Config, readings: Readings) -> tuple[Free, ...]:
    """Free parameters of a fit: with ambient pressure if only the fit can determine it."""
    if readings.opened or config.is_gauge or np.isfinite(readings.barometer):
        return FREE_IN_MARKET
    is_configured = config.data.ambient.pressure_mbar != Ambient().pressure_mbar
    return (*FREE_IN_MARKET, AMBIENT_TOLD if is_configured else AMBIENT)


def another_ambient(configured: DataSet, fitted: Fitted) -> Iterator[Remark]:
    """A remark if ambient pressure was fitted and clearly differs from the configured one."""
    keys = [free.name for free in fitted.free]
    if AMBIENT.name not in keys:
        return
    was, now = configured.ambient.pressure_mbar, fitted.data.ambient.pressure_mbar
    sigma = float(fitted.spread[keys.index(AMBIENT.name)])
    if abs(now - was) > max(AMBIENT_CLEARLY, SURELY * sigma):
        text = (
            f"the closed system follows an ambient pressure of {now:.0f} mbar; the configuration"
            f" says {was:g}"
        )
        yield Remark(text, f"[data.ambient] pressure_mbar = {now:.0f}")


def at_place(data: DataSet, place: float) -> DataSet:
    """``data`` with the sensor at a place along the line, 0 at the port and 1 at the vessel."""
    shift = data.system.sensor_shift + place - sensor_place(data)
    return data.model_copy(
        update={"system": data.system.model_copy(update={"sensor_shift": shift})}
    )


def with_known_place(free: Sequence[Free]) -> tuple[Free, ...]:
    """``free`` with the sensor's place as it is in the guess."""
    return tuple(
        replace(parameter, market=KNOWN_PLACE) if parameter.key == "sensor_shift" else parameter
        for parameter in free
    )


def by_fit(
    configured: DataSet,
    fitted: Fitted,
    verdict: Verdict,
    judged_from: Callable[[DataSet], Verdict],
) -> list[Remark]:
    """Remarks on ambient pressure and on the sensor's place; those of a bad fit mean nothing.

    ``judged_from`` fits and judges from a start at which the sensor stays. If that gets the same
    verdict with the sensor as configured, the place is no contradiction: a short tube has nearly
    the same pressure at both ends, and a fit goes to either.
    """
    if verdict.word == "refused":
        return []
    remarks, elsewhere = (
        list(another_ambient(configured, fitted)),
        list(misplaced(configured, fitted)),
    )
    if elsewhere:
        as_configured = judged_from(at_place(fitted.data, sensor_place(configured)))
        remarks += elsewhere if as_configured.word != verdict.word else []
    return remarks


def misplaced(configured: DataSet, fitted: Fitted) -> Iterator[Remark]:
    """A remark if the sensor is clearly at another place than configured."""
    configured_place, fitted_place = sensor_place(configured), sensor_place(fitted.data)
    sigma = float(fitted.spread[[free.key for free in fitted.free].index("sensor_shift")])
    if (
        abs(fitted_place - configured_place) > ELSEWHERE
        and abs(fitted_place - configured_place) > SURELY * sigma
    ):
        nearer, farther = (
            ("the vessel", "the port")
            if fitted_place > configured_place
            else ("the port", "the vessel")
        )
        text = (
            f"the pressure is read nearer to {nearer}; the configuration has the sensor nearer to"
            f" {farther}"
        )
        line = (
            '[[data.system.parts]] kind = "sensor", after the tubes'
            if fitted_place > configured_place
            else '[[data.system.parts]] kind = "sensor", before the tubes'
        )
        yield Remark(text, line)


def _thresholds(ejector: dict[str, Any], readings: Readings, ambient: float) -> list[Remark]:
    """Set H1 and its hysteresis from the turning points; keep H2 below them."""
    h1, remarks = round(ambient - readings.off / MBAR), []
    if abs(h1 - ejector["h1_mbar"]) > CLEARLY:
        text = f"the nozzle goes off at {h1:g} mbar; the configuration says {ejector['h1_mbar']:g}"
        remarks.append(Remark(text, f"[data.ejector] h1_mbar = {h1:g}"))
    hysteresis = ejector["h1_hysteresis_mbar"]
    if np.isfinite(readings.on):
        hysteresis = max(round(h1 - (ambient - readings.on / MBAR)), 1.0)
        if abs(hysteresis - ejector["h1_hysteresis_mbar"]) > CLEARLY:
            text = (
                f"the nozzle goes on again {hysteresis:g} mbar below that; the configuration says"
                f" {ejector['h1_hysteresis_mbar']:g}"
            )
            line = f"[data.ejector] h1_hysteresis_mbar = {hysteresis:g}"
            remarks.append(Remark(text, line))
    remarks += _part_present(ejector, readings, ambient)
    h2 = min(ejector["h2_mbar"], h1 - hysteresis)
    if h2 <= ejector["h2_hysteresis_mbar"]:
        hysteresis, h2 = h1 / 5.0, h1 / 2.0
    ejector.update(h1_mbar=h1, h1_hysteresis_mbar=hysteresis, h2_mbar=h2)
    return remarks


def _part_present(ejector: dict[str, float], readings: Readings, ambient: float) -> list[Remark]:
    """Set H2 to the vacuum at which the ejector reports a part, if it reports one."""
    if not np.isfinite(readings.part):
        return []
    h2, before = round(ambient - readings.part / MBAR), ejector["h2_mbar"]
    if abs(h2 - before) <= CLEARLY + readings.part_unsure / MBAR:
        return []
    ejector["h2_mbar"] = h2
    text = f"part present comes at {h2:g} mbar; the configuration says {before:g}"
    return [Remark(text, f"[data.ejector] h2_mbar = {h2:g}")]


def _volume(data: DataSet) -> float:
    """The whole evacuated volume (m³)."""
    return sum(volume(part) for part in data.system.parts) + data.ejector.port_volume_ml * ML
