"""Metrics of the similarity of a layer and an animal, each with its noise ceiling.

A metric is a function. It takes an animal and returns a `Measure`: the value that a perfect model
is expected to reach (the ceiling), and a function that measures a layer. So everything that depends
on the animal alone is computed only once. Metrics of other packages are found by the entry points
``tactile_rt.alignment_metrics``.

noise_ceiling  means over random halves of the trials, from which ceilings are estimated
rsa_cka        rsa, rsa-time and cka: the similarity of two geometries
crossnobis     distances without the bias that noise adds
linear         the share of every unit's variance that a linear readout of a layer predicts
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

from tactile_rt.alignment.neural import Animal
from tactile_rt.alignment.rdm import Floats
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.packages import added_names, import_addition
from tactile_rt.core.settings import no_such

__all__ = ["METRICS", "MINIMUM_CEILING", "Measure", "Metric", "find_metric", "metric_names"]

ENTRY_POINTS = "tactile_rt.alignment_metrics"  # of other packages
# Lowest ceiling of a correlation: below it, the noise correction would more than double a value.
MINIMUM_CEILING = 0.5


@dataclass(frozen=True, eq=False)
class Measure:
    """A metric prepared for one animal.

    Attributes:
        ceiling: The value that a perfect model is expected to reach on these trials; NaN if it
            cannot be estimated, for example from too few trials.
        fit: The function that measures a layer, given as responses (stimulus, step, unit), NaN in
            the steps that input cannot reach. It returns NaN if all stimuli give one response.
        minimum: The lowest usable ceiling; for a share of variance, the square of the limit for
            a correlation.
    """

    ceiling: float
    fit: Callable[[Floats], float]
    minimum: float = MINIMUM_CEILING

    @property
    def usable(self) -> bool:
        """True if the noise is low enough to be corrected for."""
        return bool(self.ceiling >= self.minimum)


Metric = Callable[[Animal], Measure]

# name: (path of the function, description in one line)
METRICS = {
    "rsa": (
        f"{__name__}.rsa_cka:rsa",
        "correlation of the dissimilarities (1 - r) of the stimuli, mean over time",
    ),
    "rsa-time": (
        f"{__name__}.rsa_cka:rsa_time",
        "the same in each bin of 45 ms by itself, mean over bins",
    ),
    "crossnobis": (
        f"{__name__}.crossnobis:crossnobis",
        "correlation of distances in units of the noise, cross-validated",
    ),
    "cka": (
        f"{__name__}.rsa_cka:cka",
        "centred kernel alignment, linear, without the bias of few stimuli",
    ),
    "linear": (
        f"{__name__}.linear:linear",
        "share of the units' variance that a ridge regression predicts on a held-out stimulus",
    ),
}


def metric_names() -> tuple[str, ...]:
    """Return the names of all installed metrics, those of this package first."""
    return (*METRICS, *(name for name in added_names(ENTRY_POINTS) if name not in METRICS))


def find_metric(name: str) -> Metric:
    """Return the function of an installed metric by the metric's name."""
    if name in METRICS:
        module, _, function = METRICS[name][0].partition(":")
        ours: Metric = getattr(import_module(module), function)
        return ours
    theirs: Metric | None = import_addition(ENTRY_POINTS, name)
    if theirs is None:
        raise ConfigError(no_such("metric", name, metric_names()))
    return theirs
