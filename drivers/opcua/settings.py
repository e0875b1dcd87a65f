"""The ``[driver]`` table for an OPC UA server: its address, its nodes, and our identity."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self
from urllib.parse import urlsplit

from pydantic import BeforeValidator, Field, PlainSerializer, model_validator

from drivers.optional_signals import BITS, refuse_unclear
from drivers.settings import DriverSettings
from drivers.tags import Flowmeter, Quantity, Thermometer
from drivers.trace import COMMAND_BITS, no_effect, refuse_unused
from twin.secret import Secret
from twin.settings import Settings

BIT_NODES = {  # of the trace's status, as `twin plc` names them singly
    "suction": "Cmd.Suction",
    "blow_off": "Cmd.BlowOff",
    "nozzle": "Meas.Nozzle",
    "air_saving": "Meas.AirSaving",
    "part_present": "Meas.PartPresent",
}
PORT = 4840  # registered for OPC UA
NODE = re.compile(r"(?:nsu=(?P<uri>[^;]+);)?(?P<identifier>[sigb]=.+)", re.DOTALL)


@dataclass(frozen=True)
class Node:
    """A node as a configuration names it; "" as URI means the driver's ``namespace``."""

    identifier: str  # identifier with its kind, such as "s=Meas.Pressure"
    uri: str = ""

    @classmethod
    def parse(cls, text: object) -> "Node":
        """Take ``"s=Meas.Pressure"`` or ``"nsu=urn:plc;s=Meas.Pressure"``; else ValueError."""
        if isinstance(text, cls):
            return text
        if match := NODE.fullmatch(str(text)):
            return cls(match["identifier"], match["uri"] or "")
        indexed = re.match(r"ns=\d+;", str(text))
        cause = "the index may be another after a restart; " if indexed else ""
        raise ValueError(
            f'"{text}" is no node: {cause}write "s=Name" (also i=, g=, b=) and the URI of its '
            'namespace as namespace = "…" in [driver], or "nsu=URI;s=Name"'
        )

    def __str__(self) -> str:
        return f"nsu={self.uri};{self.identifier}" if self.uri else self.identifier


NodeName = Annotated[
    Node,
    BeforeValidator(Node.parse, json_schema_input_type=str),
    PlainSerializer(str, return_type=str),
]


class NodeTag(Settings):
    """A value in the server that is on or off: a Boolean, or a bit of a number."""

    node: NodeName  # "s=Name", or with its namespace "nsu=URI;s=Name"
    bit: int | None = Field(default=None, ge=0, le=63)  # bit of a number, 0 the lowest


class NodePressure(Quantity):
    """A pressure in the server: a number, and what it means."""

    node: NodeName  # node as for the other tags


class NodeTemperature(Thermometer):
    """A temperature in the server."""

    node: NodeName  # node as for the other tags


class NodeFlow(Flowmeter):
    """A suction flow in the server."""

    node: NodeName  # node as for the other tags


class NodeTags(Settings):
    """The server's values that the twin reads one by one."""

    pressure: NodePressure
    suction: NodeTag | None = None
    blow_off: NodeTag | None = None
    supply: NodePressure | None = None
    nozzle: NodeTag | None = None  # nozzle on, as the ejector reports it
    # Air saving active (instead of nozzle): the nozzle is off under suction.
    air_saving: NodeTag | None = None
    part_present: NodeTag | None = None  # part present (H2 reached), as the ejector reports it
    ambient: NodePressure | None = None  # a barometer
    temperature: NodeTemperature | None = None  # temperature of the gas or the surroundings
    pressure_2: NodePressure | None = None  # second pressure at the other end of the line
    flow: NodeFlow | None = None  # suction flow

    @model_validator(mode="after")
    def _are_clear(self) -> Self:
        refuse_unclear(self.nozzle, self.air_saving, self.ambient)
        return self


class TraceNodes(Settings):
    """The PLC's trace of its scans: where it stands, and its ring as arrays of one length."""

    # Sequence number of the newest complete record, 32 bits.
    sequence: NodeName = Node("s=Trace.Sequence")
    time: NodeName = Node("s=Trace.Time")  # time of that record: ns since 1970, or a DateTime
    boot: NodeName = Node("s=Trace.Boot")  # number that changes at every restart
    period: NodeName = Node("s=Trace.Period")  # period of the scans, µs
    sequences: NodeName = Node("s=Trace.Sequences")  # sequence numbers; scan s is at s mod length
    statuses: NodeName = Node("s=Trace.Statuses")  # bits 0 suction, 1 blow-off, 8 overflow
    pressures: NodeName = Node("s=Trace.Pressures")  # pressures, scaled as in tags.pressure


class Security(Settings):
    """Protection of the connection. With a policy, all messages are signed and encrypted."""

    # Security policy by which messages are signed and encrypted.
    policy: Literal["None", "Basic256Sha256", "Aes256Sha256RsaPss"] = "None"
    # Folder made by twin cert: our certificate, and the trusted ones.
    certificates: Path | None = None

    @model_validator(mode="after")
    def _has_certificates(self) -> Self:
        if self.policy != "None" and self.certificates is None:
            raise ValueError(f'"{self.policy}" needs certificates = "FOLDER"; twin cert makes it')
        return self


class User(Settings):
    """Identity for the server: anonymous, a name with a password, or a certificate."""

    name: str = ""  # user name, with a password
    password: Secret | None = None
    certificate: Path | None = None  # PEM, instead of a name
    key: Path | None = None  # PEM, of that certificate

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if bool(self.name) != (self.password is not None):
            raise ValueError("name and password belong together")
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together")
        if self.name and self.certificate:
            raise ValueError("a name with a password, or a certificate: not both")
        return self


class OpcuaSettings(DriverSettings):
    """The ``[driver]`` table for a PLC behind an OPC UA server."""

    kind: Literal["opcua"] = "opcua"  # kind of driver
    url: str  # opc.tcp://HOST:PORT
    namespace: str = ""  # URI of the nodes' namespace; required where nodes do not name it
    # Read a trace that the PLC keeps, or subscribe to values.
    mode: Literal["block", "subscribe"] = "block"
    # Time between blocks, or between publications.
    interval_ms: float = Field(default=50.0, ge=5, le=1000)
    # Sampling interval requested from the server (subscribe).
    sampling_ms: float = Field(default=1.0, ge=0.1, le=1000)
    timeout_ms: float = Field(default=2000.0, ge=50, le=20_000)  # longest time for an answer
    gap_ms: float = Field(default=20.0, ge=1)  # shorter gaps in a subscription are not flagged
    # Absolute ambient pressure without a barometer; gauge pressures count from it.
    ambient_mbar: float = Field(default=1013.25, ge=500, le=1200)
    security: Security = Security()
    user: User = User()
    tags: NodeTags
    trace: TraceNodes = TraceNodes()

    @model_validator(mode="after")
    def _fits(self) -> Self:
        _checked_url(self.url)
        if self.mode == "subscribe" and (self.tags.suction is None or self.tags.blow_off is None):
            raise ValueError("subscribing needs the tags suction and blow_off")
        if self.security.policy == "None" and (self.user.name or self.user.certificate):
            raise ValueError("a user needs security.policy: a password is not sent in the clear")
        if self.mode == "block":
            self._refuse_without_effect()
        nameless = [node for node in self._nodes() if not node.uri]
        if nameless and not self.namespace:
            raise ValueError(
                f"{nameless[0]}: in which namespace? Give its URI as namespace, or write "
                f'"nsu=URI;{nameless[0]}"'
            )
        return self

    def _refuse_without_effect(self) -> None:
        """KeyedError for a tag or setting that block mode does not use."""
        for name, bit in (COMMAND_BITS | BITS).items():
            tag = getattr(self.tags, name)
            if tag is None:
                continue
            if tag.bit is not None or not tag.node.identifier.endswith(BIT_NODES[name]):
                address = tag.node if tag.bit is None else f"{tag.node} bit {tag.bit}"
                raise no_effect(name, bit, address, "subscribe")
        refuse_unused(self.model_fields_set, ("gap_ms", "sampling_ms"), "subscribe")

    def _nodes(self) -> list[Node]:
        nodes = [tag.node for _, tag in self.tags if tag is not None]
        return nodes + ([node for _, node in self.trace] if self.mode == "block" else [])

    def at(self, host: str, port: int) -> "OpcuaSettings":
        """Give the same for a server at another address."""
        path = urlsplit(self.url).path
        return self.model_copy(update={"url": f"opc.tcp://{host}:{port}{path}"})

    def below(self, folder: Path) -> "OpcuaSettings":
        """Give the same with files looked for in ``folder``, unless their paths are absolute."""
        security = _below(self.security, folder, "certificates")
        user = _below(self.user, folder, "certificate", "key")
        if self.user.password is not None:
            user = user.model_copy(update={"password": self.user.password.below(folder)})
        return self.model_copy(update={"security": security, "user": user})

    @property
    def where(self) -> str:
        """The server as messages name it."""
        return self.url


def _below(settings: Settings, folder: Path, *names: str) -> Settings:
    paths = {name: getattr(settings, name) for name in names}
    return settings.model_copy(
        update={name: folder / path for name, path in paths.items() if path is not None}
    )


def _checked_url(url: str) -> None:
    split = urlsplit(url)
    try:
        valid = split.scheme == "opc.tcp" and bool(split.hostname) and split.port != 0
    except ValueError:  # no port
        valid = False
    if not valid or split.username:
        raise ValueError(f'"{url}" is no address: write "opc.tcp://HOST:{PORT}"; the user apart')
