"""What was drawn of a cycle is given again for those that go alike, and only for those."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import rigs

from twin.model import kernel
from twin.monitor.cycles import LONGEST_PIECE, Cycle, CycleCutter, cut
from twin.monitor.model_bank import SUSPECTS, SWUNG_IN, ModelBank
from twin.monitor.prediction_cache import KEPT, LONGER_MS, CachedPrediction, PredictionCache
from twin.quality import Quality
from twin.signals import MBAR, MS, NS, Phase, Samples, Ticks

Floats = npt.NDArray[np.float64]
SECONDS = {"test_rig": 100.0, "gripper": 60.0}
# In no pressure does a threshold show: the switching is given to the hypotheses.
SHOWN = [1 + i for i, suspect in enumerate(SUSPECTS) if suspect.effect != "threshold_drift"]
MS_NS = round(MS / NS)


class Stepped:
    """Counts the rows that a bank steps over."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._advance, self.rows = kernel.advance, 0
        monkeypatch.setattr(kernel, "advance", self._count)

    def _count(self, state: kernel.State, theta: Floats, dt: Floats, *rest: Floats, **how: float):  # type: ignore[no-untyped-def]
        self.rows += len(dt)
        self._advance(state, theta, dt, *rest, **how)  # type: ignore[arg-type]

    def over(self, bank: ModelBank, cycle: Cycle) -> bool:
        """Whether any are, for a cycle."""
        self.rows = 0
        bank.take(cycle)
        return self.rows > 0


class Never(PredictionCache):
    """Keeps none: all is stepped."""

    def add(self, prediction: CachedPrediction) -> None:
        pass


def stepping(name: str) -> ModelBank:
    """A bank that uses nothing again."""
    bank = ModelBank(rigs.theta(name))
    bank._cache = Never()
    return bank


def ran(name: str, *faults: str, seconds: float = 0.0) -> tuple[Samples, Ticks]:
    samples, _ = rigs.recorded(name, seconds or SECONDS[name], faults, 7)
    return rigs.expectation(rigs.twin(name), [samples])


def signatures(expected: Floats) -> Floats:
    moved: Floats = expected[:, SHOWN] - expected[:, :1]
    return moved


def off(cycles: Sequence[tuple[Floats, Floats]]) -> Floats:
    """By what share (rms) the signatures of a bank differ from those of another, by suspect."""
    one, other = (
        np.concatenate([signatures(e) for e in bank]) for bank in zip(*cycles, strict=True)
    )
    share: Floats = np.sqrt(np.sum((one - other) ** 2, axis=0) / np.sum(other**2, axis=0))
    return share


@pytest.mark.parametrize("name", rigs.NAMES)
def test_signatures_of_cycles_that_go_alike_are_nearly_those_of_stepping(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bank, other, stepped = ModelBank(rigs.theta(name)), stepping(name), Stepped(monkeypatch)
    again = []
    for cycle in cut([ran(name)]):
        stepped.rows = 0
        rows, expected = bank.take(cycle)
        reused = stepped.rows == 0
        same_rows, right = other.take(cycle)
        np.testing.assert_array_equal(rows, same_rows)
        if reused:
            again.append((expected, right))
    assert len(again) >= 18  # of some thirty
    assert np.sqrt(np.mean(off(again) ** 2)) < 0.01
    assert off(again).max() < 0.04


@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_cycle_is_stepped_rightly_after_some_that_were_not(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples, ticks = ran(name)
    starts = np.cumsum([0] + [len(cycle.samples) for cycle in cut([(samples, ticks)])])
    samples = samples.copy()
    samples["quality"][starts[14:-2:4] + 5] = Quality.OUT_OF_RANGE  # the bank asks no pressure
    bank, other, stepped = ModelBank(rigs.theta(name)), stepping(name), Stepped(monkeypatch)
    after, before = [], True
    for cycle in cut([(samples, ticks)]):
        stepped.rows = 0
        _, expected = bank.take(cycle)
        anew, (_, right) = stepped.rows > 0, other.take(cycle)
        if anew and not before:
            after.append((expected, right))
        before = anew
    assert len(after) >= 3
    assert off(after).max() < 0.02


def renewed(cycle: Cycle, rows: npt.NDArray[np.int64]) -> Cycle:
    """Made of these rows of a cycle, a millisecond each."""
    samples, ticks = cycle.samples[rows].copy(), cycle.ticks[rows].copy()
    samples["time_ns"] = samples["time_ns"][0] + np.arange(len(rows)) * MS_NS
    return replace(cycle, samples=samples, ticks=ticks)


def later(cycle: Cycle, before: Cycle) -> Cycle:
    """The same cycle right after another one."""
    moved = replace(cycle, samples=cycle.samples.copy())
    moved.samples["time_ns"] += before.end_ns + MS_NS - int(cycle.samples["time_ns"][0])
    return moved


def same(cycle: Cycle) -> Cycle:
    return renewed(cycle, np.arange(len(cycle.samples)))


def jittered(cycle: Cycle) -> Cycle:
    """One stretch a row longer, one a row shorter."""
    return longer(longer(cycle, Phase.HOLD, 1), Phase.BLOW_OFF, -1)


def longer(cycle: Cycle, phase: Phase, by: int) -> Cycle:
    there = np.flatnonzero(cycle.ticks["phase"] == phase)
    rows = np.arange(len(cycle.samples))
    if by < 0:
        return renewed(cycle, np.delete(rows, there[by:]))
    return renewed(cycle, np.insert(rows, there[-1], np.full(by, there[-1])))


def set_on(cycle: Cycle, phase: Phase, by: float) -> Cycle:
    """The level at the beginning of a phase is another by some Pa."""
    other = same(cycle)
    other.ticks["level"][np.flatnonzero(other.ticks["phase"] == phase)[0]] += by
    return other


def without_hold(cycle: Cycle) -> Cycle:
    """As if the nozzle had stayed on; set on the same levels at the same time."""
    other = same(cycle)
    other.ticks["phase"][other.ticks["phase"] == Phase.HOLD] = Phase.SUCTION
    return other


def flagged(cycle: Cycle, quality: Quality) -> Cycle:
    other = same(cycle)
    other.samples["quality"][700] = quality
    return other


def held_up(cycle: Cycle) -> Cycle:
    """A row came 2 ms late, and the one after it at its time."""
    other = same(cycle)
    other.samples["time_ns"][700] += 2 * MS_NS
    return other


def slower(cycle: Cycle) -> Cycle:
    """As many rows, each of them some more than a millisecond after the one before."""
    other, number = same(cycle), np.arange(len(cycle.samples))
    other.samples["time_ns"] += (number * 0.1 * MS_NS).astype(np.int64)
    return other


DIFFERENT: dict[str, Callable[[Cycle], Cycle]] = {
    "longer suction": lambda cycle: longer(cycle, Phase.SUCTION, 20),
    "shorter suction": lambda cycle: longer(cycle, Phase.SUCTION, -20),
    "longer hold": lambda cycle: longer(cycle, Phase.HOLD, 30),
    "longer blow-off": lambda cycle: longer(cycle, Phase.BLOW_OFF, 12),
    "shorter idle": lambda cycle: longer(cycle, Phase.IDLE, -30),
    "a level": lambda cycle: set_on(cycle, Phase.HOLD, 4.0 * MBAR),
    "first level": lambda cycle: set_on(cycle, Phase.SUCTION, -4.0 * MBAR),
    "no level": lambda cycle: set_on(cycle, Phase.HOLD, np.nan),
    "no hold": without_hold,
    "bad": lambda cycle: flagged(cycle, Quality.BAD),
    "stale": lambda cycle: flagged(cycle, Quality.STALE),
    "clock": lambda cycle: flagged(cycle, Quality.CLOCK),
    "late row": held_up,
    "slower": slower,
    "cut off": lambda cycle: replace(cycle, complete=False),
}


def beside(name: str) -> tuple[ModelBank, ModelBank, Cycle]:
    """A bank that knows one cycle, one that uses nothing again, and that cycle."""
    known = list(cut([ran(name, seconds=20.0)]))[: 2 + SWUNG_IN]
    bank, other = ModelBank(rigs.theta(name)), stepping(name)
    for cycle in known:
        bank.take(cycle)
        other.take(cycle)
    assert len(bank._cache) == 1
    return bank, other, known[-1]


@pytest.mark.parametrize("change", [same, jittered])
def test_what_goes_as_a_known_cycle_is_not_stepped(
    change: Callable[[Cycle], Cycle], monkeypatch: pytest.MonkeyPatch
) -> None:
    bank, _, known = beside("gripper")
    assert not Stepped(monkeypatch).over(bank, later(change(known), known))


@pytest.mark.parametrize("what", DIFFERENT)
def test_what_goes_differently_is_stepped_as_ever(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bank, other, known = beside("gripper")
    cycle = later(DIFFERENT[what](known), known)
    stepped = Stepped(monkeypatch)
    rows, expected = bank.take(cycle)
    assert stepped.rows == len(rows)
    np.testing.assert_array_equal(expected, other.take(cycle)[1])


@pytest.mark.parametrize("what", DIFFERENT)
def test_what_went_differently_never_goes_alike_again(what: str) -> None:
    bank, _, known = beside("gripper")
    if what == "cut off":
        return  # that is seen at its end
    cycle = later(DIFFERENT[what](known), known)
    may = []
    for end in range(1, len(cycle.samples) + 1):
        _, stretches, _ = bank._look(cycle.samples[:end], cycle.ticks[:end])
        may.append(stretches is not None and bank._cache.could_hit(stretches))
    assert may == sorted(may, reverse=True)
    assert may[-1] == (what == "shorter idle")  # that is seen only at its end


def test_after_a_cycle_that_went_alike_the_models_stand_where_the_known_one_ended() -> None:
    bank, _, known = beside("gripper")
    stands = bank._state.copy()
    other = later(longer(known, Phase.BLOW_OFF, -60), known)
    bank.take(other)
    assert not np.array_equal(bank._state, stands)
    for number in range(3):
        again = later(known, other)
        bank.take(again)
        np.testing.assert_array_equal(bank._state, stands)
        other = later(flagged(known, Quality.BAD), again)
        bank.take(other)
        assert not np.array_equal(bank._state, stands), number


def blocks(rows: Samples, ticks: Ticks, sizes: Iterator[int]) -> Iterator[tuple[Samples, Ticks]]:
    begin = 0
    while begin < len(rows):
        end = begin + next(sizes)
        yield rows[begin:end], ticks[begin:end]
        begin = end


@pytest.mark.slow
@pytest.mark.parametrize("name", rigs.NAMES)
@pytest.mark.parametrize("most", [60, 1000, 9000])
def test_what_is_used_again_does_not_depend_on_blocks(name: str, most: int) -> None:
    samples, ticks = ran(name, "leakage=6@c8/share:0.3")
    samples = samples.copy()
    samples["quality"][[len(samples) // 2, len(samples) * 3 // 4]] = Quality.GAP, Quality.BAD
    whole = ModelBank(rigs.theta(name))
    right = [whole.take(cycle) for cycle in cut([(samples, ticks)])]
    bank, cutter, random = ModelBank(rigs.theta(name)), CycleCutter(), np.random.default_rng(most)
    sizes = iter(lambda: int(random.integers(1, most)), 0)
    found = []
    for block in blocks(samples, ticks, sizes):
        found += [bank.take(cycle) for cycle in cutter.push(*block)]
        if begun := cutter.begun():
            bank.run_ahead(*begun)
    found += [bank.take(cycle) for cycle in cutter.flush()]
    for one, other in zip(found, right, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])
    np.testing.assert_array_equal(bank._state, whole._state)


def test_while_a_cycle_may_go_as_a_known_one_nothing_is_stepped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bank, _, known = beside("gripper")
    cycle = later(longer(known, Phase.SUCTION, 300), known)
    stepped, suction = Stepped(monkeypatch), int(np.sum(known.ticks["phase"] == Phase.SUCTION))
    for end in range(50, len(cycle.samples), 50):
        bank.run_ahead(cycle.samples[:end], cycle.ticks[:end], at_edge=True)
        if end <= suction + LONGER_MS:
            assert stepped.rows == 0
    before = stepped.rows
    bank.take(cycle)
    assert before > 0.7 * stepped.rows  # little is left for its end


def test_few_drawings_are_kept_and_the_last_ones_used() -> None:
    bank, _, known = beside("gripper")
    before = known
    for number in range(2 * KEPT):
        other = later(longer(known, Phase.SUCTION, 30 * (number + 1)), before)
        bank.take(other)
        assert len(bank._cache) <= KEPT
        before = later(known, other)
        bank.take(before)  # used each time
    kept = [prediction.stretches.how[0, 0] for prediction in bank._cache._kept]
    first = int(np.sum(known.ticks["phase"] == Phase.SUCTION)) - 1
    assert first in kept
    assert sorted(kept)[1:] == [first + 30 * (2 * KEPT - n) for n in reversed(range(KEPT - 1))]
    assert all(len(prediction.drawn) <= LONGEST_PIECE for prediction in bank._cache._kept)
    assert bank._stepped == len(bank._expected) == 0


@pytest.mark.parametrize("broken", [Quality.GAP, Quality.BAD])
def test_nothing_is_kept_before_the_models_have_swung_in(broken: Quality) -> None:
    cycles = list(cut([ran("gripper", seconds=20.0)]))
    bank = ModelBank(rigs.theta("gripper"))
    cycles[2] = flagged(cycles[2], broken)
    kept = []
    for cycle in cycles[: 4 + SWUNG_IN]:
        bank.take(cycle)
        kept.append(len(bank._cache))
    assert kept == [0] * (3 + SWUNG_IN) + [1]
