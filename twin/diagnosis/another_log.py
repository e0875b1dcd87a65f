"""Judge the extended model on another log, on which nothing was fitted or chosen."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from twin.config import Config
from twin.diagnosis.answer import Diagnosis, insufficient
from twin.diagnosis.covariance import covariance
from twin.diagnosis.evidence import HEALTHY, Evidence, read_again, read_cycles
from twin.diagnosis.extend import extended
from twin.diagnosis.held_out import Judged, gain, judge
from twin.errors import SourceError
from twin.signals import Samples


def judged_on(
    diagnosis: Diagnosis, config: Config, log: str, blocks: Iterable[Samples]
) -> dict[str, Any] | None:
    """Figures of the twin as it stands and of the extended model on ``log``; None without one.

    All whole cycles of the log count, whatever their program. Intermittent causes are left out.
    Raises SourceError if the log has no cycle to judge by.
    """
    extended_model = extended(diagnosis, config)
    if extended_model is None:
        return None
    monitor = config.monitor.model_copy(update={"healthy": extended_model.healthy})
    blocks = read_again(blocks)
    other_config = replace(config, data=extended_model.data, monitor=monitor)
    read = [read_cycles(either, blocks) for either in (config, other_config)]
    before, after = (cycles_read.whole() for cycles_read in read)
    cycles = sorted({*before.judged} & {*after.judged})
    if reason := insufficient(read[0], before) or insufficient(read[1], after):
        raise SourceError(f"{log}: nothing can be judged on it: {reason}")
    as_it_stands, with_causes = _judged(before, cycles), _judged(after, cycles)
    return {
        "log": log,
        "cycles": len(cycles),
        "baseline": as_it_stands.figures,
        "extended": with_causes.figures,
        "gain": gain(as_it_stands, with_causes),
    }


def _judged(evidence: Evidence, cycles: list[int]) -> Judged:
    return judge(evidence, covariance(evidence).of(cycles), HEALTHY)
