"""The table ``[figures]``: permitted values, and where key figures are kept."""

from dataclasses import dataclass
from typing import Annotated, Self

from pydantic import Field, model_validator

from twin.figures.expected import t1_from_rest
from twin.model.dataset import DataSet
from twin.settings import Settings

Positive = Annotated[float, Field(gt=0.0)]
LEAST_T1_MS = 50.0  # over what is usual: below is scatter


class FigureSettings(Settings):
    """What is permitted in a cycle, the field's defaults; and whether figures are kept."""

    permitted_t1_ms: Positive | None = None  # as the data set expects it, and the tolerance
    permitted_leakage_mbar_s: Positive | None = None  # as the data set's, for leak monitoring
    permitted_free_flow_mbar: Positive | None = None  # where the ejector would report a part
    supply_low_bar: Annotated[float, Field(ge=0.0)] = 3.0  # gauge, at the nozzle
    supply_high_bar: Positive = 6.0
    energy_kwh_m3: Positive = 0.12  # to compress a standard cubic metre, whole compressor station
    autoset_tolerance: Annotated[float, Field(ge=0.0, le=10.0)] = 0.25  # over the last good cycles
    keep: bool = False  # twin run adds its cycles to the database
    url: str = ""  # of the database, or an SQLite file from the configuration's folder

    @model_validator(mode="after")
    def _range_is_one(self) -> Self:
        if self.supply_low_bar >= self.supply_high_bar:
            raise ValueError("supply_low_bar must be below supply_high_bar")
        return self


@dataclass(frozen=True)
class Limits:
    """What is permitted of one unit, every value known; in the figures' units."""

    t1: float  # ms; infinite where no suction of the data set reaches H1
    leakage: float  # mbar/s
    free_flow: float  # mbar
    supply: tuple[float, float]  # bar gauge


def permitted(usual: float, tolerance: float, least: float) -> float:
    """The limit of a figure: a share more than usual, at least so much more that scatter is not."""
    return usual + max(tolerance * usual, least)


def limits(settings: FigureSettings, data: DataSet) -> Limits:
    """The limits of a unit: what is not set follows from its data set."""
    ejector, t1 = data.ejector, settings.permitted_t1_ms
    if t1 is None:
        t1 = permitted(t1_from_rest(data), settings.autoset_tolerance, LEAST_T1_MS)
    leakage, free_flow = settings.permitted_leakage_mbar_s, settings.permitted_free_flow_mbar
    return Limits(
        t1=t1,
        leakage=ejector.permitted_leakage_mbar_s if leakage is None else leakage,
        free_flow=ejector.h2_mbar - ejector.h2_hysteresis_mbar if free_flow is None else free_flow,
        supply=(settings.supply_low_bar, settings.supply_high_bar),
    )
