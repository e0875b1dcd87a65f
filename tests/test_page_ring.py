"""Live rows on their way to the page: no peak is hidden, no torn row shown, nobody waits."""

import itertools
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from page_site import AMBIENT, NOW, S, flat

from twin.errors import SourceError
from twin.page import ring
from twin.page.ring import DEPTH, FILE, ROW_NS, LiveRows, read
from twin.quality import Quality
from twin.signals import SAMPLE, TICK, Command, Phase

PER_ROW = ROW_NS // 1_000_000  # samples


class Clock:
    now = NOW

    def __call__(self) -> int:
        return self.now


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "new" / "live.ring"


def left(path: Path, *blocks: tuple[np.ndarray, np.ndarray], clock: Clock | None = None) -> None:
    """Write blocks, to the end."""
    live = LiveRows(path, AMBIENT, pytest.fail, clock or Clock())
    for samples, ticks in blocks:
        live.write(samples, ticks, [])
    live.close()


def test_a_row_has_the_lowest_and_the_highest_of_its_time(path: Path) -> None:
    samples, ticks = flat(2 * PER_ROW + 1)
    samples["pressure"][7], samples["pressure"][9] = 2e5, 3e4
    ticks["expected"][11], ticks["phase"] = 1e4, Phase.HOLD
    samples["commands"][3] = Command.SUCTION
    samples["quality"][4] = Quality.GAP
    left(path, (samples, ticks))
    live = read(path)
    assert live is not None
    first, second = live.rows
    assert (first["measured_low"], first["measured_high"]) == (np.float32(3e4), np.float32(2e5))
    assert (first["expected_low"], first["expected_high"]) == (np.float32(1e4), np.float32(9e4))
    assert (first["phase"], first["commands"], first["quality"]) == (2, 1, 1)
    assert first["time_ns"] == (PER_ROW - 1) * 1_000_000
    assert second["measured_low"] == second["measured_high"] == np.float32(1e5)
    assert (live.ambient, live.next) == (AMBIENT, 2)


def test_rows_are_the_same_however_the_loop_cuts_its_blocks(tmp_path: Path) -> None:
    samples, ticks = flat(500)
    samples["pressure"] += np.arange(500)
    left(tmp_path / "whole", (samples, ticks))
    cuts = [0, 1, 13, 40, 41, 300, 500]
    parts = [slice(a, b) for a, b in itertools.pairwise(cuts)]
    left(tmp_path / "cut", *((samples[part], ticks[part]) for part in parts))
    whole, cut = read(tmp_path / "whole"), read(tmp_path / "cut")
    assert whole is not None
    assert cut is not None
    assert len(whole.rows) == 500 // PER_ROW - 1
    np.testing.assert_array_equal(whole.rows, cut.rows)


def test_what_is_no_pressure_is_not_shown_as_one(path: Path) -> None:
    samples, ticks = flat(2 * PER_ROW + 1)
    samples["quality"][: PER_ROW + 5] = Quality.STALE
    samples["pressure"][: PER_ROW + 5] = 7.0
    left(path, (samples, ticks))
    live = read(path)
    assert live is not None
    assert np.isnan(live.rows["measured_low"][0])
    assert live.rows["measured_low"][1] == np.float32(1e5)


def test_the_ring_goes_round_and_only_what_is_new_is_read(path: Path) -> None:
    left(path, flat((DEPTH + 10) * PER_ROW + 1))
    live = read(path)
    assert live is not None
    assert live.next == DEPTH + 10
    np.testing.assert_array_equal(live.rows["number"], np.arange(10, DEPTH + 10))
    later = read(path, live.next - 3)
    assert later is not None
    assert len(later.rows) == 3


def test_numbers_go_on_when_a_run_begins_again(path: Path) -> None:
    left(path, flat(3 * PER_ROW + 1))
    left(path, flat(2 * PER_ROW + 1))
    live = read(path, 3)
    assert live is not None
    assert list(live.rows["number"]) == [3, 4]
    assert list(live.rows["time_ns"] // ROW_NS) == [0, 1]


@pytest.mark.parametrize("torn", ["number", "again"])
def test_a_row_that_is_being_written_is_left_out(path: Path, torn: str) -> None:
    left(path, flat(4 * PER_ROW + 1))
    content = np.fromfile(path, FILE)
    content["rows"][torn][0, 2] += DEPTH
    content.tofile(path)
    live = read(path)
    assert live is not None
    assert list(live.rows["number"]) == [0, 1, 3]


def test_a_run_is_there_while_its_loop_is_heard_of(path: Path) -> None:
    clock = Clock()
    live = LiveRows(path, AMBIENT, pytest.fail, clock)
    begun = read(path)
    assert begun is not None
    assert begun.is_running(NOW + 4 * S)
    assert not begun.is_running(NOW + 6 * S)
    clock.now = NOW + 5 * S
    live.write(np.empty(0, SAMPLE), np.empty(0, TICK), [])  # nothing came, but the loop is there
    live.close()
    ended = read(path)
    assert ended is not None
    assert (ended.alive_ns, ended.last_ns) == (NOW + 5 * S, NOW + 5 * S)
    assert not ended.is_running(NOW + 5 * S)


def test_a_plc_that_begins_anew_does_not_stop_the_rows(path: Path) -> None:
    left(path, flat(2 * PER_ROW, 60 * S), flat(2 * PER_ROW + 1, 0))
    live = read(path)
    assert live is not None
    assert list(live.rows["time_ns"] // ROW_NS) == [2400, 2401, 0, 1]


def test_while_plc_time_stands_still_no_more_than_a_bound_is_held(path: Path) -> None:
    samples, ticks = flat(PER_ROW)
    samples["time_ns"] = 60 * S
    held = samples[:0], ticks[:0]
    rows: list[np.float32] = []
    for _ in range(200):
        held = np.concatenate([held[0], samples]), np.concatenate([held[1], ticks])
        made, held = ring._bin_rows(*held)
        rows.extend(made["measured_low"])
        assert len(held[0]) == len(held[1]) < ring.MOST_HELD
    assert rows == [np.float32(1e5)] * (200 * PER_ROW // ring.MOST_HELD)
    left(path, *[(samples, ticks)] * 200)
    live = read(path)
    assert live is not None
    assert live.next == len(rows)


def test_rows_that_cannot_be_written_are_left_out_and_said_once(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add, said, failures = (
        ring._Writer.add,
        list[str](),
        iter([MemoryError(), ValueError("a defect")]),
    )

    def fall(writer: Any, rows: Any) -> None:
        for error in failures:
            raise error
        add(writer, rows)

    monkeypatch.setattr(ring._Writer, "add", fall)
    live = LiveRows(path, AMBIENT, said.append)
    for at in range(5):
        live.write(*flat(PER_ROW, at * ROW_NS), [])
    live.close()
    assert said == ["the page's live rows: some are missing: MemoryError: "]
    found = read(path)
    assert found is not None
    assert found.next == 2  # a row is written once the next one begins


def test_another_run_of_the_same_ejector_is_refused(path: Path) -> None:
    first = LiveRows(path, AMBIENT, pytest.fail)
    with pytest.raises(SourceError, match="cannot be written") as caught:
        LiveRows(path, AMBIENT, pytest.fail)
    assert "one run at a time" in caught.value.hint
    first.close()
    left(path, flat(1))


def test_a_slow_disk_costs_rows_and_is_said_once(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ring, "MOST_WAITING", 2)
    slow, said = threading.Event(), list[str]()
    add = ring._Writer.add
    monkeypatch.setattr(ring._Writer, "add", lambda *told: (slow.wait(), add(*told))[1])
    live = LiveRows(path, AMBIENT, said.append)
    for at in range(20):
        live.write(*flat(PER_ROW, at * ROW_NS), [])  # does not wait
    assert said == ["the page's live rows: some are missing: cannot be written quickly enough"]
    slow.set()
    live.close()


@pytest.mark.parametrize("content", [b"", b"x" * 100, b"x" * FILE.itemsize, b"\0" * FILE.itemsize])
def test_a_file_that_is_no_ring_is_nothing_and_is_made_one(path: Path, content: bytes) -> None:
    path.parent.mkdir()
    path.write_bytes(content)
    assert read(path) is None
    left(path, flat(2 * PER_ROW + 1))
    live = read(path)
    assert live is not None
    assert live.next == 2
