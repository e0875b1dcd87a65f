"""Results of a calibration, for people and for programs."""

from collections.abc import Iterator, Sequence
from typing import Any

from twin.assets.record import Record
from twin.calibration.calibrate import Calibration
from twin.calibration.commission import Commissioned
from twin.calibration.doubts import Doubt
from twin.calibration.read_off import read_off
from twin.calibration.record_checks import Remark
from twin.calibration.verdict import WEAKENS, Residual, Verdict
from twin.config import Asset
from twin.diagnosis.text import spoken
from twin.errors import TwinError
from twin.languages.texts import numeral, tr
from twin.signals import MBAR, MS, Phase

CALIBRATION, COMMISSIONING = "ejector-twin-calibration/1", "ejector-twin-commissioning/1"


def in_words(calibration: Calibration) -> str:
    """How close the model came and the verdict on that, then the parameters."""
    lines = [
        calibration_headline(calibration),
        calibration_verdict(calibration.verdict),
        *_doubts(calibration.doubts),
        *_corrections(calibration.remarks),
        "",
        *_residuals(calibration.verdict),
        "",
        _values(calibration),
    ]
    return "\n".join(lines)


def _doubts(doubts: Sequence[Doubt]) -> Iterator[str]:
    """Why the record may not be of a healthy unit, each with what to do."""
    for doubt in doubts:
        yield from ("", f"is the unit healthy? {doubt.text}", f"  {doubt.action}")


def _corrections(remarks: Sequence[Remark]) -> Iterator[str]:
    """What the record corrected, each with the line to write."""
    for remark in remarks:
        yield from ("", f"the record contradicts the configuration: {remark.text}")
        yield f"  the record's value is used; write: {remark.line}"


def _residuals(verdict: Verdict) -> list[str]:
    """What is left in each phase beside the floor of the record."""
    return [
        f"{phase.name.lower().replace('_', '-'):<10}{residual.left / MBAR:>7.2f} mbar rms off;"
        f" this record cannot be followed nearer than {residual.floor / MBAR:.2f}"
        for phase, residual in verdict.residuals.items()
    ]


def _values(calibration: Calibration) -> str:
    """A table of the parameters (value, 95 % interval and source), and the healthy deviation."""
    fitted = calibration.fitted
    lines = [
        f"{'parameter':<34}{'value':>9}   {'95 % interval':<19}{'unit':<11}from",
    ]
    for free, is_determined in zip(fitted.free, fitted.determined, strict=True):
        low, high = (f"{bound:.4g}" for bound in fitted.interval(free.name))
        source = "log" if is_determined else "type"
        lines.append(
            f"{free.name:<34}{free.of(fitted.data):>9.4g}   {low + ' to ' + high:<19}"
            f"{free.unit:<11}{source}"
        )
    lines += ["", "healthy deviation, mbar rms: " + ", ".join(_scatter(calibration))]
    return "\n".join(lines)


def calibration_headline(calibration: Calibration) -> str:
    """How many cycles were fitted, and how close the model came."""
    left = calibration.fitted.left / MBAR
    return f"{calibration.cycles} healthy cycles; the model is {left:.2f} mbar rms off"


def calibration_verdict(verdict: Verdict) -> str:
    """The verdict on a calibration in a word, and what it rests on."""
    return f"{tr(verdict.word)}: {'. '.join(calibration_sentences(verdict))}"


def calibration_sentences(verdict: Verdict) -> list[str]:
    """What the verdict on a calibration rests on, and what follows; none ends in a full stop."""
    if verdict.word != "refused":
        return sentences(verdict)
    return [
        _beyond(verdict),
        tr("Nothing is stored: causes would be named wrongly"),
        tr(
            "Commands, unit and sign look right. What is left may be a part, a volume or a filter"
            " of the sensor that [data] describes otherwise, something that the model does not"
            " have, or a fault of the unit"
        ),
        tr(
            "twin commission tries more: other places of the sensor, other tubes, and parts that"
            " leave in another way"
        ),
        tr("What needs no twin: twin figures, twin compare"),
    ]


def _scatter(calibration: Calibration) -> list[str]:
    phases = [(phase.name.lower(), f"{phase.name.lower()}_rms") for phase in Phase]
    healthy = calibration.healthy.figures
    return [
        f"{phase.replace('_', '-')} {healthy[name].mean:.2f}"
        for phase, name in phases
        if name in healthy
    ]


def as_json(calibration: Calibration, asset: Asset, record: Record | None) -> dict[str, Any]:
    """The calibration for programs; ``data`` is included even if it is refused."""
    return {
        "format": CALIBRATION,
        "asset": {"type": asset.type, "id": asset.id},
        "record": record.id if record else None,
        "cycles": calibration.cycles,
        "left_mbar": calibration.fitted.left / MBAR,
        "verdict": calibration.verdict.word,
        **_refused_because(calibration.verdict),
        "residual": residuals_as_json(calibration.verdict),
        "contradicts": _contradicts(calibration.remarks),
        "doubts": _doubts_as_json(calibration.doubts),
        "parameters": parameters(calibration),
        "healthy": calibration.healthy.model_dump(mode="json"),
        "data": calibration.fitted.data.model_dump(),
    }


def _doubts_as_json(doubts: Sequence[Doubt]) -> list[dict[str, str]]:
    """For programs, why the record may not be of a healthy unit."""
    return [{"what": doubt.text, "do": doubt.action} for doubt in doubts]


def _contradicts(remarks: Sequence[Remark]) -> list[dict[str, str]]:
    """For programs, what the record corrected."""
    return [{"what": remark.text, "line": remark.line} for remark in remarks]


def residuals_as_json(verdict: Verdict) -> dict[str, dict[str, float]]:
    """What is left in each phase beside the floor of the record, and the largest of it."""
    return {
        phase.name.lower(): {
            "left_mbar": residual.left / MBAR,
            "floor_mbar": residual.floor / MBAR,
            "times": residual.times,
            "most_mbar": residual.most / MBAR,
            "at_ms": residual.at / MS,
        }
        for phase, residual in verdict.residuals.items()
    }


def parameters(calibration: Calibration) -> dict[str, dict[str, Any]]:
    """Each parameter's value with its unit, 95 % interval, and whether the log determines it."""
    fitted = calibration.fitted
    by_name = {}
    for free, is_determined in zip(fitted.free, fitted.determined, strict=True):
        low, high = fitted.interval(free.name)
        by_name[free.name] = {
            "value": free.of(fitted.data),
            "unit": free.unit,
            "low95": low,
            "high95": high,
            "determined": bool(is_determined),
        }
    return by_name


def commissioned_in_words(commissioned: Commissioned) -> str:
    """The verdict, the record's corrections, the parameters and the assumed values."""
    lines = [headline(commissioned.verdict), ""]
    lines += _residuals(commissioned.verdict)
    if commissioned.verdict.word == "refused":
        lines += ["", to_check()]
    lines += _doubts(commissioned.doubts)
    lines += _corrections(commissioned.remarks)
    for contradiction in commissioned.contradictions:
        lines += [
            "",
            f"a signal contradicts the pressure ({contradiction.signal}): {contradiction.what}",
        ]
        lines += [f"  {contradiction.action}"]
    lines += ["", "read off the record:"]
    lines += [
        f"  {entry.name:<50}{entry.shown:>8} {entry.unit:<5}{entry.known_from}"
        for entry in read_off(commissioned)
    ]
    calibration = commissioned.calibration
    lines += ["", calibration_headline(calibration), "", _values(calibration)]
    if commissioned.unseen:
        lines += ["", commissioned.unseen]
    if commissioned.assumed:
        lines += ["", f"not shown by this record, assumed: {', '.join(commissioned.assumed)}"]
    return "\n".join(lines)


def headline(verdict: Verdict) -> str:
    """The verdict in a word, and what it rests on."""
    return f"{tr(verdict.word)}: {'. '.join(sentences(verdict))}"


def sentences(verdict: Verdict) -> list[str]:
    """What the verdict rests on, and what follows from it; none ends in a full stop."""
    if verdict.word == "good":
        return [tr("the twin follows this record as closely as its cycles follow each other")]
    beyond = _beyond(verdict)
    if verdict.word == "usable":
        return [beyond, tr("Causes that act there are named less surely")]
    return [
        beyond,
        tr("Nothing is stored: causes would be named wrongly"),
        tr(
            "Commands, unit and sign look right, and the fit makes up for rough volumes and tubes."
            " What is left may be something that the model does not have, a part that"
            " [data.system.parts] does not list, or a fault of the unit"
        ),
        tr("What needs no twin: twin figures, twin compare"),
    ]


def to_check() -> str:
    """What a person can check after a refused fit; without a full stop."""
    return tr(
        "Check in [data.system.parts] hoses (length, inner diameter), volumes, and whether parts"
        " are released (cups) or stay (vessel); check on the machine whether the unit is healthy"
    )


def _beyond(verdict: Verdict) -> str:
    """That the twin is off by more than its cycles differ, and in which phases."""
    weak = "; ".join(_weak(phase, verdict.residuals[phase]) for phase in verdict.weak)
    return tr("the twin is off by more than its cycles differ: {weak}", weak=weak)


def _weak(phase: Phase, residual: Residual) -> str:
    """The residual of a phase, its largest value, and the causes that it concerns."""
    values = {
        "times": numeral(residual.times, ".1f"),
        "phase": spoken(phase.name.lower()),
        "size": numeral(abs(residual.most) / MBAR, ".1f"),
        "time": numeral(residual.at / MS, ".0f"),
        "causes": tr(WEAKENS[phase]),
    }
    if residual.most > 0.0:
        return tr(
            "{times} times in {phase}, at most {size} mbar measured above expected, {time} ms after"
            " it begins ({causes})",
            **values,
        )
    return tr(
        "{times} times in {phase}, at most {size} mbar measured below expected, {time} ms after it"
        " begins ({causes})",
        **values,
    )


def commissioned_as_json(
    commissioned: Commissioned, asset: Asset, record: Record | None
) -> dict[str, Any]:
    """The commissioning for programs; ``data`` is included even if it is refused."""
    fitted = commissioned.calibration.fitted
    return {
        "format": COMMISSIONING,
        "asset": {"type": asset.type, "id": asset.id},
        "record": record.id if record else None,
        "verdict": commissioned.verdict.word,
        **_refused_because(commissioned.verdict),
        "residual": residuals_as_json(commissioned.verdict),
        "contradicts": _contradicts(commissioned.remarks),
        "doubts": _doubts_as_json(commissioned.doubts),
        "signals": [
            {"signal": contradiction.signal, "what": contradiction.what, "do": contradiction.action}
            for contradiction in commissioned.contradictions
        ],
        "read_off": {
            entry.key: {"value": entry.value, "unit": entry.unit, "from": entry.source}
            for entry in read_off(commissioned)
        },
        "assumed": commissioned.assumed,
        "unseen": commissioned.unseen,
        "cycles": commissioned.calibration.cycles,
        "parameters": parameters(commissioned.calibration),
        "data": fitted.data.model_dump(),
    }


def _refused_because(verdict: Verdict) -> dict[str, str]:
    """Reason of a refused fit, and what to do; nothing of another verdict."""
    if verdict.word != "refused":
        return {}
    return {"reason": sentences(verdict)[0], "do": to_check()}


def refusal_as_json(
    error: TwinError, asset: Asset, answer_format: str = COMMISSIONING
) -> dict[str, Any]:
    """The refusal for programs; it has the same first keys as an answer of ``answer_format``."""
    return {
        "format": answer_format,
        "asset": {"type": asset.type, "id": asset.id},
        "record": None,
        "verdict": "refused",
        "reason": str(error),
        "do": error.hint,
    }
