"""Savings as text, and for JSON."""

import math
from collections.abc import Sequence
from typing import Any

from twin.figures.costs import NL_PER_M3, NO_PRICE, Tariff
from twin.figures.costs_text import aligned, finite
from twin.figures.money import Interval, amount, significant
from twin.figures.savings import Prediction, Savings, Setting

UNCERTAIN = (
    "95 % intervals: by what calibration left open of the data set, and by how suction follows the"
    " supply. How much air the nozzle takes is the data sheet's"
)
NOT_KNOWN = (
    "no uncertainty is known: this unit was not calibrated, or its data set has no spread"
    " (twin calibrate)"
)


def savings_table(
    savings: Savings, cycles_a_year: float, tariff: Tariff, measured: Sequence[float]
) -> str:
    """The settings on offer, the greatest saving first; why others are refused; how sure.

    ``measured`` are the known air consumptions (Nl) of the log's cycles.
    """
    head = ["setting", "air (Nl a cycle)", f"saves ({_unit(tariff)} a year)", "t0 (ms)", "t1 (ms)"]
    head.append("above H2 (mbar)")
    rows = [
        _cells(prediction, cycles_a_year, tariff) for prediction in (savings.now, *savings.offered)
    ]
    rows[0][0], rows[0][2] = f"now: {rows[0][0]}", ""
    refused = [
        f"not offered: {in_words(prediction.setting)}: {prediction.refused}"
        for prediction in savings.refused
    ]
    remarks = [_model_error(savings.now.air, measured), _basis(cycles_a_year, tariff)]
    remarks.append(UNCERTAIN if savings.is_uncertainty_known else NOT_KNOWN)
    remarks += [NO_PRICE] if tariff.per_m3 is None else []
    return "\n".join([aligned([head, *rows]), *refused, *remarks])


def savings_plain(
    savings: Savings, cycles_a_year: float, tariff: Tariff, measured: Sequence[float]
) -> dict[str, Any]:
    """The same for JSON; null if unknown. Amounts are a year's, air is a cycle's."""
    return {
        "currency": tariff.currency,
        "price_per_m3": tariff.per_m3,
        "operating_hours": tariff.hours,
        "cycles_per_year": finite(cycles_a_year),
        "measured_air_nl": finite(_mean(measured)),
        "uncertainty_is_known": savings.is_uncertainty_known,
        "now": _plain(savings.now, cycles_a_year, tariff),
        "offered": [_plain(prediction, cycles_a_year, tariff) for prediction in savings.offered],
        "refused": [_plain(prediction, cycles_a_year, tariff) for prediction in savings.refused],
    }


def in_words(setting: Setting) -> str:
    """A setting as text."""
    return f"H1 {setting.h1:g}, hysteresis {setting.hysteresis:g} mbar, {setting.supply:g} bar"


def _unit(tariff: Tariff) -> str:
    return "m³" if tariff.per_m3 is None else tariff.currency


def _of_a_year(air: Interval, cycles_a_year: float, tariff: Tariff) -> Interval:
    """Air (Nl) of a cycle as money a year; without a price as m³ of air a year."""
    return air.times(cycles_a_year / NL_PER_M3 * (tariff.per_m3 or 1.0))


def _cells(prediction: Prediction, cycles_a_year: float, tariff: Tariff) -> list[str]:
    return [
        in_words(prediction.setting),
        f"{prediction.air:.3g}",
        _with_ends(_of_a_year(prediction.saved, cycles_a_year, tariff)),
        _time(prediction.t0),
        _time(prediction.t1),
        f"{prediction.margin.value:.0f}",
    ]


def _with_ends(values: Interval) -> str:
    text = amount(values.value)
    if math.isnan(values.low95):
        return text
    return f"{text} ({amount(values.low95)} to {amount(values.high95)})"


def _time(milliseconds: float) -> str:
    return "-" if math.isnan(milliseconds) else f"{milliseconds:.0f}"


def _model_error(air: float, measured: Sequence[float]) -> str:
    """The model's air with the present setting, relative to the log's own."""
    mean = _mean(measured)
    if not mean > 0.0:
        return "the log does not tell its own air: the model cannot be compared with it"
    return (
        f"of the log's own air ({mean:.3g} Nl a cycle) the model, which runs free, has"
        f" {100.0 * air / mean:.1f} %"
    )


def _basis(cycles_a_year: float, tariff: Tariff) -> str:
    return (
        f"a year is {tariff.hours:g} h at this log's rate, {significant(cycles_a_year)} cycles;"
        " commands stay as recorded"
    )


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values) if values else math.nan


def _plain(prediction: Prediction, cycles_a_year: float, tariff: Tariff) -> dict[str, Any]:
    priced = tariff.per_m3 is not None
    money = _of_a_year(prediction.saved, cycles_a_year, tariff) if priced else None
    return {
        "h1_mbar": prediction.setting.h1,
        "h1_hysteresis_mbar": prediction.setting.hysteresis,
        "supply_bar": prediction.setting.supply,
        "air_nl": finite(prediction.air),
        "saved_nl": _interval_plain(prediction.saved),
        "saved_money": None if money is None else _interval_plain(money),
        "t0_ms": finite(prediction.t0),
        "t1_ms": finite(prediction.t1),
        "margin_mbar": _interval_plain(prediction.margin),
        **({"why_not": prediction.refused} if prediction.refused else {}),
    }


def _interval_plain(values: Interval) -> dict[str, float | None]:
    return {name: finite(value) for name, value in values._asdict().items()}
