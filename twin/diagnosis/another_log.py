"""How the extended model does on another log, which nothing was fitted to or chosen on."""

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
    """The twin as it stands and with what was found beside ``log``; None where nothing is to judge.

    All its whole cycles count, whatever their program. What comes and goes is not carried over.
    SourceError where the log has no cycle to judge by.
    """
    known = extended(diagnosis, config)
    if known is None:
        return None
    monitor = config.monitor.model_copy(update={"healthy": known.healthy})
    blocks = list(blocks)
    before = collect(config, blocks)
    after = collect(replace(config, data=known.data, monitor=monitor), blocks)
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
