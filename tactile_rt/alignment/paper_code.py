"""Protocol `paper-code`: the analysis of the published code, including its mistakes.

It serves to check published numbers. It differs from the paper's text as follows:

- rates count from the start of a trial, not from first contact (`nwb.read_nwb`);
- the recording's starting time is subtracted from spike times, though NWB has them on the session's
  clock already: the published shift (clock ``recording`` of `nwb.read_nwb`);
- the stimulus axis is the order of first appearance in each session (`neural.published_layout`);
- a stimulus that a trial did not show counts as a rate of zero (`neural.published_layout`);
- no neuron is filtered; bootstraps are, by raw r_yy and r_xx >= 0.5 (`reliability.filtered_mean`);
- the numerator is the RSA of full trial means, not of half 1 against half 2;
- two negative reliabilities pass for a positive product (`reliability.noise_corrected`);
- a model's score is its highest over all layers and all targets, including the pooled animals, not
  a mean over mice (`scoring.score`);
- raw sensor input is scored by the median without the filter (`Target.unfiltered`), models by the
  mean with it;
- standard errors use the standard deviation with division by the number of values, not by one less.

Where the published code fails an assertion (a stimulus without a trial), this code names the cause.
"""

from collections.abc import Callable, Mapping

import numpy as np

from tactile_rt.alignment import reliability
from tactile_rt.alignment.benchmark import Benchmark, Consistency, Frozen, Target
from tactile_rt.alignment.neural import pad, rates_sha256
from tactile_rt.alignment.rdm import Floats, pearson, rdm
from tactile_rt.core.errors import ConfigError, name_some
from tactile_rt.core.stream.stimuli import STIMULI

POOLED = "concatenated"  # the published name of the pooled animals


def freeze_paper_code(
    rates: Mapping[str, Floats],
    bootstraps: int = reliability.BOOTSTRAPS,
    seed: int = reliability.SEED,
    progress: Callable[[float], None] = lambda share: None,
) -> Benchmark:
    """Compute the benchmark of protocol paper-code from rates.

    Args:
        rates: (row, 6, unit) per animal, in the published layout.

    Raises:
        ConfigError: no animal has an RDM. Single animals without RDM are left out, with a note.
    """
    steps = 2 * len(rates) + 1
    targets: list[Target] = []
    notes: list[str] = []
    halves: dict[str, Floats] = {}
    done = 0
    for name in rates:
        try:
            targets.append(_freeze_target(name, rates[name], bootstraps, seed, halves))
        except ConfigError as error:
            notes.append(f"{error}: left out")
        progress((done := done + 1) / steps)
    if not targets:
        raise ConfigError(name_some(notes, 1) or "there is no animal")
    names = tuple(target.name for target in targets)
    rates = {name: rates[name] for name in names}
    pooled = None
    if len(names) > 1:
        pooled = _freeze_target(POOLED, pad(list(rates.values())), bootstraps, seed, halves)
    progress((done := done + 1) / steps)

    held_out = np.full(len(names), np.nan)
    for i, name in enumerate(names):
        others = [rates[other] for other in names if other != name]
        if others:
            source = pad(others)
            r_xx = _correlate_halves(source, bootstraps, seed)
            r_xy = pearson(rdm(reliability.trial_mean(source)), targets[i].chosen.rdm)
            held_out[i] = _compute_score(r_xy, r_xx, halves[name])
        progress((done := done + 1) / steps)
    pairwise = np.full((len(names), len(names)), np.nan)
    for i, j in zip(*np.nonzero(~np.eye(len(names), dtype=bool)), strict=True):
        r_xy = pearson(targets[i].chosen.rdm, targets[j].chosen.rdm)
        pairwise[i, j] = _compute_score(r_xy, halves[names[i]], halves[names[j]])
    return Benchmark(
        protocol="paper-code",
        targets=tuple(targets),
        pooled=pooled,
        a2a=Consistency(names, held_out, pairwise, ddof=0),
        bootstraps=bootstraps,
        seed=seed,
        notes=tuple(notes),
    )


def _freeze_target(
    name: str, rates: Floats, bootstraps: int, seed: int, halves: dict[str, Floats]
) -> Target:
    """Compute one target's RDM and factor; store its split-half correlations in `halves`."""
    mean = reliability.trial_mean(rates)
    dissimilarities = rdm(mean)
    if not np.isfinite(dissimilarities).all():
        where = [s for s, row in zip(STIMULI, mean, strict=True) if not np.ptp(row) > 0]
        raise ConfigError(
            f"animal {name}: no RDM, since the mean response to stimulus "
            f"{', '.join(str(STIMULI.index(s)) for s in where)} is missing or the same in all units"
        )
    r_yy = halves[name] = _correlate_halves(rates, bootstraps, seed)
    factor = reliability.noise_corrected(1.0, 1.0, r_yy)
    finite = r_yy[np.isfinite(r_yy)]
    corrected = float(reliability.spearman_brown(finite.mean())) if finite.size else np.nan
    usable = factor[np.isfinite(factor)]
    filtered = reliability.filtered_mean(factor, r_yy)
    units = rates.shape[2]
    return Target(
        name=name,
        chosen=Frozen(dissimilarities, corrected, filtered, units),
        unfiltered=Frozen(
            dissimilarities,
            corrected,
            float(np.median(usable)) if usable.size else np.nan,
            units,
        ),
        reliable=bool(np.isfinite(filtered)),
        trials=len(rates),
        sha256=rates_sha256({"rates": rates}),
    )


def _correlate_halves(rates: Floats, bootstraps: int, seed: int) -> Floats:
    return reliability.split_half(rates, reliability.first_halves(len(rates), bootstraps, seed))


def _compute_score(r_xy: Floats, r_xx: Floats, r_yy: Floats) -> float:
    return reliability.filtered_mean(reliability.noise_corrected(r_xy, r_xx, r_yy), r_yy, r_xx)
