"""Judge the extended model on another log, on which nothing was fitted or chosen."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from twin.config import Config
from twin.diagnosis.answer import Diagnosis, insufficient
from twin.diagnosis.covariance import covariance
from twin.diagnosis.evidence import HEALTHY, Evidence, collect
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
    blocks = list(blocks)
    before = collect(config, blocks)
    after = collect(replace(config, data=extended_model.data, monitor=monitor), blocks)
    cycles = sorted({*before.judged} & {*after.judged})
    if reason := insufficient(before) or insufficient(after):
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
