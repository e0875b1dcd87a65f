"""Commissioning: a unit that nobody has seen before, from a record and what a person can read off.

The record says what the configuration need not: noise, thresholds, ambient pressure where the
system is opened, rough flows and delays. From there the fit goes wherever the market may be.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from pydantic import ValidationError

from twin.calibration.calibrate import (
    MOST_FITTED,
    Calibration,
    complete,
    contradictions,
    like_these,
    refuse_insufficient,
    scatter,
)
from twin.calibration.cycles import Cycles
from twin.calibration.fit import Fitted, fit_from_afar
from twin.calibration.parameters import AMBIENT, AMBIENT_TOLD, FREE_IN_MARKET, Free
from twin.calibration.readings import Readings, read
from twin.calibration.stationarity import refuse_parted
from twin.calibration.verdict import Verdict, judge
from twin.calibration.wiring import refuse_miswired
from twin.config import Config
from twin.errors import ConfigError
from twin.model.dataset import Ambient, DataSet, sensor_place
from twin.model.system import Cups, Part, Sensor, Tube, volume
from twin.monitor.healthy import UNSEEN_LEVEL_MBAR
from twin.monitor.signal_checks import APART, Contradiction
from twin.monitor.surroundings import taken_in
from twin.signals import (
    MBAR,
    ML,
    MS,
    SAMPLE,
    SL_MIN,
    ZERO_C,
    Command,
    Reported,
    Samples,
    bridged,
)

SLOWEST = 10.5 * MS  # s between rows; what switches faster than a few rows is not seen
COARSE = 2.05 * MS  # s between rows, above which it is said what they do not show
MOST_MISSING = 0.2  # share of rows
ROOM_TEMPERATURE = 293.15  # K, for a first guess
# Where a fit starts: of the line, between sensor and port, and of all gas, in the port.
PLACES, PORT_SHARES = (0.05, 0.95), (0.01, 0.1)
NEARLY = 0.95  # of the deepest pressure of a suction that nothing ends but its command
# How cups give way: the share of their volume that goes, softness, and stiff_mbar (System).
RIGID, LIPS, BELLOWS = (0.0, 5.0, 30.0), (0.03, 5.0, 30.0), (0.4, 10.0, 300.0)
# s in which suction grows, for the jet to be tried as the cause; the soonest that it comes.
SLOW_JET, SOONEST_MS = (12.0 * MS, 100.0 * MS), 2.0
_JET = ("ramp_up_ms", "ramp_down_ms", "response_ms", "response_off_ms")
SAGS = {"droop_bar": 0.1, "lag_ms": 50.0}  # a supply, before anything is known of it
CLEARLY = 15.0  # mbar by which a threshold must differ to be told; overshoot is part of a turn
# Of the line, by which a sensor is at another place than told, and sigmas.
ELSEWHERE, SURELY = 0.6, 4.0
# Above ambient (mbar), from where on a record that goes so high has met a relief valve. It opens at
# about half of that.
RELIEVED, RELIEVES = 60.0, 0.5
CREEPS = 0.3  # share of what cups give way by, that comes later, before anything is known of them
DRAINS = 0.2  # of the rate at which blow-off fills, by which it drains a reservoir of its own
COMES = 40.0  # ms after suction, at which cups meet a part where the record does not show it
LITTLE_VACUUM = 200.0  # mbar; flow ejectors on leaking parts make more
AMBIENT_CLEARLY = 3.0  # mbar, the same for ambient pressure
# Share by which the evacuated volume must differ from what is told: nearly twice what a flow meter
# is off by on rigs whose truth is known.
VOLUME_CLEARLY = 0.15
LEAST_LEFT = 0.1  # of what is not a tube, that a flow meter must leave of it
# One sigma, of its value, where nobody told it. Suction then rises or falls by 6 % a bar about a
# supply of 5 bar; momentum theory of ejectors on the market has up to 12 %.
OPTIMUM_UNTOLD = 0.2
# mbar, one sigma of the hysteresis where no cycle shows it and nobody told it: ejectors on the
# market have 10 to 300.
HYSTERESIS_UNTOLD = 75.0
LEAST_OFFSET = 1.0  # mbar, of the sensor beside a barometer, to be taken for one


@dataclass(frozen=True)
class Remark:
    """Something that the record says and the configuration does not, with the line to change."""

    text: str
    line: str


@dataclass(frozen=True)
class Commissioned:
    """A unit's calibration, how well it follows the record, and what the record corrected."""

    calibration: Calibration
    readings: Readings
    verdict: Verdict
    remarks: tuple[Remark, ...]
    contradictions: tuple[Contradiction, ...]  # of what is reported and the pressure
    samples: Samples  # that the twin was judged on

    @property
    def assumed(self) -> list[str]:
        """Values that the record does not show; they stay what the guess said, and as wide."""
        fitted = self.calibration.fitted
        known = zip(fitted.free, fitted.determined, strict=True)
        return [one.name for one, sure in known if not sure]

    @property
    def unseen(self) -> str:
        """What the cadence of the record cannot show, in a sentence; empty where it shows all."""
        if self.readings.period <= COARSE:
            return ""
        apart = f"{self.readings.period / MS:.0f} ms"
        return (
            f"with a row each {apart}, when valves and nozzle act and how the pressure begins to"
            f" move is known to about {apart}; smaller delays are not told apart"
        )


def commission(
    config: Config, blocks: Iterable[Samples], progress: Callable[[str], None]
) -> Commissioned:
    """Fit a unit from its record; ``config`` says what hangs on the ejector, roughly.

    ConfigError with the reason where the record cannot answer. How well the twin follows a record
    that can is the ``verdict``; who stores it must look at it.
    """
    progress("reading the record")
    samples = np.concatenate([np.empty(0, SAMPLE), *bridged(blocks)])
    refuse_empty(samples)
    readings = read(samples)
    refuse_unreadable(readings)
    optimum_is_told = "optimum_bar" in config.data.supply.model_fields_set
    unseen_level = _unseen_level(config.data, readings)
    config = replace(config, data=taken_in(config.data, samples))
    refuse_miswired(samples, readings, config.data.ambient.pressure_mbar * MBAR)
    guess, remarks = guessed(config.data, readings)
    before = complete(guess, samples)
    refuse_insufficient(samples, before)
    looked = switching(guess, samples)
    against = contradictions(before if looked is guess else complete(looked, samples), looked)
    wrong = {one.signal for one in against}
    if "nozzle" in wrong:
        progress("the nozzle is not as reported: reading the pressure alone")
        samples = unreported(samples)
        readings = read(samples)
    if "pressure_2" in wrong:
        samples = samples.copy()
        samples["pressure_2"] = 0.0  # the fit follows one
    metered, by_flow = config.data, list[Remark]()
    if "flow" not in wrong:
        metered, by_flow = as_metered(config.data, readings)
    if "nozzle" in wrong or by_flow:
        guess, remarks = guessed(metered, readings)
        remarks = by_flow + remarks
        before = complete(guess, samples)
    samples = samples[samples["time_ns"] <= before[-1].end_ns]
    used = samples[samples["time_ns"] <= before[:MOST_FITTED][-1].end_ns]
    refuse_parted(Cycles.found(samples, guess))
    free = free_of(config, readings)
    fitted = _fit(used, starts(guess, readings.meets, readings.grows), free, progress)
    if fitted.data.ambient != guess.ambient:  # thresholds are below ambient pressure
        remarks = by_flow + guessed(within(metered, fitted.data.ambient), readings)[1]
    progress("judging the fit")
    verdict = judge(Cycles.found(samples, fitted.data), fitted.data, readings.noise)
    if verdict.word != "refused":  # a fit that does not follow says nothing of places
        remarks += [*misplaced(config.data, fitted), *another_ambient(config.data, fitted)]
    cycles = complete(fitted.data, samples)
    known = replace(config, data=fitted.data)
    sigma = OPTIMUM_UNTOLD * fitted.data.supply.optimum_bar
    untold = {} if optimum_is_told else {"supply.optimum_bar": sigma}
    healthy = like_these(known, fitted, scatter(fitted.data, cycles), samples, untold)
    healthy = healthy.model_copy(update={"unseen_level_mbar": unseen_level})
    times = samples["host_ns"]
    calibration = Calibration(fitted, healthy, len(cycles), int(times[0]), int(times[-1]))
    return Commissioned(calibration, readings, verdict, tuple(remarks), tuple(against), samples)


def _unseen_level(told: DataSet, readings: Readings) -> float:
    """One sigma (mbar) of where the nozzle goes on again, should a later record show it."""
    is_told = "h1_hysteresis_mbar" in told.ejector.model_fields_set
    return UNSEEN_LEVEL_MBAR if is_told or np.isfinite(readings.on) else HYSTERESIS_UNTOLD


def switching(data: DataSet, samples: Samples) -> DataSet:
    """``data`` so that switchings are looked for where the nozzle is reported, whatever that says.

    A report that it never goes off is what the pressure may contradict.
    """
    if not (samples["reported"] & np.uint8(Reported.NOZZLE_KNOWN)).any():
        return data
    ejector = data.ejector.model_copy(update={"air_saving": "on"})
    return data.model_copy(update={"ejector": ejector})


def unreported(samples: Samples) -> Samples:
    """The same as if nobody had reported the nozzle."""
    samples = samples.copy()
    samples["reported"] &= ~np.uint8(Reported.NOZZLE_KNOWN | Reported.NOZZLE)
    return samples


def refuse_empty(samples: Samples) -> None:
    """ConfigError if there is no suction to look at."""
    if not (samples["commands"] == Command.SUCTION).any():
        raise ConfigError("the record has no suction", "check which tag or column is suction")


def refuse_unreadable(readings: Readings) -> None:
    """ConfigError where the sampling cannot show what an ejector does."""
    if readings.period > SLOWEST:
        raise ConfigError(
            f"the record has a row each {readings.period / MS:.0f} ms: the nozzle's switching and"
            " the valves' delays are not seen in it",
            f"record again with a row each {SLOWEST / MS:.0f} ms or faster; what needs no twin:"
            " twin figures show LOG, twin compare A B",
        )
    if readings.missing > MOST_MISSING:
        raise ConfigError(
            f"{readings.missing:.0%} of the record's rows are missing",
            'record again in block mode (mode = "block"), which loses none',
        )


def _fit(
    samples: Samples,
    guesses: Sequence[DataSet],
    free: tuple[Free, ...],
    progress: Callable[[str], None],
) -> Fitted:
    try:
        return fit_from_afar(samples, guesses, progress, free)
    except (ValidationError, np.linalg.LinAlgError) as error:
        raise ConfigError(
            "the fit ends at values that no ejector has: this is no record of the parts that"
            " [data.system] lists, or of more than one unit",
            "check volumes, tubes and the sensor's place; commission on a record of one unit",
        ) from error


def as_metered(data: DataSet, readings: Readings) -> tuple[DataSet, list[Remark]]:
    """``data`` with the volume that a flow meter tells, where it is clearly another than told.

    Tubes stay as long and wide as told. Volumes of all else behind the port are multiplied alike,
    so that the sum is what the meter tells. Where hardly anything is left for them, the tubes are
    what is wrong, and nobody knows how: all stays as it is.
    """
    found = readings.evacuated(data.ambient.temperature_c + ZERO_C)
    parts = data.system.parts
    told = sum(volume(part) for part in parts)
    tubes = sum(volume(part) for part in parts if isinstance(part, Tube | Sensor))
    times = (found - tubes) / (told - tubes)
    if not abs(found / told - 1.0) > VOLUME_CLEARLY or times < LEAST_LEFT:
        return data, []
    scaled = tuple(_scaled(part, times) for part in parts)
    said = (
        f'kind = "{part.kind}", volume_ml = {_rough(part.volume_ml)}'
        for part in scaled
        if not isinstance(part, Tube | Sensor) and part.volume_ml > 0.0
    )
    text = (
        f"by the flow meter {_rough(found / ML)} ml are evacuated; the configuration says"
        f" {_rough(told / ML)}"
    )
    line = f"[[data.system.parts]] {' and '.join(said)}"
    system = data.system.model_copy(update={"parts": scaled})
    return data.model_copy(update={"system": system}), [Remark(text, line)]


def _scaled(part: Part, times: float) -> Part:
    """A part with so many times its volume; tubes have theirs from length and diameter."""
    if isinstance(part, Tube | Sensor):
        return part
    return part.model_copy(update={"volume_ml": times * part.volume_ml})


def _rough(volume_ml: float) -> str:
    """A volume as precise as a flow meter tells it."""
    return f"{round(volume_ml, 0 if volume_ml >= 100.0 else 1):g}"


def guessed(data: DataSet, readings: Readings) -> tuple[DataSet, list[Remark]]:
    """``data`` with what the record shows in its place, and remarks where that differs."""
    tables = data.model_dump()
    ambient, remarks = _ambient(tables, readings)
    tables["sensor"]["noise_mbar"] = max(readings.noise / MBAR, 0.05)
    remarks += [*_air_saving(tables["ejector"], readings, ambient), *_questions(readings)]
    tables["system"].update(free_convection=0.5, forced_convection=1.0, leak_critical_ratio=0.4)
    tables["system"]["creep_share"] = CREEPS
    tables["supply"].update(SAGS)
    _flows(tables["ejector"], readings, _volume(data), ambient * MBAR)
    return DataSet.model_validate(tables), remarks


def _ambient(tables: dict[str, dict[str, Any]], readings: Readings) -> tuple[float, list[Remark]]:
    """Set ambient pressure where it shows, and the sensor's offset; what vacuum is read from."""
    told = float(tables["ambient"]["pressure_mbar"])
    if not readings.opened:
        return told, []
    offset = (readings.idle - readings.barometer) / MBAR
    if abs(offset) <= APART / MBAR:  # so much the sensor may read off
        tables["ambient"]["pressure_mbar"] = round(readings.barometer / MBAR, 1)
        if abs(offset) > LEAST_OFFSET:
            tables["effects"]["sensor_offset"] = {"offset": round(offset, 1)}
        return readings.idle / MBAR, []
    found = round(readings.idle / MBAR, 1)
    tables["ambient"]["pressure_mbar"] = found
    if abs(found - told) <= AMBIENT_CLEARLY:
        return found, []
    text = f"the opened system stands at {found:g} mbar; the configuration says {told:g}"
    return found, [Remark(text, f"[data.ambient] pressure_mbar = {found:g}")]


def _air_saving(ejector: dict[str, Any], readings: Readings, ambient: float) -> list[Remark]:
    """Set whether air is saved, and at which pressures; ``ambient`` in mbar."""
    told = ejector["air_saving"]
    if readings.saves_air:
        ejector["air_saving"] = "on" if told == "off" else told
        return _thresholds(ejector, readings, ambient)
    ejector["air_saving"] = "off"
    remarks = []
    if told != "off":
        text = "in no suction the nozzle goes off by itself; the configuration has air saving on"
        remarks.append(Remark(text, '[data.ejector] air_saving = "off"'))
    return [*remarks, *_part_present(ejector, readings, ambient)]


def _questions(readings: Readings) -> Iterator[Remark]:
    """What is strange in the record, but may be so."""
    if not readings.tells_blow_off:
        text = "no row of the record has blow-off; where the unit has one, its command is missing"
        yield Remark(text, "[driver.tags.blow_off], or the column blow_off")
    if (highest := (readings.highest - readings.deepest) / MBAR) < LITTLE_VACUUM:
        text = f"the vacuum is {highest:.0f} mbar at most, where ejectors make 300 and more"
        yield Remark(text, "[driver.tags.pressure] unit, if it is in kPa, mmHg or psi")


def _flows(ejector: dict[str, Any], readings: Readings, evacuated: float, ambient: float) -> None:
    """Set first guesses of flows, by how fast ``evacuated`` (m³) empties and fills."""
    ejector["jet_depth"] = 0.5
    if not readings.saves_air:  # so suction goes on to where hardly anything flows
        ejector["end_pressure_mbar"] = float(np.clip(NEARLY * readings.deepest / MBAR, 10.0, 690.0))
    ejector["cracking_pressure_mbar"] = 5.0
    capacity = readings.capacity(evacuated, ambient, ROOM_TEMPERATURE) / SL_MIN
    if np.isfinite(capacity):
        ejector["suction_capacity_sl_min"] = float(np.clip(capacity, 1.0, 1000.0))
    blow_off = readings.blow_off(evacuated, ambient, ROOM_TEMPERATURE) / SL_MIN
    if np.isfinite(blow_off):
        ejector["blow_off_sl_min"] = float(np.clip(blow_off, 1.0, 2000.0))
        ejector["exhaust_sl_min"] = ejector["blow_off_sl_min"]
        ejector["relief_sl_min"] = 0.3 * ejector["blow_off_sl_min"]
        ejector["blow_off_drain_per_s"] = DRAINS * readings.fill_rate
    highest = (readings.highest - ambient) / MBAR
    relieved = RELIEVES * highest if highest > RELIEVED else ejector["cracking_pressure_mbar"]
    ejector["relief_pressure_mbar"] = relieved
    back = readings.back_flow(evacuated, ambient, ROOM_TEMPERATURE) / SL_MIN
    if np.isfinite(back):
        ejector["back_flow_sl_min"] = float(np.clip(back, 0.0, 2000.0))


def starts(data: DataSet, meets: float, grows: float = np.nan) -> list[DataSet]:
    """``data``, and what may differ from it so much that no fit leads there.

    Where along the line the sensor sits, what gas is at the port, how a part leaves, whether cups
    spread or fold, and whether they meet the next part after suction is commanded, ``meets``
    seconds (NaN: the record does not show it), or are on it by then. Where the fall ``grows``
    slowly (s), that may be the jet as well as the sensor.
    """
    cups = sum(volume(part) for part in data.system.parts if isinstance(part, Cups)) / ML
    leaves = ("in_blow_off", "after_blow_off") if cups else (data.system.part_leaves,)
    comes = meets / MS if np.isfinite(meets) else COMES
    waits = (0.0, comes) if cups else (0.0,)
    tables = data.model_dump()
    place = sensor_place(data)
    everything = _volume(data) / ML
    usual = LIPS if cups else RIGID
    softer = (BELLOWS,) if cups else (LIPS, BELLOWS)  # a vessel may be cups on a part that stays
    quick = {key: tables["ejector"][key] for key in _JET}
    slow = _slow(quick, grows / MS) if SLOW_JET[0] < grows < SLOW_JET[1] else quick
    inside = [
        (PORT_SHARES[0], usual, slow),
        (PORT_SHARES[1], usual, slow),
        *((PORT_SHARES[0], wall, slow) for wall in softer),
    ]
    if slow is not quick:
        inside.append((PORT_SHARES[0], usual, quick))
    found = []
    for wait, way, at, (share, wall, jet) in product(waits, leaves, PLACES, inside):
        shrinks, softness, stiff = wall
        port = share * everything
        tables["system"].update(part_leaves=way, rim="turbulent", sensor_shift=at - place)
        tables["system"].update(part_meets_ms=wait, shrinks_ml=shrinks * (cups or everything))
        tables["system"].update(softness=softness, stiff_mbar=stiff)
        tables["ejector"].update(jet, port_volume_ml=port)
        found.append(DataSet.model_validate(tables))
    return found


def _slow(jet: Mapping[str, float], ramp_ms: float) -> dict[str, float]:
    """A jet that takes so long to come and to go, and is half there when ``jet`` is."""
    sooner_up, sooner_down = (0.5 * (ramp_ms - jet[f"ramp_{way}_ms"]) for way in ("up", "down"))
    return {
        "ramp_up_ms": ramp_ms,
        "ramp_down_ms": ramp_ms,
        "response_ms": max(jet["response_ms"] - sooner_up, SOONEST_MS),
        "response_off_ms": max(jet["response_off_ms"] - sooner_down, SOONEST_MS),
    }


def within(data: DataSet, ambient: Ambient) -> DataSet:
    """``data`` in other surroundings."""
    return data.model_copy(update={"ambient": ambient})


def free_of(config: Config, readings: Readings) -> tuple[Free, ...]:
    """What a fit may move: ambient pressure too, where nothing but the fit can tell it."""
    if readings.opened or config.gauge or np.isfinite(readings.barometer):
        return FREE_IN_MARKET
    told = config.data.ambient.pressure_mbar != Ambient().pressure_mbar
    return (*FREE_IN_MARKET, AMBIENT_TOLD if told else AMBIENT)


def another_ambient(told: DataSet, fitted: Fitted) -> Iterator[Remark]:
    """A remark where ambient pressure was fitted and is clearly another than ``told``."""
    keys = [one.name for one in fitted.free]
    if AMBIENT.name not in keys:
        return
    was, found = told.ambient.pressure_mbar, fitted.data.ambient.pressure_mbar
    unsure = float(fitted.spread[keys.index(AMBIENT.name)])
    if abs(found - was) > max(AMBIENT_CLEARLY, SURELY * unsure):
        text = (
            f"the closed system follows an ambient pressure of {found:.0f} mbar; the configuration"
        )
        yield Remark(f"{text} says {was:g}", f"[data.ambient] pressure_mbar = {found:.0f}")


def misplaced(told: DataSet, fitted: Fitted) -> Iterator[Remark]:
    """A remark where the pressure is clearly read at another place than ``told``."""
    was, found = sensor_place(told), sensor_place(fitted.data)
    unsure = float(fitted.spread[[one.key for one in fitted.free].index("sensor_shift")])
    if abs(found - was) > ELSEWHERE and abs(found - was) > SURELY * unsure:
        here, there = ("the vessel", "the port") if found > was else ("the port", "the vessel")
        text = f"the pressure is read nearer to {here}; the configuration has the sensor nearer to"
        order = "after" if found > was else "before"
        line = f'[[data.system.parts]] kind = "sensor", {order} the tubes'
        yield Remark(f"{text} {there}", line)


def _thresholds(ejector: dict[str, Any], readings: Readings, ambient: float) -> list[Remark]:
    """Set H1 and its hysteresis from the turns; H2 stays below them."""
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
    """Set H2 to where the ejector itself says that the part is there, if it says so."""
    if not np.isfinite(readings.part):
        return []
    h2, before = round(ambient - readings.part / MBAR), ejector["h2_mbar"]
    if abs(h2 - before) <= CLEARLY + readings.part_unsure / MBAR:
        return []
    ejector["h2_mbar"] = h2
    text = f"part present comes at {h2:g} mbar; the configuration says {before:g}"
    return [Remark(text, f"[data.ejector] h2_mbar = {h2:g}")]


def _volume(data: DataSet) -> float:
    """All that is evacuated (m³)."""
    return sum(volume(part) for part in data.system.parts) + data.ejector.port_volume_ml * ML
