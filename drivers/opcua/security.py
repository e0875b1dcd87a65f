"""Who may talk to an OPC UA server of ours, and how that is kept private."""

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
ADDRESS: ContextVar[str] = ContextVar("address", default="")  # of whom a session is for
Say = Callable[[str], None]


class Guard(Protocol):
    """What to keep to."""

    @property
    def policies(self) -> Sequence[str]:
        """Names of ``POLICIES``."""

    @property
    def certificates(self) -> Path | None:
        """A folder as ``certificates.make`` makes it; needed for policies but None."""

    @property
    def users(self) -> Path | None:
        """A file as ``twin users`` makes it; if there is one, everybody has to be of it."""


@dataclass
class Person(User):  # type: ignore[misc]  # the library's classes are untyped to us
    """Whom a session is for: a user with a name, or whoever has a certificate, or anybody."""

    address: str = ""
    users: Users | None = None  # where the name stands
    proof: str = ""  # what was stored of the user at the login

    @property
    def is_still(self) -> bool:
        """Whether the user is there as at the login; not while that cannot be known."""
        try:
            return self.users is None or self.users.proof(self.name or "") == self.proof
        except TwinError:
            return False


class Session(InternalSession):  # type: ignore[misc]
    """A session that knows where it comes from, and is over for who is no user any more."""

    def activate_session(self, params: Any, peer_certificate: bytes | None) -> Any:
        """Let somebody in; meanwhile ``ADDRESS`` is where that is."""
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
    """What is inside of a server whose sessions know where they come from."""

    def create_session(self, name: Any, **options: Any) -> Session:
        """Begin a session; ``name`` is the address and port of its connection."""
        return Session(self, self.aspace, self.subscription_service, name, **options)


class Door:
    """Whom the server lets in, as the library asks for it; ``say`` is told what hinders it."""

    def __init__(self, folder: Path | None, authenticator: Authenticator | None, say: Say) -> None:
        self._authenticator, self._say = authenticator, say
        self._said = ""  # of a trouble that lasts, once
        paths = sorted((folder / certificates.USERS).glob("*.der")) if folder else []
        self._certificates = {path.read_bytes() for path in paths}

    @property
    def anybody(self) -> bool:
        """Whether nobody needs to say who it is."""
        return self._authenticator is None and not self._certificates

    def get_user(
        self,
        iserver: Any,
        username: str | None = None,
        password: str | None = None,
        certificate: bytes | None = None,
    ) -> Person | None:
        """A user, or None if that is nobody we know."""
        if username:
            return self._logged_in(username, password or "")
        right = self.anybody or certificate in self._certificates
        if self._authenticator is not None and certificate is not None:
            act = Act.LOGGED_IN if right else Act.DENIED
            who = certificates.described(x509.load_der_x509_certificate(certificate))
            self._authenticator.audit.record(act, who, ADDRESS.get())
        return Person(UserRole.User, None, ADDRESS.get()) if right else None

    def _logged_in(self, name: str, password: str) -> Person | None:
        """The user whose password that is; who guesses is refused until the wait is over."""
        if self._authenticator is None:
            return None
        users, address = self._authenticator.users, ADDRESS.get()
        try:
            proof = users.proof(name)
            login = self._authenticator.log_in(name, password, address)
        except TwinError as error:
            self._complain(f"nobody can log in over OPC UA: {error}: {error.hint}")
            return None
        self._said = ""
        known = login.user, address, users, proof
        return Person(UserRole.User, *known) if login.role else None

    def _complain(self, what: str) -> None:
        if what != self._said:
            self._say(what)
        self._said = what


def authenticator_of(users: Path | None, say: Say) -> Authenticator | None:
    """What lets in the users of a file; None without one, ConfigError if there is nobody in it."""
    if users is None:
        return None
    known = Users(users)
    if not known.names:
        raise ConfigError(
            f"{users}: no users, so nobody could come in", f"twin users add NAME --users {users}"
        )
    return Authenticator(known, Audit(users.parent, "opcua", say))


async def secure(
    server: Server, settings: Guard, authenticator: Authenticator | None, say: Say
) -> None:
    """Set policies, our own certificate, whose certificates are trusted, and who may come in."""
    server.set_security_policy([POLICIES[policy] for policy in settings.policies])
    door = Door(settings.certificates, authenticator, say)
    server.iserver.user_manager = door
    known = [ua.UserNameIdentityToken, ua.X509IdentityToken]
    server.set_identity_tokens([ua.AnonymousIdentityToken] if door.anybody else known)
    folder = settings.certificates
    if folder is None:
        return
    own = certificates.own(folder, datetime.now(UTC))
    await server.load_certificate(own.path)
    await server.load_private_key(own.key)
    await server.set_application_uri(own.uri)

    async def check(certificate: x509.Certificate, client: ua.ApplicationDescription) -> None:
        try:
            now = datetime.now(UTC)
            await trust.check(certificate, client, folder, now, "client", trust.Peer.CLIENT)
        except SourceError as error:
            raise ServiceError(ua.StatusCodes.BadSecurityChecksFailed) from error

    server.set_certificate_validator(check)
