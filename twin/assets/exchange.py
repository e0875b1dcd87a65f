"""The database as one lossless JSON document for other programs."""

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from twin.assets.record import Array, Kind, Record, checked
from twin.errors import ConfigError
from twin.settings import Settings

FORMAT = "ejector-twin-assets/1"


class ArrayForm(Settings):
    """An array: its shape, and its values with the last axis running fastest."""

    shape: list[Annotated[int, Field(ge=0)]]
    values: list[float]

    def array(self) -> Array:
        """The array itself; ValueError if the shape does not fit."""
        return np.array(self.values, dtype=np.float64).reshape(self.shape)


class RecordForm(Settings):
    """A record; times are UTC in ns."""

    id: str = Field(pattern="^[0-9a-f]{32}$")
    kind: Kind
    name: str
    type: str
    valid_from_ns: int
    recorded_ns: int
    hash: str
    data: dict[str, Any]
    healthy: dict[str, Any]
    arrays: dict[str, ArrayForm]
    provenance: dict[str, Any]


class ExportForm(Settings):
    """The whole document."""

    format: Literal["ejector-twin-assets/1"]
    program: str
    records: list[RecordForm]


def to_plain(record: Record) -> dict[str, Any]:
    """A record as a JSON document."""
    arrays = {
        name: {"shape": list(array.shape), "values": array.ravel().tolist()}
        for name, array in record.arrays.items()
    }
    return {**vars(record), "arrays": arrays}


def to_export(records: Sequence[Record]) -> dict[str, Any]:
    """The export document with these records."""
    documents = [to_plain(record) for record in records]
    return {"format": FORMAT, "program": version("ejector-twin"), "records": documents}


def parse_export(document: Mapping[str, Any]) -> list[Record]:
    """The records of an export; ConfigError if it is none, or a record was changed since."""
    try:
        form = ExportForm.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        location = ".".join(map(str, first["loc"])) or "document"
        raise ConfigError(
            f"not an export of an asset database: {location}: {first['msg']}",
            "twin assets export makes one; a newer format needs a newer ejector-twin",
        ) from error
    return [_record(record_form) for record_form in form.records]


def _record(form: RecordForm) -> Record:
    fields = {name: getattr(form, name) for name in RecordForm.model_fields}
    try:
        fields["arrays"] = {name: array_form.array() for name, array_form in form.arrays.items()}
    except ValueError as error:
        raise ConfigError(f"record {form.id} of {form.name!r}: arrays: {error}") from error
    record = checked(Record(**fields))
    if record.hash != form.hash:
        raise ConfigError(
            f"record {form.id} of {form.name!r} is not what was exported: its hash differs",
            "an export is not to be edited; add a changed data set with twin assets add",
        )
    return record
