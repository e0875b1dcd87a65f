"""What a record shows without a fit, in words: each value with its unit and where it is from."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from twin.calibration.commission import Commissioned
from twin.calibration.parameters import AMBIENT
from twin.languages.texts import numeral, tr
from twin.monitor.signal_checks import APART
from twin.signals import MBAR, MS


@dataclass(frozen=True)
class ReadOff:
    """One value that was read off a record, or that had to be assumed.

    ``name`` and ``known_from`` are in the chosen language, ``key`` and ``source`` for programs.
    """

    key: str
    name: str
    value: float | bool
    unit: str
    source: str  # record, assumed, barometer, idle or fit
    digits: int = 0  # after the point

    @property
    def shown(self) -> str:
        """The value as people read it."""
        if isinstance(self.value, bool):
            return tr("yes") if self.value else tr("no")
        return numeral(self.value, f".{self.digits}f")

    @property
    def known_from(self) -> str:
        """Where the value is from, in words."""
        return {
            "record": tr("record"),
            "assumed": tr("assumed"),
            "barometer": tr("barometer"),
            "idle": tr("idle of the opened system"),
            "fit": tr("fit"),
        }[self.source]


def read_off(commissioned: Commissioned) -> Iterator[ReadOff]:
    """Thresholds, surroundings, and how the record was sampled; levels are vacuum in mbar."""
    readings, data = commissioned.readings, commissioned.calibration.fitted.data
    ejector, ambient = data.ejector, data.ambient.pressure_mbar
    saves = readings.saves_air

    def source(*, shown: bool) -> str:
        return "record" if shown else "assumed"

    yield ReadOff(
        "air_saving", tr("air saving (the nozzle goes off by itself)"), saves, "", "record"
    )
    h1, h2, hysteresis = ejector.h1_mbar, ejector.h2_mbar, ejector.h1_hysteresis_mbar
    yield ReadOff("h1", tr("H1 (the nozzle goes off)"), h1, "mbar", source(shown=saves))
    yield ReadOff(
        "h1_hysteresis",
        tr("hysteresis (it goes on again so far below H1)"),
        hysteresis,
        "mbar",
        source(shown=saves and bool(np.isfinite(readings.on))),
    )
    part = bool(np.isfinite(readings.part))
    yield ReadOff("h2", tr("H2 (a part is present)"), h2, "mbar", source(shown=part))
    highest = ambient - readings.deepest / MBAR
    yield ReadOff("highest_vacuum", tr("highest vacuum"), highest, "mbar", "record")
    yield ReadOff("ambient", tr("ambient pressure"), ambient, "mbar", _ambient_from(commissioned))
    noise, step = readings.noise / MBAR, readings.step / MBAR
    yield ReadOff("noise", tr("noise of a reading (one sigma)"), noise, "mbar", "record", 2)
    yield ReadOff("converter_step", tr("step of the converter"), step, "mbar", "record", 2)
    yield ReadOff("sampling", tr("sampling time"), readings.period / MS, "ms", "record", 1)
    yield ReadOff("missing", tr("missing rows"), 100.0 * readings.missing, "%", "record", 1)


def _ambient_from(commissioned: Commissioned) -> str:
    """The source of ambient pressure; a barometer that contradicts the idle is not used.

    A sensor that counts from ambient shows none: without a barometer its idle is the configured
    ambient pressure.
    """
    readings, fitted = commissioned.readings, commissioned.calibration.fitted
    if fitted.data.sensor.reference == "gauge" and not np.isfinite(readings.barometer):
        return "assumed"
    if readings.opened and not abs(readings.idle - readings.barometer) <= APART:
        return "idle"
    if np.isfinite(readings.barometer):
        return "barometer"
    return "fit" if AMBIENT.name in [free.name for free in fitted.free] else "assumed"
