"""How much a mechanism acts at each time of a log."""

from dataclasses import dataclass

import numpy as np

from twin.diagnosis.evidence import Evidence, Hypothesis
from twin.model import kernel
from twin.model import mechanism as m
from twin.model.theta import Theta
from twin.monitor.bins import Floats, Ints


@dataclass(frozen=True)
class InBins:
    """The model with a mechanism at the middle row of each bin."""

    rows: Ints
    states: Floats  # (kernel.STATE, bins)
    share: Floats  # of the mechanism's size that acts


def in_bins(evidence: Evidence, hypothesis: Hypothesis) -> InBins:
    """The states of a hypothesis that ends with a mechanism, and its share."""
    used = np.flatnonzero(evidence.bins.number >= 0)
    begins = np.searchsorted(evidence.bins.number[used], np.arange(len(evidence.bins.count)))
    rows = used[begins + evidence.bins.count // 2]
    slot = _slot(evidence.course(hypothesis[:-1])[0][1], evidence.course(hypothesis)[0][1])
    states = evidence.states(hypothesis, rows)
    return InBins(rows, states, states[kernel.ACTS + slot])


def _slot(without: Theta, with_it: Theta) -> int:
    """The slot that differs."""
    firsts = [m.slot_at(number) for number in range(m.SLOTS)]
    sizes = [[first + m.SIZE, first + m.ALSO_SIZE] for first in firsts]
    return int(np.argmax([(without[own] != with_it[own]).any() for own in sizes]))
