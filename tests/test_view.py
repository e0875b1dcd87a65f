"""The view: what stands in a recording, and what a viewer on this machine may do to the twin."""

import logging
import os
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest

from twin.errors import ConfigError, SourceError
from twin.events import Event, Kind
from twin.quality import Quality
from twin.signals import MBAR, SAMPLE, TICK, Command, Phase, Samples, Ticks
from twin.view import TIMELINE, Screen, View

AMBIENT = 100_000.0
START_NS = 1_790_000_000_000_000_000
MS_NS = 1_000_000
SERIES = (
    "/vacuum/measured",
    "/vacuum/expected",
    "/deviation",
    "/commands/suction",
    "/commands/blow_off",
)


def block(rows: int, first: int = 0) -> tuple[Samples, Ticks]:
    """Make rows of 1 ms at 400 mbar of vacuum measured, 410 expected, idle."""
    samples, ticks = np.zeros(rows, SAMPLE), np.zeros(rows, TICK)
    samples["sequence"] = np.arange(first, first + rows)
    samples["time_ns"] = START_NS + samples["sequence"] * MS_NS
    samples["pressure"] = AMBIENT - 400 * MBAR
    ticks["expected"] = AMBIENT - 410 * MBAR
    return samples, ticks


def record(path: Path, *blocks: tuple[Samples, Ticks], events: tuple[Event, ...] = ()) -> None:
    screen = Screen("gripper 7", path)
    view = View(screen, AMBIENT)
    for samples, ticks in blocks:
        view.write(samples, ticks, events)
        events = ()
    view.close()
    screen.close()


def rows(path: Path, entity: str, component: str) -> list[tuple[int, Any]]:
    """Read back what stands in a recording: (time in ms since START_NS, value), by time."""
    chunk = pytest.importorskip("rerun.chunk")
    found = []
    for piece in chunk.RrdReader(path).stream():
        if piece.entity_path == entity and not piece.is_static:
            batch = piece.to_record_batch()
            times = batch.column(TIMELINE).to_numpy().astype(np.int64) - START_NS
            values = [value[0] for value in batch.column(component).to_pylist()]
            found += zip((times / MS_NS).tolist(), values, strict=True)
    return sorted(found, key=lambda row: row[0])


def scalars(path: Path, entity: str) -> dict[float, float]:
    return dict(rows(path, entity, "Scalars:scalars"))


@pytest.fixture
def target(tmp_path: Path) -> Path:
    pytest.importorskip("rerun")
    return tmp_path / "view.rrd"


def test_every_row_of_every_block_is_recorded_once(target: Path) -> None:
    blocks = [block(rows, first) for rows, first in ((7, 0), (1, 7), (2500, 8), (0, 0), (3, 2508))]
    record(target, *blocks)
    for entity in SERIES:
        assert list(scalars(target, entity)) == list(range(2511)), entity


def test_vacuum_is_in_mbar_below_ambient_and_deviation_is_the_pressures(target: Path) -> None:
    record(target, block(3))
    assert scalars(target, "/vacuum/measured")[1] == pytest.approx(400)
    assert scalars(target, "/vacuum/expected")[1] == pytest.approx(410)
    assert scalars(target, "/deviation")[1] == pytest.approx(10)


def test_commands_are_steps_of_0_and_1(target: Path) -> None:
    samples, ticks = block(4)
    samples["commands"] = [0, Command.SUCTION, Command.BLOW_OFF, 3]
    record(target, (samples, ticks))
    assert list(scalars(target, "/commands/suction").values()) == [0, 1, 0, 1]
    assert list(scalars(target, "/commands/blow_off").values()) == [0, 0, 1, 1]


def test_what_is_not_a_pressure_is_not_drawn(target: Path) -> None:
    samples, ticks = block(3)
    samples["quality"][1] = Quality.OVERFLOW
    record(target, (samples, ticks))
    for entity in ("/vacuum/measured", "/deviation"):
        drawn = np.array(list(scalars(target, entity).values()))
        assert np.isnan(drawn).tolist() == [False, True, False], entity
    assert not np.isnan(list(scalars(target, "/vacuum/expected").values())).any()


def test_phases_are_sent_where_they_change_and_across_blocks(target: Path) -> None:
    (samples, ticks), (later, later_ticks) = block(1500), block(1500, 1500)
    ticks["phase"][1000:] = later_ticks["phase"][:200] = Phase.SUCTION
    later_ticks["phase"][200:] = Phase.HOLD
    record(target, (samples, ticks), (later, later_ticks))
    assert rows(target, "/phase", "StateChange:state") == [
        (0, "idle"),
        (1000, "suction"),
        (1700, "hold (air saving)"),
    ]


@pytest.mark.parametrize("split", [False, True], ids=["in a block", "between two"])
def test_no_line_is_drawn_where_nothing_was_measured(target: Path, split: bool) -> None:
    (first, ticks), (second, more) = block(1200), block(3, 9000)
    second["quality"][0] = Quality.GAP
    blocks = [(first, ticks), (second, more)]
    if not split:
        blocks = [(np.concatenate([first, second]), np.concatenate([ticks, more]))]
    record(target, *blocks)
    after = 1199 + 1e-6  # one nanosecond after the last row before the gap
    for entity in SERIES:
        drawn = scalars(target, entity)
        assert [time for time, value in drawn.items() if np.isnan(value)] == [after], entity
        assert not np.isnan(drawn[9000])
    assert rows(target, "/phase", "StateChange:state") == [(0, "idle"), (after, ""), (9000, "idle")]


def test_a_break_before_the_first_row_leaves_nothing_to_lift(target: Path) -> None:
    samples, ticks = block(2)
    samples["quality"][0] = Quality.RESTART
    record(target, (samples, ticks))
    assert list(scalars(target, "/vacuum/measured")) == [0, 1]


def test_rows_are_sent_when_enough_time_is_there_or_nothing_more_comes(
    target: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[int] = []
    monkeypatch.setattr(View, "_send_phases", lambda _, samples, __: sent.append(len(samples)))
    screen = Screen("gripper 7", target)
    view = View(screen, AMBIENT)
    view.write(*block(600), [])
    assert sent == []
    view.write(*block(500, 600), [])
    assert sent == [1100]
    view.write(*block(5, 1100), [])
    view.write(*block(0), [])  # the source is idle: nothing is held back
    assert sent == [1100, 5]
    view.write(*block(1, 9000), [])
    view.write(*block(1), [])  # the PLC's clock jumped back
    assert sent == [1100, 5, 2]
    screen.close()


def test_events_are_a_text_log_with_levels(target: Path) -> None:
    alarm = Event(START_NS + 5 * MS_NS, Kind.DEVIATION, "31 mbar above expected")
    cycle = Event(START_NS + 9 * MS_NS, Kind.CYCLE, "750 mbar after 1.7 s")
    record(target, block(10), events=(alarm, cycle))
    assert rows(target, "/events/deviation", "TextLog:text") == [(5, alarm.text)]
    assert rows(target, "/events/deviation", "TextLog:level") == [(5, "ERROR")]
    assert rows(target, "/events/cycle", "TextLog:level") == [(9, "INFO")]


def test_alarms_stand_beside_events(target: Path) -> None:
    alarm = Event(START_NS + 5 * MS_NS, Kind.ALARM, "raised")
    gone = Event(START_NS + 9 * MS_NS, Kind.ALARM_CHANGED, "acknowledged")
    record(target, block(10), events=(alarm, gone))
    assert rows(target, "/alarms/alarm", "TextLog:level") == [(5, "WARN")]
    assert rows(target, "/alarms/alarm_changed", "TextLog:text") == [(9, gone.text)]
    assert not rows(target, "/events/alarm", "TextLog:text")


def test_probabilities_of_what_is_no_longer_likely_come_to_0(target: Path) -> None:
    said = ({"none": 1.0}, {"none": 0.1, "leakage": 0.9}, None, {"none": 0.3, "sensor_lag": 0.7})
    events = tuple(
        Event(
            START_NS + at * MS_NS,
            Kind.CYCLE,
            "",
            {} if probabilities is None else {"probabilities": probabilities},
        )
        for at, probabilities in enumerate(said)
    )
    record(target, block(10), events=events)
    assert scalars(target, "/probabilities/none") == {0: 1.0, 1: 0.1, 3: 0.3}
    assert scalars(target, "/probabilities/leakage") == {1: 0.9, 3: 0.0}
    assert scalars(target, "/probabilities/sensor_lag") == {3: 0.7}


def test_several_ejectors_are_apart_in_one_recording(target: Path) -> None:
    names = ("rig-01", "grüner_2.b")
    screen = Screen("two", target, names)
    views = [View(screen, AMBIENT, name) for name in names]
    said = {"probabilities": {"none": 1.0}}
    for number, view in enumerate(views):
        event = Event(START_NS, Kind.CYCLE, f"of {names[number]}", said)
        view.write(*block(7 + number), [event])
        view.close()
    screen.close()
    for number, name in enumerate(("rig-01", "grüner_2.b")):
        for entity in SERIES:
            assert len(scalars(target, f"/{name}{entity}")) == 7 + number
        assert rows(target, f"/{name}/phase", "StateChange:state") == [(0, "idle")]
        assert rows(target, f"/{name}/events/cycle", "TextLog:text") == [(0, f"of {names[number]}")]
        assert scalars(target, f"/{name}/probabilities/none") == {0: 1.0}
    assert layout(target) == {"TimeSeries": 2 * 4 + 2 * 2, "StateTimeline": 2, "TextLog": 2 * 2 + 1}


def layout(path: Path) -> Counter[str]:
    """Count the views of each kind that a recording asks for."""
    reader = pytest.importorskip("rerun.chunk").RrdReader(path)
    (plan,) = reader.blueprints()
    kinds: Counter[str] = Counter()
    for piece in reader.stream(store=plan):
        batch = piece.to_record_batch()
        if "ViewBlueprint:class_identifier" in batch.schema.names:
            kinds.update(
                kind for (kind,) in batch.column("ViewBlueprint:class_identifier").to_pylist()
            )
    return kinds


def test_layout_and_name_stand_in_the_recording(target: Path) -> None:
    record(target, block(10))
    assert layout(target) == {"TimeSeries": 4, "StateTimeline": 1, "TextLog": 2}
    reader = pytest.importorskip("rerun.chunk").RrdReader(target)
    properties = [
        p.to_record_batch().to_pydict() for p in reader.stream() if "prop" in p.entity_path
    ]
    assert any(p.get("RecordingInfo:name") == [["gripper 7"]] for p in properties)


def test_closing_twice_and_writing_after_it_does_nothing(target: Path) -> None:
    screen = Screen("gripper 7", target)
    view = View(screen, AMBIENT)
    screen.close()
    view.write(*block(2), [])
    view.close()
    screen.close()
    assert not scalars(target, "/deviation")


def test_file_that_cannot_be_written_is_named(target: Path) -> None:
    path = target / "nowhere" / "view.rrd"
    with pytest.raises(SourceError, match="nowhere"):
        Screen("gripper 7", path)


def test_missing_rerun_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ConfigError) as caught:
        Screen("gripper 7", tmp_path / "view.rrd")
    assert "[view]" in caught.value.hint


@pytest.fixture
def live(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Screen, psutil.Process]]:
    """Start a view with a viewer that serves a page; there is no window in a test."""
    pytest.importorskip("rerun")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "CI"):
        monkeypatch.delenv(name, raising=False)
    before = psutil.Process().children()
    screen = Screen("gripper 7", None)
    (viewer,) = (process for process in psutil.Process().children() if process not in before)
    yield screen, viewer
    screen.close()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the viewer opens a window")
class TestLive:
    @pytest.mark.slow
    def test_listens_on_loopback_only_and_ends_with_the_view(
        self, live: tuple[Screen, psutil.Process]
    ) -> None:
        screen, viewer = live
        view = View(screen, AMBIENT)
        listening = [c.laddr for c in viewer.net_connections("inet") if c.status == "LISTEN"]
        assert {address.ip for address in listening} == {"127.0.0.1"}
        assert urlsplit(screen.url).port in {address.port for address in listening}
        view.write(*block(200), [])
        view.close()
        assert viewer.is_running()  # other views may draw on
        screen.close()
        assert not viewer.is_running()

    def test_sends_no_usage_statistics(self, live: tuple[Screen, psutil.Process]) -> None:
        assert live[1].environ()["CI"]  # what Rerun looks at before it reports anything

    def test_a_viewer_that_was_closed_ends_the_view_only(
        self, live: tuple[Screen, psutil.Process], caplog: pytest.LogCaptureFixture
    ) -> None:
        screen, viewer = live
        view = View(screen, AMBIENT)
        viewer.kill()
        with caplog.at_level(logging.WARNING):
            for first in range(0, 1_000_000, 100):
                view.write(*block(101, first), [])
                if caplog.text:  # the kill takes its time on a busy machine
                    break
            view.write(*block(101, 1_000_000), [])
        assert caplog.text.count("going on without it") == 1

    def test_a_viewer_that_hangs_ends_the_view_only(
        self, live: tuple[Screen, psutil.Process], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        screen, viewer = live
        view = View(screen, AMBIENT)
        monkeypatch.setattr("twin.view.MISSES", 2)
        os.kill(viewer.pid, signal.SIGSTOP)
        for first in range(0, 20_000_000, 100_000):
            view.write(*block(100_000, first), [])
            if not psutil.pid_exists(viewer.pid):
                break
        assert not viewer.is_running()
