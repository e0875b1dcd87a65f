"""The next measurement: which recording would part what this log cannot tell apart.

Each test that a rig engineer can do is simulated as if the causes found were true; then every
look-alike is fitted to it as to a log. What is left of it, in sigmas, is how far they would part.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin.diagnosis.covariance import covariance
from twin.diagnosis.evidence import Evidence, Hypothesis, of_log
from twin.diagnosis.fit import fit
from twin.diagnosis.mechanisms import Explained
from twin.diagnosis.search import Search
from twin.model import kernel
from twin.model import theta as c
from twin.model.courses import Cause, schedule
from twin.model.theta import Theta
from twin.signals import BAR, MS, SAMPLE, Command, Samples

ENOUGH = 5.0  # sigmas that part two causes for good
REPEATS = 4  # of a test: the first one lets the model swing in
MOST_RIVALS = 3
SUPPLY_STEP = 1.0 * BAR

_OFF, _SUCTION, _BLOW = 0, int(Command.SUCTION), int(Command.BLOW_OFF)
Program = Sequence[tuple[int, int]]  # command, ms


@dataclass(frozen=True)
class Test:
    """What can be recorded, in words; a program of commands, and what is set otherwise."""

    words: str
    program: Program
    change: Callable[[Theta], None]


def _as_it_is(_theta: Theta) -> None:
    pass


def _no_air_saving(theta: Theta) -> None:
    theta[c.AIR_SAVING] = c.OFF


def _less_supply(theta: Theta) -> None:
    theta[c.SUPPLY] -= SUPPLY_STEP


_CYCLE = ((_SUCTION, 1500), (_BLOW, 300), (_OFF, 700))
# The cheapest first.
TESTS = (
    Test(
        "six short bursts of suction (60 ms) and of blow-off (60 ms), 0.4 s apart",
        ((_SUCTION, 60), (_OFF, 400), (_BLOW, 60), (_OFF, 400)) * 2,
        _as_it_is,
    ),
    Test(
        "cycles with a blow-off of 1 s",
        ((_SUCTION, 1500), (_BLOW, 1000), (_OFF, 700)),
        _as_it_is,
    ),
    Test(
        "cycles in which the part is held for 8 s",
        ((_SUCTION, 8000), (_BLOW, 300), (_OFF, 700)),
        _as_it_is,
    ),
    Test(
        "cycles of 4 s of suction to the end vacuum, the air saving switched off",
        ((_SUCTION, 4000), (_BLOW, 300), (_OFF, 700)),
        _no_air_saving,
    ),
    Test("cycles with the supply pressure lowered by 1 bar", _CYCLE, _less_supply),
)


def next_experiment(
    evidence: Evidence, searched: Search, mechanism: Explained | None = None
) -> str | None:
    """What to record so that causes this log cannot tell apart come apart; None if none are.

    Where a ``mechanism`` acts, so that it comes apart from what else it may be.
    """
    if mechanism is not None:
        others = [(*mechanism.beside, one) for one in mechanism.rivals[:1]]  # the nearest
        found = mechanism.fitted.hypothesis
        return _recording(evidence, found, others, "the mechanism", "what else it may be")
    if searched.found is None:
        return None
    rivals = [one for some in searched.rivals for one in some][:MOST_RIVALS]
    names = ", ".join(
        dict.fromkeys(e for one in rivals for e in one.effects if e not in searched.found.effects)
    )
    this, found = " and ".join(searched.found.effects), searched.found.hypothesis
    return _recording(evidence, found, [one.hypothesis for one in rivals], this, names)


def _recording(
    evidence: Evidence, found: Hypothesis, rivals: Sequence[Hypothesis], this: str, names: str
) -> str | None:
    """The cheapest test that parts what was found from its rivals, else the one that does most."""
    if not rivals:
        return None
    settled, others = _settled(evidence, found), [_settled(evidence, one) for one in rivals]
    parted = []
    for test in TESTS:
        apart = _apart(evidence, settled, others[:MOST_RIVALS], test)
        parted.append((test, apart))
        if apart >= ENOUGH:
            break
    test, apart = parted[-1] if parted[-1][1] >= ENOUGH else max(parted, key=lambda one: one[1])
    if apart < 2.0:
        return (
            f"no recording of this sensor is predicted to part {this} from {names}"
            f" (at most {apart:.1f} sigma): measure one of them by other means"
        )
    return f"record {test.words}: {this} and {names} are predicted to part by {apart:.0f} sigma"


def _settled(evidence: Evidence, hypothesis: Hypothesis) -> Hypothesis:
    """Causes as they are at the end of the log, from then on constant."""
    last, end = int(evidence.numbers[-1]), float(evidence.seconds[-1])
    return tuple(
        Cause(one.effect, one.at(evidence.theta, end, last) or one.values) for one in hypothesis
    )


def _apart(
    evidence: Evidence, found: Hypothesis, rivals: Sequence[Hypothesis], test: Test
) -> float:
    """By how many sigmas a test would part the causes found from the nearest of their rivals."""
    theta = evidence.theta.copy()
    test.change(theta)
    beside = replace(evidence, theta=theta, uncertain=(), _seen={})
    recorded = of_log(beside, [_simulated(theta, found, test.program)])
    if len(recorded.judged) < 2:
        return 0.0
    weights = covariance(recorded, found).of(recorded.judged)
    fitted = fit(recorded, weights, [found, *rivals])
    return float(np.sqrt(max(min(one.chi2 for one in fitted[1:]) - fitted[0].chi2, 0.0)))


def _simulated(theta: Theta, hypothesis: Hypothesis, program: Program) -> Samples:
    """What the PLC would record of a program, free of noise."""
    commands = np.concatenate(
        [np.zeros(300, np.uint8)]
        + [np.full(ms, command, np.uint8) for command, ms in program] * REPEATS
    )
    rows = len(commands)
    now: Theta = schedule(theta, hypothesis, np.zeros(1), np.zeros(1, np.int64))[-1][1]
    phase, expected = np.empty(rows, np.uint8), np.empty(rows)
    kernel.simulate(kernel.at_rest(now), now, np.full(rows, MS), commands, phase, expected)
    samples = np.zeros(rows, SAMPLE)
    samples["sequence"] = np.arange(rows)
    samples["time_ns"] = 1 + np.arange(rows) * 1_000_000
    samples["pressure"], samples["commands"] = expected, commands
    return samples
