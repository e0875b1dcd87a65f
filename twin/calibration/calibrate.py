"""Calibration: healthy cycles in, instance-specific data set out, or a reason why not."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from twin.calibration.cycles import Cycles
from twin.calibration.empty_picks import without_empty_picks
from twin.calibration.fit import Fitted, fit
from twin.calibration.parameters import FREE, Space
from twin.calibration.readings import read
from twin.calibration.stationarity import check_stationary
from twin.calibration.verdict import Verdict, judge
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
from twin.monitor.detector_window import select_window
from twin.monitor.healthy import Healthy, Scatter, sure
from twin.monitor.measured_supply import SUPPLY, is_gauge, supplied
from twin.monitor.signal_checks import Contradiction, standing
from twin.monitor.surroundings import taken_in
from twin.quality import BREAK, UNUSABLE
from twin.signals import MBAR, SAMPLE, Command, Phase, Samples, bridged

FEWEST = 5  # complete cycles
MOST_FITTED = 12  # cycles that are fitted; the others only show the scatter
MOST_SPOILT = 0.02  # share of samples that are saturated, stale or bad
MOST_LEFT = 15.0  # mbar rms: a larger residual means that the log is not of such an ejector
LEAST_SCATTER = 0.05  # of a figure, in its unit
NOTHING: Mapping[str, float] = MappingProxyType({})
# bar: the supply is reported if it differs by more from the configuration; gauges and regulators
# scatter by half of it.
SUPPLY_CLEARLY = 0.2


@dataclass(frozen=True)
class Remark:
    """A contradiction of record and configuration, with the line to change."""

    text: str
    line: str


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration: the fit of one unit, its verdict, and the healthy scatter."""

    fitted: Fitted
    verdict: Verdict
    healthy: Healthy
    cycles: int
    first_ns: int  # host time of the log's first and last row
    last_ns: int
    remarks: tuple[Remark, ...] = ()  # corrections that the record made; Commissioned has its own


def calibrate(
    config: Config, blocks: Iterable[Samples], progress: Callable[[str], None]
) -> Calibration:
    """Calibrate the unit of ``config`` on a log, starting from its data set.

    Raises ConfigError if the log does not suffice or is not that of a healthy unit.
    """
    progress("reading the log")
    samples = np.concatenate([np.empty(0, SAMPLE), *bridged(blocks)])
    samples, by_picks = picked(config.data, samples)
    gauged, by_gauge = as_gauged(config.data, samples)
    config = replace(config, data=taken_in(gauged, samples))
    before = complete(config.data, samples)
    refuse_insufficient(samples, before, "calibration")
    refuse_contradicting(before, config.data)
    samples = samples[samples["time_ns"] <= before[-1].end_ns]
    used = samples["time_ns"] <= before[:MOST_FITTED][-1].end_ns
    fitted = fit(samples[used], Space.of_type(config.data), progress)
    refuse_rounded(fitted.data, samples)
    progress("what healthy cycles scatter")
    cycles = complete(fitted.data, samples)
    check_unchanged(fitted.data, samples, cycles)
    check_within_type(fitted, config.data)
    progress("judging the fit")
    verdict = judge(Cycles.found(samples[used], fitted.data), fitted.data, read(samples).noise)
    healthy = like_these(config, fitted, scatter(fitted.data, cycles), samples)
    times = samples["host_ns"]
    ends = int(times[0]), int(times[-1])
    return Calibration(fitted, verdict, healthy, len(cycles), *ends, (*by_picks, *by_gauge))


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


def complete(data: DataSet, samples: Samples) -> list[Cycle]:
    """Complete cycles with the twin of ``data``, without the first, in which it settles."""
    return [cycle for cycle in whole(Twin.of(data).over([samples])) if cycle.settled]


def refuse_insufficient(samples: Samples, cycles: Sequence[Cycle], purpose: str) -> None:
    """ConfigError if there is not enough for ``purpose``, which the message names."""
    if not (samples["commands"] & Command.SUCTION).any():
        raise ConfigError("the log has no suction phase", "check which tag is suction")
    spoilt = np.isnan(samples["pressure"]) | ((samples["quality"] & UNUSABLE) != 0)
    if (share := float(np.mean(spoilt))) > MOST_SPOILT:
        raise ConfigError(
            f"the pressure is saturated, stale or bad in {share:.1%} of the samples",
            "check the sensor's range and wiring, then record again",
        )
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


def refuse_contradicting(cycles: Sequence[Cycle], data: DataSet) -> None:
    """ConfigError if the reported nozzle contradicts the pressure."""
    for contradiction in contradictions(cycles, data):
        if contradiction.signal == "nozzle":
            raise ConfigError(contradiction.what, f"{contradiction.action}; or leave the tag out")


def contradictions(cycles: Sequence[Cycle], data: DataSet) -> list[Contradiction]:
    """Signals of a record that its pressure contradicts."""
    twin = Twin.of(data)
    return standing(cycles, twin.theta, twin.detector)


def refuse_rounded(data: DataSet, samples: Samples) -> None:
    """ConfigError if a twin of ``data`` would not see the nozzle go off in each cycle."""
    detector = Twin.of(data).detector
    if select_window(detector, [samples]) != detector:
        raise ConfigError(
            "the air saving's switching is too round in this log to be seen in each cycle: the"
            f" pressure comes slower than a lag of {data.sensor.lag_ms:.3g} ms explains",
            "set [data.sensor] lag_ms to that of sensor and PLC input together, or choose a faster"
            " input filter and record again",
        )


def check_within_type(fitted: Fitted, data: DataSet) -> None:
    """ConfigError if the fit is no healthy unit of its type."""
    if fitted.left > MOST_LEFT * MBAR:
        raise ConfigError(
            f"the model cannot follow this log: {fitted.left / MBAR:.0f} mbar rms are left",
            "check [data.system] against what hangs on the ejector; twin diagnose says more",
        )
    for free in FREE:
        value, expected, sigma = free.of(fitted.data), free.of(data), free.sigma(data)
        low, high = free.healthy or (np.inf, np.inf)
        if not -low * sigma <= value - expected <= high * sigma:
            raise ConfigError(
                f"this log is not that of a healthy unit: {free.name} would be {value:.3g}"
                f" {free.unit}, where {max(expected - low * sigma, free.low):.3g} to"
                f" {expected + high * sigma:.3g} is healthy for its type",
                "repair first (twin diagnose names the cause), or set the value in [data] if it is"
                " as built",
            )


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
