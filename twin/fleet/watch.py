"""Summarises one log of an ejector: mean key figures, and the likely size of every effect."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from twin.config import Config
from twin.figures.cycle import CycleFigures, compiled
from twin.figures.key_figures import FIGURES
from twin.live import Twin
from twin.monitor.cycles import CycleCutter, figures
from twin.monitor.model_bank import SUSPECTS, ModelBank, Suspect
from twin.monitor.statistics import CycleResidual, ScoreExtractor
from twin.signals import Samples, bridged

FORMAT = "ejector-twin-watched/1"


def watched(config: Config, blocks: Iterable[Samples]) -> dict[str, Any]:
    """Run twin and hypotheses over a log; returns the averages over its cycles."""
    extractor, cutter = ScoreExtractor.of(config.data, config.monitor.healthy), CycleCutter()
    bank = ModelBank(extractor.theta, extractor.suspects)
    key_figures = compiled(config)
    figures_of_cycles: list[CycleFigures] = []
    residuals: list[CycleResidual] = []
    for rows, ticks in Twin.of(config.data).over(bridged(blocks)):
        for cycle in cutter.push(rows, ticks):
            predictions = bank.take(cycle)
            if (cycle_figures := key_figures.take(cycle)) is not None:
                figures_of_cycles.append(cycle_figures)
            if cycle.complete and cycle.settled:
                residual = extractor.extract(cycle, *predictions, figures(cycle, extractor.theta))
                residuals += [] if residual is None else [residual]
    return {
        "format": FORMAT,
        "asset": {"type": config.asset.type, "id": config.asset.id, "batch": config.asset.batch},
        "data_set": config.data.hash,
        "cycles": len(residuals),
        "begin_ns": figures_of_cycles[0].host_ns if figures_of_cycles else None,
        "figures": _figures(figures_of_cycles),
        "effects": _effects(residuals),
    }


def name_of(suspect: Suspect) -> str:
    """The name in answers; an effect with several parameters has a name for each."""
    is_only_parameter = sum(candidate.effect == suspect.effect for candidate in SUSPECTS) == 1
    return suspect.effect if is_only_parameter else f"{suspect.effect}.{suspect.parameter.name}"


def _figures(cycles: Sequence[CycleFigures]) -> dict[str, dict[str, float]]:
    """Mean of every key figure over cycles where it is both measured and expected."""
    means = {}
    for name in FIGURES:
        pairs = np.array(
            [(cycle.measured[name], cycle.expected[name]) for cycle in cycles]
        ).reshape(-1, 2)
        finite = pairs[np.all(np.isfinite(pairs), axis=1)]
        if len(finite):
            means[name] = dict(
                zip(("measured", "expected"), finite.mean(axis=0).tolist(), strict=True)
            )
    return means


def _effects(residuals: Sequence[CycleResidual]) -> dict[str, dict[str, Any]]:
    """For every effect alone: sigmas a cycle, their scatter, and the best-fitting size."""
    if not residuals:
        return {}
    scores = np.array([residual.scores() for residual in residuals])
    sizes = np.array([residual.sizes() for residual in residuals])
    effects = {}
    for number, suspect in enumerate(SUSPECTS):
        is_finite = np.isfinite(scores[:, number])
        if not is_finite.any():
            continue
        values = scores[is_finite, number]
        effects[name_of(suspect)] = {
            "sigmas": float(values.mean()),
            "scatter": float(values.std(ddof=1)) if len(values) > 1 else None,
            "cycles": len(values),
            "size": float(sizes[is_finite, number].mean()) * suspect.step,
            "unit": suspect.parameter.unit,
        }
    return effects
