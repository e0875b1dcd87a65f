"""The messages of a log as protobuf, from the tables below; the log carries the schemas itself."""

from typing import Any, NamedTuple, TypeAlias

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

from twin.signals import EXTRA, SAMPLE, TICK

_Field = descriptor_pb2.FieldDescriptorProto
_TIME = ".google.protobuf.Timestamp"
_Type: TypeAlias = _Field.Type.ValueType | str  # a string names a message or an enum
_Fields = dict[int, tuple[str, _Type]]  # by number: name and type

COLUMNS = (*(SAMPLE.names or ()), *(TICK.names or ()))  # in the order of twin.log.columns
ADDED = {"signals", *EXTRA}  # optional columns of a log; all zero where they are missing

_SAMPLES = """Rows of the measurement and the model at full rate, column by column, lossless.
Each column: 8 bytes with the first row's bits, then k byte planes of `count` bytes each.
Bits: the field's bits as a signed little-endian integer, sign-extended to 64 bits
(int64: sequence, time_ns, host_ns; 8 bits: commands, quality, reported, phase, signals; others
float32).
Planes: d[0] = 0, d[i] = bits[i] - bits[i-1] modulo 2**64, z = (d << 1) ^ (d >> 63);
plane j holds byte j of every z; k = (length - 8) / count; planes that would be all zero are left
out. Units: time_ns PLC time and host_ns time of receipt in ns, pressure and expected Pa absolute,
supply Pa gauge, level Pa absolute on which the model was set anew, commands 1 suction
+ 2 blow-off, quality 1 gap + 2 restart + 4 clock + 8 out of range + 16 overflow + 32 stale
+ 64 bad + 128 received late by the twin itself, phase 0 idle, 1 suction, 2 hold, 3 blow-off,
signals that the model hands out 1 part present (H2) + 2 air saving (H1).
Where they are measured, else zero, and left out where all are: reported by the ejector 1 nozzle
known + 2 nozzle on + 4 part present known + 8 part present + 16 flow known, ambient Pa absolute of
a barometer, temperature K, pressure_2 Pa absolute of a second sensor, flow kg/s of suction."""

_SCALARS = """About 50 rows a second, and each row where a command or the phase changes, to look at.
deviation_mbar is measured minus expected absolute pressure: above 0 is less vacuum than expected.
NaN where there is no value."""

_EVENT = """One thing that happened, in PLC time; data_json holds its numbers."""

# Fields are only ever added, with new numbers: a log outlives the program.
_TWIN: dict[str, tuple[str, _Fields]] = {
    "Samples": (
        _SAMPLES,
        {
            1: ("count", _Field.TYPE_UINT32),
            **{n: (name, _Field.TYPE_BYTES) for n, name in enumerate(SAMPLE.names or (), 2)},
            **{n: (name, _Field.TYPE_BYTES) for n, name in enumerate(TICK.names or (), 32)},
        },
    ),
    "Scalars": (
        _SCALARS,
        {
            1: ("timestamp", _TIME),
            2: ("vacuum_mbar", _Field.TYPE_DOUBLE),
            3: ("expected_vacuum_mbar", _Field.TYPE_DOUBLE),
            4: ("deviation_mbar", _Field.TYPE_DOUBLE),
            5: ("supply_bar", _Field.TYPE_DOUBLE),
            6: ("suction", _Field.TYPE_UINT32),
            7: ("blow_off", _Field.TYPE_UINT32),
            8: ("phase", _Field.TYPE_UINT32),
        },
    ),
    "Event": (
        _EVENT,
        {
            1: ("timestamp", _TIME),
            2: ("kind", _Field.TYPE_STRING),
            3: ("severity", _Field.TYPE_STRING),
            4: ("text", _Field.TYPE_STRING),
            5: ("data_json", _Field.TYPE_STRING),
        },
    ),
}

# As Foxglove defines it; its log panel relies on the name and the field numbers.
_FOXGLOVE: dict[str, tuple[str, _Fields]] = {
    "Log": (
        "A log message",
        {
            1: ("timestamp", _TIME),
            2: ("level", ".foxglove.Log.Level"),
            3: ("message", _Field.TYPE_STRING),
            4: ("name", _Field.TYPE_STRING),
            5: ("file", _Field.TYPE_STRING),
            6: ("line", _Field.TYPE_FIXED32),
        },
    )
}
_LEVELS = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")


def _add_field(
    message: descriptor_pb2.DescriptorProto, number: int, name: str, kind: _Type
) -> None:
    field = message.field.add(name=name, number=number, label=_Field.LABEL_OPTIONAL)
    if isinstance(kind, str):
        field.type = _Field.TYPE_MESSAGE if kind == _TIME else _Field.TYPE_ENUM
        field.type_name = kind
    else:
        field.type = kind


def _file(
    package: str, messages: dict[str, tuple[str, _Fields]]
) -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{package}.proto",
        package=package,
        syntax="proto3",
        dependency=[timestamp_pb2.DESCRIPTOR.name],
    )
    for index, (name, (comment, fields)) in enumerate(messages.items()):
        message = file.message_type.add(name=name)
        file.source_code_info.location.add(
            path=[4, index], span=[0, 0, 0], leading_comments=comment
        )
        for number, (field, kind) in fields.items():
            _add_field(message, number, field, kind)
    return file


def _foxglove() -> descriptor_pb2.FileDescriptorProto:
    file = _file("foxglove", _FOXGLOVE)
    levels = file.message_type[0].enum_type.add(name="Level")
    for number, name in enumerate(_LEVELS):
        levels.value.add(name=name, number=number)
    return file


_TIMESTAMP = descriptor_pb2.FileDescriptorProto.FromString(timestamp_pb2.DESCRIPTOR.serialized_pb)
_FILES = {"foxglove": _foxglove(), "ejector_twin": _file("ejector_twin", _TWIN)}

_POOL = descriptor_pool.DescriptorPool()  # not the default pool: others may register foxglove.Log
for _file_descriptor in (_TIMESTAMP, *_FILES.values()):
    _POOL.Add(_file_descriptor)


class Channel(NamedTuple):
    """One topic of a log; message classes made at run time have no types to check against."""

    topic: str
    schema: str  # name of the message
    files: bytes  # FileDescriptorSet that defines it, kept in the log
    message: Any


def _channel(topic: str, schema: str) -> Channel:
    descriptor = _FILES[schema.partition(".")[0]]
    files = descriptor_pb2.FileDescriptorSet(file=[_TIMESTAMP, descriptor]).SerializeToString()
    kind = message_factory.GetMessageClass(_POOL.FindMessageTypeByName(schema))
    return Channel(topic, schema, files, kind)


SAMPLES = _channel("/samples", "ejector_twin.Samples")
SCALARS = _channel("/scalars", "ejector_twin.Scalars")
EVENTS = _channel("/events", "ejector_twin.Event")
LOG = _channel("/log", "foxglove.Log")

# Where a file's header names LIBRARY, channel ids count from 1 in this order. Only the first chunk
# names the channels; with fixed ids a file is readable without it.
CHANNELS = {1: SAMPLES, 2: SCALARS, 3: EVENTS, 4: LOG}
LIBRARY = "ejector-twin"
