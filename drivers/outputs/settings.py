"""The ``[results]`` table: the OPC UA server of the twin's results, and access to it."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

from pydantic import Field, model_validator

from twin.settings import Settings
from twin.tls import is_loopback
from twin.users import UsersFile

if TYPE_CHECKING:
    pass

Policy = Literal["None", "Basic256Sha256", "Aes256Sha256RsaPss"]  # with sign-and-encrypt


class ResultsSettings(Settings):
    """Off unless ``opcua`` is set, and for this machine alone unless it is protected."""

    opcua: bool = False  # whether results are served
    host: str = "127.0.0.1"  # address that it listens on; beyond this machine only with security
    port: int = Field(default=4841, ge=0, le=65535)  # 0 takes any free one
    interval_ms: float = Field(default=100.0, ge=20, le=10_000)  # shortest time between two values
    # Security policies that clients may use.
    policies: tuple[Policy, ...] = Field(default=("None",), min_length=1)
    certificates: Path | None = None  # a folder as twin cert makes it; the same as the driver's
    users: UsersFile | None = None  # file of twin users; with one, every client must log in
    unprotected: bool = False  # beyond this machine without a policy all the same

    @model_validator(mode="after")
    def _is_protected(self) -> Self:
        if self.policies != ("None",) and self.certificates is None:
            raise ValueError('policies need certificates = "FOLDER"; twin cert makes it')
        if self.users and "None" in self.policies:
            raise ValueError(
                "users need policies without None: a password is not sent in the clear"
            )
        if "None" in self.policies and not is_loopback(self.host) and not self.unprotected:
            raise ValueError(
                f'"{self.host}" is beyond this machine: set policies without None, or say '
                "unprotected = true if everybody there may read"
            )
        return self

    def below(self, folder: Path) -> "ResultsSettings":
        """Give the same with files looked for in ``folder``, unless their paths are absolute."""
        pki = None if self.certificates is None else folder / self.certificates
        users = None if self.users is None else folder / self.users
        return self.model_copy(update={"certificates": pki, "users": users})
