"""Models that learn names, courses and sizes of effects from features of records.

Each model is chosen by cross-validation on training records alone; no rig is on both sides of it.
"""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from sklearn.base import BaseEstimator, clone
from sklearn.calibration import CalibratedClassifierCV
from sklearn.ensemble import (
    ExtraTreesClassifier,
    ExtraTreesRegressor,
    HistGradientBoostingClassifier,
)
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression, RidgeCV
from sklearn.model_selection import GroupKFold, cross_val_predict
from sklearn.neural_network import MLPClassifier, MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from tools.learned_features import Floats, Record

NONE, UNLISTED = "none", "unlisted"  # beside the effects
TOGETHER = 0.95  # share of the effects' probability that a cause and its look-alikes have
COVERS = 0.95
ENDS = ("low95", "high95")  # of an interval
LEAST = 1e-6  # probability, where cross-entropies are compared
FOLDS = 5  # of cross-validation, each with rigs of its own
Names = npt.NDArray[np.str_]


def squashed(features: Floats) -> Floats:
    """Features compressed like a logarithm if large; 0 if a record does not show one."""
    squashed_features: Floats = np.nan_to_num(np.arcsinh(features))
    return squashed_features


def _over(*steps: BaseEstimator) -> BaseEstimator:
    """A model of squashed features, by its steps."""
    return make_pipeline(FunctionTransformer(squashed), *steps)


_TREES = {"n_estimators": 200, "random_state": 0}
_LINEAR = _over(StandardScaler(), LogisticRegression(C=0.3, max_iter=500))
_NETWORK = _over(StandardScaler(), MLPClassifier((128,), alpha=1.0, random_state=0))
_FOREST = _over(ExtraTreesClassifier(max_features=0.1, **_TREES))
_BOOSTED = _over(
    HistGradientBoostingClassifier(
        max_iter=60, learning_rate=0.15, max_leaf_nodes=6, max_features=0.1, random_state=0
    )
)
CLASSIFIERS: Mapping[str, BaseEstimator] = {
    "logistic regression": _LINEAR,
    "a network of 128": _NETWORK,
    "boosted trees": _BOOSTED,
    "randomised trees": _FOREST,
    "randomised trees, tempered": CalibratedClassifierCV(_FOREST, method="temperature", cv=3),
}
REGRESSORS: Mapping[str, BaseEstimator] = {
    "ridge regression": _over(StandardScaler(), RidgeCV(np.geomspace(1.0, 1e4, 9))),
    "a network of 32": _over(
        StandardScaler(), MLPRegressor(hidden_layer_sizes=(32,), alpha=1.0, random_state=0)
    ),
    "randomised trees": _over(ExtraTreesRegressor(max_features=0.3, **_TREES)),
}


@dataclass(frozen=True)
class Sizes:
    """Sizes of one effect, with intervals from the errors of cross-validation."""

    model: BaseEstimator  # of the arcsinh of sizes in units of ``typical``
    typical: float
    half_width: float  # of an interval, in that arcsinh

    def of(self, features: Floats) -> dict[str, float]:
        """Size of the effect in a record and its 95 % interval."""
        (middle,) = self.model.predict(features[None])
        ends = {"value": 0.0, "low95": -self.half_width, "high95": self.half_width}
        return {name: self.typical * math.sinh(middle + off) for name, off in ends.items()}


@dataclass(frozen=True)
class Learned:
    """Names effect, course and size from the features of a record."""

    effects: BaseEstimator
    courses: BaseEstimator
    sizes: Mapping[str, Sizes]  # by effect
    chosen: Mapping[str, str]  # the kind of each model

    @classmethod
    def fit(cls, records: Sequence[Record]) -> Self:
        """Choose models for training records and fit them."""
        if strange := [record.seed for record in records if not record.trains]:
            raise ValueError(f"records to be judged are not learned from: seeds {strange}")
        singles = [record for record in records if record.kind == "single"]
        with _unconverged():
            effects, of_effect = _classifier(records, [label(record) for record in records])
            courses, of_course = _classifier(
                singles, [record.hidden[0].course for record in singles]
            )
            sizes, of_size = _sizes(singles)
        chosen = {"effect": of_effect, "course": of_course, "size": of_size}
        return cls(effects, courses, sizes, chosen)

    def answer(self, features: Floats) -> dict[str, Any]:
        """The answer to a record, with the fields of a diagnosis that it can fill."""
        verdict, effects = named(self.effects, features)
        if verdict != "explained":
            return {"verdict": verdict, "causes": []}
        (first, probability), *look_alikes = effects.items()
        (course,) = self.courses.predict(features[None])
        size = self.sizes[first].of(features)
        if course == "ramp":
            size |= {"at_end": size["value"]} | {f"at_end_{end}": size[end] for end in ENDS}
        cause = {
            "effect": first,
            "course": str(course),
            "parameters": {"size": size},
            "probability": probability,
            "not_separable_from": [name for name, _ in look_alikes],
        }
        return {"verdict": verdict, "causes": [cause]}


def label(record: Record) -> str:
    """The true class of a record: an effect, none or something unlisted."""
    if record.kind == "unlisted":
        return UNLISTED
    return record.hidden[0].effect if record.hidden else NONE


def named(classifier: BaseEstimator, features: Floats) -> tuple[str, dict[str, float]]:
    """Verdict on a record, and the effects that cannot be told apart, likeliest first.

    They have the share TOGETHER of the effects' probability.
    """
    predicted = zip(classifier.classes_, classifier.predict_proba(features[None])[0], strict=True)
    probability = {str(name): float(share) for name, share in predicted}
    none, unlisted = (probability.pop(name, 0.0) for name in (NONE, UNLISTED))
    listed = sum(probability.values())
    if max(none, unlisted) > listed:
        return ("consistent" if none > unlisted else "unlisted"), {}
    effects, so_far = dict[str, float](), 0.0
    for name in sorted(probability, key=probability.__getitem__, reverse=True):
        if so_far >= TOGETHER * listed:
            break
        effects[name] = probability[name]
        so_far += probability[name]
    return "explained", effects


def unlisted_unseen(learned: Learned, records: Sequence[Record]) -> list[bool]:
    """Whether unlisted mechanisms are recognised if no record of them was in the training."""
    called_unlisted = []
    mechanisms = {record.hidden[0].effect for record in records if record.kind == "unlisted"}
    for mechanism in sorted(mechanisms):
        has_mechanism = [
            bool(record.hidden) and record.hidden[0].effect == mechanism for record in records
        ]
        training = [record for record, has in zip(records, has_mechanism, strict=True) if not has]
        with _unconverged():
            model = clone(learned.effects).fit(
                _features(training), [label(record) for record in training]
            )
        has = [record for record, has in zip(records, has_mechanism, strict=True) if has]
        called_unlisted += [named(model, record.features)[0] == "unlisted" for record in has]
    return called_unlisted


@contextmanager
def _unconverged() -> Iterator[None]:
    """Ignore warnings of networks that did not converge: they are judged as they are."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        yield


def _features(records: Sequence[Record]) -> Floats:
    return np.array([record.features for record in records])


def _folds(records: Sequence[Record]) -> dict[str, Any]:
    """Cross-validation with each rig on one side."""
    rigs = np.array([record.rig for record in records])
    return {"groups": rigs, "cv": GroupKFold(min(FOLDS, len(np.unique(rigs))))}


def _classifier(records: Sequence[Record], names: Sequence[str]) -> tuple[BaseEstimator, str]:
    """The classifier with the least cross-entropy of held-out rigs, fitted to all; its kind."""
    features, losses = _features(records), dict[str, float]()
    true = np.searchsorted(np.unique(names), names)
    for kind, model in CLASSIFIERS.items():
        probabilities = cross_val_predict(
            model, features, names, method="predict_proba", **_folds(records)
        )
        of_true = probabilities[np.arange(len(names)), true]
        losses[kind] = -float(np.log(np.maximum(of_true, LEAST)).mean())
    best = min(losses, key=losses.__getitem__)
    return clone(CLASSIFIERS[best]).fit(features, names), best


def _sizes(singles: Sequence[Record]) -> tuple[dict[str, Sizes], str]:
    """Models of the sizes of each effect, of the kind that misses held-out rigs least."""
    by_effect = dict[str, list[Record]]()
    for single in singles:
        by_effect.setdefault(single.hidden[0].effect, []).append(single)
    typical = {
        name: float(np.median([abs(single.hidden[0].size) for single in of_effect]))
        for name, of_effect in by_effect.items()
    }
    misses = {
        kind: {
            name: _misses(model, of_effect, typical[name]) for name, of_effect in by_effect.items()
        }
        for kind, model in REGRESSORS.items()
    }
    best = min(misses, key=lambda kind: np.square(np.concatenate([*misses[kind].values()])).mean())
    return {
        name: Sizes(
            clone(REGRESSORS[best]).fit(_features(of_effect), _targets(of_effect, typical[name])),
            typical[name],
            half_width(misses[best][name]),
        )
        for name, of_effect in by_effect.items()
    }, best


def _targets(records: Sequence[Record], typical: float) -> Floats:
    return np.arcsinh(np.array([record.hidden[0].size for record in records]) / typical)


def _misses(model: BaseEstimator, records: Sequence[Record], typical: float) -> Floats:
    """Errors of the sizes of held-out rigs."""
    targets = _targets(records, typical)
    held_out = cross_val_predict(model, _features(records), targets, **_folds(records))
    missed: Floats = np.abs(held_out - targets)
    return missed


def half_width(misses: Floats) -> float:
    """Half width that covers the share COVERS of future errors (conformal prediction)."""
    rank = min(math.ceil((len(misses) + 1) * COVERS), len(misses))
    return float(np.sort(misses)[rank - 1])
