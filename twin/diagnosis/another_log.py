"""Judge the extended model on another log, on which nothing was fitted or chosen."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from twin.config import Config
from twin.diagnosis.answer import Diagnosis, insufficient
from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis, read_again, read_cycles
from twin.diagnosis.extend import extended, swings
from twin.diagnosis.held_out import Judged, gain, judge
from twin.diagnosis.residual_covariance import covariance
from twin.errors import SourceError
from twin.model.courses import Cause
from twin.signals import Samples

PHASES = 24  # of a rhythm that are tried on another log


def judged_on(
    diagnosis: Diagnosis, config: Config, log: str, blocks: Iterable[Samples]
) -> dict[str, Any] | None:
    """Figures of the twin as it stands and of the extended model on ``log``; None without one.

    All whole cycles of the log count, whatever their program. Intermittent causes are left out.
    What swings begins anew in each log: every second cycle shows its phase, the others judge.
    Raises SourceError if the log has no cycle to judge by.
    """
    extended_model = extended(diagnosis, config)
    swinging = tuple(filter(swings, diagnosis.acting))
    if extended_model is None and not swinging:
        return None
    blocks, other_config = read_again(blocks), config
    if extended_model is not None:
        monitor = config.monitor.model_copy(update={"healthy": extended_model.healthy})
        other_config = replace(config, data=extended_model.data, monitor=monitor)
    read = [read_cycles(either, blocks) for either in (config, other_config)]
    before, after = (cycles_read.whole() for cycles_read in read)
    cycles = sorted({*before.judged} & {*after.judged})
    if reason := insufficient(read[0], before) or insufficient(read[1], after):
        raise SourceError(f"{log}: nothing can be judged on it: {reason}")
    if swinging:
        swinging, cycles = (_in_phase(after, cycles[::2], swinging[0]),), cycles[1::2]
    as_it_stands, with_causes = _judged(before, cycles), _judged(after, cycles, swinging)
    return {
        "log": log,
        "cycles": len(cycles),
        "baseline": as_it_stands.figures,
        "extended": with_causes.figures,
        "gain": gain(as_it_stands, with_causes),
    }


def _judged(evidence: Evidence, cycles: list[int], swinging: Hypothesis = HEALTHY) -> Judged:
    return judge(evidence, covariance(evidence, swinging).of(cycles), swinging)


def _in_phase(evidence: Evidence, cycles: list[int], cause: Cause) -> Cause:
    """The swinging cause with the phase that suits some cycles of a log best."""
    period = cause.values["period"]
    shifts = np.linspace(0.0, period, PHASES, endpoint=False)
    causes = [replace(cause, values={**cause.values, "shift": float(s)}) for s in shifts]
    bins = np.isin(evidence.bins.cycle, cycles)
    off = evidence.off([(shifted,) for shifted in causes])[bins]
    squares = np.average(off**2, axis=0, weights=evidence.bins.count[bins])
    return causes[int(np.argmin(squares))]
