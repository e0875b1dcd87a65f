"""What a calibration found, for people and for programs."""

from typing import Any

from twin.assets.record import Record
from twin.calibration.calibrate import Calibration
from twin.calibration.parameters import FREE
from twin.signals import MBAR, Phase


def in_words(calibration: Calibration) -> str:
    """A table of the parameters: value, 95 % interval, and where each comes from."""
    fitted = calibration.fitted
    lines = [
        f"{calibration.cycles} healthy cycles; the model is {fitted.left / MBAR:.2f} mbar rms off",
        "",
        f"{'parameter':<34}{'value':>9}   {'95 % interval':<19}{'unit':<11}from",
    ]
    for free, known in zip(FREE, fitted.determined, strict=True):
        low, high = (f"{bound:.4g}" for bound in fitted.interval(free.name))
        source = "log" if known else "type"
        lines.append(
            f"{free.name:<34}{free.of(fitted.data):>9.4g}   {low + ' to ' + high:<19}"
            f"{free.unit:<11}{source}"
        )
    lines += ["", "healthy deviation, mbar rms: " + ", ".join(_scatter(calibration))]
    return "\n".join(lines)


def _scatter(calibration: Calibration) -> list[str]:
    phases = [(phase.name.lower(), f"{phase.name.lower()}_rms") for phase in Phase]
    healthy = calibration.healthy.figures
    return [
        f"{phase.replace('_', '-')} {healthy[name].mean:.2f}"
        for phase, name in phases
        if name in healthy
    ]


def as_json(calibration: Calibration, record: Record) -> dict[str, Any]:
    """The same for programs, with the data set as it was stored."""
    return {
        "format": "ejector-twin-calibration/1",
        "asset": {"type": record.type, "id": record.name},
        "record": record.id,
        "cycles": calibration.cycles,
        "left_mbar": calibration.fitted.left / MBAR,
        "parameters": parameters(calibration),
        "healthy": dict(record.healthy),
        "data": dict(record.data),
    }


def parameters(calibration: Calibration) -> dict[str, dict[str, Any]]:
    """Each parameter's value with its unit, 95 % interval, and whether the log determines it."""
    fitted = calibration.fitted
    found = {}
    for free, known in zip(FREE, fitted.determined, strict=True):
        low, high = fitted.interval(free.name)
        found[free.name] = {
            "value": free.of(fitted.data),
            "unit": free.unit,
            "low95": low,
            "high95": high,
            "determined": bool(known),
        }
    return found
