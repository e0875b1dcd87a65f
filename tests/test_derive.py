"""Commands derived from the pressure alone, against those that were recorded and kept from it."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import rigs
from second_world import draw_rig, record

from twin.errors import ConfigError, SourceError
from twin.quality import Quality
from twin.signals import MBAR, SAMPLE, Command, Samples
from twin.tables.derive import derive
from twin.tables.reader import open_table
from twin.tables.settings import ImportSettings

Floats = npt.NDArray[np.float64]
DATA = Path(__file__).parent / "data" / "suction_gripper"
AMBIENT = 101_325.0  # Pa
SEED = 4711
KINDS = ("soft_cups", "held_part", "porous_part", "no_air_saving", "micro", "two_stage")
LATE_MS = 80.0  # valve, jet and soft cups: the pressure moves after its command
OFF_MS = 15.0  # by which an edge may come before its command, at a row each ms
COARSE_S = 0.0256


def rows_of(time: Floats, pressure: Floats) -> Samples:
    """Rows with nothing but time (s) and absolute pressure (Pa)."""
    samples = np.zeros(len(time), SAMPLE)
    samples["time_ns"] = samples["host_ns"] = np.round(time * 1e9).astype(np.int64)
    samples["sequence"], samples["pressure"] = np.arange(len(time)), pressure
    return samples


@cache
def known(name: str) -> Samples:
    """A record with its commands: of a shipped rig, or of the second world."""
    if name in rigs.NAMES:
        return rigs.recorded(name, 20.0, seed=SEED)[0]
    made = record(draw_rig(SEED, name), SEED, 5)
    samples = rows_of(made.time_ns * 1e-9, made.pressure_pa)
    samples["commands"] = made.suction * 1 + made.blow_off * 2
    return samples


def coarse(samples: Samples) -> Samples:
    """About 39 rows a second, as a slow logger takes them, some of them late."""
    time = (samples["time_ns"] - samples["time_ns"][0]) * 1e-9
    rng = np.random.default_rng(SEED)
    at = np.cumsum(rng.normal(COARSE_S, 0.1 * COARSE_S, round(1.1 * time[-1] / COARSE_S)))
    return samples[np.unique(np.searchsorted(time, at).clip(0, len(time) - 1))]


def edges(samples: Samples, bit: Command, *, ends: bool = False) -> Floats:
    """When (s) a command goes on, or off, within the record."""
    on = ((samples["commands"] & bit.value) != 0).astype(np.int8)
    rows = np.flatnonzero(np.diff(on) == (-1 if ends else 1)) + 1
    times: Floats = samples["time_ns"][rows] * 1e-9
    return times


def idle_lasts_longer(true: Samples) -> bool:
    """Than blow-off. Otherwise its plateau looks like idle, and idle like an open cup."""
    begins, ends = edges(true, Command.BLOW_OFF), edges(true, Command.BLOW_OFF, ends=True)
    after = edges(true, Command.SUCTION)[1:]
    many = min(len(ends), len(after))
    idle, blown = after[:many] - ends[:many], ends[:many] - begins[:many]
    return bool(np.median(idle) > np.median(blown))


def with_derived(samples: Samples) -> Samples:
    blank = samples.copy()
    blank["commands"] = 0
    blank["commands"] = derive(blank).commands
    return blank


def late(found: Floats, true: Floats) -> Floats:
    """By how much (ms) each found edge comes after its command; they must be as many."""
    assert len(found) == len(true), (found, true)
    return (found - true) * 1e3


@pytest.mark.parametrize("name", [*rigs.NAMES, *KINDS])
@pytest.mark.parametrize("taken", [lambda samples: samples, coarse], ids=["1 kHz", "38 Hz"])
def test_every_suction_is_found_and_none_else(
    name: str, taken: Callable[[Samples], Samples]
) -> None:
    true = known(name)
    rows = taken(true)
    found = with_derived(rows)
    step = float(np.median(np.diff(rows["time_ns"]))) * 1e-6  # ms
    if idle_lasts_longer(true):
        begins = late(edges(found, Command.SUCTION), edges(true, Command.SUCTION))
        assert begins.min() > -OFF_MS - step
        assert begins.max() < LATE_MS + 2.0 * step
        assert np.ptp(begins) < 30.0 + 3.0 * step
    # Suction has ended where the vacuum does: where blow-off, or the valve's venting, begins.
    releases = edges(true, Command.BLOW_OFF)
    ends = late(edges(found, Command.SUCTION, ends=True), releases)
    assert ends.min() > -OFF_MS - step
    assert ends.max() < LATE_MS + 2.0 * step


@pytest.mark.parametrize("name", [*rigs.NAMES, "held_part"])
def test_a_release_above_idle_is_a_blow_off(name: str) -> None:
    true = known(name)
    found = with_derived(true)
    ends = edges(true, Command.BLOW_OFF, ends=True)
    off = late(edges(found, Command.BLOW_OFF, ends=True)[: len(ends)], ends)
    assert -OFF_MS < np.median(off) < LATE_MS
    assert derive(true).blown


def cycle(parts: Sequence[tuple[float, float, float]], noise: float, step: float) -> Samples:
    """Pressure that goes from level to level (mbar): each with its time constant and length (s)."""
    levels = [1013.0]
    for target, constant, length in parts:
        rows = np.arange(1, round(length / step) + 1) * step
        levels += list(target + (levels[-1] - target) * np.exp(-rows / constant))
    pressure = np.array(levels) + np.random.default_rng(1).normal(0.0, noise, len(levels))
    return rows_of(np.arange(len(levels)) * step, pressure * MBAR)


IDLE, PICK, VENT = (1013.0, 0.002, 0.5), (300.0, 0.1, 1.0), (1013.0, 0.01, 0.6)


@pytest.mark.parametrize("step", [0.001, 0.0256])
@pytest.mark.parametrize(
    ("parts", "suctions"),
    [
        ([IDLE, *[PICK, VENT] * 3], 3),
        ([IDLE, *[(300.0, 0.03, 0.15), (1013.0, 0.005, 0.15)] * 9], 9),
        ([IDLE, (300.0, 4.0, 40.0), (1013.0, 0.3, 20.0), (300.0, 4.0, 40.0), VENT], 2),
        ([IDLE, PICK, VENT, (985.0, 0.02, 1.0), VENT, PICK, VENT], 3),  # one without a part
        ([IDLE, PICK, (980.0, 0.05, 0.6), VENT, PICK, VENT], 2),  # a part that is lost
        ([IDLE, *[(985.0, 0.02, 0.4), PICK, VENT] * 3], 3),  # the cup is open at first
        ([PICK, VENT, PICK], 2),  # begins and ends in one
        ([IDLE, PICK, *[(450.0, 0.3, 0.3), (300.0, 0.1, 0.3)] * 4, VENT], 1),  # air saving
    ],
    ids=["three", "0.3 s", "60 s", "no part", "lost", "open cup", "cut", "air saving"],
)
def test_cycles_of_all_kinds(
    parts: list[tuple[float, float, float]], suctions: int, step: float
) -> None:
    for noise in (0.0, 0.5, 2.0):
        found = derive(cycle(parts, noise, step))
        assert found.suctions == suctions, noise
        assert not found.blown


def test_no_offset_and_no_drift_changes_what_is_found() -> None:
    samples = known("gripper").copy()
    before = with_derived(samples)["commands"]
    samples["pressure"] += 15.0 * MBAR
    assert np.array_equal(with_derived(samples)["commands"], before)
    samples["pressure"] += np.linspace(0.0, 40.0 * MBAR, len(samples)).astype(np.float32)
    drifted = with_derived(samples)["commands"]
    assert np.mean(drifted != before) < 0.01


def test_what_is_missing_or_bad_hides_no_cycle() -> None:
    samples = known("gripper")
    kept = np.random.default_rng(3).random(len(samples)) > 0.05
    some = samples[kept].copy()
    some["quality"][1:][np.diff(some["sequence"]) > 1] = Quality.GAP.value
    some["pressure"][100:110] = np.nan
    some["quality"][200:203] = Quality.BAD.value
    assert derive(some).suctions == derive(samples).suctions


def test_records_behind_each_other_are_looked_at_one_by_one() -> None:
    one = cycle([IDLE, PICK, VENT], 0.5, 0.0256)
    both = np.concatenate([one, one])
    both["quality"][len(one)] = Quality.CLOCK.value
    found = derive(both)
    assert found.suctions == 2
    assert np.array_equal(found.commands[: len(one)], found.commands[len(one) :])


def test_where_no_release_goes_above_idle_it_is_not_called_blow_off() -> None:
    vented = derive(cycle([IDLE, PICK, VENT], 0.5, 0.001))
    blown = derive(cycle([IDLE, PICK, (1100.0, 0.02, 0.2), (1013.0, 0.02, 1.0)], 0.5, 0.001))
    assert not (vented.commands & Command.BLOW_OFF).any()
    assert "whether a blow-off or a vent ends the vacuum cannot be told" in vented.words(["x"])
    assert (blown.commands & Command.BLOW_OFF).any()
    assert "valve delays and the timing of commands cannot be told" in blown.words(["x"])


def test_a_long_blow_off_is_told_from_idle_where_ambient_is_known() -> None:
    blown = [PICK, (1040.0, 0.02, 1.0), (1013.0, 0.02, 0.6)]
    samples = cycle([IDLE, *blown * 3], 0.5, 0.001)
    starts = 0.5 + 2.6 * np.arange(3)
    samples["commands"] = derive(samples, 101_300.0).commands
    assert edges(samples, Command.SUCTION) == pytest.approx(starts, abs=0.01)
    assert edges(samples, Command.BLOW_OFF, ends=True) == pytest.approx(starts + 2.0, abs=0.02)
    # Without it nobody knows: what stands longer is taken for idle, and the rest for an open cup.
    found = edges(with_derived(samples), Command.SUCTION)
    assert found == pytest.approx(starts[1:] - 0.6, abs=0.01)


TIME = np.arange(0.0, 20.0, 0.01)


@pytest.mark.parametrize(
    ("mbar", "why"),
    [
        (np.full(len(TIME), 1013.0), "moves by 0.0 mbar only: no vacuum"),
        (1013.0 + 5.0 * np.sin(TIME), "no vacuum is made"),
        (900.0 + 5.0 * TIME, "but drift"),
        (960.0 + 50.0 * np.sin(TIME * np.pi / 20.0), "but drift"),
        (np.where(TIME % 2 < 1, 1.013, 0.3), "it is probably in bar"),
        (np.where(TIME % 2 < 1, 0.0, -700.0), "probably gauge pressure or vacuum"),
        (np.where(TIME % 2 < 1, 0.0, 700.0), "probably gauge pressure or vacuum"),
        (1013.0 + np.where(TIME % 2 < 0.5, 0.0, 700.0), "as no ambient pressure is"),
        (350.0 + 40.0 * np.sin(6.0 * TIME), "no vacuum ends in it"),
    ],
    ids=["still", "weather", "ramp", "slow", "bar", "gauge", "vacuum", "sign", "hold"],
)
def test_what_is_no_record_of_cycles_is_refused_with_the_reason(mbar: Floats, why: str) -> None:
    noise = np.random.default_rng(2).normal(0.0, 1e-4 * np.abs(mbar).max(), len(TIME))
    samples = rows_of(TIME, (mbar + (noise if "0.0" not in why else 0.0)) * MBAR)
    with pytest.raises(SourceError, match=why):
        derive(samples)


def test_too_few_rows_are_refused() -> None:
    with pytest.raises(SourceError, match="too few usable readings"):
        derive(rows_of(np.arange(3.0), np.full(3, AMBIENT)))


# --- in a table -----------------------------------------------------------------------------------


def written(path: Path, samples: Samples, *commands: str) -> Path:
    """A CSV with the vacuum, and with these of the commands."""
    columns = {"time_s": samples["time_ns"] * 1e-9}
    columns["vacuum_mbar"] = (AMBIENT - samples["pressure"].astype(np.float64)) / MBAR
    for name in commands:
        columns[name] = (samples["commands"] & Command[name.upper()].value) != 0
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, "%.6f", ",", header=",".join(columns), comments="")
    return path


def test_a_table_gets_the_commands_that_it_lacks(tmp_path: Path) -> None:
    true = known("gripper")
    path = written(tmp_path / "a.csv", true)
    table = open_table(path, ImportSettings(), AMBIENT, derive=True).with_commands()
    rows = np.concatenate(list(table.blocks()))
    assert np.array_equal(rows["commands"], with_derived(true)["commands"])
    assert table.commands.startswith("suction and blow_off derived from the pressure: 10 suctions")


def test_a_command_that_is_there_stays(tmp_path: Path) -> None:
    true = known("gripper")
    path = written(tmp_path / "a.csv", true, "suction")
    table = open_table(path, ImportSettings(), AMBIENT, derive=True).with_commands()
    rows = np.concatenate(list(table.blocks()))
    assert np.array_equal(rows["commands"] & Command.SUCTION, true["commands"] & Command.SUCTION)
    assert (rows["commands"] & Command.BLOW_OFF).any()
    assert table.commands.startswith("blow_off derived")


def test_where_both_are_there_none_is_derived(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", known("gripper")[:100], "suction", "blow_off")
    with pytest.raises(ConfigError, match="none is to be derived"):
        open_table(path, ImportSettings(), AMBIENT, derive=True)


def test_without_being_asked_nothing_is_derived(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", known("gripper")[:100])
    with pytest.raises(SourceError, match="no column suction") as refused:
        open_table(path, ImportSettings(), AMBIENT)
    assert "--derive-commands" in refused.value.hint


def test_the_reason_names_the_file(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", rows_of(TIME, np.full(len(TIME), AMBIENT)))
    table = open_table(path, ImportSettings(), AMBIENT, derive=True)
    with pytest.raises(SourceError, match=r"a\.csv:1: the pressure moves by"):
        table.with_commands()


def test_whatever_comes_ends_in_commands_or_in_a_reason() -> None:
    rng = np.random.default_rng(SEED)
    for _ in range(300):
        count = int(rng.integers(1, 400))
        steps = rng.exponential(rng.choice([0.001, 0.03, 1.0]), count)
        if rng.random() < 0.3:
            steps = np.abs(rng.choice([0.0, 0.001, 0.001, 5.0], count))
        kind = rng.integers(4)
        walk = np.cumsum(rng.normal(0.0, rng.choice([1.0, 30.0, 200.0]), count))
        blocks = np.repeat(rng.choice([300.0, 500.0, 985.0, 1013.0, 1090.0, 1300.0], count), 7)
        shapes = (700.0 + walk, blocks[:count], 1013.0 - np.abs(walk), rng.uniform(0, 1200, count))
        samples = rows_of(np.cumsum(steps), shapes[kind] * MBAR)
        bad = rng.random(count) < 0.05
        samples["pressure"][bad] = np.nan
        samples["quality"][rng.random(count) < 0.02] = Quality.CLOCK.value
        try:
            found = derive(samples, None if rng.random() < 0.5 else AMBIENT)
        except SourceError:
            continue
        assert len(found.commands) == count
        assert set(np.unique(found.commands).tolist()) <= {0, 1, 2}
        assert found.suctions > 0
