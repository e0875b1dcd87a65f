"""What a calibration found, for people and for programs."""

from typing import Any

from twin.assets.record import Record
from twin.calibration.calibrate import Calibration
from twin.calibration.commission import Commissioned
from twin.calibration.verdict import WEAKENS, Residual, Verdict
from twin.config import Asset
from twin.signals import MBAR, MS, Phase


def in_words(calibration: Calibration) -> str:
    """A table of the parameters: value, 95 % interval, and where each comes from."""
    fitted = calibration.fitted
    lines = [
        f"{calibration.cycles} healthy cycles; the model is {fitted.left / MBAR:.2f} mbar rms off",
        "",
        f"{'parameter':<34}{'value':>9}   {'95 % interval':<19}{'unit':<11}from",
    ]
    for free, known in zip(fitted.free, fitted.determined, strict=True):
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
    for free, known in zip(fitted.free, fitted.determined, strict=True):
        low, high = fitted.interval(free.name)
        found[free.name] = {
            "value": free.of(fitted.data),
            "unit": free.unit,
            "low95": low,
            "high95": high,
            "determined": bool(known),
        }
    return found


def commissioned_in_words(found: Commissioned) -> str:
    """The verdict, what the record corrects, what was found and what was assumed."""
    lines = [headline(found.verdict), ""]
    lines += [
        f"{phase.name.lower().replace('_', '-'):<10}{one.left / MBAR:>7.2f} mbar rms off;"
        f" this record cannot be followed nearer than {one.floor / MBAR:.2f}"
        for phase, one in found.verdict.residuals.items()
    ]
    for remark in found.remarks:
        lines += ["", f"the record contradicts the configuration: {remark.text}"]
        lines += [f"  the record's value is used; write: {remark.line}"]
    for one in found.contradictions:
        lines += ["", f"a signal contradicts the pressure ({one.signal}): {one.what}"]
        lines += [f"  {one.action}"]
    lines += ["", in_words(found.calibration)]
    if found.unseen:
        lines += ["", found.unseen]
    if found.assumed:
        lines += ["", f"not shown by this record, assumed: {', '.join(found.assumed)}"]
    return "\n".join(lines)


def headline(verdict: Verdict) -> str:
    """The verdict in a sentence or two."""
    if verdict.word == "good":
        return "good: the twin follows this record as closely as its cycles follow each other"
    weak = "; ".join(_weak(phase, verdict.residuals[phase]) for phase in verdict.weak)
    beyond = f"the twin is off by more than its cycles differ: {weak}"
    if verdict.word == "usable":
        return f"usable: {beyond}. Causes that act there are named less surely"
    return (
        f"refused: {beyond}. Nothing is stored: causes would be named wrongly. Commands, unit and"
        " sign look right, and the fit makes up for rough volumes and tubes. So something hangs on"
        " the ejector that [data.system.parts] does not list, or the unit has a fault already, or"
        " it does what the model has not. What needs no twin: twin figures, twin compare"
    )


def _weak(phase: Phase, one: Residual) -> str:
    """What is left in a phase, where most, and which causes that concerns."""
    side = "above" if one.most > 0.0 else "below"
    return (
        f"{one.times:.1f} times in {phase.name.lower().replace('_', '-')}, at most"
        f" {abs(one.most) / MBAR:.1f} mbar measured {side} expected, {one.at / MS:.0f} ms after it"
        f" begins ({WEAKENS[phase]})"
    )


def commissioned_as_json(
    found: Commissioned, asset: Asset, record: Record | None
) -> dict[str, Any]:
    """The same for programs; ``data`` is there even where it is refused."""
    fitted = found.calibration.fitted
    return {
        "format": "ejector-twin-commissioning/1",
        "asset": {"type": asset.type, "id": asset.id},
        "record": record.id if record else None,
        "verdict": found.verdict.word,
        "residual": {
            phase.name.lower(): {
                "left_mbar": one.left / MBAR,
                "floor_mbar": one.floor / MBAR,
                "times": one.times,
                "most_mbar": one.most / MBAR,
                "at_ms": one.at / MS,
            }
            for phase, one in found.verdict.residuals.items()
        },
        "contradicts": [{"what": one.text, "line": one.line} for one in found.remarks],
        "signals": [
            {"signal": one.signal, "what": one.what, "do": one.action}
            for one in found.contradictions
        ],
        "assumed": found.assumed,
        "unseen": found.unseen,
        "cycles": found.calibration.cycles,
        "parameters": parameters(found.calibration),
        "data": fitted.data.model_dump(),
    }
