"""Fit the [data] tables of a configuration to healthy cycles of its own simulated rig.

    python tools/fit_rig.py configs/test_rig.toml

prints TOML: the data set that makes the model follow that rig best, and what its healthy cycles
scatter. The shipped configurations were made with it; rerun it when the model's physics change.
"""

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares, minimize_scalar

from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from twin.config import Asset, Config, LogSettings
from twin.diagnosis.evidence import Evidence, collect
from twin.live import Twin
from twin.model.dataset import AMBIENT, DataSet, coefficients
from twin.monitor.cycles import CycleCutter, figures
from twin.monitor.detect import MonitorSettings, Scatter
from twin.monitor.phases import PhaseFinder, expected_knees
from twin.monitor.signatures import expect
from twin.settings import Document
from twin.signals import MBAR, Phase, Samples

# What the fit may move: table, key, step that matters, bounds. Volume and wall area are trusted.
FREE = (
    ("ejector", "suction_capacity_sl_min", 2.0, 10.0, 80.0),
    ("ejector", "end_pressure_mbar", 10.0, 30.0, 500.0),
    ("ejector", "bulge", 0.2, -0.5, 2.0),
    ("ejector", "skew", 0.2, -2.0, 2.0),
    ("ejector", "response_ms", 2.0, 0.0, 60.0),
    ("ejector", "ramp_up_ms", 2.0, 1.0, 60.0),
    ("ejector", "ramp_down_ms", 2.0, 1.0, 8.0),
    ("vessel", "film_coefficient", 3.0, 0.0, 100.0),
    ("vessel", "line_drop_mbar", 10.0, 0.0, 600.0),
    ("vessel", "leak_sl_min", 0.1, 0.0, 3.0),
    ("sensor", "lag_ms", 1.0, 1.0, 30.0),
    ("ejector", "blow_off_sl_min", 10.0, 5.0, 500.0),
    ("ejector", "blow_off_response_ms", 2.0, 0.0, 60.0),
    ("ejector", "blow_off_ramp_ms", 2.0, 1.0, 60.0),
    ("ejector", "relief_sl_min", 20.0, 0.0, 2000.0),
)
# Weights by phase (idle, suction, hold, blow-off): evacuation first, then blow-off, then all.
STAGES = (
    ((0.0, 1.0, 1.0, 0.0), FREE[:11]),
    ((0.3, 0.05, 0.05, 1.0), FREE[11:]),
    ((1.0, 1.0, 1.0, 0.5), FREE),
    ((1.0, 1.0, 1.0, 0.5), FREE),  # again: the knees follow the jet and the sensor
)
Tables = dict[str, dict[str, float]]


def main() -> None:
    """Fit and print."""
    document = Document.read(Path(sys.argv[1]))
    rig = document.section(PlcSettings, "plc")
    start = document.section(DataSet, "data")
    samples = np.concatenate(list(blocks(rig, duration_s=40.0, seed=7)))
    tables = {name: dict(table) for name, table in start.model_dump().items()}
    for weights, free in STAGES:
        tables = fit(tables, samples, np.array(weights), free)
    data = DataSet.model_validate(tables)
    data = time_response(healthy_evidence(document, data, rig, seed=8), data)
    evidence = healthy_evidence(document, data, rig, seed=9)
    print_tables(data)
    print_healthy(evidence)


def healthy_evidence(document: Document, data: DataSet, rig: PlcSettings, seed: int) -> Evidence:
    """Healthy cycles of the rig, judged by the scatter of others."""
    cycles = np.concatenate(list(blocks(rig, duration_s=300.0, seed=seed + 100)))
    healthy = healthy_figures(data, cycles)
    config = Config(document, Asset(), data, MonitorSettings(healthy=healthy), LogSettings())
    return collect(config, blocks(rig, duration_s=60.0, seed=seed))


def time_response(evidence: Evidence, data: DataSet) -> DataSet:
    """Move the response to where healthy cycles show no delay, in sigmas of their scatter.

    The rig's jet builds up in another shape than the model's; least squares in mbar splits the
    difference, and a diagnosis would find a delay of a millisecond or two in every healthy log.
    """

    def moved(response_ms: float) -> DataSet:
        ejector = data.ejector.model_copy(update={"response_ms": response_ms})
        return data.model_copy(update={"ejector": ejector})

    def misfit(response_ms: float) -> float:
        residuals = evidence.residuals([(0, coefficients(moved(response_ms)))])
        return sum(float(part @ part) for part in residuals)

    now = data.ejector.response_ms
    best = minimize_scalar(misfit, bounds=(max(now - 6.0, 0.0), now + 6.0), method="bounded")
    print(f"# response {now:.2f} -> {best.x:.2f} ms", file=sys.stderr)
    return moved(float(best.x))


def fit(
    tables: Tables,
    samples: Samples,
    weights: npt.NDArray[np.float64],
    free: tuple[tuple[str, str, float, float, float], ...],
) -> Tables:
    """Return ``tables`` with the free values that follow the measured pressure best."""
    data = DataSet.model_validate(tables)
    theta = coefficients(data)
    finder = PhaseFinder(expected_knees(theta, data.sensor.noise_mbar * MBAR))
    found = (finder.push(samples), finder.flush())
    rows, phase, level = (np.concatenate(column) for column in zip(*found, strict=True))
    scale = np.array([step for _, _, step, _, _ in free])
    low = np.array([low for _, _, _, low, _ in free])
    high = np.array([high for _, _, _, _, high in free])

    def moved(values: npt.NDArray[np.float64]) -> Tables:
        changed = {name: dict(table) for name, table in tables.items()}
        for (table, key, *_), value in zip(free, values, strict=True):
            changed[table][key] = float(value)
        return changed

    def residual(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        expected = expect(coefficients(DataSet.model_validate(moved(values))), rows, phase, level)
        off = (rows["pressure"] - expected) / MBAR * weights[phase]
        return np.where(np.isfinite(off), off, 0.0)[::2]

    def jacobian(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        at = residual(values)
        steps = np.where(values + 1e-2 * scale < high, 1e-2, -1e-2) * scale
        moves = np.diag(steps)
        return np.stack([(residual(values + move) - at) for move in moves], axis=1) / steps

    first = np.clip([tables[table][key] for table, key, *_ in free], low + 1e-9, high - 1e-9)
    best = least_squares(
        residual, first, jacobian, (low, high), x_scale=scale, loss="soft_l1", f_scale=2.0
    )
    rms = float(np.sqrt(np.mean(residual(best.x) ** 2)))
    print(f"# weights {weights}: {rms:.2f} mbar rms after {best.nfev} evaluations", file=sys.stderr)
    return moved(best.x)


def print_tables(data: DataSet) -> None:
    """Print the data set as TOML."""
    for name, table in data.model_dump().items():
        print(f"\n[data.{name}]")
        for key, value in table.items():
            if value is not None:
                print(f"{key} = {round(value, 3)}")


def print_healthy(evidence: Evidence) -> None:
    """Print what healthy cycles scatter, and what the whitened residuals have left."""
    off = evidence.off(evidence.expect([(0, evidence.theta)]))
    left = [float(np.sqrt(np.mean(evidence.whitened(off, one) ** 2))) for one in evidence.judged]
    healthy = dict(evidence.healthy) | {"leftover": (float(np.mean(left)), float(np.std(left)))}
    print("\n[monitor.healthy]")
    for name, (mean, sigma) in healthy.items():
        print(f"{name} = {{ mean = {mean:.3f}, sigma = {sigma:.3f} }}")


def healthy_figures(data: DataSet, samples: Samples) -> dict[str, Scatter]:
    """Mean and scatter of every figure over the complete cycles of healthy ``samples``."""
    theta = coefficients(data)
    twin = Twin(theta, expected_knees(theta, data.sensor.noise_mbar * MBAR))
    cutter = CycleCutter()
    cycles = [*cutter.push(*twin.advance(samples)), *cutter.push(*twin.flush()), *cutter.flush()]
    found = [figures(cycle, theta[AMBIENT]) for cycle in cycles if cycle.complete][1:]
    judged = [f"{phase.name.lower()}_{kind}" for phase in Phase for kind in ("mean", "rms")]
    scatter = {}
    for name in [*judged, "h1_level", "h1_low_level"]:
        values = [one[name] for one in found if name in one]
        if len(values) >= 10:
            sigma = max(float(np.std(values, ddof=1)), 0.02)
            scatter[name] = Scatter(mean=float(np.mean(values)), sigma=sigma)
    return scatter


if __name__ == "__main__":
    main()
