"""Calibration: healthy cycles in, instance-specific data set out, or a reason why not."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from twin.calibration.cycles import Cycles
from twin.calibration.doubts import Doubt, healthy_range, measured_doubts
from twin.calibration.fit import Fitted, fit
from twin.calibration.market_fit import judged, market_fit
from twin.calibration.parameters import FREE, FREE_IN_MARKET, Free, Space, values
from twin.calibration.record_checks import (
    FEWEST,
    Remark,
    checked,
    questions,
    refuse_insufficient,
)
from twin.calibration.stationarity import check_one_group, check_stationary
from twin.calibration.verdict import Verdict
from twin.config import Config
from twin.diagnosis.evidence import collect
from twin.diagnosis.healthy import learned
from twin.errors import ConfigError
from twin.figures.cycle import KeyFigures
from twin.figures.settings import LIMITED
from twin.live import Twin
from twin.model.dataset import DataSet, coefficients
from twin.monitor.breakpoints import converter_step, rounding_error
from twin.monitor.cycles import Cycle, figures, whole
from twin.monitor.healthy import Healthy, Scatter, sure
from twin.monitor.measured_supply import SUPPLY, is_gauge
from twin.monitor.signal_checks import Contradiction, standing
from twin.quality import UNUSABLE
from twin.signals import MBAR, Phase, Samples

MOST_FITTED = 12  # cycles that are fitted; the others only show the scatter
LEAST_SCATTER = 0.05  # of a figure, in its unit
NOTHING: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration: the fit of one unit, its verdict, and the healthy scatter."""

    fitted: Fitted
    verdict: Verdict
    healthy: Healthy
    cycles: int
    first_ns: int  # host time of the log's first and last row
    last_ns: int
    # Corrections that the record made, and doubts that it is of a healthy unit; Commissioned has
    # its own.
    remarks: tuple[Remark, ...] = ()
    doubts: tuple[Doubt, ...] = ()


def calibrate(
    config: Config, blocks: Iterable[Samples], progress: Callable[[str], None]
) -> Calibration:
    """Calibrate the unit of ``config`` on a log, starting from its data set.

    It stays near the type if the twin then follows the log. If not, all is fitted that a
    commissioning fits, beginning from there. Raises ConfigError if the log does not suffice or is
    not that of a healthy unit. A caller must check the ``verdict`` before storing the result.
    """
    progress("reading the log")
    record = checked(config, blocks)
    config, samples, readings = record.config, record.samples, record.readings
    before = complete(config.data, samples)
    refuse_insufficient(samples, before, "calibration")
    refuse_contradicting(before, config.data)
    samples = samples[samples["time_ns"] <= before[-1].end_ns]
    used = samples[samples["time_ns"] <= before[:MOST_FITTED][-1].end_ns]
    fitted = fit(used, Space.of_type(config.data), progress)
    progress("what healthy cycles scatter")
    check_unchanged(fitted.data, samples, complete(fitted.data, samples))
    fitted, found_cycles, verdict = judged(samples, readings.noise, fitted, progress)
    check_one_group(found_cycles)
    if verdict.word == "refused":
        progress("more is left than the cycles differ: fitting all that ejectors differ by")
        wider = market_fit(used, [fitted.data], FREE_IN_MARKET, progress)
        wider_verdict = judged(samples, readings.noise, wider, progress)[-1]
        if wider_verdict.worst < verdict.worst:
            fitted, verdict = wider, wider_verdict
    if verdict.word != "refused":
        check_within_type(fitted, config.data)
    cycles = complete(fitted.data, samples)
    healthy = like_these(config, fitted, scatter(fitted.data, cycles), samples)
    return Calibration(
        fitted,
        verdict,
        healthy,
        len(cycles),
        first_ns=int(samples["host_ns"][0]),
        last_ns=int(samples["host_ns"][-1]),
        remarks=(*record.remarks, *questions(readings)),
        doubts=tuple(measured_doubts(config.data, readings, healthy)),
    )


def complete(data: DataSet, samples: Samples) -> list[Cycle]:
    """Complete cycles with the twin of ``data``, without the first, in which it settles."""
    return [cycle for cycle in whole(Twin.of(data).over([samples])) if cycle.settled]


def refuse_contradicting(cycles: Sequence[Cycle], data: DataSet) -> None:
    """ConfigError if the reported nozzle contradicts the pressure."""
    for contradiction in contradictions(cycles, data):
        if contradiction.signal == "nozzle":
            raise ConfigError(contradiction.what, f"{contradiction.action}; or leave the tag out")


def contradictions(cycles: Sequence[Cycle], data: DataSet) -> list[Contradiction]:
    """Signals of a record that its pressure contradicts."""
    twin = Twin.of(data)
    return standing(cycles, twin.theta, twin.detector)


def check_within_type(fitted: Fitted, data: DataSet) -> None:
    """ConfigError if the fit is no healthy unit of its type; names the value farthest beyond."""
    limited_free = [free for free in FREE if free.healthy is not None]
    free = max(limited_free, key=lambda free: _excess(free, fitted.data, data))
    if _excess(free, fitted.data, data) > 0.0:
        value, (low, high) = free.of(fitted.data), healthy_range(free, data)
        size = f"{value:.3g} {free.unit}".strip()
        raise ConfigError(
            f"this log is not that of a healthy unit: {free.name} would be {size}, where"
            f" {low:.3g} to {high:.3g} is healthy for its type",
            "repair first (twin diagnose names the cause), or set the value in [data] if it is"
            " as built",
        )


def _excess(free: Free, fitted: DataSet, data: DataSet) -> float:
    """Sigmas by which a value is beyond what is healthy for the type ``data``; below 0 within."""
    value, (low, high) = free.of(fitted), healthy_range(free, data)
    return max(value - high, low - value) / free.sigma(data)


def check_unchanged(data: DataSet, samples: Samples, cycles: Sequence[Cycle]) -> None:
    """ConfigError if something came or went while the log was recorded."""
    theta = coefficients(data)
    cycle_figures = [figures(cycle, theta) for cycle in cycles]
    check_stationary(
        Cycles.as_live(samples, data), theta, data.sensor.noise_in_means() * MBAR, cycle_figures
    )


def scatter(data: DataSet, cycles: Sequence[Cycle]) -> dict[str, Scatter]:
    """Mean and scatter of every figure of healthy cycles.

    A few cycles show their scatter only roughly: each sigma is an upper bound that holds with SURE.
    """
    theta = coefficients(data)
    cycle_figures = [figures(cycle, theta) for cycle in cycles]
    names = [f"{phase.name.lower()}_{kind}" for phase in Phase for kind in ("mean", "rms")]
    by_name = {
        name: np.array(
            [values_of_cycle[name] for values_of_cycle in cycle_figures if name in values_of_cycle]
        )
        for name in [*names, "h1_level", "h1_low_level"]
    }
    return {name: _scatter(values) for name, values in by_name.items() if len(values) >= FEWEST}


def _scatter(values: npt.NDArray[np.float64]) -> Scatter:
    sigma = max(float(np.std(values, ddof=1)) * sure(len(values)), LEAST_SCATTER)
    return Scatter(mean=float(np.mean(values)), sigma=sigma, cycles=len(values))


def uncertain(fitted: Fitted, untold: Mapping[str, float]) -> dict[str, tuple[float, ...]]:
    """Factor of the covariance that the log leaves to the data set, as ``Healthy`` has it.

    ``untold`` has sigmas of values that no log shows and nobody configured.
    """
    factor = block_diag(fitted.factor, np.diag([*untold.values()]))
    names = [*(free.name for free in fitted.free), *untold]
    return {
        name: tuple(float(f"{change:.4g}") for change in row[: number + 1])
        for number, (name, row) in enumerate(zip(names, factor, strict=True))
    }


def _leaky(fitted: Fitted) -> dict[str, float]:
    """Changes of values to a larger leak with more suction, if that fits as well."""
    if fitted.leaky is None:
        return {}
    changes = values(fitted.leaky, fitted.free) - values(fitted.data, fitted.free)
    names = [free.name for free in fitted.free]
    return {name: float(f"{change:.4g}") for name, change in zip(names, changes, strict=True)}


def like_these(
    config: Config,
    fitted: Fitted,
    figures: dict[str, Scatter],
    samples: Samples,
    untold: Mapping[str, float] = NOTHING,
) -> Healthy:
    """Healthy deviations from the calibrated twin; ``untold`` as in ``uncertain``."""
    model_scatter = Healthy(
        figures=figures,
        uncertain=uncertain(fitted, untold),
        leaky=_leaky(fitted),
        rounding_mbar=rounding(fitted.data, samples),
    )
    monitor = config.monitor.model_copy(update={"healthy": model_scatter})
    healthy = learned(collect(replace(config, data=fitted.data, monitor=monitor), [samples]))
    return healthy.model_copy(update={"key_figures": limited(fitted.data, samples)})


def rounding(data: DataSet, samples: Samples) -> float:
    """What rounding leaves (mbar, one sigma) in a mean of the readings of one pressure."""
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(samples["pressure"])
    step = converter_step(samples["pressure"][usable].astype(np.float64)) / MBAR
    return round(rounding_error(step, data.sensor.noise_mbar), 4)


def limited(data: DataSet, samples: Samples) -> dict[str, Scatter]:
    """Scatter of a healthy record's limited key figures that at least FEWEST cycles have.

    A measured supply is among them: what a gauge reads later is compared with it.
    """
    key_figures = KeyFigures(data)
    told_cycles = [*filter(None, map(key_figures.take, whole(Twin.of(data).over([samples]))))]
    names = (*LIMITED, SUPPLY) if is_gauge(samples) else LIMITED
    by_name = {name: np.array([cycle.measured[name] for cycle in told_cycles]) for name in names}
    by_name = {name: values[np.isfinite(values)] for name, values in by_name.items()}
    return {name: _scatter(values) for name, values in by_name.items() if len(values) >= FEWEST}
