"""How often healthy cycles raise an alarm, at the rate that is set, beside what is wanted.

Healthy cycles of the simulated gripper go through twin and monitor as in the loop. One false alarm
in a month of 3 s cycles is one in 0.9 million of them, and of single cycles one in 17 million. So
the tail is measured in two ways. Sums run at the real limit over cycles that are drawn from these
by importance sampling. For single cycles and the limits of key figures a generalised Pareto
distribution is fitted to the farthest tenth and extrapolated to the limit. Intervals are those of
95 %, from devices or cycles drawn anew. That of the total is the sum of their ends, and so wider.

Cycles are drawn independently and scores are standardised: what this leaves out, as a correlation
of cycles far apart or an offset of one device, is not in the result.

A simulated device is kept in a folder, so that a run that was stopped goes on where it was. Sources
without a commit, or that differ from it, are simulated each time.

    nice -n 19 python -m tools.false_alarms [--devices 16] [--cycles 2500] [--workers 2]
        [--keep FOLDER] [--write docs/isolation.md]
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import genpareto

from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from tools.fault_run import ROOT
from tools.importance_sampling import Weighing, times_wanted
from tools.version import commit
from twin.calibration.calibrate import limited
from twin.cli.setup import pair_of
from twin.config import Config
from twin.events import Event, Kind
from twin.figures.settings import LIMITED, Limits, limits_of
from twin.files import private_folder, user_cache
from twin.model import theta as c
from twin.monitor.baseline import LEARNED, Baseline
from twin.monitor.false_alarm_budget import (
    LIMITS,
    SINGLE_CYCLES,
    SUMS,
    cycles_between,
    normal_limit,
)
from twin.monitor.isolation import CycleScores, Isolation, Verdict, looked_for
from twin.monitor.model_bank import SUSPECTS, ModelBank
from twin.monitor.statistics import ScoreExtractor
from twin.settings import Document
from twin.signals import joined

Floats = npt.NDArray[np.float64]

CONFIG = ROOT / "configs" / "gripper.toml"
# Short, to have many cycles; blow-off is long enough to release each part.
PROGRAM = {"suction_ms": 800.0, "blow_off_ms": 220.0, "idle_ms": 250.0}
CYCLE_S = 1.3
COMMISSIONED_S = 83.0  # 64 cycles: as many as the shipped unit's figures come from
DAYS, WANTED_CYCLE_S = 30.0, 3.0  # wanted time between false alarms; duration of a cycle for it
AFTER = 1_000_000  # difference of the seeds of a device's commissioning
NEVER_DAYS = 1e9  # sums go on, to be judged here
WITHIN = 1.5  # factor, either way, by which the rate may differ from the one that is set
FARTHEST = 0.1  # share of single cycles to which the tail is fitted
RUNS = 1500  # runs to an alarm: the mean of so many is known to 2 %
RESAMPLES = 100  # of cycles, for an interval of 95 %
DRAWN_ANEW = 20  # times that devices are drawn anew for an interval of 95 %
BEGIN = "<!-- false alarms: python -m tools.false_alarms --write docs/isolation.md -->"
END = "<!-- end -->"
# Which rate an alarm of the rules belongs to. Others are no judgement of healthy cycles' figures.
PATH_OF = {
    "deviation": "sums and single cycles",
    "t1_over_limit": "limits",
    "leakage_over_limit": "limits",
    "free_flow_too_high": "limits",
    "supply_out_of_range": "limits",
    "h1_not_reached": "counted",
    "valve_protection": "counted",
    "signal_contradicts": "counted",
    "plc_stale": "stream",
    "signal_bad": "stream",
    "output_down": "stream",
}
COUNTED = tuple(name for name, path in PATH_OF.items() if path == "counted")


@dataclass(frozen=True)
class Device:
    """What a device's healthy cycles after learning show."""

    scores: Floats  # normal, (cycles, suspects)
    alike: Floats  # cosines between signatures
    farthest: Floats  # normal value of the figure that is farthest out, of each cycle
    shown: int  # figures
    key_figures: Floats  # those with limits, (cycles, figures)
    limits: Floats  # (2, figures), infinite without a limit
    counted: int  # other alarms: cycles with a warning of COUNTED, or a signal that contradicts


class _Recording(Isolation):
    """Keeps the scores of each cycle."""

    def __init__(self, bank: ModelBank, extractor: ScoreExtractor, days: float) -> None:
        super().__init__(bank, extractor, days)
        self.normal: list[Floats] = []

    def judge(
        self, cycle: CycleScores, far: float = 0.0, *, begins: bool = False
    ) -> Verdict | None:
        """Judge as the loop does."""
        verdict = super().judge(cycle, far, begins=begins)
        self.normal.append(self.last_scores[1])
        return verdict


def device(seed: int, cycles: int) -> Device:
    """Run a device over healthy cycles; its key figures are commissioned on a record before."""
    config, rig = _commissioned(seed)
    twin, monitor = pair_of(config)
    isolation = _Recording.of(config.data, config.monitor.healthy, NEVER_DAYS)
    monitor.isolation = isolation
    seconds = (LEARNED + cycles) * CYCLE_S
    events = list[Event]()
    for block in blocks(rig, seconds, seed=seed, block=20_000):
        block["temperature"] = twin.theta[c.TEMPERATURE]  # without, sums leave a hall's out
        events += monitor.update(*twin.advance(block))
    summaries = [event.data for event in events if event.kind is Kind.CYCLE]
    farthest, shown = _farthest(config, [data for data in summaries if "probabilities" in data])
    key_figures = [[data.get(f"{name}_measured", np.nan) for name in LIMITED] for data in summaries]
    warned = sum(name in COUNTED for data in summaries for name in data.get("warnings", ()))
    contradicted = sum(event.kind is Kind.SIGNAL_CONTRADICTS for event in events)
    return Device(
        np.array(isolation.normal[LEARNED:]),
        isolation.last_scores[0].alike(),
        farthest[LEARNED:],
        shown,
        np.array(key_figures[LEARNED:]),
        _bounds(limits_of(config)),
        warned + contradicted,
    )


def _commissioned(seed: int) -> tuple[Config, PlcSettings]:
    """The unit with its key figures as a commissioning would have them, and its rig."""
    document = Document.read(CONFIG)
    config, rig = Config.of(document), document.section(PlcSettings, "plc")
    rig = rig.model_copy(update={"program": rig.program.model_copy(update=PROGRAM)})
    record = joined(*blocks(rig, COMMISSIONED_S, seed=seed + AFTER))
    healthy = config.monitor.healthy
    key_figures = {
        name: scatter for name, scatter in limited(config.data, record).items() if name in LIMITED
    }
    healthy = healthy.model_copy(update={"key_figures": key_figures})
    monitor = config.monitor.model_copy(update={"healthy": healthy})
    return replace(config, monitor=monitor), rig


def _farthest(config: Config, cycles: Sequence[Mapping[str, Any]]) -> tuple[Floats, int]:
    """Normal value of each cycle's farthest figure, and how many figures a cycle has."""
    baseline, farthest, shown = Baseline(config.monitor.healthy), [], 0
    for cycle in cycles:
        figures = {name: float(cycle[name]) for name in baseline.names if name in cycle}
        normal = baseline.normal(figures, config.monitor.smallest_mbar, {})
        baseline.learn(figures, normal)
        farthest.append(float(np.nanmax(np.abs(normal))))
        shown = len(figures)
    return np.array(farthest), shown


def _bounds(limits: Limits) -> Floats:
    """Lower and upper limits, in the order of ``LIMITED``."""
    low, high = limits.supply
    nowhere = np.inf
    lower = [-nowhere, -nowhere, -nowhere, low, -nowhere]
    return np.array([lower, [limits.t1, limits.leakage, limits.free_flow, nowhere, high]])


@dataclass(frozen=True)
class Rate:
    """False alarms over the wanted number, with the 95 % interval."""

    what: str
    share: float  # of all
    times: float
    low: float
    high: float
    how: str


def of_sums(
    devices: Sequence[Device], seed: int, *, runs: int = RUNS, anew: int = DRAWN_ANEW
) -> Rate:
    """Sums over cycles by importance sampling; the interval by devices drawn anew."""
    rng = np.random.default_rng(seed)
    whole, drawn_anew = _sampled(devices, rng, runs), []
    for number in range(anew):
        chosen = rng.integers(len(devices), size=len(devices))
        drawn_anew.append(_sampled([devices[index] for index in chosen], rng, runs // 3))
        _progress(f"devices drawn anew {number + 1} of {anew}")
    low, high = np.quantile(drawn_anew, (0.025, 0.975))
    how = f"importance sampling of {sum(len(tested.scores) for tested in devices):,} cycles"
    return Rate("sums over cycles", SUMS, whole, float(low), float(high), how)


def _sampled(devices: Sequence[Device], rng: np.random.Generator, runs: int) -> float:
    """Alarms of sums over the wanted number, of cycles of these devices."""
    both_ways = np.array([suspect.both_ways for suspect in SUSPECTS])
    often = np.array([suspect.often for suspect in SUSPECTS])
    changes, weighing = looked_for(), Weighing(both_ways, often)
    for detector in (changes, weighing):
        detector.weigh(devices[0].alike)
    scores = _standard(np.concatenate([tested.scores for tested in devices]))
    wanted = cycles_between(DAYS, SUMS, WANTED_CYCLE_S)
    return times_wanted(scores, changes, weighing, wanted, rng, runs)


def _standard(scores: Floats) -> Floats:
    """Scores with mean 0 and sigma 1 over all cycles; a suspect that no cycle shows stays NaN.

    A detector goes on learning, so that its scores have both in the long run. What they are off in
    a few thousand cycles is chance, but it would last for the whole month that is drawn from them.
    """
    shown = np.isfinite(scores).any(axis=0)
    standard = np.full_like(scores, np.nan)
    here = scores[:, shown]
    standard[:, shown] = (here - np.nanmean(here, axis=0)) / np.nanstd(here, axis=0)
    return standard


def of_single_cycles(devices: Sequence[Device], seed: int) -> Rate:
    """The tail of the figure that is farthest out, by extreme-value statistics."""
    wanted = cycles_between(DAYS, SINGLE_CYCLES, WANTED_CYCLE_S)
    farthest = np.concatenate([tested.farthest for tested in devices])
    limit = normal_limit(wanted, devices[0].shown)
    rng = np.random.default_rng(seed)
    resampled = [
        _beyond(farthest[rng.integers(len(farthest), size=len(farthest))], limit)
        for _ in range(RESAMPLES)
    ]
    low, high = np.quantile(resampled, (0.025, 0.975))
    how = (
        f"tail of {len(farthest):,} cycles, of which the farthest is"
        f" {farthest.max():.1f} of {limit:.1f} sigma"
    )
    times = np.array([_beyond(farthest, limit), low, high]) * wanted
    return Rate("single cycles", SINGLE_CYCLES, *times.tolist(), how)


def of_limits(devices: Sequence[Device], seed: int, *, resamples: int = RESAMPLES) -> Rate:
    """The tail of the key figure that is nearest to its limit."""
    wanted = cycles_between(DAYS, LIMITS, WANTED_CYCLE_S)
    nearest = np.concatenate([_nearest(tested) for tested in devices])
    rng = np.random.default_rng(seed)
    resampled = [
        _beyond(nearest[rng.integers(len(nearest), size=len(nearest))], 1.0)
        for _ in range(resamples)
    ]
    how = (
        f"tail of {len(nearest):,} cycles, of which the farthest is"
        f" {nearest.max():.0%} of the way from usual to its limit"
    )
    times = np.array([_beyond(nearest, 1.0), *np.quantile(resampled, (0.025, 0.975))]) * wanted
    return Rate("limits of key figures", LIMITS, *times.tolist(), how)


def _nearest(tested: Device) -> Floats:
    """How far each cycle's key figures are from usual: share of the way to the nearest limit."""
    shown = np.isfinite(tested.key_figures).any(axis=0)  # without an open cup there is no free flow
    values, limits = tested.key_figures[:, shown], tested.limits[:, shown]
    usual = np.nanmean(values, axis=0)
    nearest: Floats = np.nanmax((values - usual) / (limits - usual)[:, None], axis=(0, 2))
    return nearest


def _beyond(values: Floats, limit: float) -> float:
    """Share of cycles beyond a limit, by a distribution fitted to the farthest.

    Their squares are fitted: those of a normal value have an exponential tail, which a Pareto
    distribution has with a shape near zero.
    """
    squares = np.maximum(values, 0.0) ** 2
    threshold = float(np.quantile(squares, 1.0 - FARTHEST))
    over = squares[squares > threshold] - threshold
    shape, _, scale = genpareto.fit(over, floc=0.0)
    return FARTHEST * float(genpareto.sf(limit**2 - threshold, shape, scale=scale))


def total_of(rates: Sequence[Rate]) -> float:
    """False alarms of all paths over the wanted number."""
    return sum(rate.share * rate.times for rate in rates)


def is_as_set(rates: Sequence[Rate]) -> bool:
    """Whether the rate is the one that is set, within a factor of ``WITHIN`` either way."""
    return 1.0 / WITHIN <= total_of(rates) <= WITHIN


def table(rates: Sequence[Rate], devices: int, cycles: int, counted: int) -> str:
    """The rates as a table for the page.

    The ends of the intervals are summed for the total: they are those of a wider one than 95 %.
    """
    low, high = (sum(rate.share * getattr(rate, end) for rate in rates) for end in ("low", "high"))
    lines = [
        f"**{commit()}, {cycles:,} healthy cycles of {devices} simulated grippers:"
        f" {total_of(rates):.2f} times as many false alarms as are wanted (sums of the intervals'"
        f" ends: {low:.2g} to {high:.2g}), asked for {1.0 / WITHIN:.2f} to {WITHIN:g}:"
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
        "",
        f"Of the other alarms that follow from cycles ({', '.join(COUNTED)}), these cycles raised"
        f" {counted or 'none'}.",
    ]
    return "\n".join(lines)


def simulated(numbers: Sequence[int], cycles: int, folder: Path, workers: int) -> list[Device]:
    """The devices of these seeds: kept ones, and the others simulated now and kept.

    Only those of a commit are used again: other sources have no name, and may have changed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sources = commit()
    is_named = sources != "unknown" and not sources.endswith("-dirty")
    files = {seed: folder / f"{sources}-{seed}-{cycles}.npz" for seed in numbers}
    missing = [seed for seed, file in files.items() if not (is_named and file.exists())]
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        running = [pool.submit(_keep, seed, cycles, files[seed]) for seed in missing]
        for done, future in enumerate(as_completed(running), 1):
            future.result()
            _progress(f"{done} of {len(missing)} devices simulated")
    return [_kept(file) for file in files.values()]


def _keep(seed: int, cycles: int, file: Path) -> None:
    part = file.with_suffix(".part.npz")
    np.savez_compressed(part, **asdict(device(seed, cycles)))
    part.rename(file)


def _kept(file: Path) -> Device:
    with np.load(file) as stored:
        values = {field.name: stored[field.name] for field in fields(Device)}
    return Device(**values | {name: int(values[name]) for name in ("shown", "counted")})


def _progress(text: str) -> None:
    if sys.stderr.isatty():
        print(f"\r{text} ", end="", file=sys.stderr, flush=True)


def main() -> int:
    """Run from the command line; 1 if the total is not as set, too many or too few."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--devices", type=int, default=16)
    parser.add_argument("--cycles", type=int, default=2200, help="of each device")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1, help="processes that simulate")
    parser.add_argument(
        "--keep", type=Path, help="folder of simulated devices; by default in the user's own cache"
    )
    parser.add_argument("--write", type=Path, help="the page with a place for the table")
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + arguments.devices)
    folder = arguments.keep or private_folder(user_cache() / "false_alarms")
    devices = simulated(seeds, arguments.cycles, folder, arguments.workers)
    rates = [
        of_sums(devices, arguments.seed),
        of_single_cycles(devices, arguments.seed),
        of_limits(devices, arguments.seed),
    ]
    cycles, counted = (
        sum(len(tested.scores) for tested in devices),
        sum(tested.counted for tested in devices),
    )
    text_table = table(rates, len(devices), cycles, counted)
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
