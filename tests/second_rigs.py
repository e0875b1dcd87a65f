"""Rigs of the second world as a person meets them: what can be read off, and a record's rows."""

from dataclasses import replace
from typing import Any

import numpy as np
from calibrations import typed
from second_world.records import Record

from twin.config import Asset, Config
from twin.model.dataset import DataSet
from twin.signals import SAMPLE, Command, Samples

UNKNOWN_TYPE = "nobody-knows-40"


def known(value: Any, otherwise: float) -> float:
    return otherwise if value == "unknown" else float(value)


def config_of(truth: dict[str, Any]) -> Config:
    """What a person read off the machine, a fifth off or unknown, of a type that nobody knows."""
    ambient = known(truth["ambient_mbar"], 1013.0)
    hose = {
        "kind": "tube",
        "length_mm": 1e3 * known(truth["hose_length_m"], 1.0),
        "diameter_mm": known(truth["hose_diameter_mm"], 6.0),
    }
    kind = "cups" if truth["part_released"] else "vessel"
    end = {"kind": kind, "volume_ml": known(truth["vessel_ml"], 300.0)}
    parts = [{"kind": "sensor"}, hose, end]
    if truth["sensor_place"] != "ejector":
        parts = [hose, {"kind": "sensor"}, end]
    supply = known(truth["supply_bar"], 5.0)
    data = {
        "ambient": {"pressure_mbar": ambient},
        "supply": {"pressure_bar": supply, "optimum_bar": supply},
        "ejector": {"air_saving": "on" if truth["air_saving"] else "off"},
        "system": {"parts": parts},
    }
    asset = Asset(type=UNKNOWN_TYPE, id="unit-1")
    return replace(typed("test_rig"), asset=asset, data=DataSet.model_validate(data))


def samples_of(logged: Record) -> Samples:
    """A record as it would be imported, its missing rows unflagged."""
    rows = np.zeros(len(logged.time_ns), SAMPLE)
    rows["time_ns"] = rows["host_ns"] = logged.time_ns
    period = np.median(np.diff(logged.time_ns))
    rows["sequence"] = np.round((logged.time_ns - logged.time_ns[0]) / period)
    rows["commands"] = logged.suction * np.uint8(Command.SUCTION)
    rows["commands"] |= logged.blow_off * np.uint8(Command.BLOW_OFF)
    rows["pressure"], rows["supply"] = logged.pressure_pa, np.nan
    return rows
