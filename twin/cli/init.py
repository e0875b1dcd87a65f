"""``twin init``: write a first, commented configuration from flags and a few questions."""

import json
import math
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import Annotated, Any, TypeVar

import typer

from twin.cli.options import Force
from twin.errors import ConfigError, known_names
from twin.files import refuse_existing, said_plainly

_STARTERS = Path(__file__).parents[1] / "starters"
STARTERS = tuple(sorted(path.stem for path in _STARTERS.glob("*.toml")))
UNKNOWN = "unknown"
NO_PLC = "none"
FILE_ONLY, PLACEHOLDER = "none: there are only files", "192.168.0.10:502"
OPC_UA = "opc.tcp://"
SIMULATED_NAMESPACE = "urn:ejector-twin:plc"  # of the simulated PLC
SCHEMA = "twin.schema.json"
_HEAD = (  # of each new file
    f"#:schema ./{SCHEMA}",
    f"# An editor then completes and checks keys: twin config schema > {SCHEMA}",
)
LAYOUTS = {  # pressure and commands in the simulated PLC and in docs/connect-your-plc.md
    ("modbus", True): ("30002", "30005/0", "30005/1"),
    ("modbus", False): ("40001", "00001", "00002"),
    ("opcua", True): ("s=Meas.Pressure", "s=Cmd.Suction", "s=Cmd.BlowOff"),
    ("opcua", False): ("s=Meas.Pressure", "s=Cmd.Suction", "s=Cmd.BlowOff"),
}
_TAGS = {  # remark on the tags, by OPC UA and by ring
    (False, True): "in block mode the ring's values are read instead",
    (False, False): 'addresses as in manuals, or counted from 0: "holding:0"',
    (True, True): "in block mode the values of [driver.trace] are read instead",
    (True, False): "nodes of the namespace",
}
# Factors that true volumes are within: of a vessel read off roughly, of a guessed tube or vessel.
A_FIFTH_OFF, A_TUBE_GUESSED, A_VESSEL_GUESSED = 1.25, 3.0, 10.0
GUESSED = {"hose_mm": 1000.0, "diameter_mm": 6.0, "cups": 50.0, "vessel": 750.0}  # mid-market


# Optional signals of the same PLC, as comments in the file that are ready for use.
OFFERED = """\
# Optional signals; each makes the fit more certain (docs/reported-signals.md). Use nozzle (1: it
# blows) or air_saving (1: it does not), not both. pressure_2 is measured at the other end.
"""
BESIDE_RING = """\
# nozzle = { address = "30005", bit = 2 }
# air_saving = { address = "30005", bit = 3 }
# part_present = { address = "30005", bit = 4 }
# ambient = { address = "30008", type = "int16", scale = 0.1, unit = "mbar", reference = "absolute" }
# temperature = { address = "30009", type = "int16", scale = 0.1, unit = "C" }
# pressure_2 = { address = "30010", type = "float32", unit = "mbar", reference = "absolute" }
# flow = { address = "30012", type = "float32", unit = "sl/min" }
"""  # noqa: E501
BESIDE_POLLED = """\
# nozzle = { address = "00003" }
# air_saving = { address = "00004" }
# part_present = { address = "00005" }
# ambient = { address = "40003", type = "int16", scale = 0.1, unit = "mbar", reference = "absolute" }
# temperature = { address = "40004", type = "int16", scale = 0.1, unit = "C" }
# pressure_2 = { address = "40005", type = "float32", unit = "mbar", reference = "absolute" }
# flow = { address = "40007", type = "float32", unit = "sl/min" }
"""  # noqa: E501
BESIDE_NODES = """\
# nozzle = { node = "s=Meas.Nozzle" }
# air_saving = { node = "s=Meas.AirSaving" }
# part_present = { node = "s=Meas.PartPresent" }
# ambient = { node = "s=Meas.Ambient", unit = "mbar", reference = "absolute" }
# temperature = { node = "s=Meas.Temperature", unit = "C" }
# pressure_2 = { node = "s=Meas.Pressure2", unit = "mbar", reference = "absolute" }
# flow = { node = "s=Meas.Flow", unit = "sl/min" }
"""
BESIDE_COLUMNS = """\
# reported_nozzle = "Nozzle"
# reported_air_saving = "AirSaving"
# reported_part_present = "PartPresent"
# ambient_mbar = "Ambient"
# temperature_c = "Temperature"
# pressure_2_mbar = "Pressure2"
# flow_sl_min = "Flow"
"""


class Unit(StrEnum):
    """Unit of the pressure as it arrives."""

    MBAR = "mbar"
    HPA = "hPa"
    BAR = "bar"
    KPA = "kPa"
    PA = "Pa"
    PSI = "psi"
    IN_HG = "inHg"
    TORR = "torr"


class Reference(StrEnum):
    """What a pressure is counted from."""

    ABSOLUTE = "absolute"
    GAUGE = "gauge"
    VACUUM = "vacuum"


class Number(StrEnum):
    """How a pressure is coded in registers."""

    INT16 = "int16"
    UINT16 = "uint16"
    INT32 = "int32"
    UINT32 = "uint32"
    FLOAT32 = "float32"


class End(StrEnum):
    """What the ejector evacuates."""

    CUPS = "cups"
    VESSEL = "vessel"


class Place(StrEnum):
    """Place of the sensor that the PLC reads."""

    EJECTOR = "ejector"
    END = "end"
    UNKNOWN = UNKNOWN


class Answer(StrEnum):
    """Answer to a question that a person may not be able to answer."""

    YES = "yes"
    NO = "no"
    UNKNOWN = UNKNOWN


def _positive(text: str) -> float | None:
    """Parse a size: usage error unless it is above zero; None for ``unknown``."""
    if text == UNKNOWN:
        return None
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e9:
        raise typer.BadParameter(f"{text!r} is no number above zero; write unknown, if it is")
    return value


def _address(text: str) -> str:
    """Parse the PLC's address: usage error unless it has one of the three forms."""
    host, _, port = text.removeprefix(OPC_UA).rpartition(":")
    if text != NO_PLC and not (host and port.isdecimal() and 0 < int(port) <= 0xFFFF):
        raise typer.BadParameter(
            f"{text!r} is no address: write HOST:PORT (Modbus TCP), {OPC_UA}HOST:PORT, or none"
        )
    return text


def _range(text: str) -> tuple[float, float] | None:
    """Parse the sensor's range: usage error unless LOW,HIGH; None for ``unknown``."""
    if text == UNKNOWN:
        return None
    try:
        low, high = map(float, text.split(","))
    except ValueError:
        low, high = 0.0, 0.0
    if not -1e9 < low < high < 1e9:
        raise typer.BadParameter(f"{text!r} is no range: write LOW,HIGH, for example 0,1500")
    return low, high


def _scale(text: str) -> float:
    """Parse the scale of raw values: usage error unless it is a number other than zero."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < abs(value) < 1e9:
        raise typer.BadParameter(f"{text!r} is no number other than zero")
    return value


@dataclass(frozen=True)
class Connection:
    """Source of pressure and commands."""

    address: str
    is_ring: bool
    namespace: str
    pressure: str
    coded: Number
    scale: float
    suction: str
    blow_off: str


@dataclass(frozen=True)
class Sensor:
    """Meaning of the pressure."""

    unit: Unit
    reference: Reference
    range: tuple[float, float] | None


@dataclass(frozen=True)
class System:
    """What hangs on the ejector; None means unknown."""

    hose_mm: float | None
    diameter_mm: float | None
    end: End
    volume_ml: float | None
    sensor: Place
    released: Answer
    supply_bar: float | None


T = TypeVar("T")


class Questions:
    """Values of flags, or people's answers without a flag; ``guessed`` lists the defaults used."""

    def __init__(self) -> None:
        self.guessed: list[str] = []

    def ask(
        self, flag: str, value: Any, question: str, default: str, parse: Callable[[str], T]
    ) -> T:
        """A flag's value, else a person's answer, else the default."""
        text = default
        if value is not None:
            text = str(value)
        elif sys.stdin.isatty():
            text = typer.prompt(
                question, default=default, value_proc=partial(_valid_answer, parse), err=True
            )
        elif default != UNKNOWN:
            self.guessed.append(flag)
        if text == UNKNOWN:
            self.guessed.append(flag)
        return parse(text)


def _valid_answer(parse: Callable[[str], Any], text: str) -> str:
    """The text that a person typed, if it is valid; else a usage error, and it is asked again."""
    try:
        parse(text.strip())
    except ValueError as error:  # no choice of an enumeration
        raise typer.BadParameter(f"{text!r} is none of these") from error
    return text.strip()


def _size(flag: str, help_text: str) -> Any:
    return typer.Option(flag, metavar="X|unknown", help=help_text)


def init(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The new configuration.")] = Path(
        "cell.toml"
    ),
    *,
    starter: Annotated[
        str, typer.Option(metavar="NAME", help=f"Copy an example: {', '.join(STARTERS)}.")
    ] = "",
    unit: Annotated[
        str | None, typer.Option("--id", metavar="ID", help="Name of the unit.")
    ] = None,
    kind: Annotated[
        str | None, typer.Option("--type", help="Type on the nameplate, or unknown.")
    ] = None,
    address: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT|opc.tcp://HOST:PORT|none", help="Where the PLC is."),
    ] = None,
    ring: Annotated[
        bool | None,
        typer.Option("--ring/--no-ring", help="The PLC keeps a ring of scans, or is polled."),
    ] = None,
    namespace: Annotated[
        str | None, typer.Option(metavar="URI", help="Of the OPC UA nodes.")
    ] = None,
    pressure: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Of the pressure: register or node.")
    ] = None,
    coded: Annotated[
        Number | None, typer.Option("--pressure-type", help="Of the pressure's register.")
    ] = None,
    scale: Annotated[
        str | None,
        typer.Option(metavar="FLOAT", help="Pressure in its unit for a raw value of 1."),
    ] = None,
    suction: Annotated[
        str | None, typer.Option(metavar="ADDRESS[/BIT]", help="Of the suction command.")
    ] = None,
    blow_off: Annotated[
        str | None, typer.Option(metavar="ADDRESS[/BIT]", help="Of the blow-off command.")
    ] = None,
    pressure_unit: Annotated[Unit | None, typer.Option("--unit", help="Of the pressure.")] = None,
    reference: Annotated[
        Reference | None, typer.Option(help="What the pressure is counted from.")
    ] = None,
    sensor_range: Annotated[
        str | None, typer.Option("--range", metavar="LOW,HIGH|unknown", help="Of the sensor.")
    ] = None,
    hose: Annotated[str | None, _size("--hose-mm", "Length of the hose.")] = None,
    diameter: Annotated[str | None, _size("--diameter-mm", "Inner diameter of the hose.")] = None,
    end: Annotated[End | None, typer.Option(help="What is evacuated.")] = None,
    volume: Annotated[str | None, _size("--volume-ml", "Of all cups, or of the vessel.")] = None,
    sensor: Annotated[Place | None, typer.Option(help="Where the sensor is.")] = None,
    released: Annotated[
        Answer | None, typer.Option(help="Whether blow-off lets the part go.")
    ] = None,
    supply: Annotated[str | None, _size("--supply-bar", "At the regulator, gauge.")] = None,
    force: Force = False,
) -> None:
    """Write a commented configuration to begin with, from flags or a few questions.

    On a terminal what no flag says is asked; unknown is an answer to most. Elsewhere it is
    guessed, and the file says so. An example has its simulated PLC with it, so it can be tried
    without a machine.
    """
    refuse_existing(file, force=force)
    if starter:
        _refuse_other_options(context, "file", "force", "starter")
        _write(
            file,
            _example(starter),
            f"twin plc {file}",
            f"twin run {file} --log today.mcap   # in a second terminal",
            force=force,
        )
        return
    questions = Questions()
    ask = questions.ask
    named = ask("--id", unit, "Name of this unit", file.stem, str)
    typed = ask("--type", kind, "Type on the nameplate", UNKNOWN, str)
    plc_address = ask(
        "--address", address, f"Where the PLC is ({FILE_ONLY})", PLACEHOLDER, _address
    )
    connection = None
    if plc_address != NO_PLC:
        tags = pressure, suction, blow_off
        connection = _connection(questions, plc_address, ring, namespace, tags, coded, scale)
    pressure_meaning = Sensor(
        ask("--unit", pressure_unit, f"Unit of the pressure ({_of(Unit)})", Unit.MBAR, Unit),
        ask("--reference", reference, f"Counted from ({_of(Reference)})", "absolute", Reference),
        ask("--range", sensor_range, "Range of the sensor, LOW,HIGH", UNKNOWN, _range),
    )
    end_kind = ask("--end", end, f"What is evacuated ({_of(End)})", End.CUPS, End)
    volume_question = "Volume of all cups, or of the vessel, ml"
    released_question = f"Does blow-off let the part go ({_of(Answer)})"
    system = System(
        ask("--hose-mm", hose, "Length of the hose, mm", UNKNOWN, _positive),
        ask("--diameter-mm", diameter, "Its inner diameter, mm", UNKNOWN, _positive),
        end_kind,
        ask("--volume-ml", volume, volume_question, UNKNOWN, _positive),
        ask("--sensor", sensor, f"Where the sensor is ({_of(Place)})", UNKNOWN, Place),
        ask("--released", released, released_question, UNKNOWN, Answer),
        ask("--supply-bar", supply, "Supply at the regulator, bar gauge", UNKNOWN, _positive),
    )
    text = configuration(
        file, (named, typed), connection, pressure_meaning, system, questions.guessed
    )
    _check(text, file)
    _write(file, text, *next_commands(file, connection), force=force)


def _write(file: Path, text: str, *commands: str, force: bool) -> None:
    """Write a new file, and print the commands to run next."""
    with said_plainly(file), file.open("w" if force else "x", encoding="utf-8") as stream:
        stream.write(text)
    print(f"written: {file}; look through it, then:")
    for line in commands:
        print(f"  {line}")


def _example(name: str) -> str:
    """The text of a shipped configuration below that of each new file.

    ConfigError if there is none of that name.
    """
    if name not in STARTERS:
        raise ConfigError(
            f"--starter {name}: there is no such example", known_names(name, STARTERS)
        )
    shipped = (_STARTERS / f"{name}.toml").read_text(encoding="utf-8")
    return "\n".join((*_HEAD, shipped))


def _refuse_other_options(context: typer.Context, *allowed: str) -> None:
    """ConfigError if more is given than is ``allowed``: an example is copied as it is."""
    for parameter in context.command.params:
        name = str(parameter.name)
        source = context.get_parameter_source(name)
        if name not in allowed and source is not None and source.name == "COMMANDLINE":
            message = f"{parameter.opts[0]} does not change an example"
            raise ConfigError(message, "leave it out, and edit the file")


def _of(choices: type[StrEnum]) -> str:
    return ", ".join(choices)


def _connection(
    questions: Questions,
    address: str,
    ring: bool | None,
    namespace: str | None,
    tags: tuple[str | None, ...],
    coded: Number | None,
    scale: str | None,
) -> Connection:
    kind = "opcua" if address.startswith(OPC_UA) else "modbus"
    question = "Does the PLC keep a ring of scans, as docs/connect-your-plc.md has it (yes, no)"
    answer = None if ring is None else Answer.YES if ring else Answer.NO
    is_ring = questions.ask("--ring", answer, question, Answer.YES, Answer) is Answer.YES
    if kind == "opcua":
        question = "Namespace of the nodes, an URI"
        uri = questions.ask("--namespace", namespace, question, SIMULATED_NAMESPACE, str)
    else:
        uri = namespace or SIMULATED_NAMESPACE
    layout, number = LAYOUTS[kind, is_ring], coded or Number.FLOAT32
    if is_ring:  # a ring has its own layout
        at, on, off = (tag or layout_tag for tag, layout_tag in zip(tags, layout, strict=True))
        factor = _factor(questions, kind, number, scale)
        return Connection(address, is_ring, uri, at, number, factor, on, off)
    at = questions.ask("--pressure", tags[0], "Address of the pressure", layout[0], str)
    if kind == "modbus":
        question = f"Its type ({_of(Number)})"
        number = questions.ask("--pressure-type", coded, question, Number.INT16, Number)
    factor = _factor(questions, kind, number, scale)
    question = "Address of the suction command, with /BIT in a word"
    on = questions.ask("--suction", tags[1], question, layout[1], str)
    off = questions.ask("--blow-off", tags[2], "Address of the blow-off command", layout[2], str)
    return Connection(address, is_ring, uri, at, number, factor, on, off)


def _factor(questions: Questions, kind: str, number: Number, scale: str | None) -> float:
    """The scale of raw values: asked of whole numbers in registers, 1 for others."""
    if kind == "modbus" and number is not Number.FLOAT32:
        question = "Pressure in its unit for a raw value of 1"
        return questions.ask("--scale", scale, question, "1", _scale)
    return _scale(scale or "1")


def _check(text: str, file: Path) -> None:
    """ConfigError if the answers make no valid configuration: then nothing is written."""
    from drivers.sources import settings_of
    from twin.config import Config
    from twin.settings import Document

    document = Document.parse(text, str(file))
    if "driver" in document.tables:
        settings_of(document)
    config = Config.of(document, calibrated=False)
    if config.asset.id.strip() != config.asset.id or not config.asset.id.isprintable():
        raise ConfigError(f"{config.asset.id!r} cannot be the name of a unit", "use plain letters")


def next_commands(file: Path, connection: Connection | None) -> tuple[str, str]:
    """The two commands to run next."""
    if connection is None:
        return (
            f"twin import TRACE.csv --config {file} -o healthy.mcap",
            f"twin commission healthy.mcap --config {file}",
        )
    return f"twin probe {file}", f"twin commission {file} --cycles 12"


# --- the file -----------------------------------------------------------------------------------


def configuration(
    file: Path,
    asset: tuple[str, str],
    connection: Connection | None,
    sensor: Sensor,
    system: System,
    guessed: Sequence[str],
) -> str:
    """Text of a configuration for ``asset`` (ID and type); it lists what is ``guessed``."""
    unit, kind = asset
    is_known = kind not in ("", UNKNOWN)
    name = kind if is_known else f"type-of-{unit}"
    note = "as on the nameplate" if is_known else "not known: a type of its own"
    first, second = next_commands(file, connection)
    lines = [
        *_HEAD,
        "# What a person knows of this ejector. What a calibration finds is kept in the asset",
        "# database, not here. docs/data-set.md has every key of [data].",
        f"# Next: {first}; then {second}",
        *(
            f"# {line}"
            for line in wrap(f"Not said, so guessed: {', '.join(guessed)}", 96)
            if guessed
        ),
        "",
        "[asset]",
        _line(f"type = {_quoted(name)}", note),
        f"id = {_quoted(unit)}",
        "",
        *(_no_driver(sensor) if connection is None else _driver(connection, sensor)),
        "",
        "# --- what hangs on the ejector, outwards from its port; 20 % off is near enough --------",
        "",
        *_system(system),
        "",
        *_supply(system.supply_bar),
        "",
        "# twin commission finds the rest. If you are sure of these, set them:",
        "# [data.ejector]",
        "# h1_mbar = 750.0               # vacuum at which air saving ends suction",
        '# control_sensor = "plc"        # it switches by the sensor that the PLC reads (IO-Link)',
    ]
    return "\n".join(lines) + "\n"


def _driver(connection: Connection, sensor: Sensor) -> list[str]:
    is_opcua = connection.address.startswith(OPC_UA)
    lines = [
        "# --- where the samples come from: docs/connect-your-plc.md, docs/opcua.md ---------",
        "",
    ]
    lines += ["[driver]"]
    if is_opcua:
        polled, key = "subscribe", "node"
        lines += ['kind = "opcua"', f"url = {_quoted(connection.address)}"]
        is_simulated = connection.namespace == SIMULATED_NAMESPACE
        remark = "of the simulated PLC: put your nodes' here" if is_simulated else "of the nodes"
        lines += [_line(f"namespace = {_quoted(connection.namespace)}", remark)]
    else:
        polled, key = "poll", "address"
        host, _, port = connection.address.rpartition(":")
        remark = "not said: put the PLC's address here" if connection.address == PLACEHOLDER else ""
        lines += ['kind = "modbus"', _line(f"host = {_quoted(host)}", remark), f"port = {port}"]
        lines += ["unit = 1", _line('word_order = "big"', "twin probe tells which")]
    mode = "block" if connection.is_ring else polled
    mode_remark = (
        f'a ring of scans; without one "{polled}"' if connection.is_ring else "no ring of scans"
    )
    lines += [
        _line(f'mode = "{mode}"', mode_remark),
        "",
        _line("[driver.tags]", _TAGS[is_opcua, connection.is_ring]),
    ]
    number = "" if is_opcua else f'type = "{connection.coded}", '
    scale = "" if connection.scale == 1.0 else f"scale = {connection.scale:g}, "
    pressure = f"{key} = {_quoted(connection.pressure)}, {number}{scale}{_meaning(sensor)}"
    lines += [f"pressure = {{ {pressure} }}"]
    for name, tag_address in (("suction", connection.suction), ("blow_off", connection.blow_off)):
        bit = re.fullmatch(r"(.+)/(\d+)", tag_address)
        at = (
            f"{key} = {_quoted(bit[1])}, bit = {bit[2]}"
            if bit
            else f"{key} = {_quoted(tag_address)}"
        )
        lines += [f"{name} = {{ {at} }}"]
    registers = BESIDE_RING if connection.is_ring else BESIDE_POLLED
    return [*lines, *(OFFERED + (BESIDE_NODES if is_opcua else registers)).splitlines()]


def _no_driver(sensor: Sensor) -> list[str]:
    """Lines for a unit that has only files."""
    pressure = f'{{ name = "Pressure", unit = "{sensor.unit}", reference = "{sensor.reference}" }}'
    return [
        "# --- files of another program: docs/csv.md --------------------------------------",
        "",
        "[import]",
        '# time_zone = "Europe/Berlin"   # zone of times without one',
        "",
        "[import.columns]",
        '# time_s = "Time"               # the file\'s names, where they are others',
        f"# pressure = {pressure}",
        *(OFFERED + BESIDE_COLUMNS).splitlines(),
    ]


def _meaning(sensor: Sensor) -> str:
    words = f'unit = "{sensor.unit}", reference = "{sensor.reference}"'
    if sensor.range is None:
        return words
    low, high = sensor.range
    return f"{words}, range = [{low:g}, {high:g}]"


def _system(system: System) -> list[str]:
    is_released = system.released is Answer.YES or (
        system.released is Answer.UNKNOWN and system.end is End.CUPS
    )
    kind = "cups" if is_released else "vessel"
    cups_remark = {
        Answer.YES: "open to ambient once the part is gone",
        Answer.NO: "closed: nothing is released",
        Answer.UNKNOWN: "not known whether the part is released: guessed",
    }[system.released]
    sizes = {
        "length_mm": (system.hose_mm, GUESSED["hose_mm"]),
        "diameter_mm": (system.diameter_mm, GUESSED["diameter_mm"]),
    }
    guessed = [name for name, (size, _) in sizes.items() if size is None]
    values = ", ".join(
        f"{name} = {size if size is not None else guess}" for name, (size, guess) in sizes.items()
    )
    hose = _line(
        f'    {{ kind = "tube", {values} }},',
        f"{' and '.join(guessed)} not known: guessed" if guessed else "",
    )
    volume = system.volume_ml if system.volume_ml is not None else GUESSED[system.end]
    size = "" if system.volume_ml is not None else "; volume_ml not known: guessed"
    sensor_remark = (
        "not known: guessed" if system.sensor is Place.UNKNOWN else f"at the {system.sensor}"
    )
    sensor = _line('    { kind = "sensor" },', sensor_remark)
    parts = [hose, sensor] if system.sensor is Place.END else [sensor, hose]
    last = _line(f'    {{ kind = "{kind}", volume_ml = {volume} }},', cups_remark + size)
    return ["[data.system]", "parts = [", *parts, last, "]", _exactness(system)]


def _exactness(system: System) -> str:
    """The line on how exact volumes are that were read off, or guessed."""
    if system.volume_ml is None:
        within, remark = A_VESSEL_GUESSED, "guessed: only ratios of flows and volumes are found"
    else:
        remark = "flows and volumes found are as exact; 1.02 if measured"
        within = A_FIFTH_OFF
        if system.hose_mm is None or system.diameter_mm is None:
            length = system.hose_mm or GUESSED["hose_mm"]
            diameter = system.diameter_mm or GUESSED["diameter_mm"]
            tube_ml = 1e-3 * math.pi / 4.0 * diameter**2 * length
            most_ml = A_FIFTH_OFF * system.volume_ml + A_TUBE_GUESSED * tube_ml
            within = most_ml / (system.volume_ml + tube_ml)
    return _line(f"volumes_within_factor = {within:.3g}", remark)


def _supply(pressure_bar: float | None) -> list[str]:
    value = "# pressure_bar = 5.0" if pressure_bar is None else f"pressure_bar = {pressure_bar}"
    remark = "gauge, at the regulator" + ("; not known" if pressure_bar is None else "")
    return ["[data.supply]", _line(value, remark)]


def _line(text: str, comment: str) -> str:
    return f"{text:<31} # {comment}" if comment else text


def _quoted(text: str) -> str:
    """A TOML string."""
    return json.dumps(text, ensure_ascii=False)
