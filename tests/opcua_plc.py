"""A simulated PLC that serves OPC UA, in a process of its own, with certificates for both sides."""

import shutil
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rigs
import tomli_w
from plc_process import PlcProcess, start_plc

from drivers.opcua import certificates
from drivers.opcua.settings import OpcuaSettings


@dataclass(frozen=True)
class OpcuaPlc:
    """A running PLC; ``folder`` has its configuration and the certificates."""

    process: PlcProcess
    url: str
    folder: Path

    @property
    def ours(self) -> Path:
        """Certificates of a client that this PLC trusts, and that trusts it."""
        return self.folder / "ours"

    @property
    def port(self) -> int:
        return int(self.url.rpartition(":")[2])

    def settings(self, **changes: Any) -> OpcuaSettings:
        """The shipped configuration for this server; tables are replaced, not merged."""
        table = tables()["driver"] | {"url": self.url} | changes
        return OpcuaSettings.model_validate(table)

    def secure(self, policy: str, folder: Path | None = None) -> dict[str, Any]:
        return {"policy": policy, "certificates": folder or self.ours}


def tables() -> dict[str, Any]:
    return tomllib.loads(rigs.path_of("test_rig_opcua").read_text(encoding="utf-8"))


def acquainted(folder: Path) -> None:
    """Certificates for the PLC and for us, each trusted by the other."""
    theirs, ours = folder / "theirs", folder / "ours"
    certificates.make(theirs, "plc")
    certificates.make(ours)
    trust(ours, theirs)
    trust(theirs, ours)


def trust(folder: Path, other: Path, place: str = certificates.TRUSTED) -> None:
    (folder / place).mkdir(exist_ok=True)
    shutil.copy(other / certificates.OWN, folder / place / f"{other.name}.der")


def write(folder: Path, **changes: Any) -> Path:
    """The configuration of a PLC with other settings for its OPC UA server."""
    document = tables()
    document["plc"]["opcua"] |= {"port": 0} | changes
    path = folder / "plc.toml"
    path.write_text(tomli_w.dumps(document), encoding="utf-8")
    return path


def started(folder: Path, **changes: Any) -> OpcuaPlc:
    process = start_plc(write(folder, **changes), "--seed", "3")
    assert process.process.stdout is not None
    line = process.process.stdout.readline()
    return OpcuaPlc(process, line.strip().removeprefix("OPC UA on "), folder)


@contextmanager
def start_opcua(folder: Path, **changes: Any) -> Iterator[OpcuaPlc]:
    """Run it while the context lasts; with certificates, if ``policies`` are named alone."""
    if "policies" in changes and "certificates" not in changes:
        acquainted(folder)
        changes["certificates"] = str(folder / "theirs")
    plc = started(folder, **changes)
    with plc.process:
        yield plc
