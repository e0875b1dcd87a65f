"""The course of faults in time: how strongly each acts in every scan of the PLC."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from drivers.plc.faults import COLUMNS, ROW, UNITS, Fault, Parameter, Rows

SCANS_PER_S = 1000


@dataclass
class Schedule:
    """Gives ``ROW`` for each scan; ``cycle_starts`` grows with each command of suction."""

    faults: Sequence[Fault]
    seed: int
    vessel_film: float  # W/(m²·K), the rig's own
    cycle_starts: list[int] = field(default_factory=list)

    def rows(self, first: int, cycles: npt.NDArray[np.int64]) -> Rows:
        """Rows for the scans from ``first`` on; ``cycles`` is the cycle of each, -1 before any."""
        rows = np.empty(len(cycles), ROW)
        rows[["supply_scatter", "seal_scatter"]] = 0.0
        for name, parameter in COLUMNS.items():
            rows[name] = self._neutral(parameter)
        scans = first + np.arange(len(cycles))
        for number, fault in enumerate(self.faults):
            strength = self._progress(fault, scans) * self._acts(number, fault, cycles)
            rows[fault.column] += (fault.value - self._neutral(fault.parameter)) * strength
        for name, parameter in COLUMNS.items():
            rows[name] = np.clip(rows[name], parameter.low, parameter.high) * UNITS[parameter.unit]
        return rows

    def _neutral(self, parameter: Parameter) -> float:
        return self.vessel_film if parameter.neutral is None else parameter.neutral

    def _progress(
        self, fault: Fault, scans: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64] | float:
        """Share of the full size that the course has reached."""
        start = fault.start_s * SCANS_PER_S
        if fault.start_cycle is not None:
            if fault.start_cycle >= len(self.cycle_starts):
                return 0.0
            start = float(self.cycle_starts[fault.start_cycle])
        if fault.ramp_s:
            return np.clip((scans - start) / (fault.ramp_s * SCANS_PER_S), 0.0, 1.0)
        return (scans >= start).astype(np.float64)

    def _acts(
        self, number: int, fault: Fault, cycles: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.bool_]:
        """Whether the fault acts in each cycle; ``share`` draws the same cycles at every run."""
        if fault.share >= 1.0:
            return np.equal(cycles % fault.every, 0)
        draws = np.random.default_rng([self.seed, 3, number]).random(len(self.cycle_starts) + 1)
        return np.less(draws[cycles + 1], fault.share)
