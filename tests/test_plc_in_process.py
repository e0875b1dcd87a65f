"""The simulated PLC in this process: it ends by itself, keeps what it scanned, and can be set."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import rigs

from drivers.plc.live import SET_NS, WITNESSED, announce, run_plc
from drivers.plc.settings import PlcSettings


def test_it_keeps_every_scan_and_its_clock_can_be_set(tmp_path: Path) -> None:
    settings = rigs.config("gripper").document.section(PlcSettings, "plc")
    server = settings.server.model_copy(update={"port": 0})
    settings = settings.model_copy(update={"server": server, "opcua": None})
    witness, where = tmp_path / "scans", list[tuple[str, int]]()

    def ready(host: str, port: int) -> None:
        where.append((host, port))
        os.kill(os.getpid(), signal.SIGUSR1)  # the loop takes it once it runs

    run_plc(settings, seed=3, duration_s=0.3, ready=ready, witness=witness)
    rows = np.fromfile(witness, WITNESSED)
    assert len(where) == 1
    assert where[0][1] > 0
    assert np.array_equal(rows["sequence"], rows["sequence"][0] + np.arange(len(rows)))
    ahead_ns = int(rows["time_ns"][-1]) - time.time_ns()
    assert SET_NS // 2 < ahead_ns <= SET_NS


def test_no_time_ends_it_at_once() -> None:
    settings = rigs.config("gripper").document.section(PlcSettings, "plc").on_port(0)
    settings = settings.model_copy(update={"opcua": None})
    listening = list[int]()
    run_plc(settings, duration_s=0.0, ready=lambda _, port: listening.append(port))
    assert len(listening) == 1


def test_it_says_where_it_listens(capsys: pytest.CaptureFixture[str]) -> None:
    announce("127.0.0.1", 502)
    assert capsys.readouterr().out == "listening on 127.0.0.1:502\n"
