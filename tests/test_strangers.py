"""A log may be anybody's: what its own configuration names is never opened."""

import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rigs
from command_line import twin

from twin.config import Config
from twin.log.header import LogHeader
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.signals import TICK


@pytest.fixture
def theirs() -> Iterator[socket.socket]:
    """The server of somebody else: nobody is to come."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        yield server


def came(server: socket.socket) -> bool:
    try:
        server.accept()[0].close()
    except BlockingIOError:
        return False
    return True


def written(path: Path, tables: str, config_name: str = "g.toml") -> Path:
    samples, _ = rigs.recorded("gripper", 1.0)
    text = rigs.config("gripper").document.text
    with Recorder(path, LogHeader("compact-ejector-35", "", config_name, text + tables)) as log:
        log.write(samples, np.zeros(len(samples), TICK))
    return path


@pytest.mark.parametrize("name", ["g.toml", "/tmp/elsewhere/g.toml", "../g.toml"])
def test_a_log_without_a_data_set_opens_no_server(
    tmp_path: Path, theirs: socket.socket, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("PGPASSWORD", "s3cret")
    monkeypatch.chdir(tmp_path)
    url = f"postgresql://me@127.0.0.1:{theirs.getsockname()[1]}/x"
    tables = "".join(f'\n[{table}]\nurl = "{url}"\n' for table in ("assets", "figures", "alarms"))
    log = written(tmp_path / "log.mcap", tables, name)
    assert twin(monkeypatch, "replay", log) == 0
    assert not came(theirs)


def test_a_log_without_a_data_set_writes_into_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    victim = tmp_path / "victim.sqlite"
    victim.touch()
    tables = "".join(
        f'\n[{table}]\nurl = "{victim}"\nkeep = true\n' for table in ("figures", "alarms")
    )
    log = written(tmp_path / "log.mcap", f'{tables}\n[assets]\nurl = "{victim}"\n')
    assert twin(monkeypatch, "replay", log) == 0
    assert twin(monkeypatch, "figures", "show", log) == 0
    assert victim.read_bytes() == b""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.mcap", "victim.sqlite"]


def test_what_a_log_names_is_not_in_its_configuration(tmp_path: Path) -> None:
    tables = '\n[alarms]\nrules = "/etc/passwd"\n[figures]\nurl = "/x"\nautoset_tolerance = 0.5\n'
    log = open_log(written(tmp_path / "log.mcap", tables))
    config = Config.of_recorded(log.header, "log")
    assert "alarms" not in config.document.tables
    assert config.document.tables["figures"] == {"autoset_tolerance": 0.5}
    assert config.log_header().config_text.endswith(tables)  # and another log has it as it was
