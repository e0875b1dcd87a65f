"""Judge the extended model on another log, on which nothing was fitted or chosen."""

import math
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import ValidationError

from twin.config import Config
from twin.diagnosis.answer import Diagnosis, insufficient
from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis, read_again, read_cycles
from twin.diagnosis.extend import extended, has_rhythm
from twin.diagnosis.held_out import Judged, gain, judge
from twin.diagnosis.residual_covariance import covariance
from twin.errors import ConfigError, SourceError
from twin.log.header import LogHeader
from twin.model.courses import Cause
from twin.model.dataset import DataSet
from twin.monitor.bins import Floats
from twin.monitor.prediction_cache import LONGER, LONGER_MS
from twin.signals import MS, NS, Command, Samples

OF_A_ROW = 1.5  # rows by which a median may be off: commands are seen at the next row
# Phases of a rhythm that are tried on another log, at least; and in each pulse, since a pulse that
# is off by as much as it lasts explains nothing.
PHASES, IN_A_PULSE = 24, 4
STRETCHES = ("suction", "blow-off", "idle")
SUPPLY = ("supply", "pressure_bar")
# What a person changes on a rig between two logs. A sensor that counts from ambient counts from the
# ambient pressure of the configuration.
CONDITIONS = (
    SUPPLY,
    ("system", "parts"),
    ("sensor", "reference"),
    ("ambient", "pressure_mbar"),
)


def judged_on(
    diagnosis: Diagnosis,
    config: Config,
    log: str,
    blocks: Iterable[Samples],
    there: Config | None = None,
) -> dict[str, Any] | None:
    """Figures of the unchanged twin and of the extended model on ``log``; None without one.

    All whole cycles of the log count, whatever their program. ``there`` is the configuration under
    the conditions of that log (``conditions``). Intermittent causes are left out, and so are curves
    from data if the program is another: ``left_out`` says so. A rhythm begins anew in each log:
    every second cycle shows its phase, the others judge. Raises SourceError if the log has no cycle
    to judge by.
    """
    extended_model = extended(diagnosis, config)
    rhythmic = tuple(filter(has_rhythm, diagnosis.acting))
    if extended_model is None and not rhythmic:
        return None
    blocks, there = read_again(blocks), there or config
    read_before = read_cycles(there, blocks)
    before = read_before.whole()
    if reason := insufficient(read_before, before):
        raise SourceError(_nothing_judged(log, reason))
    left_out = _other_program(diagnosis, before) if diagnosis.terms else ""
    if left_out:
        extended_model = extended(replace(diagnosis, terms=()), config)
    other_config = there
    if extended_model is not None:
        monitor = config.monitor.model_copy(update={"healthy": extended_model.healthy})
        data = _with(extended_model.data, there.data, CONDITIONS, log)
        other_config = replace(config, data=data, monitor=monitor)
    read_after = read_cycles(other_config, blocks)
    after = read_after.whole()
    if reason := insufficient(read_after, after):
        raise SourceError(_nothing_judged(log, reason))
    cycles = sorted({*before.judged} & {*after.judged})
    if rhythmic:
        rhythmic, cycles = (_in_phase(after, cycles[::2], rhythmic[0]),), cycles[1::2]
    as_it_stands, with_causes = _judged(before, cycles), _judged(after, cycles, rhythmic)
    return {
        "log": log,
        "cycles": len(cycles),
        "baseline": as_it_stands.figures,
        "extended": with_causes.figures,
        "gain": gain(as_it_stands, with_causes),
        "left_out": left_out or None,
    }


def _nothing_judged(log: str, reason: str) -> str:
    return f"{log}: nothing can be judged on it: {reason}"


def conditions(config: Config, log: tuple[str, LogHeader], other: tuple[str, LogHeader]) -> Config:
    """``config`` with what the configuration in the other log has otherwise than that in ``log``.

    That is the supply, the parts, and what the pressure sensor counts from. What both logs say
    alike stays as in ``config``, which may be another one than theirs. ConfigError or SourceError
    if the configuration in a log cannot be read.
    """
    own, there = (_recorded(config, *named).data for named in (log, other))
    changed = {
        (table, key)
        for table, key in CONDITIONS
        if getattr(getattr(own, table), key) != getattr(getattr(there, table), key)
    }
    return replace(config, data=_with(config.data, there, changed, other[0]))


def _recorded(config: Config, log: str, header: LogHeader) -> Config:
    """The configuration in a log; ``config`` for its rows if it has none."""
    if header.config_text or "data" in header.metadata:
        return Config.of_recorded(header, log)
    return config.of_rows(header)


def _with(data: DataSet, other: DataSet, changed: Collection[tuple[str, str]], log: str) -> DataSet:
    """The data set with some values of another; ConfigError names the log if they do not fit."""
    try:
        if SUPPLY in changed:
            data = data.at_supply(other.supply.pressure_bar)
        tables, others = data.model_dump(), other.model_dump()
        for table, key in changed:
            tables[table][key] = others[table][key]
        if tables["sensor"]["reference"] != "gauge":
            tables["ambient"] = data.ambient.model_dump()  # an absolute reading shows the weather
        # A jet's ratios of pressures stay.
        ratio = tables["ambient"]["pressure_mbar"] / data.ambient.pressure_mbar
        for key in ("end_pressure_mbar", "suction_capacity_sl_min"):
            tables["ejector"][key] *= ratio
        return DataSet.model_validate(tables)
    except ValidationError as error:
        raise ConfigError(
            f"{log}: the twin cannot have the supply and the parts of its configuration:"
            f" {error.errors()[0]['msg']}",
            "diagnose that log by itself: twin diagnose",
        ) from error


def _other_program(diagnosis: Diagnosis, other: Evidence) -> str:
    """Why curves from data are left out on a log of another program; empty on the same program."""
    here, there = program(diagnosis.evidence), program(other)
    rows = max(_between_rows(diagnosis.evidence), _between_rows(other))
    differs = np.abs(there - here) > np.maximum(LONGER * here, max(LONGER_MS, OF_A_ROW * rows))
    if not differs.any():
        return ""
    lasts = (
        f"{name} lasts {there[i]:.0f} ms there and {here[i]:.0f} ms here"
        for i, name in enumerate(STRETCHES)
        if differs[i]
    )
    return f"the curve from data, which holds for its program of commands only: {', '.join(lasts)}"


def _between_rows(evidence: Evidence) -> float:
    """Median time (ms) from row to row."""
    return float(np.median(np.diff(evidence.samples["time_ns"]))) * NS / MS


def program(evidence: Evidence) -> Floats:
    """Median duration (ms) of suction, blow-off and idle in a cycle."""
    seconds = np.diff(evidence.samples["time_ns"], append=evidence.samples["time_ns"][-1:]) * NS
    commands = evidence.samples["commands"]
    durations = []
    for told in (Command.SUCTION, Command.BLOW_OFF, Command(0)):
        in_rows = np.where(commands == told, np.maximum(seconds, 0.0), 0.0)
        durations.append(np.add.reduceat(in_rows, evidence.starts[:-1]))
    medians: Floats = np.median(np.array(durations), axis=1) / MS
    return medians


def _judged(evidence: Evidence, cycles: list[int], rhythmic: Hypothesis = HEALTHY) -> Judged:
    return judge(evidence, covariance(evidence, rhythmic).of(cycles), rhythmic)


def _in_phase(evidence: Evidence, cycles: list[int], cause: Cause) -> Cause:
    """The rhythmic cause with the phase that suits some cycles of a log best."""
    period = cause.values["period"]
    shifts = np.linspace(0.0, period, _phases(cause), endpoint=False)
    causes = [replace(cause, values={**cause.values, "shift": float(s)}) for s in shifts]
    bins = np.isin(evidence.bins.cycle, cycles)
    off = evidence.off([(shifted,) for shifted in causes])[bins]
    squares = np.average(off**2, axis=0, weights=evidence.bins.count[bins])
    return causes[int(np.argmin(squares))]


def _phases(cause: Cause) -> int:
    """Number of phases of a rhythm that are tried; a swing is on for half of its period."""
    return max(PHASES, math.ceil(IN_A_PULSE * 100.0 / cause.values.get("duty", 50.0)))
