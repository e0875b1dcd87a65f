"""The certificate by which the twin proves itself, and which connections need protection."""

import ipaddress
from pathlib import Path
from typing import Self

from pydantic import model_validator

from twin.settings import Settings


class OwnCertificate(Settings):
    """Our own certificate, for servers that require one."""

    certificate: Path | None = None  # PEM, our own, where the other side requires one
    key: Path | None = None  # PEM, of our own certificate

    @model_validator(mode="after")
    def _belong_together(self) -> Self:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together")
        return self


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches ``host``, an address or a name."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name
        return host == "localhost"
