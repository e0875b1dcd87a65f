"""PLCs of other make, each in a process of its own, that the drivers are tested against.

node-opcua (npm) as an OPC UA server, libmodbus (Debian) as a Modbus server, and before it stunnel
(Debian) for Modbus/TCP Security. They serve a known signal: a pressure says which scan it is of.
"""

import json
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rigs
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from drivers.opcua import certificates
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks as simulated_blocks

PEERS = Path(__file__).parent / "peers"
PATIENCE_S = 30.0  # a busy machine takes longer than others
SCANS = 150_000
COMMANDS = np.array([0, 1, 0, 2], np.uint8)  # for 256 scans each, over and over


@dataclass(frozen=True)
class Truth:
    """What scan after scan has, from scan 0 on."""

    pressure: npt.NDArray[np.float32]  # Pa
    commands: npt.NDArray[np.uint8]


@cache
def known_signal() -> Truth:
    """What the peers of other make serve."""
    scan = np.arange(SCANS)
    mbar = 200.0 + (scan % 4096) * 0.25
    return Truth((mbar * 100).astype(np.float32), COMMANDS[scan >> 8 & 3])


@cache
def simulated(seed: int) -> Truth:
    """What the simulated PLC serves."""
    plc = rigs.config("test_rig").document.section(PlcSettings, "plc")
    samples = np.concatenate(list(simulated_blocks(plc, SCANS * 1e-3, seed=seed)))
    return Truth(samples["pressure"].copy(), samples["commands"].copy())


# --- processes ----------------------------------------------------------------------------------


def modbus_program(folder: Path) -> Path:
    """The server around libmodbus, compiled into ``folder`` unless it is there."""
    program = folder / "modbus_server"
    if program.exists():
        return program
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "libmodbus"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    options = ["-O2", "-Wall", "-Wextra", "-Werror", "-pthread", "-o", program]
    source = PEERS / "modbus_server.c"
    subprocess.run(["cc", *options, source, *flags], check=True, timeout=60)
    return program


@dataclass
class Server:
    """Running programs, of which the last is the one that clients reach at ``port``."""

    port: int
    programs: list["subprocess.Popen[str]"] = field(default_factory=list)

    def kill(self) -> None:
        """End all without warning, as a power cut would."""
        for program in self.programs:
            program.kill()
        for program in self.programs:
            program.wait(PATIENCE_S)
            for pipe in (program.stdout, program.stderr):
                if pipe is not None:
                    pipe.close()


def _listening(command: Sequence[str | Path]) -> "tuple[subprocess.Popen[str], int]":
    """Start it and wait until it says "listening on HOST:PORT"."""
    program = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=PEERS
    )
    assert program.stdout is not None
    for line in program.stdout:
        if line.startswith("listening on "):
            return program, int(line.rsplit(":", 1)[1])
    Server(0, [program]).kill()
    raise RuntimeError(f"{command[0]} did not start")


@contextmanager
def _until_done(server: Server) -> Iterator[Server]:
    try:
        yield server
    finally:
        server.kill()


@contextmanager
def libmodbus(folder: Path, port: int = 0) -> Iterator[Server]:
    """Plain registers and the ring, at 1 kHz."""
    program, port = _listening([modbus_program(folder), str(port)])
    with _until_done(Server(port, [program])) as server:
        yield server


@contextmanager
def libmodbus_in_tls(
    folder: Path, port: int = 0, certificate: Path | None = None, clients: Path | None = None
) -> Iterator[Server]:
    """The same behind stunnel, with ``folder/plc`` or another certificate; ``clients`` may come."""
    program, inner = _listening([modbus_program(folder), "0"])
    server = Server(port or free_port(), [program])
    with _until_done(server):
        lines = [
            *("foreground = yes", "pid =", "syslog = no", "debug = err", "[modbus]"),
            f"accept = 127.0.0.1:{server.port}",
            f"connect = 127.0.0.1:{inner}",
            f"cert = {certificate or pem(folder / 'plc')}",
            f"key = {folder / 'plc' / certificates.KEY}",
            *([f"CAfile = {clients}", "verifyPeer = yes"] if clients else []),
        ]
        config = folder / f"stunnel-{server.port}.conf"
        config.write_text("\n".join(lines) + "\n", encoding="utf-8")
        server.programs.append(
            subprocess.Popen(["stunnel", config], stderr=subprocess.DEVNULL, text=True)
        )
        _wait_for(server.port)
        yield server


@contextmanager
def node_opcua(folder: Path, port: int = 0, **options: Any) -> Iterator[Server]:
    """The trace as arrays, and single nodes; ``folder`` has certificates as ``opcua_plc`` makes."""
    own = certificates.own(folder / "theirs", datetime.now(UTC))
    told = {
        "port": port,
        "folder": str(folder),
        "certificate": str(own.path),
        "key": str(own.key),
        "uri": own.uri,
        "trusted": [str(folder / "ours" / certificates.OWN)],
    }
    script = PEERS / "opcua_server.js"
    program, port = _listening(["node", script, json.dumps(told | options)])
    with _until_done(Server(port, [program])) as server:
        yield server


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def _wait_for(port: int) -> None:
    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
        except OSError:
            if time.monotonic() > end:
                raise
            time.sleep(0.02)
        else:
            return


def pem(folder: Path) -> Path:
    """The certificate of a folder by ``certificates.make``, as PEM."""
    path = folder / "certificate.pem"
    certificate = x509.load_der_x509_certificate((folder / certificates.OWN).read_bytes())
    path.write_bytes(certificate.public_bytes(Encoding.PEM))
    return path
