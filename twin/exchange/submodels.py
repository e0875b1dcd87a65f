"""The submodels of a shell, after the submodel templates of the IDTA.

Digital Nameplate 3.0 (02006), Technical Data 2.0 (02003), Provision of Simulation Models 1.0
(02005) and Time Series Data 1.1 (02008). Properties that the asset database does not know have no
value.
"""

import base64
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta
from urllib.parse import quote

from basyx.aas import model
from basyx.aas.model import datatypes

from twin.assets.diagram import FLOW, SUPPLY, VACUUM
from twin.assets.file import show_time
from twin.assets.record import Record
from twin.exchange.elements import (
    ARBITRARY,
    Element,
    group,
    link,
    listed,
    meaning,
    numbers,
    submodel,
    text,
    tree,
    typed,
    words,
)
from twin.exchange.fmu_file import MEDIA_TYPE, Fmu

MCAP = "application/x-mcap"
DESIGNATION = "Pneumatic vacuum ejector"

_DICTIONARY = "0173-1#02-"
_PLATE = "0112/2///61987#"
_ADDRESS = "https://admin-shell.io/zvei/nameplate/1/0/ContactInformations/AddressInformation"
_SIMULATION = "https://admin-shell.io/idta/SimulationModels/"
_SERIES = "https://admin-shell.io/idta/TimeSeries/"
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
# The fields of a message of /scalars in a log, without its time.
_SCALARS = {
    "vacuum_mbar": datatypes.Double,
    "expected_vacuum_mbar": datatypes.Double,
    "deviation_mbar": datatypes.Double,
    "supply_bar": datatypes.Double,
    "suction": datatypes.Boolean,
    "blow_off": datatypes.Boolean,
    "phase": datatypes.Int,
}


def nameplate(identifier: str, asset: str, record: Record) -> model.Submodel:
    """The nameplate of an asset; ``asset`` is its global id."""
    kind, unit = record.type, record.name
    elements = [
        typed("URIOfTheProduct", datatypes.AnyURI, asset, f"{_PLATE}ABN590#002"),
        words("ManufacturerName", None, f"{_PLATE}ABA565#009"),
        words("ManufacturerProductDesignation", DESIGNATION, f"{_PLATE}ABA567#009"),
        group("AddressInformation", (), _ADDRESS),
        text("OrderCodeOfManufacturer", None, f"{_PLATE}ABA950#008"),
        text("ManufacturerProductType", kind, f"{_PLATE}ABA300#008"),
    ]
    if record.kind == "instance":
        elements.append(text("SerialNumber", unit, f"{_PLATE}ABA951#009"))
    semantic = "https://admin-shell.io/idta/nameplate/3/0/Nameplate"
    return submodel(identifier, "Nameplate", elements, semantic)


def technical_data(identifier: str, record: Record) -> model.Submodel:
    """The data set of a record, and its characteristic diagram."""
    general = [
        text("ManufacturerName", None, f"{_DICTIONARY}AAO677#004"),
        words("ManufacturerProductDesignation", DESIGNATION, f"{_DICTIONARY}AAW338#003"),
        text("ManufacturerArticleNumber", None, f"{_DICTIONARY}AAO676#005"),
        text("ManufacturerOrderCode", None, f"{_DICTIONARY}AAO227#004"),
    ]
    since = (_EPOCH + timedelta(seconds=record.valid_from_ns // 10**9)).date()
    date = datatypes.Date(since.year, since.month, since.day)
    further = [
        words("TextStatement", _statement(record), f"{_DICTIONARY}ABK134#002"),
        model.Property(
            "ValidDate", datatypes.Date, date, semantic_id=meaning(f"{_DICTIONARY}ABL775#001")
        ),
    ]
    elements = [
        group("GeneralInformation", general, f"{_DICTIONARY}ABK161#002/0173-1#01-AHX838#002"),
        technical_areas(record),
        group("FurtherInformation", further, f"{_DICTIONARY}ABK164#002"),
    ]
    return submodel(identifier, "TechnicalData", elements, "0173-1#01-AHX837#002")


def _statement(record: Record) -> str:
    since, recorded = show_time(record.valid_from_ns), show_time(record.recorded_ns)
    note = str(record.provenance.get("note", ""))
    statement = f"Data set {record.hash}, valid from: {since}, recorded {recorded}"
    return f"{statement}; {note}" if note else statement


def technical_areas(record: Record) -> Element:
    """The tables of a data set, and its characteristic diagram if there is one."""
    tables = tree({"data": record.data, "healthy": record.healthy})
    elements = [*tables, *_diagram(record)]
    semantic = f"{_DICTIONARY}ABL358#002/0173-1#01-AHX773#002"
    areas = [group(None, elements, semantic)] if elements else []
    return listed("TechnicalPropertyAreas", areas, f"{_DICTIONARY}ABK163#002")


def _diagram(record: Record) -> Iterator[Element]:
    """Suction capacity over vacuum, a curve for each operating pressure."""
    if VACUUM not in record.arrays:
        return
    supply, flow = record.arrays[SUPPLY], record.arrays[FLOW]
    curves = [
        group(
            f"curve_{number}",
            [
                typed("supply_bar", float, pressure, ARBITRARY),
                numbers("suction_capacity_sl_min", row),
            ],
            ARBITRARY,
        )
        for number, (pressure, row) in enumerate(zip(supply, flow, strict=True))
    ]
    axis = numbers("vacuum_mbar", record.arrays[VACUUM])
    yield group("characteristic_diagram", [axis, *curves], ARBITRARY)


def simulation_models(identifier: str, fmu: Fmu, path: str) -> model.Submodel:
    """The submodel of an FMU at ``path`` in the package."""
    s = _SIMULATION
    version = [
        text("ModelVersionId", fmu.version or None, f"{s}ModelVersionId/1/0"),
        link("DigitalFile", path, MEDIA_TYPE, f"{s}DigitalFile/1/0"),
    ]
    files = [
        text("ModelFileType", fmu.kind, f"{s}ModelFileType/1/0"),
        group("ModelFileVersion", version, f"{s}ModelFileVersion/1/0"),
    ]
    purpose = "expected vacuum over time; virtual commissioning"
    described = [
        words("Summary", f"{DESIGNATION} with what hangs on it", f"{s}Summary/1/0"),
        group(
            "SimPurpose",
            [text("PosSimPurpose", purpose, f"{s}PosSimPurpose/1/0")],
            f"{s}SimPurpose/1/0",
        ),
        text("TypeOfModel", "lumped parameters, differential equations", f"{s}TypeOfModel/1/0"),
        text("ScopeOfModel", "pneumatics: pressures, mass flows, heat", f"{s}ScopeOfModel/1/0"),
        group("ModelFile", files, f"{s}ModelFile/1/0"),
        text("ParamMethod", "parameters of the FMU, set to this asset's", f"{s}ParamMethod/1/0"),
        text("InitStateMethod", "at ambient pressure, not commanded", f"{s}InitStateMethod/1/0"),
    ]
    simulation_model = group("SimulationModel", described, f"{s}SimulationModel/1/0")
    return submodel(identifier, "SimulationModels", [simulation_model], f"{s}SimulationModels/1/0")


def time_series(identifier: str, records: Iterable[Record], logs: str) -> model.Submodel:
    """The logs from which records were made; ``logs`` is their address, or empty."""
    s = _SERIES
    columns = [typed(name, kind, None, ARBITRARY) for name, kind in _SCALARS.items()]
    columns.insert(0, typed("Time", datatypes.Long, None, f"{s}RelativePointInTime/1/1"))
    description = "MCAP files; a message of /scalars has these values, PLC time in ns"
    metadata = [
        words("Name", "Logs of the ejector", f"{s}Metadata/Name/1/1"),
        words("Description", description, f"{s}Metadata/Description/1/1"),
        group("Record", columns, f"{s}Record/1/1"),
    ]
    by_log = {str(record.provenance["log_sha256"]): record for record in records}
    segments = [
        _segment(f"ExternalSegment{number:02d}", record, logs)
        for number, record in enumerate(by_log.values(), 1)
    ]
    elements = [
        group("Metadata", metadata, f"{s}Metadata/1/1"),
        group("Segments", segments, f"{s}Segments/1/1"),
    ]
    return submodel(identifier, "TimeSeries", elements, f"{s}1/1")


def _segment(name: str, record: Record, logs: str) -> Element:
    """The log from which a record was made; it is outside the package."""
    log, digest = str(record.provenance["log"]), str(record.provenance["log_sha256"])
    since, s = show_time(record.valid_from_ns), f"{_SERIES}Segment/"
    description = f"Data set {record.hash} was made of it; SHA-256 {digest}"
    elements = [
        words("Name", log, f"{s}Name/1/1"),
        words("Description", description, f"{s}Description/1/1"),
        text("StartTime", since, f"{s}StartTime/1/1"),
        text("State", "completed", f"{s}State/1/1"),
        link("File", place_of(log, digest, logs), MCAP, f"{_SERIES}File/1/1"),
    ]
    return group(name, elements, f"{_SERIES}Segments/ExternalSegment/1/1")


def place_of(log: str, digest: str, logs: str) -> str:
    """The address of a stored log; without one, its name by content (RFC 6920)."""
    if logs:
        return f"{logs.rstrip('/')}/{quote(log)}"
    return f"ni:///sha-256;{base64.urlsafe_b64encode(bytes.fromhex(digest)).decode().rstrip('=')}"
