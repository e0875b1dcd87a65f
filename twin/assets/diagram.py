"""The characteristic diagram: suction capacity over vacuum and operating pressure."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError, ValidationInfo, field_validator

from twin.errors import ConfigError
from twin.settings import Settings

VACUUM, SUPPLY, FLOW = "diagram_vacuum_mbar", "diagram_supply_bar", "diagram_flow_sl_min"

Vacuum = Annotated[float, Field(ge=0.0, lt=1100.0)]
Supply = Annotated[float, Field(gt=0.0, le=16.0)]
Flow = Annotated[float, Field(ge=0.0)]


class Diagram(Settings):
    """As a file has it: two axes and, for each supply pressure, one row over the vacuum."""

    vacuum_mbar: list[Vacuum] = Field(min_length=2)  # below ambient, from 0
    supply_bar: list[Supply] = Field(min_length=1)  # gauge, at the nozzle
    suction_capacity_sl_min: list[list[Flow]]

    @field_validator("vacuum_mbar", "supply_bar")
    @classmethod
    def _rises(cls, axis: list[float]) -> list[float]:
        for number, (low, high) in enumerate(pairwise(axis), 2):
            if high <= low:
                raise ValueError(f"must rise strictly, but value {number} is {high} after {low}")
        return axis

    @field_validator("vacuum_mbar")
    @classmethod
    def _starts_open(cls, axis: list[float]) -> list[float]:
        if axis[0] != 0.0:
            raise ValueError("must start at 0, where the port is open")
        return axis

    @field_validator("suction_capacity_sl_min")
    @classmethod
    def _fits_and_falls(cls, rows: list[list[float]], info: ValidationInfo) -> list[list[float]]:
        vacuum, supply = info.data.get("vacuum_mbar"), info.data.get("supply_bar")
        if vacuum is None or supply is None:  # the axes have reported their own errors
            return rows
        if len(rows) != len(supply):
            raise ValueError(f"has {len(rows)} rows for {len(supply)} supply pressures")
        for pressure, row in zip(supply, rows, strict=True):
            _check_row(f"row for {pressure:g} bar", row, vacuum)
        return rows

    def arrays(self) -> dict[str, npt.NDArray[np.float64]]:
        """Vacuum (n,) in mbar, supply (m,) in bar, suction capacity (m, n) in sl/min."""
        return {
            VACUUM: np.array(self.vacuum_mbar, dtype=np.float64),
            SUPPLY: np.array(self.supply_bar, dtype=np.float64),
            FLOW: np.array(self.suction_capacity_sl_min, dtype=np.float64),
        }


def _check_row(label: str, row: list[float], vacuum: list[float]) -> None:
    if len(row) != len(vacuum):
        raise ValueError(f"{label} has {len(row)} values for {len(vacuum)} vacuums")
    if row[0] <= 0.0:
        raise ValueError(f"{label} must be positive at vacuum 0")
    for vacuum_mbar, (flow, next_flow) in zip(vacuum[1:], pairwise(row), strict=True):
        if next_flow > flow:
            raise ValueError(
                f"{label} must not rise, but does at {vacuum_mbar:g} mbar: {flow} to {next_flow}"
            )


def diagram_of(arrays: Mapping[str, npt.NDArray[np.float64]]) -> Diagram | None:
    """The diagram among the arrays, checked (ValidationError), or None if there is none."""
    if not arrays.keys() & {VACUUM, SUPPLY, FLOW}:
        return None
    table = {
        "vacuum_mbar": arrays.get(VACUUM),
        "supply_bar": arrays.get(SUPPLY),
        "suction_capacity_sl_min": arrays.get(FLOW),
    }
    return Diagram.model_validate({k: v.tolist() for k, v in table.items() if v is not None})


def check_diagram(name: str, arrays: Mapping[str, npt.NDArray[np.float64]]) -> None:
    """ConfigError if the asset's arrays hold an invalid diagram."""
    try:
        diagram_of(arrays)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        location = ".".join(map(str, first["loc"]))
        raise ConfigError(
            f"{name!r}: characteristic diagram: {location}: {first['msg']}"
        ) from error
