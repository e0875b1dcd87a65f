"""The command line: exit codes, messages for people, and logs that survive what is done to it."""

import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rigs
from command_line import edited, twin
from plc_process import PlcProcess, start_plc

from twin.alarms.loop import Alarms
from twin.alarms.settings import board_rules
from twin.cli.console import Console
from twin.cli.setup import pair_of
from twin.events import Event, Kind
from twin.figures.cycle import KeyFigures
from twin.live import run
from twin.log.header import LogHeader
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.model.courses import table as courses
from twin.model.effects import EFFECTS, table
from twin.model.mechanism import PLACES, WHENS
from twin.signals import SAMPLE, TICK

GRIPPER = rigs.path_of("gripper")
PATIENCE_S = 30.0  # s; only a busy machine takes so long


@contextmanager
def started(*arguments: str | Path) -> Iterator["subprocess.Popen[str]"]:
    """Run the command line as a process of its own; it is killed at the end if it still runs."""
    command = [sys.executable, "-m", "twin.cli", *map(str, arguments)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=rigs.ROOT, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def make_log(path: Path, name: str, faults: tuple[str, ...]) -> Path:
    document = rigs.config(name).document
    clock = count(0.0, 0.5).__next__  # half a second for each block, so that each is flushed
    recorder = Recorder(path, LogHeader("type", "id", f"{name}.toml", document.text), clock=clock)
    blocks = rigs.cut(rigs.recorded(name, 25.0, faults)[0], 500)
    monitor = rigs.isolating(name)
    monitor.key_figure_source = KeyFigures(rigs.config(name).data)  # as the program has it
    alarms = Alarms(board_rules(None), None)
    run(blocks, rigs.twin(name), monitor, [recorder], advisers=[alarms])
    return path


@pytest.fixture(scope="module")
def faulty_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_log(tmp_path_factory.mktemp("log") / "f.mcap", "test_rig", ("sensor_lag=25@c3",))


@pytest.fixture(scope="module")
def healthy_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_log(tmp_path_factory.mktemp("log") / "h.mcap", "test_rig", ())


# Messages.


def test_the_effects_are_written_as_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "effects.json"
    assert twin(monkeypatch, "effects", "--json", file) == 0
    answer = json.loads(file.read_text())
    assert [effect["name"] for effect in answer["effects"]] == list(EFFECTS)
    leak = answer["effects"][0]
    assert leak["sentence"] == EFFECTS[leak["name"]].sentence
    (flow,) = leak["parameters"]
    declared = EFFECTS[leak["name"]].parameters[0]
    assert flow == {
        "name": "sonic_flow",
        "unit": "sl/min",
        "low": declared.low,
        "high": declared.high,
    }
    assert {"constant", "ramp"} <= {course["name"] for course in answer["courses"]}
    assert twin(monkeypatch, "effects", "--json", file, "add", "x.toml") == 2


def test_effects_are_listed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "effects") == 0
    out = capsys.readouterr().out
    assert out.startswith(f"{table('; ')}\n\n{courses()}")
    assert all(f"| `{name}` |" in out for name in (*PLACES, *WHENS))
    assert "| `h1_shift` -200 to 200 mbar; `h2_shift` -200 to 200 mbar |" in out  # for a terminal
    assert "<" not in out


@pytest.mark.parametrize("command", ["run", "replay", "plc", "probe", "effects", "log"])
def test_every_command_explains_itself(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, command, "--help") == 0
    assert command in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [("run",), ("walk",), ("run", GRIPPER, "--fast"), ("log",)])
def test_wrong_usage_is_exit_code_2(
    arguments: Sequence[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert twin(monkeypatch, *arguments) == 2


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("optimum_bar = ", "optinum_bar = ", "data.supply.optinum_bar: unknown key"),
        ("optimum_bar = ", "optimum_bar = -", "data.supply.optimum_bar: "),
        ("interval_ms = 30", "interval_ms = 3000", "driver.interval_ms: "),
        ("[asset]", "[aset]", "unknown table [aset]"),
    ],
)
def test_a_wrong_configuration_is_exit_code_2_with_its_place(
    old: str,
    new: str,
    key: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, line = edited(tmp_path, old, new)
    assert twin(monkeypatch, "run", path) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"twin: {path}:{line}: {key}")
    assert len(said.splitlines()) >= 2  # a hint


def test_no_configuration_is_exit_code_3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "run", tmp_path / "none.toml") == 3
    assert "none.toml: cannot be read" in capsys.readouterr().err


def test_no_plc_is_exit_code_3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))  # and does not listen
        address = f"127.0.0.1:{nobody.getsockname()[1]}"
        log = tmp_path / "run.mcap"
        command = ("run", GRIPPER, "--once", "--address", address, "--log", log)
        assert twin(monkeypatch, *command) == 3
    assert not log.exists()  # or the next try would find a log it may not overwrite
    said = capsys.readouterr().err
    assert f"{address}: no connection" in said
    assert "is the Modbus TCP server started there" in said


@pytest.mark.parametrize("address", ["nowhere", ":502", "10.0.0.5:", "10.0.0.5:http"])
def test_what_is_no_address_is_exit_code_2(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert twin(monkeypatch, "run", GRIPPER, "--address", address) == 2


def test_two_views_at_once_are_exit_code_2(
    plc: PlcProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = ("--view", "--rrd", tmp_path / "a.rrd")
    assert twin(monkeypatch, "run", GRIPPER, "--address", f"127.0.0.1:{plc.port}", *views) == 2


def test_a_fault_that_cannot_be_meant_is_exit_code_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "plc", GRIPPER, "--port", "0", "--fault", "leek=2") == 2
    assert "no effect 'leek'" in capsys.readouterr().err


def test_probe_says_what_answers(
    plc: PlcProcess, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "probe", GRIPPER, "--address", f"127.0.0.1:{plc.port}") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines
    assert all(line.startswith("ok") for line in lines)


# Logs.


def test_a_replay_prints_and_counts_what_happened(
    faulty_log: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    answer = tmp_path / "events.json"
    assert twin(monkeypatch, "replay", faulty_log, "--json", answer) == 0
    said = capsys.readouterr()
    assert "sensor_lag" in said.out
    assert said.err == ""  # no progress in a pipe
    events = json.loads(answer.read_text())["events"]
    stored = list(open_log(faulty_log).events())
    again = [(e["time_ns"], e["kind"], e["severity"], e["text"], e["data"]) for e in events]
    first = [(e.time_ns, e.kind, e.severity, e.text, dict(e.data)) for e in stored]
    of_alarms = (Kind.ALARM, Kind.ALARM_CHANGED)  # these follow the block they were found in
    for alarms in (False, True):
        chosen = [line for line in first if (line[1] in of_alarms) is alarms]
        assert chosen
        assert [line for line in again if (line[1] in of_alarms) is alarms] == chosen
    assert len(said.out.splitlines()) == len(stored)


def test_an_alarm_is_exit_code_1_only_where_that_is_asked_for(
    faulty_log: Path, healthy_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert twin(monkeypatch, "replay", faulty_log) == 0
    assert twin(monkeypatch, "replay", faulty_log, "--fail-on-alarm") == 1
    assert twin(monkeypatch, "replay", healthy_log, "--fail-on-alarm") == 0


def test_what_was_printed_is_let_go_of() -> None:
    """A loop runs for months, and a cycle's event has some kilobytes."""

    class Data(dict[str, float]):
        """What can be watched going."""

    data = Data(cycle=0)
    gone = weakref.ref(data)
    console = Console()
    console.write(np.empty(0, SAMPLE), np.empty(0, TICK), [Event(0, Kind.CYCLE, "cycle 0", data)])
    del data
    assert gone() is None


def test_a_replay_into_a_new_log_holds_the_same_rows(
    faulty_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out.mcap"
    assert twin(monkeypatch, "replay", faulty_log, "-o", out) == 0
    for old, new in zip(open_log(faulty_log).blocks(), open_log(out).blocks(), strict=True):
        assert [rows.tobytes() for rows in old] == [rows.tobytes() for rows in new]
    assert twin(monkeypatch, "replay", faulty_log, "-o", out) == 3  # never overwritten


def test_a_replay_with_another_configuration_expects_something_else(
    faulty_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, _ = edited(tmp_path, "volume_ml = 750.0", "volume_ml = 700.0")
    path.write_text(path.read_text().replace('id = "rig-01"', 'id = "rig-02"'))
    assert twin(monkeypatch, "replay", faulty_log, "--config", path, "-o", tmp_path / "b.mcap") == 0
    old, new = (
        np.concatenate([ticks["expected"] for _, ticks in open_log(log).blocks()])
        for log in (faulty_log, tmp_path / "b.mcap")
    )
    assert np.nanmax(np.abs(old - new)) > 1000


def test_what_is_no_log_is_exit_code_3(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "replay", GRIPPER) == 3
    assert "not an MCAP file" in capsys.readouterr().err


def test_a_torn_log_is_checked_and_recovered(
    healthy_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torn, whole = tmp_path / "torn.mcap", tmp_path / "whole.mcap"
    data = healthy_log.read_bytes()
    torn.write_bytes(data[: len(data) * 2 // 3])
    assert twin(monkeypatch, "log", "check", healthy_log) == 0
    assert twin(monkeypatch, "log", "check", torn) == 3
    assert twin(monkeypatch, "log", "recover", torn, "-o", whole) == 0
    assert twin(monkeypatch, "log", "check", whole) == 0
    assert 1000 < sum(len(samples) for samples, _ in open_log(whole).blocks()) < 25_000


# The live loop as a process.


def run_beside(plc: PlcProcess, log: Path) -> tuple[str | Path, ...]:
    return "run", GRIPPER, "--address", f"127.0.0.1:{plc.port}", "--log", log


def until_logged(log: Path, process: "subprocess.Popen[str]", pieces: int) -> None:
    """Wait until the log has grown so many times: then it is being written."""
    deadline = time.monotonic() + PATIENCE_S
    size = 0
    while pieces:
        assert time.monotonic() < deadline, "nothing is logged"
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.02)
        if log.exists() and log.stat().st_size > size:
            size = log.stat().st_size
            pieces -= 1


def rows_in(log: Path) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    rows = np.concatenate([samples for samples, _ in open_log(log).blocks()])
    assert len(rows) > 200
    return rows


@contextmanager
def not_ignored(number: signal.Signals) -> Iterator[None]:
    """Have processes take a signal that they are to ignore where the tests run under nohup."""
    before = signal.getsignal(number)
    if before == signal.SIG_IGN:
        signal.signal(number, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(number, before)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_ends_it_with_130_and_a_finished_log(
    plc: PlcProcess, tmp_path: Path, number: signal.Signals
) -> None:
    log = tmp_path / "a.mcap"
    with not_ignored(number), started(*run_beside(plc, log)) as process:
        until_logged(log, process, 4)
        process.send_signal(number)
        _, said = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 130
    assert "Traceback" not in said
    rows_in(log)
    assert open_log(log).complete


def until(done: Callable[[], bool], process: "subprocess.Popen[str]") -> None:
    """Wait for something while a process goes on."""
    deadline = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < deadline
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.05)


@pytest.mark.slow
def test_who_reads_what_it_says_may_go_and_it_goes_on(plc: PlcProcess, tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    with started(*run_beside(plc, log)) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        process.stdout.close()
        until_logged(log, process, 12)
        cycles = [event for event in open_log(log).events() if event.kind is Kind.CYCLE]
        until(lambda: len(list(open_log(log).events())) > len(cycles) + 2, process)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 130
    assert open_log(log).complete


@pytest.mark.slow
def test_a_reader_that_takes_nothing_holds_nothing_up(plc: PlcProcess, tmp_path: Path) -> None:
    """As a paused pager does: the pipe is full before the run says its first word."""
    log, (reads, writes) = tmp_path / "a.mcap", os.pipe()
    os.set_blocking(writes, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writes, b"x" * 4096)
    os.set_blocking(writes, True)
    command = [sys.executable, "-m", "twin.cli", *map(str, run_beside(plc, log))]
    with subprocess.Popen(
        command, cwd=rigs.ROOT, stdout=writes, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            until_logged(log, process, 2)
            until(lambda: len(list(open_log(log).events())) > 1, process)  # there was much to say
            until_logged(log, process, 8)
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
        assert process.returncode == 130
    assert "output lost: " in said
    assert open_log(log).complete
    assert (np.diff(rows_in(log)["sequence"]) == 1).all()
    os.close(reads)
    os.close(writes)


@pytest.mark.slow
def test_a_file_that_may_grow_no_more_is_followed_by_another(
    plc: PlcProcess, tmp_path: Path
) -> None:
    """A quota is met by a new part, with what the full one no longer took."""
    log = tmp_path / "a.mcap"
    with started(*run_beside(plc, log)) as process:
        until_logged(log, process, 2)
        most = log.stat().st_size + 20_000
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))
        third = tmp_path / "a.0002.mcap"
        until(third.exists, process)
        no_limit = resource.RLIM_INFINITY, resource.RLIM_INFINITY
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, no_limit)
        until_logged(third, process, 3)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 130
    assert (np.diff(rows_in(log)["sequence"]) == 1).all()
    told = [event.kind for event in open_log(log).events()]
    assert Kind.OUTPUT_DOWN in told
    assert Kind.OUTPUT_BACK in told


def test_an_interrupt_that_a_compiler_swallows_is_heeded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def swallows(_data: object) -> None:
        with suppress(KeyboardInterrupt):  # as callbacks from C do
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("twin.live.compiled", swallows)
    with pytest.raises(KeyboardInterrupt):
        pair_of(rigs.config("gripper"))


@pytest.mark.slow
def test_a_kill_costs_half_a_second_at_most(plc: PlcProcess, tmp_path: Path) -> None:
    """Measured from the last row logged; a stall of the whole machine may spoil a try."""
    lost_s = []
    for attempt in range(3):
        log = tmp_path / f"{attempt}.mcap"
        with started(*run_beside(plc, log)) as process:
            until_logged(log, process, 3)
            time.sleep(0.2)  # anywhere between two flushes
            process.kill()
            killed_ns = time.time_ns()
            process.wait(PATIENCE_S)
        assert not open_log(log).complete
        lost_s.append((killed_ns - int(rows_in(log)["host_ns"][-1])) * 1e-9)
        if lost_s[-1] <= 0.5:
            return
    pytest.fail(f"lost {lost_s} s")


def test_a_duration_ends_it_with_0(
    plc: PlcProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "a.mcap"
    assert twin(monkeypatch, *run_beside(plc, log), "--duration", "1") == 0
    rows = rows_in(log)
    assert open_log(log).complete
    assert (rows["time_ns"][-1] - rows["time_ns"][0]) * 1e-9 > 0.3


def test_in_a_folder_each_run_has_its_log_and_old_ones_make_room(
    plc: PlcProcess,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config, logs = tmp_path / "cell.toml", tmp_path / "logs"
    config.write_text(GRIPPER.read_text() + "[log]\nkeep_gb = 1e-6\n")
    logs.mkdir()
    run_once = ("run", config, "--address", f"127.0.0.1:{plc.port}", "--log", logs)
    assert twin(monkeypatch, *run_once, "--duration", "1") == 0
    (first,) = logs.glob("*.mcap")
    assert re.fullmatch(r"gripper-01\.\d{8}T\d{6}Z\.mcap", first.name)
    assert "log_deleted" not in capsys.readouterr().out
    assert twin(monkeypatch, *run_once, "--duration", "1") == 0
    (second,) = logs.glob("*.mcap")
    assert second != first
    deleted = [event.text for event in open_log(second).events() if event.kind is Kind.LOG_DELETED]
    assert len(deleted) == 1
    assert deleted[0].startswith(f"{first.name} is deleted")
    assert "log_deleted" in capsys.readouterr().out


def test_a_name_without_an_ending_is_a_folder_of_logs(
    plc: PlcProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert twin(monkeypatch, *run_beside(plc, tmp_path / "line" / "logs"), "--duration", "0.3") == 0
    (log,) = (tmp_path / "line" / "logs").glob("*.mcap")
    assert open_log(log).complete


def test_a_log_has_the_ending_of_a_log(
    plc: PlcProcess,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert twin(monkeypatch, *run_beside(plc, tmp_path / "day.txt")) == 2
    said = capsys.readouterr().err
    assert "a log is an MCAP file, and its name ends in .mcap" in said
    assert "--log" in said
    assert "day.mcap" in said
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(("used", "left"), [(79_000, 2), (81_000, 1)])
def test_by_default_old_logs_go_when_the_disk_is_four_fifths_full(
    plc: PlcProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, used: int, left: int
) -> None:
    usage = SimpleNamespace(total=100_000, used=used, free=100_000 - used)
    monkeypatch.setattr("twin.log.retention.shutil.disk_usage", lambda _: usage)
    for name in ("a", "b"):
        assert (
            twin(monkeypatch, *run_beside(plc, tmp_path / f"{name}.mcap"), "--duration", "1") == 0
        )
    assert len(list(tmp_path.glob("*.mcap"))) == left
    assert (tmp_path / "b.mcap").exists()


@pytest.mark.slow
def test_a_plc_that_restarts_is_told_and_followed_on(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    with start_plc(GRIPPER) as first, started(*run_beside(first, log)) as process:
        until_logged(log, process, 3)
        first.kill()
        with start_plc(GRIPPER, port=first.port):
            before = len(rows_in(log))
            while not any(event.kind is Kind.PLC_RESTARTED for event in open_log(log).events()):
                until_logged(log, process, 1)
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=PATIENCE_S)
    assert len(rows_in(log)) > before
