"""How often healthy cycles of rigs from another world raise an alarm while the loop runs.

    nice -n 19 python -m tools.healthy_trial [--first SEED] [--rigs 12] [--cycles 250]
        [--keep FILE.jsonl] [--write docs/isolation.md]

Each rig is drawn by seed from the second world, which shares no equation with the model, and is
commissioned on twelve cycles, as a person would. Then further healthy cycles go through twin, bank
and monitor as in the loop. Nobody measures the weather. ``--keep`` keeps each rig, and goes on
where it was stopped.

Counted are alarms that are raised while none stands, by what raised them: sums over cycles, or a
single cycle.
"""

import argparse
import json
import secrets
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from tools import battery_second
from tools.version import commit
from twin.config import Config
from twin.events import Event, Kind
from twin.live import Twin, run
from twin.model.dataset import coefficients
from twin.monitor.isolation import Isolation
from twin.monitor.monitor import Monitor
from twin.signals import NS, Samples, Ticks

SEEDS = 1_000_000  # without --first, the first seed is drawn below this
AGAIN = 17  # seed of the further cycles: this times the rig's, and one more
BLOCK = 500  # rows
BEGIN = "<!-- healthy rigs: python -m tools.healthy_trial --write docs/isolation.md -->"
END = "<!-- end of healthy rigs -->"


@dataclass(frozen=True)
class Watched:
    """Alarms of a healthy rig; none are counted if its commissioning was refused."""

    seed: int
    system: str
    cycles: int  # 0: refused
    hours: float
    sums: int
    singles: int


class _Events:
    """An output that keeps events of alarms and of cycles."""

    def __init__(self) -> None:
        self.kept = list[Event]()

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Keep these events."""
        self.kept += events

    def close(self) -> None:
        """Do nothing: nothing is open."""


def raised(events: Iterable[Event]) -> tuple[int, int]:
    """Alarms by sums over cycles and by single cycles, of those raised while none stands."""
    sums = singles = 0
    stands = False
    for event in events:
        if event.kind is Kind.DEVIATION:
            by_sums = event.data["figure"] == "cycles"
            sums += by_sums and not stands
            singles += not (by_sums or stands)
        if event.kind in (Kind.DEVIATION, Kind.DEVIATION_CLEARED):
            stands = event.kind is Kind.DEVIATION
    return sums, singles


def watched(seed: int, cycles: int) -> Watched:
    """Commission a rig, and watch so many further healthy cycles of it."""
    met = battery_second.drawn(seed, battery_second.CADENCES)
    assert met is not None
    commissioned = battery_second.with_unit(met, battery_second.commissioned(met))
    if commissioned is None or commissioned.unit is None:
        return Watched(seed, met.rig.kind, 0, 0.0, 0, 0)
    logged = battery_second.record(met.rig, AGAIN * seed + 1, cycles)
    samples = met.person.samples(logged)
    events = _alarms(commissioned.unit, samples)
    judged = sum(event.kind is Kind.CYCLE for event in events)
    hours = float(np.ptp(samples["time_ns"])) * NS / 3600.0
    return Watched(seed, met.rig.kind, judged, round(hours, 3), *raised(events))


def _alarms(config: Config, samples: Samples) -> list[Event]:
    sink = _Events()
    isolation = Isolation.of(config.data, config.monitor.healthy, config.monitor.false_alarm_days)
    monitor = Monitor(config.monitor, coefficients(config.data), isolation=isolation)
    blocks = (samples[at : at + BLOCK] for at in range(0, len(samples), BLOCK))
    run(blocks, Twin.of(config.data), monitor, [sink])
    return sink.kept


def table(rigs: Sequence[Watched], name: str) -> str:
    """The table of the page."""
    met = [rig for rig in rigs if rig.cycles]
    cycles, hours = sum(rig.cycles for rig in met), sum(rig.hours for rig in met)
    seeds = f"{rigs[0].seed} to {rigs[-1].seed}"
    rows = [
        ("sums over cycles", [rig.sums for rig in met]),
        ("single cycles", [rig.singles for rig in met]),
        ("either", [rig.sums + rig.singles for rig in met]),
    ]
    lines = [
        f"{name}, seeds {seeds}: {len(met)} of {len(rigs)} rigs were commissioned; {cycles:,}"
        f" healthy cycles in {hours:.1f} hours.",
        "",
        "| raised by | rigs with an alarm | alarms | alarms in 1 000 cycles |",
        "| --- | --- | --- | --- |",
    ]
    for what, counts in rows:
        having, total = sum(count > 0 for count in counts), sum(counts)
        share = 1000.0 * total / max(cycles, 1)
        lines.append(f"| {what} | {having} of {len(met)} | {total} | {share:.1f} |")
    return "\n".join(lines)


def _known(path: Path | None, run: tuple[str, int]) -> dict[int, Watched]:
    """Rigs that a file keeps of the same sources and cycles, by seed."""
    if path is None or not path.exists():
        return {}
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    kept = [Watched(**line["rig"]) for line in lines if (line["commit"], line["asked"]) == run]
    return {rig.seed: rig for rig in kept}


def _written(path: Path, text: str) -> str:
    """The page with its table replaced; ValueError if it has no place for it."""
    page = path.read_text(encoding="utf-8")
    if BEGIN not in page or END not in page:
        raise ValueError(f"{path} lacks the lines {BEGIN} and {END}")
    head, tail = page.split(BEGIN)[0], page.split(END)[1]
    return f"{head}{BEGIN}\n{text}\n{END}{tail}"


def main() -> None:
    """Watch the rigs on all processors; print the table, or write it into its page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, metavar="SEED")
    parser.add_argument("--rigs", type=int, default=12)
    parser.add_argument("--cycles", type=int, default=250)
    parser.add_argument("--keep", type=Path, metavar="FILE.jsonl")
    parser.add_argument("--write", type=Path, metavar="PAGE")
    arguments = parser.parse_args()
    first = secrets.randbelow(SEEDS) if arguments.first is None else arguments.first
    seeds, now = range(first, first + arguments.rigs), commit()
    rigs = _known(arguments.keep, (now, arguments.cycles))
    if arguments.write:
        _written(arguments.write, "")  # says now if it cannot be
    missing = [seed for seed in seeds if seed not in rigs]
    with ProcessPoolExecutor(None, get_context("spawn")) as workers:
        for rig in workers.map(partial(watched, cycles=arguments.cycles), missing):
            rigs[rig.seed] = rig
            print(
                f"{rig.system} {rig.seed}: {rig.cycles} cycles, {rig.sums} alarms by sums,"
                f" {rig.singles} by single cycles",
                flush=True,
            )
            if arguments.keep:
                with arguments.keep.open("a", encoding="utf-8") as file:
                    file.write(
                        json.dumps({"commit": now, "asked": arguments.cycles, "rig": asdict(rig)})
                        + "\n"
                    )
    text = table([rigs[seed] for seed in seeds], now)
    print(text)
    if arguments.write:
        arguments.write.write_text(_written(arguments.write, text), encoding="utf-8")


if __name__ == "__main__":
    main()
