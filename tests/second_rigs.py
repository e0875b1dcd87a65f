"""Rigs of the second world as a person meets them: what can be read off, and a record's rows."""

from dataclasses import replace
from typing import Any

import numpy as np
from calibrations import typed
from scipy.signal import lfilter
from second_world.records import Record

from twin.config import Asset, Config
from twin.model.dataset import DataSet
from twin.signals import MBAR, SAMPLE, Command, Reported, Samples

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


def with_signals(logged: Record, slow_ms: float = 5.0) -> Samples:
    """The same with a flow meter, and a second pressure at the other end of the line.

    Both follow ``slow_ms`` later. The meter has noise, 1 %; the sensor reads 2 mbar and 0.3 % off.
    """
    rows, truth, rng = (
        samples_of(logged),
        logged.truth,
        np.random.default_rng(logged.truth.rig.seed),
    )
    at_vessel = truth.rig.sensor.place == "ejector"
    second = truth.vessel_pressure if at_vessel else truth.head_pressure
    keep = float(np.exp(-1.0 / slow_ms)) if slow_ms else 0.0
    when = np.round(logged.time_ns * 1e-6 - 1.0).astype(int).clip(0, len(second) - 1)
    flow, vacuum = (
        lfilter([1.0 - keep], [1.0, -keep], values)[when]
        for values in (truth.flow, truth.noted_ambient - second)
    )
    noise = rng.normal(0.0, 1.0, (2, len(rows)))
    rows["flow"] = flow + 0.01 * truth.flow.max() * noise[0]
    rows["reported"] |= np.uint8(Reported.FLOW_KNOWN)
    rows["pressure_2"] = truth.noted_ambient - 1.003 * vacuum + (2.0 + 0.4 * noise[1]) * MBAR
    return rows


def with_gauge(logged: Record) -> Samples:
    """The same with a gauge of the supply, 0.05 bar off, with noise of 10 mbar and its steps."""
    rows, truth = samples_of(logged), logged.truth
    rng = np.random.default_rng(truth.rig.seed)
    when = np.round(logged.time_ns * 1e-6 - 1.0).astype(int)
    gauge = truth.supply_pressure[when.clip(0, len(truth.supply_pressure) - 1)]
    gauge = gauge - truth.noted_ambient + 50.0 * MBAR + rng.normal(0.0, 10.0 * MBAR, len(rows))
    rows["supply"] = np.round(gauge / (10.0 * MBAR)) * 10.0 * MBAR
    return rows
