"""Requests over the broker to upload a unit's logs; they are stored until they are done."""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import AwareDatetime, Field, ValidationError, model_validator
from sqlalchemy import (
    URL,
    BigInteger,
    Column,
    Integer,
    MetaData,
    Row,
    Table,
    Text,
    func,
    select,
)

from twin.alarms.database import ALARM_DATABASE
from twin.assets.engine import Database
from twin.assets.unit import Unit, of_unit, unit_columns
from twin.errors import TwinError
from twin.settings import Settings

REQUEST_FORMAT = "ejector-twin-upload-request/1"
LONGEST = 4096  # bytes of a request
KEPT = 1000  # requests remembered, so that none is done twice
ACCEPTED, RUNNING, DONE, REFUSED = "accepted", "running", "done", "refused"
OPEN = (ACCEPTED, RUNNING)


class RefusedError(TwinError):
    """A request that is refused, with the reason."""


class UploadRequest(Settings):
    """A log by its name, or what was received in a range of time, or both. Never a place."""

    format: Literal["ejector-twin-upload-request/1"]
    id: str = Field(pattern=r"^[A-Za-z0-9._:-]{1,64}$")  # chosen by who asks
    log: str = Field(default="", max_length=255)  # the name of its first file
    begin: AwareDatetime | None = Field(default=None, alias="from")
    end: AwareDatetime | None = Field(default=None, alias="to")

    @model_validator(mode="after")
    def _asks_for_something(self) -> Self:
        if (self.begin is None) != (self.end is None):
            raise ValueError("from and to belong together")
        if not self.log and self.begin is None:
            raise ValueError("name a log, or from and to")
        if self.begin is not None and self.end is not None and self.begin >= self.end:
            raise ValueError("from is not before to")
        return self


def parse(payload: bytes) -> UploadRequest:
    """Parse a received request; RefusedError says what is wrong with it."""
    if len(payload) > LONGEST:
        raise RefusedError(f"a request has {LONGEST} bytes at most")
    try:
        return UploadRequest.model_validate_json(payload)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        location = ".".join(map(str, first["loc"]))
        unknown = first["type"] == "extra_forbidden"
        problem = "unknown key" if unknown else first["msg"].removeprefix("Value error, ")
        raise RefusedError(f"{location[:80]}: {problem}" if location else problem) from error


@dataclass(frozen=True)
class File:
    """A file that has arrived."""

    name: str
    size: int
    sha256: str  # hexadecimal


@dataclass(frozen=True)
class Asked:
    """A request and its state."""

    number: int
    request: UploadRequest
    state: str
    why: str = ""  # reason of a refusal
    files: tuple[File, ...] = ()  # files that have arrived


metadata = MetaData()

UPLOADS = Table(
    "uploads",
    metadata,
    Column("number", Integer, primary_key=True),  # the order
    *unit_columns(in_key=False),
    Column("id", Text, nullable=False),
    Column("request", Text, nullable=False),  # JSON
    Column("asked_ns", BigInteger, nullable=False),
    Column("state", Text, nullable=False),
    Column("why", Text, nullable=False),
    Column("files", Text, nullable=False),  # JSON
    sqlite_autoincrement=True,
)


def open_uploads(
    where: str | Path | URL,
    unit: Unit,
    *,
    busy_s: float = 5.0,
    clock: Callable[[], int] = time.time_ns,
) -> "Uploads":
    """Open the upload requests of a unit in the alarm database at a URL or in an SQLite file.

    ConfigError for a URL of an unknown kind, SourceError if the database cannot be used.
    """
    uploads = Uploads(where, unit, busy_s, clock)
    with uploads.closed_on_error():
        uploads.prepare()
    return uploads


class Uploads(Database):
    """The upload requests of a unit. Each thread opens its own."""

    def __init__(
        self, where: str | Path | URL, unit: Unit, busy_s: float, clock: Callable[[], int]
    ) -> None:
        super().__init__(where, ALARM_DATABASE, busy_s, clock)
        self._unit = unit

    def prepare(self) -> None:
        """Create the table if it is missing."""
        self._make_missing(metadata)

    def find(self, number: str) -> Asked | None:
        """The request with an ID, if it is still remembered."""
        statement = select(UPLOADS).where(*of_unit(UPLOADS, self._unit), UPLOADS.c.id == number)
        with self._reading() as connection:
            row = connection.execute(statement).first()
        return _asked(row) if row else None

    def add(self, request: UploadRequest) -> None:
        """Store an accepted request, and delete the oldest finished ones beyond ``KEPT``."""
        row: dict[str, Any] = {"asset_type": self._unit.type, "asset_id": self._unit.id}
        row |= {"id": request.id, "request": request.model_dump_json(by_alias=True)}
        row |= {"asked_ns": self._clock(), "state": ACCEPTED, "why": "", "files": "[]"}
        of_this_unit = of_unit(UPLOADS, self._unit)
        with self._writing() as connection:
            connection.execute(UPLOADS.insert(), row)
            newest = select(func.max(UPLOADS.c.number)).where(*of_this_unit)
            limit = int(connection.execute(newest).scalar_one()) - KEPT
            old = UPLOADS.c.number <= limit, UPLOADS.c.state.not_in(OPEN)
            connection.execute(UPLOADS.delete().where(*of_this_unit, *old))

    def waiting(self) -> list[Asked]:
        """The requests that are not done yet, in order."""
        condition = *of_unit(UPLOADS, self._unit), UPLOADS.c.state.in_(OPEN)
        with self._reading() as connection:
            rows = connection.execute(select(UPLOADS).where(*condition).order_by(UPLOADS.c.number))
            return [_asked(row) for row in rows]

    def note(self, number: int, state: str, files: Sequence[File], why: str = "") -> None:
        """Store the state of a request."""
        files_json = json.dumps([vars(file) for file in files])
        values = {"state": state, "files": files_json, "why": why}
        with self._writing() as connection:
            connection.execute(UPLOADS.update().where(UPLOADS.c.number == number).values(values))


def _asked(row: Row[Any]) -> Asked:
    request = UploadRequest.model_validate_json(row.request)
    files = tuple(File(**file) for file in json.loads(row.files))
    return Asked(row.number, request, row.state, row.why, files)
