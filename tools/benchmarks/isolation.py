"""Isolation in the loop: whether the right cause is named soon after its onset.

A simulated rig with one effect that begins at a known cycle goes through twin, bank and monitor as
in the loop. The size is twice the smallest that can be isolated within three cycles. That one is
detected by then by a CUSUM for this effect alone, and differs from every other re-fitted effect.
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np

from benchmarks.figures import Measured, Run
from benchmarks.processes import ROOT
from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from twin.config import Config
from twin.events import Event, Kind
from twin.live import Twin
from twin.model.dataset import coefficients
from twin.model.effects import EFFECTS
from twin.monitor.bins import Floats, Ints
from twin.monitor.cycles import CycleCutter, CycleView, figures
from twin.monitor.isolation import Isolation
from twin.monitor.model_bank import SUSPECTS, variants
from twin.monitor.monitor import RIVAL, Monitor
from twin.monitor.statistics import CycleResidual
from twin.settings import Document

SYSTEMS = ("test_rig", "gripper")
RUNS = 60
BEGINS, WITHIN = 30, 3  # cycles
HEALTHY = 60  # cycles from which scatter is learned
APART = 100_000  # between the seeds of healthy cycles and of those with the effect
CYCLE_S = {"test_rig": 3.2, "gripper": 2.3}  # at most
FOUND = 3.2  # sigmas a cycle that the best CUSUM for one false alarm in 30 days detects by then
REJECTED = 10.8  # chi-square that chance exceeds once in a thousand
TIMES = 2.0  # times the smallest size that can be isolated
MOST_NAMED = 3
FIRST_SEED = 6000


@dataclass(frozen=True)
class Outcome:
    """The hidden effect of a run, and the effects named, the most probable first."""

    system: str
    effect: str
    size: float
    unit: str
    told: Sequence[str]

    @property
    def right(self) -> bool:
        """Whether the effect is among at most MOST_NAMED named ones."""
        return self.effect in self.told and len(self.told) <= MOST_NAMED


def causes(run: Run) -> Sequence[Measured]:
    """Share (%) of runs in which the right cause is not named within three cycles."""
    outcomes = []
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as workers:
        for result in workers.map(outcome, range(FIRST_SEED, FIRST_SEED + RUNS)):
            outcomes.append(result)
            run.tell(f"isolation: {len(outcomes)} of {RUNS} runs")
    right = [result for result in outcomes if result.right]
    alone = sum(len(result.told) == 1 for result in right)
    missed = ", ".join(
        f"{result.effect} ({result.system})" for result in outcomes if not result.right
    )
    note = f"({alone} alone; not: {missed or 'none'})"
    return [Measured([100.0 * (1.0 - len(right) / RUNS)], note=note)]


def outcome(seed: int) -> Outcome:
    """One run: system, effect and sign drawn by seed."""
    rng = np.random.default_rng(seed)
    system = SYSTEMS[int(rng.integers(len(SYSTEMS)))]
    effect = EFFECTS[str(rng.choice(list(EFFECTS)))]
    number = next(i for i, candidate in enumerate(SUSPECTS) if candidate.effect == effect.name)
    suspect = SUSPECTS[number]
    document = Document.read(ROOT / "configs" / f"{system}.toml")
    config, rig = Config.of(document), document.section(PlcSettings, "plc")
    sign = rng.choice([-1.0, 1.0]) if suspect.both_ways else 1.0
    healthy = heard(config, rig, CYCLE_S[system] * HEALTHY, seed + APART)
    steps = (
        sign * TIMES * least([residual for residual, _ in healthy], number, ways_of(config, number))
    )
    parameter = suspect.parameter
    healthy_is = 0.0 if parameter.coefficient is None else rig.rig.vessel_film
    size = healthy_is + steps * suspect.step
    size = float(np.clip(size, parameter.low, parameter.high))
    fault = f"{effect.name}={size:.6g}@c{BEGINS}"
    events = _watched(config, rig, CYCLE_S[system] * (BEGINS + WITHIN + 1), fault, seed)
    return Outcome(system, effect.name, size, parameter.unit, _told(events))


def ways_of(config: Config, number: int) -> Ints:
    """Columns of a residual's uncertain signatures that are those of a suspect."""
    numbers = np.array([suspect for suspect, _ in variants(coefficients(config.data))])
    return np.flatnonzero(numbers == number)


def least(healthy: Sequence[CycleResidual], number: int, ways: Ints) -> float:
    """Smallest size of a suspect, in its steps, that is isolated WITHIN cycles.

    ``ways`` are the columns of what its law leaves open.
    """
    effect = SUSPECTS[number].effect
    others = [i for i, suspect in enumerate(SUSPECTS) if suspect.effect != effect]
    last = healthy[-1]
    signature = last.signatures[:, number]
    uncertain = last.unsure[:, ways]
    unknown = last.alone + uncertain @ uncertain.T
    power = float(signature @ np.linalg.solve(unknown, signature))
    scatter = float(np.nanstd([residual.scores()[number] for residual in healthy]))
    nearest = float(np.max(np.abs(last.alike()[number, others])))
    apart = np.sqrt(REJECTED / WITHIN / (1.0 - nearest**2))
    return max(FOUND, float(apart)) * scatter / np.sqrt(power)


def heard(
    config: Config, rig: PlcSettings, seconds: float, seed: int
) -> Iterator[tuple[CycleResidual, Floats]]:
    """The residual of each cycle of a healthy rig, and its scores as standard normal variables."""
    twin, cutter = Twin.of(config.data), CycleCutter()
    isolation = Isolation.of(config.data, config.monitor.healthy, days=1e9)
    for block in blocks(rig, seconds, seed=seed, block=20_000):
        rows, ticks = twin.advance(block)
        views = [
            CycleView(
                cycle,
                None,
                figures(cycle, twin.theta),
                cycle.complete and cycle.settled,
                twin.theta,
            )
            for cycle in cutter.push(rows, ticks)
        ]
        for residual in isolation.extract(views):
            if residual and isolation.judge(residual) is not None:
                yield isolation.last_scores


def _watched(
    config: Config, rig: PlcSettings, seconds: float, fault: str, seed: int
) -> list[Event]:
    """All events of a rig with a fault."""
    twin, events = Twin.of(config.data), []
    isolation = Isolation.of(config.data, config.monitor.healthy, config.monitor.false_alarm_days)
    monitor = Monitor(config.monitor, coefficients(config.data), isolation=isolation)
    for block in blocks(rig, seconds, [parse_fault(fault)], seed=seed):
        events += monitor.update(*twin.advance(block))
    return events


def _told(events: Sequence[Event]) -> list[str]:
    """Effects named within WITHIN cycles of the onset; empty without an alarm."""
    last = BEGINS + WITHIN - 1
    since = [event for event in events if BEGINS <= event.data.get("cycle", -1) <= last]
    alarms = [event for event in since if event.kind is Kind.DEVIATION]
    if not alarms:
        return []
    shares = [event.data["probabilities"] for event in since if "probabilities" in event.data]
    if shares:
        likely = sorted(shares[-1].items(), key=lambda item: -item[1])
        return [effect for effect, share in likely if effect != "none" and share >= RIVAL]
    return [alarms[-1].data["effect"], *filter(None, alarms[-1].data["also"].split(","))]
