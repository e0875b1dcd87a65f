"""One entry of the asset database: what was known of a type or of one unit, and from where."""

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
    """What the database has of an asset: the unit's own data set, or its type's."""

    record: Record
    base: Record | None = None  # of a unit: what holds of its type

    @property
    def used(self) -> Kind:
        """Whether it is the unit's own or its type's."""
        return self.record.kind


class UnknownAssetError(ConfigError):
    """Neither a unit nor its type is in the database."""


def content_hash(record: Record) -> str:
    """16 hex digits over data set, healthy scatter and arrays: same hash, same content."""
    shapes = {name: array.shape for name, array in record.arrays.items()}
    content = {"data": record.data, "healthy": record.healthy, "arrays": shapes}
    # Sorted: in which order a file has its keys says nothing about the ejector.
    digest = hashlib.sha256(to_json(content, sort_keys=True).encode())
    for _, array in sorted(record.arrays.items()):
        digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return digest.hexdigest()[:16]


def holding(records: Iterable[Record], at_ns: int) -> Record | None:
    """Which of an asset's records holds at a time: the newest valid one, of these the last."""
    valid = (record for record in records if record.valid_from_ns <= at_ns)
    return max(valid, key=lambda r: (r.valid_from_ns, r.recorded_ns, r.id), default=None)


def to_json(value: object, *, sort_keys: bool = False) -> str:
    """JSON as the database keeps it; ValueError or TypeError where JSON has no word for it."""
    return json.dumps(value, sort_keys=sort_keys, separators=(",", ":"), allow_nan=False)


def checked(record: Record) -> Record:
    """The record as the database would give it back, hash included; ConfigError if it cannot be."""
    _check_names(record)
    _check_times(record)
    kept = replace(
        record,
        data=_plain(record, "data", record.data),
        healthy=_plain(record, "healthy", record.healthy),
        provenance=_plain(record, "provenance", record.provenance),
        arrays={
            name: np.array(array, dtype=np.float64) for name, array in sorted(record.arrays.items())
        },
    )
    _check_arrays(kept)
    return replace(kept, hash=content_hash(kept))


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
    for what in ("valid_from_ns", "recorded_ns"):
        if getattr(record, what) not in _INT64:
            raise ConfigError(f"{record.name!r}: {what} is not a time: {getattr(record, what)!r}")


def _plain(record: Record, what: str, table: Mapping[str, Any]) -> dict[str, Any]:
    """The table as JSON keeps it."""
    try:
        plain: dict[str, Any] = json.loads(to_json(table))
    except (TypeError, ValueError, RecursionError) as error:
        raise ConfigError(
            f"{record.name!r}: its {what} cannot be kept: {error}",
            "tables, lists, texts, finite numbers, true and false can be",
        ) from error
    return plain


def _check_arrays(record: Record) -> None:
    for name, array in record.arrays.items():
        if not np.isfinite(array).all():
            raise ConfigError(f"{record.name!r}: array {name!r} holds values that are not finite")
    check_diagram(record.name, record.arrays)
