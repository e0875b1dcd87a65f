"""How often healthy cycles raise an alarm, at the rate that is set, beside what is wanted.

Healthy cycles of the simulated gripper go through twin, monitor and isolation as in the loop. One
false alarm in a month of 3 s cycles is one in 1.7 million of them. So the tail is measured in two
ways. Sums over cycles run over resampled blocks of these cycles, at the real limit. For single
cycles a generalised Pareto distribution is fitted to the farthest hundredth and extrapolated to the
limit.

    python -m tools.false_alarms [--devices 16] [--cycles 6000] [--drawn 30_000_000]
        [--write docs/isolation.md]
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2, genpareto

from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from tools.fault_run import ROOT
from tools.version import commit
from twin.config import Config
from twin.figures.cycle import KeyFigures
from twin.figures.settings import LIMITED, Limits, limits_of
from twin.live import Twin
from twin.monitor.baseline import LEARNED, Baseline
from twin.monitor.change_detection import ChangeDetector, limit
from twin.monitor.cycles import CycleCutter, CycleView, figures
from twin.monitor.false_alarm_budget import (
    LIMITS,
    SINGLE_CYCLES,
    SUMS,
    cycles_between,
    normal_limit,
)
from twin.monitor.isolation import Isolation, looked_for
from twin.settings import Document

Floats = npt.NDArray[np.float64]

CONFIG = ROOT / "configs" / "gripper.toml"
# Short, to have many cycles; blow-off is long enough to release each part.
PROGRAM = {"suction_ms": 800.0, "blow_off_ms": 220.0, "idle_ms": 250.0}
CYCLE_S = 1.3
DAYS, WANTED_CYCLE_S = 30.0, 3.0  # wanted time between false alarms; duration of a cycle for it
BLOCK = 100  # cycles in a row that are drawn together: gas and walls keep some heat
AT_ONCE = 2000  # devices
WITHIN = 1.5  # factor, either way, by which the rate may differ from the one that is set
FARTHEST = 0.01  # share of single cycles to which the tail is fitted
BEGIN = "<!-- false alarms: python -m tools.false_alarms --write docs/isolation.md -->"
END = "<!-- end -->"


@dataclass(frozen=True)
class Device:
    """Statistics of a device's healthy cycles after learning."""

    scores: Floats  # normal, (cycles, suspects)
    alike: Floats  # cosines between signatures
    farthest: Floats  # normal value of the figure that is farthest out, of each cycle
    shown: int  # figures
    key_figures: Floats  # those with limits, (cycles, figures)
    limits: Floats  # (2, figures), infinite without a limit


def device(seed: int, cycles: int) -> Device:
    """Run a device over healthy cycles."""
    document = Document.read(CONFIG)
    config, rig = Config.of(document), document.section(PlcSettings, "plc")
    rig = rig.model_copy(update={"program": rig.program.model_copy(update=PROGRAM)})
    healthy, smallest = config.monitor.healthy, config.monitor.smallest_mbar
    isolation, baseline = Isolation.of(config.data, healthy, days=1e9), Baseline(healthy)
    key_figure_source = KeyFigures(config.data, watch=config.monitor)
    scores, farthest, cosines, shown, key_figures = [], [], np.eye(0), 0, []
    for look in _looks(config, rig, (LEARNED + cycles) * CYCLE_S, seed):
        if (cycle_figures := key_figure_source.take(look.cycle)) is not None:
            key_figures.append([cycle_figures.measured[name] for name in LIMITED])
        (residual,) = isolation.extract([look])
        if residual is None:
            continue
        isolation.judge(residual)
        scored, normal = isolation.last_scores
        cosines = scored.alike()
        scores.append(normal)
        normal = baseline.normal(look.figures, smallest)
        baseline.learn(look.figures, normal)
        farthest.append(float(np.nanmax(np.abs(normal))))
        shown = int(np.isfinite(normal).sum())
    learned = np.array(scores[LEARNED:]), cosines, np.array(farthest[LEARNED:]), shown
    return Device(*learned, np.array(key_figures[LEARNED:]), _bounds(limits_of(config)))


def _bounds(limits: Limits) -> Floats:
    """Lower and upper limits, in the order of ``LIMITED``."""
    low, high = limits.supply
    nowhere = np.inf
    lower = [-nowhere, -nowhere, -nowhere, low, -nowhere]
    return np.array([lower, [limits.t1, limits.leakage, limits.free_flow, nowhere, high]])


def _looks(config: Config, rig: PlcSettings, seconds: float, seed: int) -> Iterator[CycleView]:
    twin, cutter = Twin.of(config.data), CycleCutter()
    for block in blocks(rig, seconds, seed=seed, block=20_000):
        for cycle in cutter.push(*twin.advance(block)):
            yield CycleView(
                cycle, None, figures(cycle, twin.theta), cycle.complete and cycle.settled
            )


@dataclass(frozen=True)
class Rate:
    """False alarms over the wanted number, with the 95 % interval."""

    what: str
    share: float  # of all
    times: float
    low: float
    high: float
    how: str


def of_sums(devices: Sequence[Device], drawn: int, seed: int) -> Rate:
    """Sums over resampled cycles, in blocks of one device each."""
    wanted = cycles_between(DAYS, SUMS, WANTED_CYCLE_S)
    rng, changes = np.random.default_rng(seed), _changes(devices)
    alarms, cycles = 0, 0
    changes.take(np.full((AT_ONCE, devices[0].scores.shape[1]), np.nan))  # as many as that
    while cycles < drawn:
        for normal in _block(devices, rng):
            changes.take(normal)
            raised = changes.log_sums >= limit(wanted)
            alarms += int(raised.sum())
            changes.begin_some(raised)
        cycles += BLOCK * AT_ONCE
        if sys.stderr.isatty():
            print(f"\r{cycles:,} of {drawn:,} drawn", end="", file=sys.stderr, flush=True)
    low = chi2.ppf(0.025, 2 * alarms) / 2 if alarms else 0.0
    high = chi2.ppf(0.975, 2 * alarms + 2) / 2
    times = np.array([alarms, low, high]) * wanted / cycles
    return Rate("sums over cycles", SUMS, *times.tolist(), f"{alarms} in {cycles:,} drawn cycles")


def _changes(devices: Sequence[Device]) -> ChangeDetector:
    changes = looked_for()
    changes.weigh(devices[0].alike)
    return changes


def _block(devices: Sequence[Device], rng: np.random.Generator) -> Floats:
    """Blocks of cycles for all devices at once, (cycles, devices, suspects)."""
    device_numbers = rng.integers(len(devices), size=AT_ONCE)
    share = rng.random(AT_ONCE)
    parts = []
    for number, position in zip(device_numbers, share, strict=True):
        scores = devices[number].scores
        begin = int(position * (len(scores) - BLOCK))
        parts.append(scores[begin : begin + BLOCK])
    return np.stack(parts, axis=1)


def of_single_cycles(devices: Sequence[Device], seed: int) -> Rate:
    """The tail of the figure that is farthest out, by extreme-value statistics."""
    wanted = cycles_between(DAYS, SINGLE_CYCLES, WANTED_CYCLE_S)
    farthest = np.concatenate([tested.farthest for tested in devices])
    limit = normal_limit(wanted, devices[0].shown)
    rng = np.random.default_rng(seed)
    resampled = [
        _beyond(farthest[rng.integers(len(farthest), size=len(farthest))], limit)
        for _ in range(200)
    ]
    low, high = np.quantile(resampled, (0.025, 0.975))
    how = (
        f"tail of {len(farthest):,} cycles, of which the farthest is"
        f" {farthest.max():.1f} of {limit:.1f} sigma"
    )
    times = np.array([_beyond(farthest, limit), low, high]) * wanted
    return Rate("single cycles", SINGLE_CYCLES, *times.tolist(), how)


def of_limits(devices: Sequence[Device], seed: int) -> Rate:
    """The tail of the key figure that is nearest to its limit, in its standard deviations."""
    wanted = cycles_between(DAYS, LIMITS, WANTED_CYCLE_S)
    values = np.concatenate([tested.key_figures for tested in devices])
    shown = np.isfinite(values).any(axis=0)  # no part is open while it is sucked: no free flow
    values, (low, high) = values[:, shown], devices[0].limits[:, shown]
    sigma = np.nanstd(values, axis=0)
    nearest = np.nanmax(np.maximum(values - high, low - values) / sigma, axis=1)
    rng = np.random.default_rng(seed)
    resampled = [
        _beyond(nearest[rng.integers(len(nearest), size=len(nearest))], 0.0) for _ in range(200)
    ]
    how = (
        f"tail of {len(nearest):,} cycles, of which the nearest is"
        f" {-nearest.max():.0f} sigma from it"
    )
    times = np.array([_beyond(nearest, 0.0), *np.quantile(resampled, (0.025, 0.975))]) * wanted
    return Rate("limits of key figures", LIMITS, *times.tolist(), how)


def _beyond(values: Floats, limit: float) -> float:
    """Share of cycles beyond a limit, by a distribution fitted to the farthest."""
    threshold = float(np.quantile(values, 1.0 - FARTHEST))
    over = values[values > threshold] - threshold
    shape, _, scale = genpareto.fit(over, floc=0.0)
    return FARTHEST * float(genpareto.sf(limit - threshold, shape, scale=scale))


def total_of(rates: Sequence[Rate]) -> float:
    """False alarms of all paths over the wanted number."""
    return sum(rate.share * rate.times for rate in rates)


def is_as_set(rates: Sequence[Rate]) -> bool:
    """Whether the rate is the one that is set, within a factor of ``WITHIN`` either way."""
    return 1.0 / WITHIN <= total_of(rates) <= WITHIN


def table(rates: Sequence[Rate], cycles: int) -> str:
    """The rates as a table for the page."""
    total = total_of(rates)
    lines = [
        f"**{commit()}, {cycles:,} simulated healthy cycles of the gripper: {total:.2f} times as"
        f" many false alarms as are wanted, asked for {1.0 / WITHIN:.2f} to {WITHIN:g}:"
        f" {'kept' if is_as_set(rates) else 'not kept'}.**",
        "",
        "| what | of the budget | found over wanted | 95 % | from |",
        "| --- | --- | --- | --- | --- |",
        *(
            f"| {rate.what} | {rate.share:.0%} | {rate.times:.2g} |"
            f" {rate.low:.2g} to {rate.high:.2g} |"
            f" {rate.how} |"
            for rate in rates
        ),
    ]
    return "\n".join(lines)


def main() -> int:
    """Run from the command line; 1 if the total is not as set, too many or too few."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--devices", type=int, default=16)
    parser.add_argument("--cycles", type=int, default=6000, help="of each device")
    parser.add_argument("--drawn", type=int, default=30_000_000, help="cycles that sums run over")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--write", type=Path, help="the page with a place for the table")
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + arguments.devices)
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as workers:
        devices = list(workers.map(device, seeds, [arguments.cycles] * arguments.devices))
    rates = [
        of_sums(devices, arguments.drawn, arguments.seed),
        of_single_cycles(devices, arguments.seed),
        of_limits(devices, arguments.seed),
    ]
    text_table = table(rates, sum(len(rate.scores) for rate in devices))
    print(text_table)
    if arguments.write:
        text = arguments.write.read_text(encoding="utf-8")
        before, rest = text.split(BEGIN)
        after = rest.split(END, 1)[1]
        text = f"{before}{BEGIN}\n{text_table}\n{END}{after}"
        arguments.write.write_text(text, encoding="utf-8")
    return 0 if is_as_set(rates) else 1


if __name__ == "__main__":
    sys.exit(main())
