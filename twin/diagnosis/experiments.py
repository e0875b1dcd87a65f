"""The next measurement: a recording that would separate causes that this log cannot tell apart.

Each test that a rig engineer can do is simulated with the found causes. Every look-alike is then
fitted to it as to a log. The residual, in sigmas, is the separation by the test.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis, of_log
from twin.diagnosis.fit import fit
from twin.diagnosis.mechanisms import Explained
from twin.diagnosis.residual_covariance import Covariance, covariance, explained_by_day
from twin.diagnosis.search import Search
from twin.model import kernel
from twin.model import theta as c
from twin.model.courses import Cause, schedule
from twin.model.theta import Theta
from twin.signals import BAR, MS, SAMPLE, Command, Samples

ENOUGH = 5.0  # sigmas that separate two causes for certain
REPEATS = 4  # cycles of a test; the model settles in the first
MOST_RIVALS = 3
SUPPLY_STEP = 1.0 * BAR
MOSTLY = 0.5  # of what causes leave (rms), that weather must explain to be asked for
HIDES = 1.0  # rms of the deviation that weather explains, over that of healthy cycles

_OFF, _SUCTION, _BLOW = 0, int(Command.SUCTION), int(Command.BLOW_OFF)
Program = Sequence[tuple[int, int]]  # command, ms


@dataclass(frozen=True)
class Test:
    """A possible recording: text, program of commands, and changed settings."""

    words: str
    program: Program
    change: Callable[[Theta], None]


def _as_it_is(_theta: Theta) -> None:
    pass


def _no_air_saving(theta: Theta) -> None:
    theta[c.AIR_SAVING] = c.OFF


def _less_supply(theta: Theta) -> None:
    theta[c.SUPPLY] -= SUPPLY_STEP


# A recording that shows more of what nobody listed, by the phase in which most of it is left.
LONGER = {
    "idle": "cycles with three times as long an idle",
    "suction": "cycles with suction to the end vacuum, the air saving switched off",
    "hold": "cycles with three times as long a hold",
    "blow_off": "cycles with three times as long a blow-off",
}
_CYCLE = ((_SUCTION, 1500), (_BLOW, 300), (_OFF, 700))
# Tests in order of cost, the cheapest first.
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
    """The recording that separates causes this log cannot tell apart; None without rivals.

    With a ``mechanism``, the recording separates it from its rivals.
    """
    if mechanism is not None:
        alternatives = [(*mechanism.beside, rival) for rival in mechanism.rivals[:1]]  # the nearest
        hypothesis = mechanism.fitted.hypothesis
        return _recording(
            evidence, hypothesis, alternatives, "the mechanism", "what else it may be"
        )
    if searched.found is None:
        return None
    rivals = [rival for rivals_of_cause in searched.rivals for rival in rivals_of_cause][
        :MOST_RIVALS
    ]
    names = ", ".join(
        dict.fromkeys(
            e for rival in rivals for e in rival.effects if e not in searched.found.effects
        )
    )
    text, hypothesis = " and ".join(searched.found.effects), searched.found.hypothesis
    return _recording(evidence, hypothesis, [rival.hypothesis for rival in rivals], text, names)


def beside_weather(
    evidence: Evidence, about: Covariance, hypothesis: Hypothesis = HEALTHY, share: float = 0.0
) -> str | None:
    """What to measure if a log deviates from a hypothesis as under another weather; else None.

    Nobody measured the weather, so a fault could hide in it. ``about`` is the covariance about the
    hypothesis; weather must explain this ``share`` of the deviation's rms.
    """
    unmeasured = [name for name in ("ambient", "temperature") if name not in evidence.told]
    if not unmeasured:
        return None
    (off,) = evidence.off([hypothesis]).T
    parts = explained_by_day(about, off), off
    explained, deviation = (
        float(np.sqrt(np.average(part**2, weights=evidence.bins.count))) for part in parts
    )
    if not explained > max(HIDES * about.of(evidence.judged).usual, share * deviation):
        return None
    missing = {"ambient": "ambient pressure", "temperature": "temperature"}[unmeasured[0]]
    return (
        f"record {missing} as well: {explained:.1f} mbar of the deviation (rms) look like another"
        " weather, and a fault of that size could hide behind it"
    )


def show_more(phase: str) -> str:
    """The recording that shows more of what nobody listed, if most of it is left in ``phase``."""
    where = phase.replace("_", "-")
    return (
        f"record {LONGER[phase]}: what is left is largest in {where}, and how it goes on there"
        " tells what it may be"
    )


def _recording(
    evidence: Evidence, hypothesis: Hypothesis, rivals: Sequence[Hypothesis], text: str, names: str
) -> str | None:
    """The cheapest test that separates a hypothesis from its rivals, or the best one."""
    if not rivals:
        return None
    settled, settled_rivals = (
        _settled(evidence, hypothesis),
        [_settled(evidence, candidate) for candidate in rivals],
    )
    results = []
    for test in TESTS:
        sigmas = _separation(evidence, settled, settled_rivals[:MOST_RIVALS], test)
        results.append((test, sigmas))
        if sigmas >= ENOUGH:
            break
    test, sigmas = (
        results[-1]
        if results[-1][1] >= ENOUGH
        else max(results, key=lambda candidate: candidate[1])
    )
    if sigmas < 2.0:
        return (
            f"no recording of this sensor is predicted to part {text} from {names}"
            f" (at most {sigmas:.1f} sigma): measure one of them by other means"
        )
    return f"record {test.words}: {text} and {names} are predicted to part by {sigmas:.0f} sigma"


def _settled(evidence: Evidence, hypothesis: Hypothesis) -> Hypothesis:
    """Causes with their sizes at the end of the log, constant from then on."""
    last, end = int(evidence.numbers[-1]), float(evidence.seconds[-1])
    return tuple(
        Cause(cause.effect, cause.at(evidence.theta, end, last) or cause.values)
        for cause in hypothesis
    )


def _separation(
    evidence: Evidence, hypothesis: Hypothesis, rivals: Sequence[Hypothesis], test: Test
) -> float:
    """Sigmas by which a test would separate the found causes from their nearest rival."""
    theta = evidence.theta.copy()
    test.change(theta)
    base = replace(evidence, theta=theta, uncertain=(), _detected_switchings={})
    recorded = of_log(base, [_simulated(theta, hypothesis, test.program)])
    if len(recorded.judged) < 2:
        return 0.0
    weights = covariance(recorded, hypothesis).of(recorded.judged)
    fitted = fit(recorded, weights, [hypothesis, *rivals])
    return float(np.sqrt(max(min(rival.chi2 for rival in fitted[1:]) - fitted[0].chi2, 0.0)))


def _simulated(theta: Theta, hypothesis: Hypothesis, program: Program) -> Samples:
    """Simulated record of a program, without noise."""
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
