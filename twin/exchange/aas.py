"""The asset database as Asset Administration Shells, in one AASX package, and back.

Each type has a shell, and each unit has one that is derived from its type's. A shell shows the data
set that holds. The submodel ``DataSets`` has all records of its asset as a file, so that nothing is
lost.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any
from uuid import UUID, uuid5
from zipfile import ZipFile, is_zipfile

from basyx.aas import model
from basyx.aas.adapter.aasx import AASXReader, AASXWriter, DictSupplementaryFileContainer
from basyx.aas.adapter.json import AASToJsonEncoder

from twin.assets.exchange import FORMAT, parse_export, to_export
from twin.assets.record import Kind, Record, holding
from twin.errors import ConfigError, SourceError
from twin.exchange.elements import link, meaning, short, submodel, text
from twin.exchange.fmu_file import MEDIA_TYPE, Fmu
from twin.exchange.submodels import (
    nameplate,
    simulation_models,
    technical_areas,
    technical_data,
    time_series,
)
from twin.files import unzipped_within_budget

JSON = "application/json"
HINT = "take a package that twin assets export --aasx wrote, as it was written"
_AREAS = "TechnicalPropertyAreas"

Store = model.DictIdentifiableStore[model.Identifiable]


@dataclass(frozen=True)
class Package:
    """Contents of a package: an export of a database, and FMUs by their paths in the package."""

    document: dict[str, Any]
    fmus: dict[str, bytes]


@dataclass(frozen=True)
class _Asset:
    """A type or a unit with all its records, oldest first."""

    records: Sequence[Record]
    now_ns: int

    @property
    def shown(self) -> Record:
        """The record that holds; the last recorded one if none holds yet."""
        return holding(self.records, self.now_ns) or self.records[-1]

    def id(self, part: str) -> str:
        """The id of a part, the same in every export: it depends on the asset's first record."""
        return uuid5(UUID(hex=self.records[0].id), part).urn

    def place(self, file: str) -> str:
        """The path of one of its files in the package."""
        return f"/aasx/files/{UUID(self.id('shell')).hex}/{file}"


def write_package(
    records: Iterable[Record], now_ns: int, fmus: Mapping[str, Fmu], logs: str
) -> bytes:
    """The records as an AASX package; each asset shows the data set that holds at a time (UTC).

    ``fmus`` holds simulation models by the name of their unit. ``logs`` is the address of the
    stored logs, or empty. ConfigError if a shell cannot hold a name.
    """
    store, files = _empty_containers()
    assets = _by_asset(records, now_ns)
    try:
        shells = [_shell(asset, assets, fmus, logs, store, files) for asset in assets.values()]
    except (ValueError, model.AASConstraintViolation) as error:
        raise ConfigError(
            f"a shell cannot hold what the asset database has: {error}",
            "export it as JSON: twin assets export",
        ) from error
    package = BytesIO()
    with AASXWriter(package, failsafe=False) as writer:
        writer.write_aas([shell.id for shell in shells], store, files, write_json=True)
    return package.getvalue()


def _empty_containers() -> tuple[Store, DictSupplementaryFileContainer]:
    return model.DictIdentifiableStore(), DictSupplementaryFileContainer()  # type: ignore[no-untyped-call]


def _by_asset(records: Iterable[Record], now_ns: int) -> dict[tuple[Kind, str], _Asset]:
    groups: dict[tuple[Kind, str], list[Record]] = {}
    for record in records:
        groups.setdefault((record.kind, record.name), []).append(record)
    return {key: _Asset(group, now_ns) for key, group in groups.items()}


def _shell(
    asset: _Asset,
    assets: Mapping[tuple[Kind, str], _Asset],
    fmus: Mapping[str, Fmu],
    logs: str,
    store: Store,
    files: DictSupplementaryFileContainer,
) -> model.AssetAdministrationShell:
    """The shell of an asset; adds it and its submodels to ``store``, their files to ``files``."""
    record = asset.shown
    submodels = [
        nameplate(asset.id("Nameplate"), asset.id("asset"), record),
        technical_data(asset.id("TechnicalData"), record),
        _data_sets(asset, files),
    ]
    if of_logs := [item for item in asset.records if "log_sha256" in item.provenance]:
        submodels.append(time_series(asset.id("TimeSeries"), of_logs, logs))
    if record.kind == "instance" and (fmu := fmus.get(record.name)):
        fmu_path = asset.place(f"{short(Path(fmu.name).stem)}.fmu")
        files.add_file(fmu_path, BytesIO(fmu.content), MEDIA_TYPE)
        submodels.append(simulation_models(asset.id("SimulationModels"), fmu, fmu_path))
    shell = model.AssetAdministrationShell(
        _information(asset, assets),
        asset.id("shell"),
        short(record.name),
        submodel={model.ModelReference.from_referable(item) for item in submodels},
        derived_from=_derived_from(record, assets),
    )
    store.update([shell, *submodels])
    return shell


def _information(
    asset: _Asset, assets: Mapping[tuple[Kind, str], _Asset]
) -> model.AssetInformation:
    record = asset.shown
    if record.kind == "type":
        return model.AssetInformation(model.AssetKind.TYPE, asset.id("asset"))
    kind = assets.get(("type", record.type))
    return model.AssetInformation(
        model.AssetKind.INSTANCE,
        asset.id("asset"),
        specific_asset_id=[model.SpecificAssetId("serialNumber", record.name)],
        asset_type=kind.id("asset") if kind else None,
    )


def _derived_from(
    record: Record, assets: Mapping[tuple[Kind, str], _Asset]
) -> model.ModelReference[model.AssetAdministrationShell] | None:
    """The shell of a unit's type."""
    kind = assets.get(("type", record.type))
    if record.kind == "type" or kind is None:
        return None
    key = model.Key(model.KeyTypes.ASSET_ADMINISTRATION_SHELL, kind.id("shell"))
    return model.ModelReference((key,), model.AssetAdministrationShell)


def _data_sets(asset: _Asset, files: DictSupplementaryFileContainer) -> model.Submodel:
    """A submodel with all records of an asset, in the format of ``twin assets export``."""
    content = json.dumps(to_export(asset.records), indent=1).encode()
    path = files.add_file(asset.place("records.json"), BytesIO(content), JSON)
    elements = [text("Format", FORMAT, FORMAT), link("Records", path, JSON, FORMAT)]
    return submodel(asset.id("DataSets"), "DataSets", elements, FORMAT)


# --- reading ------------------------------------------------------------------------------------


def read_package(path: Path) -> Package:
    """The contents of an AASX package of ``write_package``.

    SourceError if it cannot be read; ConfigError if it is none, is damaged or was changed.
    """
    store, files = _open_package(path)
    exports, fmus = [], {}
    for item in store:
        if not isinstance(item, model.Submodel):
            continue
        if item.semantic_id == meaning(FORMAT):
            exports.append(_export(path, item, files))
        for fmu_path in _file_paths(item, MEDIA_TYPE):
            fmus[fmu_path] = _file(path, fmu_path, files)
    if not exports:
        raise ConfigError(f"{path}: no shell in it has data sets of this program", HINT)
    records = [record for export in exports for record in export["records"]]
    records.sort(key=lambda item: (item["recorded_ns"], item["id"]))
    document = {**exports[0], "records": records}
    _check_unchanged(path, parse_export(document), store)
    return Package(document, fmus)


def _open_package(path: Path) -> tuple[Store, DictSupplementaryFileContainer]:
    store, files = _empty_containers()
    try:
        content = BytesIO(path.read_bytes())
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
        raise SourceError(message, "check the path") from error
    if not is_zipfile(content):
        raise ConfigError(f"{path}: not a whole AASX package: it is not a ZIP file", HINT)
    try:
        with ZipFile(content) as archive:
            unzipped_within_budget(archive)
        with AASXReader(content, failsafe=False) as reader:
            reader.read_into(store, files)
    except Exception as error:  # the parsers of ZIP, OPC, XML and JSON raise many kinds
        cause = f"{type(error).__name__}: {error}"
        raise ConfigError(f"{path}: not a whole AASX package: {cause}", HINT) from error
    return store, files


def _export(
    path: Path, data_sets: model.Submodel, files: DictSupplementaryFileContainer
) -> dict[str, Any]:
    """The records of one asset; the database checks later whether they were changed."""
    for file_path in _file_paths(data_sets, JSON):
        try:
            document = json.loads(_file(path, file_path, files))
            parse_export(document)
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"{path}: {file_path}: not valid JSON: {error}", HINT) from error
        return dict(document)
    raise ConfigError(f"{path}: the data sets of {data_sets.id} are missing", HINT)


def _file_paths(data_submodel: model.Submodel, content: str) -> list[str]:
    """The paths of a submodel's files of one content type."""
    pending: list[Any] = list(data_submodel.submodel_element)
    paths = []
    while pending:
        element = pending.pop()
        if isinstance(element, model.File) and element.content_type == content and element.value:
            paths.append(element.value)
        elif isinstance(element, model.SubmodelElementCollection):
            pending += element.value
    return paths


def _file(path: Path, file_path: str, files: DictSupplementaryFileContainer) -> bytes:
    content = BytesIO()
    try:
        files.write_file(file_path, content)
    except KeyError as error:
        raise ConfigError(f"{path}: {file_path} is not in the package", HINT) from error
    return content.getvalue()


def _check_unchanged(path: Path, records: Sequence[Record], store: Store) -> None:
    """ConfigError if technical data match no record: their change would be lost."""
    for (_, name), asset in _by_asset(records, 0).items():
        stored = store.get(asset.id("TechnicalData"))
        if not isinstance(stored, model.Submodel):
            continue
        areas = {_plain(entry) for entry in stored.submodel_element if entry.id_short == _AREAS}
        if areas and not areas & {_plain(technical_areas(entry)) for entry in asset.records}:
            raise ConfigError(
                f"{path}: the technical data of {name!r} were changed, and are not those of any of"
                " its data sets",
                "a package is not to be edited; add a changed data set with twin assets add",
            )


def _plain(element: model.SubmodelElement) -> str:
    return json.dumps(element, cls=AASToJsonEncoder, sort_keys=True)
