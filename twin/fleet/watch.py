"""What one log says of its ejector: mean key figures, and how much of every effect there may be."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from twin.config import Config
from twin.figures.cycle import CycleFigures, compiled
from twin.figures.table import FIGURES
from twin.live import Twin
from twin.monitor.cycles import CycleCutter, figures
from twin.monitor.model_bank import SUSPECTS, ModelBank, Suspect
from twin.monitor.statistics import CycleResidual, ScoreExtractor
from twin.signals import Samples, bridged

FORMAT = "ejector-twin-watched/1"


def watched(config: Config, blocks: Iterable[Samples]) -> dict[str, Any]:
    """Run twin and hypotheses over a log; give what its cycles say on average."""
    listener, cutter = ScoreExtractor.of(config.data, config.monitor.healthy), CycleCutter()
    bank = ModelBank(listener.theta, listener.suspects)
    teller = compiled(config)
    told: list[CycleFigures] = []
    heard: list[CycleResidual] = []
    for rows, ticks in Twin.of(config.data).over(bridged(blocks)):
        for cycle in cutter.push(rows, ticks):
            drawn = bank.take(cycle)
            if (one := teller.take(cycle)) is not None:
                told.append(one)
            if cycle.complete and cycle.settled:
                said = listener.hear(cycle, *drawn, figures(cycle, listener.theta))
                heard += [] if said is None else [said]
    return {
        "format": FORMAT,
        "asset": {"type": config.asset.type, "id": config.asset.id, "batch": config.asset.batch},
        "data_set": config.data.hash,
        "cycles": len(heard),
        "begin_ns": told[0].host_ns if told else None,
        "figures": _figures(told),
        "effects": _effects(heard),
    }


def name_of(suspect: Suspect) -> str:
    """As answers have it: an effect with several parameters has one for each."""
    alone = sum(one.effect == suspect.effect for one in SUSPECTS) == 1
    return suspect.effect if alone else f"{suspect.effect}.{suspect.parameter.name}"


def _figures(told: Sequence[CycleFigures]) -> dict[str, dict[str, float]]:
    """Mean of every key figure over the cycles that tell it, of both sides where both are told."""
    means = {}
    for name in FIGURES:
        both = np.array([(one.measured[name], one.expected[name]) for one in told]).reshape(-1, 2)
        known = both[np.all(np.isfinite(both), axis=1)]
        if len(known):
            means[name] = dict(
                zip(("measured", "expected"), known.mean(axis=0).tolist(), strict=True)
            )
    return means


def _effects(heard: Sequence[CycleResidual]) -> dict[str, dict[str, Any]]:
    """Of every effect on its own: sigmas a cycle, how they scatter, the size that fits best."""
    if not heard:
        return {}
    scores = np.array([said.scores() for said in heard])
    sizes = np.array([said.sizes() for said in heard])
    found = {}
    for number, suspect in enumerate(SUSPECTS):
        shown = np.isfinite(scores[:, number])
        if not shown.any():
            continue
        mean = scores[shown, number]
        found[name_of(suspect)] = {
            "sigmas": float(mean.mean()),
            "scatter": float(mean.std(ddof=1)) if len(mean) > 1 else None,
            "cycles": len(mean),
            "size": float(sizes[shown, number].mean()) * suspect.step,
            "unit": suspect.parameter.unit,
        }
    return found
