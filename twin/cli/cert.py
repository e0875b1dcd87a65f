"""``twin cert``: a certificate of our own, for OPC UA servers that ask for one."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli.options import Force
from twin.extras import require
from twin.files import said_plainly


def cert(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="For certificates; made where it is missing.")
    ],
    name: Annotated[str, typer.Option(help="Of this application, for people.")] = "ejector-twin",
    force: Force = False,
) -> None:
    """Make a certificate and key of our own, beside folders for those we trust."""
    require("opcua", "twin cert")
    from drivers.opcua import certificates

    with said_plainly(folder):
        made = certificates.make(folder, name, force=force)
    print(f"made {made.path}")
    print(f"     {certificates.described(made.certificate)}")
    print(f"     valid until {made.certificate.not_valid_after_utc:%Y-%m-%d}; the key stays here")
    print(f"then let the server trust {made.path},")
    print(f"put the server's certificate into {folder / certificates.TRUSTED}/")
    print(f'and say so in [driver.security]: certificates = "{folder}"')
