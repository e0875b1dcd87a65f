"""The compressed air that the simulated rig takes, by its own valves and supply."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import rigs

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import with_truth
from twin.signals import BAR, MBAR, Command, Samples


def taken(
    name: str,
    seconds: float,
    faults: tuple[str, ...] = (),
    seed: int = 1,
    control: Mapping[str, float] | None = None,
) -> float:
    """Mean air (Nl) of a cycle, from the first suction edge to the last one.

    ``control`` has other settings of the ejector's own control, as in ``[plc.control]``.
    """
    rig = rigs.config(name).document.section(PlcSettings, "plc")
    rig = rig.model_copy(update={"control": rig.control.model_copy(update=control or {})})
    parts = with_truth(rig, seconds, [parse_fault(text) for text in faults], seed)
    samples, truth = (np.concatenate(column) for column in zip(*parts, strict=True))
    return _in_cycles(name, samples, truth)


def _in_cycles(name: str, samples: Samples, truth: npt.NDArray[np.void]) -> float:
    data = rigs.config(name).data
    ambient = data.ambient.pressure_mbar * MBAR
    pressed = (truth["supply"] + ambient) / (data.supply.nozzle_bar * BAR + ambient)
    blows = (samples["commands"] & Command.BLOW_OFF) != 0
    per_minute = truth["nozzle"] * data.ejector.air_consumption_sl_min * pressed
    per_minute += blows * data.ejector.blow_off_sl_min
    sucks = (samples["commands"] & Command.SUCTION) != 0
    edges = np.flatnonzero(sucks[1:] & ~sucks[:-1]) + 1
    return float(per_minute[edges[0] : edges[-1]].sum() * 1e-3 / 60.0) / (len(edges) - 1)
