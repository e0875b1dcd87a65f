"""Checks of a record before any fit, the same for a calibration and for a commissioning.

A record that does not suffice, or whose curves show another wiring, is refused with the reason.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin.calibration.empty_picks import without_empty_picks
from twin.calibration.readings import Readings, read
from twin.calibration.wiring import refuse_miswired
from twin.config import Config
from twin.errors import ConfigError
from twin.model.dataset import DataSet
from twin.monitor.cycles import Cycle
from twin.monitor.measured_supply import supplied
from twin.monitor.surroundings import taken_in
from twin.quality import BREAK, UNUSABLE
from twin.signals import MBAR, MS, SAMPLE, Command, Samples, bridged

FEWEST = 5  # complete cycles
MOST_SPOILT = 0.02  # share of samples that are saturated, stale or bad
SLOWEST = 10.5 * MS  # s between rows; switching within a few rows would not be seen
MOST_MISSING = 0.2  # share of rows
# bar: the supply is reported if it differs by more from the configuration; gauges and regulators
# scatter by half of it.
SUPPLY_CLEARLY = 0.2
LITTLE_VACUUM = 200.0  # mbar; flow ejectors on leaking parts make more


@dataclass(frozen=True)
class Remark:
    """A contradiction of record and configuration, with the line to change."""

    text: str
    line: str


@dataclass(frozen=True)
class CheckedRecord:
    """A record that is wired as it says, and the configuration with what it measured."""

    config: Config  # with supply pressure and surroundings as measured
    samples: Samples  # without suctions that met no part
    readings: Readings
    remarks: tuple[Remark, ...]  # corrections that the record made so far


def checked(config: Config, blocks: Iterable[Samples]) -> CheckedRecord:
    """Read a record; ConfigError if rows are too few or spoilt, or the wiring is another."""
    samples = np.concatenate([np.empty(0, SAMPLE), *bridged(blocks)])
    refuse_empty(samples)
    refuse_spoilt(samples)
    samples, by_picks = picked(config.data, samples)
    readings = read(samples)
    refuse_unreadable(readings)
    gauged, by_gauge = as_gauged(config.data, samples)
    config = replace(config, data=taken_in(gauged, samples))
    refuse_miswired(samples, readings, config.data.ambient.pressure_mbar * MBAR)
    return CheckedRecord(config, samples, readings, (*by_picks, *by_gauge))


def picked(data: DataSet, samples: Samples) -> tuple[Samples, list[Remark]]:
    """``samples`` without suctions that met no part, and a remark if there are any."""
    with_part, empty = without_empty_picks(data, samples)
    if not empty:
        return samples, []
    left_out = (
        "1 suction met no part and was left out"
        if empty == 1
        else f"{empty} suctions met no part and were left out"
    )
    line = '[[data.system.parts]] kind = "vessel", if no part is picked up'
    return with_part, [Remark(left_out, line)]


def as_gauged(data: DataSet, samples: Samples) -> tuple[DataSet, list[Remark]]:
    """``data`` with the supply pressure that a gauge shows at rest, if there is one."""
    gauged = supplied(data, samples)
    measured, configured = gauged.supply.pressure_bar, data.supply.pressure_bar
    if abs(measured - configured) <= SUPPLY_CLEARLY:
        return gauged, []
    text = f"the supply reads {measured:g} bar; the configuration says {configured:g}"
    return gauged, [Remark(text, f"[data.supply] pressure_bar = {measured:g}")]


def questions(readings: Readings) -> Iterator[Remark]:
    """Remarks on what is unusual in the record, but possible."""
    if not readings.tells_blow_off:
        text = "no row of the record has blow-off; where the unit has one, its command is missing"
        yield Remark(text, "[driver.tags.blow_off], or the column blow_off")
    if (highest := (readings.highest - readings.deepest) / MBAR) < LITTLE_VACUUM:
        text = f"the vacuum is {highest:.0f} mbar at most, where ejectors make 300 and more"
        yield Remark(text, "[driver.tags.pressure] unit, if it is in kPa, mmHg or psi")


def refuse_empty(samples: Samples) -> None:
    """ConfigError if there is no suction."""
    if not (samples["commands"] == Command.SUCTION).any():
        raise ConfigError("the record has no suction", "check which tag or column is suction")


def refuse_spoilt(samples: Samples) -> None:
    """ConfigError if too many readings of the pressure cannot be used."""
    spoilt = np.isnan(samples["pressure"]) | ((samples["quality"] & UNUSABLE) != 0)
    if (share := float(np.mean(spoilt))) > MOST_SPOILT:
        raise ConfigError(
            f"the pressure is saturated, stale or bad in {share:.1%} of the samples",
            "check the sensor's range and wiring, then record again",
        )


def refuse_unreadable(readings: Readings) -> None:
    """ConfigError if rows are too far apart, or too many are missing."""
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


def refuse_insufficient(samples: Samples, cycles: Sequence[Cycle], purpose: str) -> None:
    """ConfigError if there are too few whole cycles for ``purpose``, which the message names."""
    breaks = int(np.count_nonzero(samples["quality"][1:] & BREAK))
    if breaks > len(cycles):
        raise ConfigError(
            f"the log has {breaks} gaps and {len(cycles)} cycles without one",
            "record again in block mode",
        )
    if len(cycles) < FEWEST:
        raise ConfigError(
            f"the log has {len(cycles)} complete cycles that count; {purpose} needs {FEWEST}",
            "record suction, blow-off and idle again and again without a gap",
        )
