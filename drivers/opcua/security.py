"""Access control and encryption of our own OPC UA server."""

from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from asyncua import Server, ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from cryptography import x509

from drivers.opcua import certificates, trust
from twin.audit import Act, Audit
from twin.errors import ConfigError, SourceError, TwinError
from twin.login import Authenticator
from twin.users import Users

POLICIES = {
    "None": ua.SecurityPolicyType.NoSecurity,
    "Basic256Sha256": ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    "Aes256Sha256RsaPss": ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
}
ADDRESS: ContextVar[str] = ContextVar("address", default="")  # of the client that logs in
Say = Callable[[str], None]


class Guard(Protocol):
    """Security settings of a server."""

    @property
    def policies(self) -> Sequence[str]:
        """Names of ``POLICIES``."""

    @property
    def certificates(self) -> Path | None:
        """A folder as ``certificates.make`` makes it; needed for every policy but None."""

    @property
    def users(self) -> Path | None:
        """A file as ``twin users`` makes it; with one, nobody gets in anonymously."""


@dataclass
class Person(User):  # type: ignore[misc]  # the library's classes are untyped to us
    """The identity behind a session: a user, the owner of a certificate, or anonymous."""

    address: str = ""
    users: Users | None = None  # the file that has the name
    proof: str = ""  # what was stored of the user at the login

    @property
    def is_still(self) -> bool:
        """Whether the user is unchanged since the login; False while that cannot be read."""
        try:
            return self.users is None or self.users.proof(self.name or "") == self.proof
        except TwinError:
            return False


class Session(InternalSession):  # type: ignore[misc]
    """A session that knows its client's address, and ends once its user is removed or changed."""

    def activate_session(self, params: Any, peer_certificate: bytes | None) -> Any:
        """Log a client in; meanwhile ``ADDRESS`` is its address."""
        token = ADDRESS.set(str(self.name[0]) if self.external and self.name else "")
        try:
            return super().activate_session(params, peer_certificate)
        finally:
            ADDRESS.reset(token)

    def touch(self) -> None:
        """Called before each request is answered."""
        super().touch()
        if isinstance(self.user, Person) and not self.user.is_still:
            raise ServiceError(ua.StatusCodes.BadUserAccessDenied)


class GuardedServer(InternalServer):  # type: ignore[misc]
    """The core of a server, whose sessions know their client's address."""

    def create_session(self, name: Any, **options: Any) -> Session:
        """Begin a session; ``name`` is the address and port of its connection."""
        return Session(self, self.aspace, self.subscription_service, name, **options)


class Door:
    """Authenticates clients for the library; ``say`` receives the reasons that prevent a login."""

    def __init__(self, folder: Path | None, authenticator: Authenticator | None, say: Say) -> None:
        self._authenticator, self._say = authenticator, say
        self._reported = ""  # the last trouble; a lasting one is reported once
        paths = sorted((folder / certificates.USERS).glob("*.der")) if folder else []
        self._certificates = {path.read_bytes() for path in paths}

    @property
    def anybody(self) -> bool:
        """Whether clients may stay anonymous."""
        return self._authenticator is None and not self._certificates

    def get_user(
        self,
        iserver: Any,
        username: str | None = None,
        password: str | None = None,
        certificate: bytes | None = None,
    ) -> Person | None:
        """The identity of a client, or None if it is not let in."""
        if username:
            return self._logged_in(username, password or "")
        admitted = self.anybody or certificate in self._certificates
        if self._authenticator is not None and certificate is not None:
            act = Act.LOGGED_IN if admitted else Act.DENIED
            subject = certificates.described(x509.load_der_x509_certificate(certificate))
            self._authenticator.audit.record(act, subject, ADDRESS.get())
        return Person(UserRole.User, None, ADDRESS.get()) if admitted else None

    def _logged_in(self, name: str, password: str) -> Person | None:
        """The user with this password, or None; after wrong ones it refuses for a while."""
        if self._authenticator is None:
            return None
        users, address = self._authenticator.users, ADDRESS.get()
        try:
            proof = users.proof(name)
            login = self._authenticator.log_in(name, password, address)
        except TwinError as error:
            self._report(f"nobody can log in over OPC UA: {error}: {error.hint}")
            return None
        self._reported = ""
        identity = login.user, address, users, proof
        return Person(UserRole.User, *identity) if login.role else None

    def _report(self, trouble: str) -> None:
        if trouble != self._reported:
            self._say(trouble)
        self._reported = trouble


def authenticator_of(users: Path | None, say: Say) -> Authenticator | None:
    """The authenticator for a file of users; None without one, ConfigError if it has no users."""
    if users is None:
        return None
    registered = Users(users)
    if not registered.names:
        raise ConfigError(
            f"{users}: no users, so nobody could come in", f"twin users add NAME --users {users}"
        )
    return Authenticator(registered, Audit(users.parent, "opcua", say))


async def secure(
    server: Server, settings: Guard, authenticator: Authenticator | None, say: Say
) -> None:
    """Set policies, our own certificate, the check of clients' certificates, and their logins."""
    server.set_security_policy([POLICIES[policy] for policy in settings.policies])
    door = Door(settings.certificates, authenticator, say)
    server.iserver.user_manager = door
    tokens = [ua.UserNameIdentityToken, ua.X509IdentityToken]
    server.set_identity_tokens([ua.AnonymousIdentityToken] if door.anybody else tokens)
    folder = settings.certificates
    if folder is None:
        return
    own_certificate = certificates.own(folder, datetime.now(UTC))
    await server.load_certificate(own_certificate.path)
    await server.load_private_key(own_certificate.key)
    await server.set_application_uri(own_certificate.uri)

    async def check(certificate: x509.Certificate, client: ua.ApplicationDescription) -> None:
        try:
            now = datetime.now(UTC)
            await trust.check(certificate, client, folder, now, "client", trust.Peer.CLIENT)
        except SourceError as error:
            raise ServiceError(ua.StatusCodes.BadSecurityChecksFailed) from error

    server.set_certificate_validator(check)
