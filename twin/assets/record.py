"""One record of the asset database: the data of a type or of one unit, with provenance."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from twin.assets.diagram import check_diagram
from twin.errors import ConfigError

Kind = Literal["type", "instance"]
Array = npt.NDArray[np.float64]

_INT64 = range(-(2**63), 2**63)


@dataclass(frozen=True, eq=False)
class Record:
    """A data set of a type (object-specific) or of one unit (instance-specific).

    ``id``, ``recorded_ns`` and ``hash`` are the database's own; they are empty before it is added.
    """

    kind: Kind
    name: str  # of the type, or the unit's ID
    type: str  # of the unit; of a type its own name
    data: Mapping[str, Any]  # nested tables in the field's units, as [data] in a configuration
    healthy: Mapping[str, Any] = field(default_factory=dict)  # what healthy cycles scatter
    arrays: Mapping[str, Array] = field(default_factory=dict)  # characteristic diagram, covariance
    provenance: Mapping[str, Any] = field(default_factory=dict)  # which log, cycles, code; a note
    valid_from_ns: int = 0  # UTC; 0 is "always"
    recorded_ns: int = 0  # UTC
    id: str = ""
    hash: str = ""


@dataclass(frozen=True)
class Found:
    """The database's entry for an asset: the unit's own data set, or its type's."""

    record: Record
    base: Record | None = None  # of a unit: what holds of its type

    @property
    def used(self) -> Kind:
        """The kind of the record: of the unit itself or of its type."""
        return self.record.kind


class UnknownAssetError(ConfigError):
    """Neither a unit nor its type is in the database."""


def content_hash(record: Record) -> str:
    """16 hex digits over data set, healthy scatter and arrays: same hash, same content."""
    shapes = {name: array.shape for name, array in record.arrays.items()}
    content = {"data": record.data, "healthy": record.healthy, "arrays": shapes}
    # Sorted, because the order of keys in a file must not matter.
    digest = hashlib.sha256(to_json(content, sort_keys=True).encode())
    for _, array in sorted(record.arrays.items()):
        digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return digest.hexdigest()[:16]


def holding(records: Iterable[Record], at_ns: int) -> Record | None:
    """The record that holds at a time: that with the newest valid time, then the last recorded."""
    valid = (record for record in records if record.valid_from_ns <= at_ns)
    return max(valid, key=lambda r: (r.valid_from_ns, r.recorded_ns, r.id), default=None)


def to_json(value: object, *, sort_keys: bool = False) -> str:
    """JSON for the database; ValueError or TypeError for a value that JSON cannot express."""
    return json.dumps(value, sort_keys=sort_keys, separators=(",", ":"), allow_nan=False)


def checked(record: Record) -> Record:
    """The record as the database would return it, with hash; ConfigError if it is invalid."""
    _check_names(record)
    _check_times(record)
    record_to_store = replace(
        record,
        data=_plain(record, "data", record.data),
        healthy=_plain(record, "healthy", record.healthy),
        provenance=_plain(record, "provenance", record.provenance),
        arrays={
            name: np.array(array, dtype=np.float64) for name, array in sorted(record.arrays.items())
        },
    )
    _check_arrays(record_to_store)
    return replace(record_to_store, hash=content_hash(record_to_store))


def _check_names(record: Record) -> None:
    if not record.type:
        raise ConfigError(
            f"{record.kind} {record.name!r} has no type", "say which type of ejector it is"
        )
    for name in (record.name, record.type, *record.arrays):
        if not name or not name.isprintable() or name != name.strip():
            raise ConfigError(
                f"{name!r} cannot be a name in the asset database",
                "use printable characters, no margins",
            )
    if record.kind == "type" and record.type != record.name:
        raise ConfigError(f"type {record.name!r} says it is of type {record.type!r}")


def _check_times(record: Record) -> None:
    for field_name in ("valid_from_ns", "recorded_ns"):
        if getattr(record, field_name) not in _INT64:
            raise ConfigError(
                f"{record.name!r}: {field_name} is not a time: {getattr(record, field_name)!r}"
            )


def _plain(record: Record, field_name: str, table: Mapping[str, Any]) -> dict[str, Any]:
    """The table after a round trip through JSON."""
    try:
        content: dict[str, Any] = json.loads(to_json(table))
    except (TypeError, ValueError, RecursionError) as error:
        raise ConfigError(
            f"{record.name!r}: its {field_name} cannot be kept: {error}",
            "tables, lists, texts, finite numbers, true and false can be",
        ) from error
    return content


def _check_arrays(record: Record) -> None:
    for name, array in record.arrays.items():
        if not np.isfinite(array).all():
            raise ConfigError(f"{record.name!r}: array {name!r} holds values that are not finite")
    check_diagram(record.name, record.arrays)
