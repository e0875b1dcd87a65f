"""Who may talk to an OPC UA server of ours, and how that is kept private."""

import hmac
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from asyncua import Server, ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from cryptography import x509

from drivers import certificates
from drivers import opcua_trust as trust
from twin.errors import SourceError
from twin.throttle import LoginThrottle

POLICIES = {
    "None": ua.SecurityPolicyType.NoSecurity,
    "Basic256Sha256": ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    "Aes256Sha256RsaPss": ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
}
LONGEST_S = 10.0  # that somebody has to wait after wrong passwords, as on the page


class Guard(Protocol):
    """What to keep to."""

    @property
    def policies(self) -> Sequence[str]:
        """Names of ``POLICIES``."""

    @property
    def certificates(self) -> Path | None:
        """A folder as ``certificates.make`` makes it; needed for policies but None."""


class Users:
    """Whom the server lets in, as the library asks for it."""

    def __init__(self, folder: Path | None, passwords: Mapping[str, str]) -> None:
        self._passwords = {name: one.encode() for name, one in passwords.items()}
        self._throttle = LoginThrottle(LONGEST_S)
        paths = sorted((folder / certificates.USERS).glob("*.der")) if folder else []
        self._certificates = {path.read_bytes() for path in paths}

    @property
    def anybody(self) -> bool:
        """Whether nobody needs to say who it is."""
        return not self._passwords and not self._certificates

    def get_user(
        self,
        iserver: Any,
        username: str | None = None,
        password: str | None = None,
        certificate: bytes | None = None,
    ) -> User | None:
        """A user, or None if that is nobody we know."""
        if username:
            right = self._is_right(username, password or "")
        else:
            right = self.anybody or certificate in self._certificates
        return User(role=UserRole.User, name=username) if right else None

    def _is_right(self, name: str, password: str) -> bool:
        """Whether that is the password; who guesses has to wait, and is refused until then."""
        known = self._passwords.get(name)
        if known is None or self._throttle.wait_s(name) > 0.0:
            return False
        right = hmac.compare_digest(known, password.encode())
        (self._throttle.right if right else self._throttle.wrong)(name)
        return right


async def secure(server: Server, settings: Guard, passwords: Mapping[str, str]) -> None:
    """Set policies, our own certificate, and whose certificates are trusted.

    ``passwords`` by user; if there are any, everybody has to be one of them.
    """
    server.set_security_policy([POLICIES[policy] for policy in settings.policies])
    users = Users(settings.certificates, passwords)
    server.iserver.user_manager = users
    known = [ua.UserNameIdentityToken, ua.X509IdentityToken]
    server.set_identity_tokens([ua.AnonymousIdentityToken] if users.anybody else known)
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
