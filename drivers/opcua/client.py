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

# The library logs each error with its traceback; what matters is raised as well.
logging.getLogger("asyncua").setLevel(logging.CRITICAL + 1)

POLICIES = {
    "Basic256Sha256": security_policies.SecurityPolicyBasic256Sha256,
    "Aes256Sha256RsaPss": security_policies.SecurityPolicyAes256Sha256RsaPss,
}
ENCRYPTED = ua.MessageSecurityMode.SignAndEncrypt
SESSION_MS = 60_000  # short, since PLCs have few sessions and keep an interrupted one so long
NEVER_S = 3600.0  # effectively disables the library's own watch over the connection

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
    """Parameters of a subscription that a server granted."""

    publishing_ms: float
    sampling_ms: float  # sampling interval of the slowest node
    queue: int  # length of the shortest queue
    silence_s: float  # longest silence before the server counts as lost


class OpcuaClient:
    """A connection that reads nodes and takes publications; it closes when it is broken.

    The library is asynchronous; its event loop runs only while a call waits.
    """

    def __init__(self, settings: OpcuaSettings, clock: Clock) -> None:
        refuse_endless_arrays()
        self._settings = settings
        self._clock = clock
        self._runner: asyncio.Runner | None = None
        self._client: Client | None = None
        self._uris: list[str] = []
        self._plans: dict[tuple[Node, ...], ua.ReadParameters] = {}
        self._kinds: dict[tuple[Node, ...], tuple[ua.VariantType, ...]] = {}  # types to write
        self._published: asyncio.Queue[ua.PublishResult] = asyncio.Queue()
        self._has_served = False  # it has once served all nodes

    # --- connecting -------------------------------------------------------------------------------

    def open(self) -> None:
        """Connect, unless it is connected.

        LostError if that fails; SourceError or ConfigError if the server is not trusted, or rejects
        us.
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
        """Close the connection."""
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
            # It has just told its endpoints; some servers silently hang up on unknown clients.
            raise LostError(*self._certificate_rejected("it hung up")) from error

    def _certificate_rejected(self, detail: str) -> tuple[str, str]:
        """Text and hint if the server does not accept our certificate."""
        folder = self._settings.security.certificates or "FOLDER"
        return (
            f"{self._settings.where}: it does not trust our certificate, or requires one"
            f" ({detail})",
            f"let the server trust {folder}/{certificates.OWN}, and set security.policy",
        )

    async def _protect(self, client: Client) -> None:
        """Check the server's certificate before anything confidential is sent."""
        security, now = self._settings.security, self._now()
        assert security.certificates is not None  # the settings check it
        own_certificate = certificates.own(security.certificates, now)
        policy = POLICIES[security.policy]
        offered = await client.connect_and_get_server_endpoints()
        endpoint = self._endpoint(offered, policy.URI)
        chain: bytes = endpoint.ServerCertificate
        der = chain[: int.from_bytes(chain[2:4], "big") + 4]  # the first certificate of the chain
        await trust.check(
            x509.load_der_x509_certificate(der),
            endpoint.Server,
            security.certificates,
            now,
            self._settings.where,
            trust.Peer.SERVER,
            urlsplit(self._settings.url).hostname or "",
        )
        client.application_uri = own_certificate.uri
        await client.set_security(
            policy, own_certificate.path, own_certificate.key, None, der, ENCRYPTED
        )

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
        """Values of ``nodes`` by one request, of any quality.

        LostError if no answer comes; AbsentError if a node is missing or cannot be read.
        """
        values = self._do("reading", self._read(nodes))
        if len(values) != len(nodes):
            raise self._lost("reading", "it answered with another number of values")
        for node, value in zip(nodes, values, strict=True):
            self._refuse(node, code_of(value))
        self._has_served = True
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
        """The node's id, with the present index of its namespace."""
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
        server = self._settings.where
        if code & CODE in UNKNOWN:
            raise self._unfit(
                f"{server}: there is no node {node}",
                "compare the nodes in [driver] with the server's; any OPC UA browser shows them",
            )
        if code & CODE in FORBIDDEN:
            raise self._unfit(
                f"{server}: {node} cannot be read ({status_name(code)})",
                "may this user read it, and is it a variable?",
            )

    def _unfit(self, text: str, hint: str) -> SourceError:
        """The error for a missing node; a server that once had it may only be starting."""
        return LostError(text, hint) if self._has_served else AbsentError(text, hint)

    # --- subscribing ------------------------------------------------------------------------------

    def subscribe(self, nodes: tuple[Node, ...], queue: int) -> Subscribed:
        """Have every value of ``nodes`` published; errors as from ``read``.

        The index of a node is its handle in publications.
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
        subscription = await session.create_subscription(params, self._published.put_nowait)
        items = await session.create_monitored_items(
            ua.CreateMonitoredItemsParameters(
                SubscriptionId=subscription.SubscriptionId,
                TimestampsToReturn=ua.TimestampsToReturn.Both,
                ItemsToCreate=[
                    self._monitored(node, number, queue) for number, node in enumerate(nodes)
                ],
            )
        )
        for node, item in zip(nodes, items, strict=True):
            self._refuse_item(node, item.StatusCode.value)
        self._has_served = True
        alive_s = (
            subscription.RevisedPublishingInterval * subscription.RevisedMaxKeepAliveCount * 1e-3
        )
        return Subscribed(
            subscription.RevisedPublishingInterval,
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
        """Write numbers by one request, each as its node's type; a Boolean is true unless 0.

        LostError if no answer comes; SourceError if a node cannot be written or cannot hold its
        number. Only hardware in the loop writes (drivers/opcua/hil.py).
        """
        nodes = tuple(values)
        if nodes not in self._kinds:
            self._kinds[nodes] = tuple(
                self._kind(*pair) for pair in zip(nodes, self.read(nodes), strict=True)
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
                    "may this user write it? Only the tags of [hil.tags] are written",
                )

    async def _write(self, nodes: tuple[Node, ...], variants: list[ua.Variant]) -> list[int]:
        assert self._client is not None
        writes = [
            ua.WriteValue(
                NodeId=self._id(node),
                AttributeId=ua.AttributeIds.Value,
                Value=ua.DataValue(variant, None),  # many servers refuse a status, or times
            )
            for node, variant in zip(nodes, variants, strict=True)
        ]
        params = ua.WriteParameters(NodesToWrite=writes)
        return [int(code.value) for code in await self._client.uaclient.write(params)]

    def _kind(self, node: Node, value: ua.DataValue) -> ua.VariantType:
        variant = value.Value
        if variant is None or variant.is_array or variant.VariantType not in WRITABLE:
            raise wrong_type(node, variant, "a number or a Boolean")
        return variant.VariantType

    # --- errors -----------------------------------------------------------------------------------

    def _do(self, action: str, work: Coroutine[Any, Any, T]) -> T:
        """Run ``work``; errors of the library become errors for people."""
        if self._runner is None:
            work.close()
            raise self._lost(action, "the connection is closed")
        try:
            return self._runner.run(work)
        except (SourceError, ConfigError):
            raise
        except ua.UaStatusCodeError as error:
            raise self._refusal(action, int(error.code)) from error
        except OSError as error:
            if action == "connecting":
                self._abandon()
                raise unreachable(self._settings.where, error, "OPC UA server") from error
            raise self._lost(action, "no answer") from error
        except Exception as error:  # garbage can make the library's decoder raise anything
            raise self._lost(
                action, f"a broken answer ({error or type(error).__name__})"
            ) from error

    def _refusal(self, action: str, code: int) -> SourceError:
        """The error for a status code by which the server refused."""
        server, name = self._settings.where, status_name(code)
        if action == "connecting" and code & CODE in STRANGER:
            self.close()
            return SourceError(
                f"{server}: it does not let this user in ({name})",
                "check [driver.user]: the name and its password, or the certificate; without the "
                "table we come as nobody",
            )
        if action == "connecting" and code & CODE in UNTRUSTED:
            self.close()
            return SourceError(*self._certificate_rejected(name))
        if action == "connecting" and code & CODE in UNPROTECTED:
            self.close()
            return SourceError(
                f"{server}: it wants the connection protected otherwise ({name})",
                f"set security.policy in [driver], to None or one of {', '.join(POLICIES)}",
            )
        return self._lost(action, f"it said {name}")

    def _lost(self, action: str, cause: str) -> LostError:
        """The error for a lost answer; closes, so that no late answer is taken for the next one."""
        self._abandon()
        return LostError(
            f"{self._settings.where}: {action}: {cause}",
            "is the PLC on and reachable, its OPC UA server started, is the url right?",
        )

    def _abandon(self) -> None:
        """Close without ending the session, since nobody would answer."""
        runner, client = self._runner, self._client
        self._runner, self._client, self._plans = None, None, {}
        if client is not None:
            client.disconnect_socket()
        if runner is not None:
            runner.close()

    def _now(self) -> datetime:
        return datetime.fromtimestamp(self._clock.wall_ns() * 1e-9, UTC)


def _usable(offered: Sequence[ua.EndpointDescription]) -> list[str]:
    """Policies of the endpoints that we support, as the settings name them."""
    modes = {"None": ua.MessageSecurityMode.None_} | dict.fromkeys(POLICIES, ENCRYPTED)
    names = [endpoint.SecurityPolicyUri.rpartition("#")[2].replace("_", "") for endpoint in offered]
    fit = {
        name
        for name, endpoint in zip(names, offered, strict=True)
        if modes.get(name) == endpoint.SecurityMode
    }
    return sorted(fit) or ["none of ours"]


async def _leave(client: Client, patience_s: float) -> None:
    """End the session politely if the server cooperates, else close the socket."""
    try:
        await asyncio.wait_for(client.disconnect(), patience_s)
    except (OSError, TimeoutError, ua.UaError):
        client.disconnect_socket()
