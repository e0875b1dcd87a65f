"""One connection to an OPC UA server, and its errors for people."""

import asyncio
import logging
from collections.abc import Coroutine, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

from asyncua import Client, ua
from asyncua.crypto import security_policies
from cryptography import x509

from drivers.opcua import certificates, trust
from drivers.opcua.bounds import refuse_endless_arrays
from drivers.opcua.settings import Node, OpcuaSettings
from drivers.opcua.values import (
    CODE,
    SEVERITY,
    UNCERTAIN,
    WRITABLE,
    code_of,
    status_name,
    typed,
    wrong_type,
)
from drivers.reconnect import AbsentError, Clock, LostError, unreachable
from twin.errors import ConfigError, SourceError

# It logs whatever goes wrong, tracebacks and all; what matters is raised as well.
logging.getLogger("asyncua").setLevel(logging.CRITICAL + 1)

NAMESPACES = Node("i=2255", "http://opcfoundation.org/UA/")
POLICIES = {
    "Basic256Sha256": security_policies.SecurityPolicyBasic256Sha256,
    "Aes256Sha256RsaPss": security_policies.SecurityPolicyAes256Sha256RsaPss,
}
ENCRYPTED = ua.MessageSecurityMode.SignAndEncrypt
SESSION_MS = 60_000  # PLCs have few sessions: one that was cut off must not be kept for long
NEVER_S = 3600.0  # the library's own watch over the connection is not needed

_S = ua.StatusCodes
UNKNOWN = {_S.BadNodeIdUnknown, _S.BadNodeIdInvalid}
FORBIDDEN = {_S.BadUserAccessDenied, _S.BadNotReadable, _S.BadAttributeIdInvalid}
STRANGER = {
    _S.BadIdentityTokenRejected,
    _S.BadIdentityTokenInvalid,
    _S.BadUserAccessDenied,
    _S.BadUserSignatureInvalid,
}
UNTRUSTED = {
    _S.BadSecurityChecksFailed,
    _S.BadCertificateUntrusted,
    _S.BadCertificateInvalid,
    _S.BadCertificateTimeInvalid,
    _S.BadCertificateUriInvalid,
    _S.BadCertificateUseNotAllowed,
}
UNPROTECTED = {_S.BadSecurityModeRejected, _S.BadSecurityPolicyRejected}

T = TypeVar("T")


@dataclass(frozen=True)
class Subscribed:
    """What a server made of a subscription that was asked for."""

    publishing_ms: float
    sampling_ms: float  # of the slowest node
    queue: int  # of the shortest
    silence_s: float  # longer without a word, and the server is lost


class OpcuaClient:
    """A connection that reads nodes and takes publications; it closes when it is broken.

    The library is asynchronous; its loop runs here while something is awaited, and not between.
    """

    def __init__(self, settings: OpcuaSettings, clock: Clock) -> None:
        refuse_endless_arrays()
        self._settings = settings
        self._clock = clock
        self._runner: asyncio.Runner | None = None
        self._client: Client | None = None
        self._uris: list[str] = []
        self._plans: dict[tuple[Node, ...], ua.ReadParameters] = {}
        self._kinds: dict[tuple[Node, ...], tuple[ua.VariantType, ...]] = {}  # to be written as
        self._published: asyncio.Queue[ua.PublishResult] = asyncio.Queue()
        self._known = False  # it has once served all that we want

    # --- connecting -------------------------------------------------------------------------------

    def open(self) -> None:
        """Connect, unless it is connected.

        LostError if that fails; SourceError or ConfigError if the server is not to be trusted, or
        does not want us.
        """
        if self._client is not None:
            return
        self._runner = asyncio.Runner()
        self._published = asyncio.Queue()
        try:
            self._client = self._do("connecting", self._connect())
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Hang up."""
        runner, client = self._runner, self._client
        self._runner, self._client, self._plans = None, None, {}
        if runner is None:
            return
        try:
            if client is not None:
                runner.run(_leave(client, self._settings.timeout_ms * 1e-3))
        finally:
            runner.close()

    async def _connect(self) -> Client:
        settings = self._settings
        client = Client(settings.url, settings.timeout_ms * 1e-3, watchdog_intervall=NEVER_S)
        client.name = client.description = "ejector-twin"
        client.session_timeout = SESSION_MS
        if settings.security.policy != "None":
            await self._protect(client)
        await self._introduce(client)
        await self._enter(client)
        try:
            self._uris = await self._namespaces(client)
        except BaseException:
            await _leave(client, settings.timeout_ms * 1e-3)
            raise
        return client

    async def _enter(self, client: Client) -> None:
        """Open channel and session."""
        try:
            await client.connect()
        except ConnectionError as error:
            if self._settings.security.policy == "None":
                raise
            # It told its endpoints just now; some hang up without a word on whom they do not know.
            raise LostError(*self._stranger("it hung up")) from error

    def _stranger(self, how: str) -> tuple[str, str]:
        """Text and hint where the server does not take our certificate."""
        folder = self._settings.security.certificates or "FOLDER"
        return (
            f"{self._settings.where}: it does not trust our certificate, or wants one ({how})",
            f"let the server trust {folder}/{certificates.OWN}, and set security.policy",
        )

    async def _protect(self, client: Client) -> None:
        """Know the server by its certificate before anything is said to it."""
        security, now = self._settings.security, self._now()
        assert security.certificates is not None  # the settings see to it
        own = certificates.own(security.certificates, now)
        policy = POLICIES[security.policy]
        offered = await client.connect_and_get_server_endpoints()
        endpoint = self._endpoint(offered, policy.URI)
        chain: bytes = endpoint.ServerCertificate
        der = chain[: int.from_bytes(chain[2:4], "big") + 4]  # the first of it, DER
        await trust.check(
            x509.load_der_x509_certificate(der),
            endpoint.Server,
            security.certificates,
            now,
            self._settings.where,
            trust.Peer.SERVER,
            urlsplit(self._settings.url).hostname or "",
        )
        client.application_uri = own.uri
        await client.set_security(policy, own.path, own.key, None, der, ENCRYPTED)

    def _endpoint(
        self, offered: Sequence[ua.EndpointDescription], uri: str
    ) -> ua.EndpointDescription:
        for endpoint in offered:
            if endpoint.SecurityPolicyUri == uri and endpoint.SecurityMode == ENCRYPTED:
                return endpoint
        raise SourceError(
            f"{self._settings.where}: it does not offer {self._settings.security.policy} with "
            "signing and encryption",
            f"set security.policy in [driver] to one that it has: {', '.join(_usable(offered))}",
        )

    async def _introduce(self, client: Client) -> None:
        user = self._settings.user
        if user.name and user.password:
            client.set_user(user.name)
            client.set_password(user.password.read("[driver.user] password", Path()))
        elif user.certificate and user.key:
            try:
                await client.load_client_certificate(str(user.certificate))
                await client.load_private_key(user.key)
            except (OSError, ValueError) as error:
                raise ConfigError(
                    f"[driver.user]: certificate or key cannot be used: {error}",
                    "certificate: DER or PEM; key: PEM without a password",
                ) from error

    async def _namespaces(self, client: Client) -> list[str]:
        uris: list[str] = await client.get_namespace_array()
        return uris

    # --- reading ----------------------------------------------------------------------------------

    def read(self, nodes: tuple[Node, ...]) -> list[ua.DataValue]:
        """Values of ``nodes``, by one request, whatever their quality.

        LostError if no answer comes; AbsentError if a node is not there or not to be read.
        """
        values = self._do("reading", self._read(nodes))
        if len(values) != len(nodes):
            raise self._lost("reading", "it answered with another number of values")
        for node, value in zip(nodes, values, strict=True):
            self._refuse(node, code_of(value))
        self._known = True
        return values

    async def _read(self, nodes: tuple[Node, ...]) -> list[ua.DataValue]:
        assert self._client is not None
        plan = self._plans.get(nodes)
        if plan is None:
            plan = self._plans[nodes] = ua.ReadParameters(
                TimestampsToReturn=ua.TimestampsToReturn.Source,
                NodesToRead=[self._wanted(node) for node in nodes],
            )
        values: list[ua.DataValue] = await self._client.uaclient.read(plan)
        return values

    def _wanted(self, node: Node) -> ua.ReadValueId:
        return ua.ReadValueId(NodeId=self._id(node), AttributeId=ua.AttributeIds.Value)

    def _id(self, node: Node) -> ua.NodeId:
        """The node by the index that its namespace has now."""
        uri = node.uri or self._settings.namespace
        if uri not in self._uris:
            raise self._unfit(
                f"{self._settings.where}: it has no namespace {uri!r}",
                f"set namespace in [driver] to one that it has: {', '.join(self._uris)}",
            )
        try:
            return ua.NodeId.from_string(f"ns={self._uris.index(uri)};{node.identifier}")
        except (ua.UaError, ValueError) as error:
            raise ConfigError(f"{node} is no node: {error}", "write it as s=Name") from error

    def _refuse(self, node: Node, code: int) -> None:
        """Raise if the server has no such node, or does not let us read it."""
        where = self._settings.where
        if code & CODE in UNKNOWN:
            raise self._unfit(
                f"{where}: there is no node {node}",
                "compare the nodes in [driver] with the server's; any OPC UA browser shows them",
            )
        if code & CODE in FORBIDDEN:
            raise self._unfit(
                f"{where}: {node} cannot be read ({status_name(code)})",
                "may this user read it, and is it a variable?",
            )

    def _unfit(self, text: str, hint: str) -> SourceError:
        """It lacks what we want: for good, or until it has started, if it once had it."""
        return LostError(text, hint) if self._known else AbsentError(text, hint)

    # --- subscribing ------------------------------------------------------------------------------

    def subscribe(self, nodes: tuple[Node, ...], queue: int) -> Subscribed:
        """Have every value of ``nodes`` published; errors as from ``read``.

        The index of a node is its handle in what is published.
        """
        return self._do("subscribing", self._subscribe(nodes, queue))

    async def _subscribe(self, nodes: tuple[Node, ...], queue: int) -> Subscribed:
        assert self._client is not None
        session, settings = self._client.uaclient.session, self._settings
        params = ua.CreateSubscriptionParameters(
            RequestedPublishingInterval=settings.interval_ms,
            RequestedLifetimeCount=max(300, round(60e3 / settings.interval_ms)),
            RequestedMaxKeepAliveCount=max(1, round(250 / settings.interval_ms)),
            MaxNotificationsPerPublish=0,
            PublishingEnabled=True,
        )
        made = await session.create_subscription(params, self._published.put_nowait)
        items = await session.create_monitored_items(
            ua.CreateMonitoredItemsParameters(
                SubscriptionId=made.SubscriptionId,
                TimestampsToReturn=ua.TimestampsToReturn.Both,
                ItemsToCreate=[
                    self._monitored(node, number, queue) for number, node in enumerate(nodes)
                ],
            )
        )
        for node, item in zip(nodes, items, strict=True):
            self._refuse_item(node, item.StatusCode.value)
        self._known = True
        alive_s = made.RevisedPublishingInterval * made.RevisedMaxKeepAliveCount * 1e-3
        return Subscribed(
            made.RevisedPublishingInterval,
            max(item.RevisedSamplingInterval for item in items),
            min(item.RevisedQueueSize for item in items),
            3 * alive_s + settings.timeout_ms * 1e-3,
        )

    def _monitored(self, node: Node, number: int, queue: int) -> ua.MonitoredItemCreateRequest:
        trigger = ua.DataChangeTrigger.StatusValueTimestamp  # equal values are samples as well
        return ua.MonitoredItemCreateRequest(
            ItemToMonitor=self._wanted(node),
            MonitoringMode=ua.MonitoringMode.Reporting,
            RequestedParameters=ua.MonitoringParameters(
                ClientHandle=number,
                SamplingInterval=self._settings.sampling_ms,
                Filter=ua.DataChangeFilter(Trigger=trigger),
                QueueSize=queue,
                DiscardOldest=True,
            ),
        )

    def _refuse_item(self, node: Node, code: int) -> None:
        self._refuse(node, code)
        if code & SEVERITY not in (0, UNCERTAIN):
            raise self._unfit(
                f"{self._settings.where}: it does not let {node} be subscribed to "
                f"({status_name(code)})",
                "does the server support data changes of it, with the timestamp as trigger?",
            )

    def published(self, silence_s: float) -> ua.PublishResult:
        """The next publication; LostError if none comes, not even one that is empty."""
        return self._do("waiting for values", asyncio.wait_for(self._published.get(), silence_s))

    # --- writing ----------------------------------------------------------------------------------

    def write(self, values: Mapping[Node, float]) -> None:
        """Write numbers, by one request, each as its node's type; Booleans as unlike 0.

        LostError if no answer comes; SourceError if a node cannot be written or cannot hold its
        number. Only hardware in the loop does (drivers/opcua/hil.py).
        """
        nodes = tuple(values)
        if nodes not in self._kinds:
            self._kinds[nodes] = tuple(
                self._kind(*one) for one in zip(nodes, self.read(nodes), strict=True)
            )
        variants = [
            typed(value, kind, node)
            for (node, value), kind in zip(values.items(), self._kinds[nodes], strict=True)
        ]
        for node, code in zip(
            nodes, self._do("writing", self._write(nodes, variants)), strict=True
        ):
            if code & SEVERITY:
                raise SourceError(
                    f"{self._settings.where}: {node} cannot be written ({status_name(code)})",
                    "may this user write it? Only what stands under [hil.tags] is written",
                )

    async def _write(self, nodes: tuple[Node, ...], variants: list[ua.Variant]) -> list[int]:
        assert self._client is not None
        written = [
            ua.WriteValue(
                NodeId=self._id(node),
                AttributeId=ua.AttributeIds.Value,
                Value=ua.DataValue(variant, None),  # many servers refuse a status, or times
            )
            for node, variant in zip(nodes, variants, strict=True)
        ]
        params = ua.WriteParameters(NodesToWrite=written)
        return [int(code.value) for code in await self._client.uaclient.write(params)]

    def _kind(self, node: Node, value: ua.DataValue) -> ua.VariantType:
        variant = value.Value
        if variant is None or variant.is_array or variant.VariantType not in WRITABLE:
            raise wrong_type(node, variant, "a number or a Boolean")
        return variant.VariantType

    # --- errors -----------------------------------------------------------------------------------

    def _do(self, what: str, work: Coroutine[Any, Any, T]) -> T:
        """Run ``work``; whatever the library raises becomes an error for people."""
        if self._runner is None:
            work.close()
            raise self._lost(what, "the connection is closed")
        try:
            return self._runner.run(work)
        except (SourceError, ConfigError):
            raise
        except ua.UaStatusCodeError as error:
            raise self._told(what, int(error.code)) from error
        except OSError as error:
            if what == "connecting":
                self._abandon()
                raise unreachable(self._settings.where, error, "OPC UA server") from error
            raise self._lost(what, "no answer") from error
        except Exception as error:  # the library decodes; there is no telling what garbage raises
            raise self._lost(what, f"a broken answer ({error or type(error).__name__})") from error

    def _told(self, what: str, code: int) -> SourceError:
        """The server said no."""
        where, name = self._settings.where, status_name(code)
        if what == "connecting" and code & CODE in STRANGER:
            self.close()
            return SourceError(
                f"{where}: it does not let this user in ({name})",
                "check [driver.user]: the name and its password, or the certificate; without the "
                "table we come as nobody",
            )
        if what == "connecting" and code & CODE in UNTRUSTED:
            self.close()
            return SourceError(*self._stranger(name))
        if what == "connecting" and code & CODE in UNPROTECTED:
            self.close()
            return SourceError(
                f"{where}: it wants the connection protected otherwise ({name})",
                f"set security.policy in [driver], to None or one of {', '.join(POLICIES)}",
            )
        return self._lost(what, f"it said {name}")

    def _lost(self, what: str, why: str) -> LostError:
        """Close too: a late answer must not be taken for that to the next request."""
        self._abandon()
        return LostError(
            f"{self._settings.where}: {what}: {why}",
            "is the PLC on and reachable, its OPC UA server started, is the url right?",
        )

    def _abandon(self) -> None:
        """Close without a word, since nobody would answer it."""
        runner, client = self._runner, self._client
        self._runner, self._client, self._plans = None, None, {}
        if client is not None:
            client.disconnect_socket()
        if runner is not None:
            runner.close()

    def _now(self) -> datetime:
        return datetime.fromtimestamp(self._clock.wall_ns() * 1e-9, UTC)


def _usable(offered: Sequence[ua.EndpointDescription]) -> list[str]:
    """The policies among the endpoints that we can take, as the settings name them."""
    modes = {"None": ua.MessageSecurityMode.None_} | dict.fromkeys(POLICIES, ENCRYPTED)
    names = [one.SecurityPolicyUri.rpartition("#")[2].replace("_", "") for one in offered]
    fit = {
        name
        for name, one in zip(names, offered, strict=True)
        if modes.get(name) == one.SecurityMode
    }
    return sorted(fit) or ["none of ours"]


async def _leave(client: Client, patience_s: float) -> None:
    """End the session politely, as far as the server goes along with it."""
    try:
        await asyncio.wait_for(client.disconnect(), patience_s)
    except (OSError, TimeoutError, ua.UaError):
        client.disconnect_socket()
