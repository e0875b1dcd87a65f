"""A real PostgreSQL server in a folder of its own, reached by a socket in that folder alone."""

import os
import pwd
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psycopg
import pytest

PATIENCE_S = 30.0
QUIET = ("autovacuum=off", "fsync=off", "listen_addresses=", "max_logical_replication_workers=0")


def somebody_else() -> dict[str, Any]:
    """Whom to run the server as: PostgreSQL refuses root."""
    if os.geteuid() != 0:
        return {}
    for name in ("postgres", "nobody"):
        try:
            user = pwd.getpwnam(name)
        except KeyError:
            continue
        return {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []}
    pytest.skip("PostgreSQL refuses root, and there is neither a user postgres nor nobody")


@contextmanager
def postgres_server() -> Iterator[Path]:
    """Start a server, give the folder of its socket, and stop it."""
    user = somebody_else()
    with tempfile.TemporaryDirectory(prefix="pg", dir="/tmp") as name:  # short, for the socket
        folder = Path(name)
        if user:
            os.chown(folder, user["user"], user["group"])
        options = ["-A", "trust", "-U", "test", "-E", "UTF8", "--locale=C", "--no-sync"]
        cluster = folder / "cluster"
        started = {"cwd": folder, **user, "stdout": subprocess.DEVNULL}
        subprocess.run(
            ["initdb", "-D", cluster, *options], check=True, timeout=PATIENCE_S, **started
        )
        settings = [part for setting in QUIET for part in ("-c", setting)]
        command = ["postgres", "-D", cluster, "-k", folder, *settings]
        with subprocess.Popen(command, stderr=subprocess.DEVNULL, **started) as server:
            try:
                _wait_for(folder, server)
                yield folder
            finally:
                server.send_signal(signal.SIGINT)  # fast shutdown: clients are cut off
                _end(server)


def make_schema(folder: Path, name: str) -> str:
    """Make an empty place for tables, quicker than a database; gives its URL."""
    with psycopg.connect(f"host={folder} user=test dbname=postgres", autocommit=True) as server:
        server.execute(f"CREATE SCHEMA {name}".encode())
    return f"postgresql://test@/postgres?host={folder}&options=-csearch_path%3D{name}"


def _wait_for(folder: Path, server: "subprocess.Popen[bytes]") -> None:
    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            psycopg.connect(f"host={folder} user=test dbname=postgres").close()
        except psycopg.OperationalError:
            if server.poll() is not None or time.monotonic() > end:
                raise
            time.sleep(0.05)
        else:
            return


def _end(server: "subprocess.Popen[bytes]") -> None:
    try:
        server.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        server.kill()
        raise
