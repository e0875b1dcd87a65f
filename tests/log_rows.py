"""Rows, events and headers for the tests of the log."""

import numpy as np

from twin.events import Event, Kind
from twin.log.header import LogHeader
from twin.log.reader import Log
from twin.quality import Quality
from twin.signals import SAMPLE, TICK, Phase, Samples, Ticks

START_NS = 1_760_000_000_000_000_000
HEADER = LogHeader(
    asset_type="SCPSi 15",
    asset_id="robot 7, left",
    config_name="cell.toml",
    config_text='[asset]\ntype = "SCPSi 15"  # ä\n',
    metadata={"dataset": "5a3c", "program": "0.1.0"},
    ambient=100_000.0,
)


def course(n: int, step: float = 10.0, block: int = 30) -> tuple[Samples, Ticks]:
    """n rows of 1 ms: cycles of 2.5 s, noise of 0.2 mbar, readings in steps of ``step`` Pa."""
    rng = np.random.default_rng(1)
    samples, ticks = np.zeros(n, SAMPLE), np.zeros(n, TICK)
    row = np.arange(n)
    inside = row % 2500
    suction, blow_off = (inside >= 200) & (inside < 1700), (inside >= 1700) & (inside < 1900)
    pull = 75e3 * (1 - np.exp(-(inside - 200) / 220))
    vacuum = np.where(suction, pull, 0.0) + 75e3 * np.exp(-(inside - 1700) / 40) * (inside >= 1700)
    expected = (101_325 - vacuum) * (1 + 1e-4 * np.sin(row // 2500))
    samples["sequence"] = row + 1000
    samples["time_ns"] = START_NS + row * 1_000_000
    late = rng.integers(200_000, 3_000_000, n // block + 1)
    samples["host_ns"] = (START_NS + (row // block + 1) * block * 1_000_000) + late[row // block]
    samples["pressure"] = np.round((expected + rng.normal(0, 20, n)) / step) * step
    samples["supply"] = np.round((5.5e5 + rng.normal(0, 300, n)) / 200) * 200
    samples["commands"] = suction + 2 * blow_off
    ticks["expected"] = expected
    ticks["level"] = np.where(inside == 0, expected, np.nan)
    ticks["phase"] = np.where(blow_off, Phase.BLOW_OFF, np.where(suction, Phase.SUCTION, 0))
    return samples, ticks


def awkward() -> tuple[Samples, Ticks]:
    """Rows of everything that is lost easily: extremes, NaNs with a message, all flags."""
    samples, ticks = np.zeros(7, SAMPLE), np.zeros(7, TICK)
    extremes = [-(2**63), 2**63 - 1, 0, -1, 1, 2**63 - 1, -(2**63)]
    nan_bits = [0x7FC00000, 0x7F800001, 0xFFFFFFFF, 0xFF800000, 0x80000000, 1, 0x7F7FFFFF]
    for name in ("sequence", "time_ns", "host_ns"):
        samples[name] = extremes
    for rows, name in ((samples, "pressure"), (samples, "supply"), (ticks, "expected")):
        rows.view(np.dtype([(n, f"u{rows.dtype[n].itemsize}") for n in rows.dtype.names]))[name] = (
            nan_bits
        )
    samples["quality"] = [0, *(int(flag) for flag in Quality)][:7]
    samples["commands"] = range(7)
    ticks["phase"] = [255, 0, 255, 0, 1, 2, 3]
    return samples, ticks


EVENTS = [
    Event(START_NS + 40_000_000, Kind.GAP, "12 samples are missing", {"missing": 12}),
    Event(START_NS + 55_000_000, Kind.CYCLE, "ä ✓", {"t0": 103.0, "n": 3, "name": '\n"'}),
    Event(-5, Kind.DEVIATION, "", {}),
]


def rows_of(log: Log, size: int = 10_000) -> tuple[bytes, bytes]:
    """All rows of a log, to the bit."""
    blocks = list(log.blocks(size))
    assert all(len(samples) == len(ticks) for samples, ticks in blocks)
    samples = b"".join(rows.tobytes() for rows, _ in blocks)
    return samples, b"".join(rows.tobytes() for _, rows in blocks)
