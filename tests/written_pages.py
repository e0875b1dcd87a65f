"""What a person reads on a page that a command writes, and a commissioning to write one of."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
from calibrations import log_of, typed

from twin.calibration.calibrate import Calibration
from twin.calibration.commission import Commissioned
from twin.calibration.fit import Fitted
from twin.calibration.parameters import FREE
from twin.calibration.readings import read
from twin.calibration.record_checks import Remark
from twin.calibration.verdict import Residual, Verdict
from twin.config import Asset
from twin.monitor.healthy import Healthy
from twin.monitor.signal_checks import Contradiction
from twin.signals import MBAR, MS, Phase

ENGLISH_WORDS = re.compile(
    r"\b(the|and|of|with|is|are|from|that|not|which|cause|log|cycles?|by|to|mean|expected|left)\b"
)
UNIT = Asset(type="unbekannt", id="gripper-7")
REMARKS = (
    Remark(
        "the nozzle goes off at 752.5 mbar; the configuration says 700",
        "[data.ejector] h1_mbar = 752.5",
    ),
    Remark(
        "the pressure is read nearer to the vessel; the configuration has the sensor nearer to the"
        " port",
        '[[data.system.parts]] kind = "sensor", after the tubes',
    ),
)
CONTRADICTION = Contradiction(
    "part_present",
    "part present comes at 512 mbar of vacuum; H2 is 600 mbar",
    "set [data.ejector] h2_mbar = 512, or H2 of the ejector",
)
TIMES = {"good": 1.2, "usable": 1.8, "refused": 3.5}  # the floor, in the phase that is worst


def visible(page: str) -> str:
    """What a person reads or hears, without what was given: the log's name and the program's."""
    page = re.sub(r"<style.*?</style>", "", page, flags=re.DOTALL)
    page = re.sub(r'<p lang="en">.*?</p>|<wbr>', "", page)
    texts = re.findall(r">([^<>]+)<", page)
    texts += re.findall(r'aria-label="([^"]*)"', page)
    return re.sub(r"ejector-twin [\d.]+|\w+\.mcap", "", "\n".join(texts))


@cache
def commissioned(word: str) -> Commissioned:
    """A commissioning with a verdict, as if it had been fitted."""
    samples = log_of("test_rig")
    data = typed("test_rig").data
    prior = np.array([free.spread for free in FREE])
    covariance = np.diag((np.where(np.arange(len(FREE)) % 2, 0.1, 1.0) * prior) ** 2)
    scaled = np.zeros(len(FREE), bool)
    fitted = Fitted(data, FREE, covariance, covariance, prior, 1.5 * MBAR, scaled)
    residuals = {phase: Residual(1.1 * MBAR, MBAR) for phase in Phase}
    residuals[Phase.HOLD] = Residual(TIMES[word] * MBAR, MBAR, -3.25 * MBAR, 123 * MS)
    residuals[Phase.BLOW_OFF] = Residual(TIMES[word] * MBAR, MBAR, 31.25 * MBAR, 12 * MS)
    made = Commissioned(
        Calibration(fitted, Verdict(residuals), Healthy(), 8, 0, 1),
        replace(read(samples), period=8.0 * MS),
        () if word == "good" else REMARKS,
        () if word == "good" else (CONTRADICTION,),
        samples,
    )
    assert made.verdict.word == word
    return made
