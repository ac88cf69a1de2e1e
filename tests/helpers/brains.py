"""Synthetic animals: units that mix a few features of the stimuli, and noise on every trial."""

import numpy as np

from tactile_rt.alignment.neural import Animal, NeuralSession


def geometry(rng, features=8):
    """Features (6, feature) that animals may share."""
    return rng.normal(size=(6, features))


def responses(rng, patterns, units):
    """Noiseless responses (6, unit): every unit mixes the features, about a level of its own."""
    return rng.uniform(5, 20, units) + patterns @ rng.normal(size=(patterns.shape[1], units))


def session(rng, animal, name, patterns, trials=20, units=40, noise=1.0, idle=0):
    """A session in random trial order; `idle` units respond to nothing."""
    tuned = responses(rng, patterns, units)
    tuned = np.concatenate([tuned, np.full((6, idle), 12.0)], axis=1)
    stimulus = rng.permutation(np.repeat(np.arange(6), trials))
    rates = tuned[stimulus] + noise * rng.normal(size=(6 * trials, units + idle))
    return NeuralSession(animal, name, rates, stimulus)


def animals(rng, number=6, sessions=2, scrambled=False, shared=None, **kwargs):
    """Animals of one geometry; scrambled: each has its stimuli in an order of its own."""
    shared = geometry(rng) if shared is None else shared
    made = []
    for i in range(number):
        order = rng.permutation(6) if scrambled else np.arange(6)
        name = f"mouse-{i}"
        own = (f"{name}-{k}" for k in range(sessions))
        made.append(
            Animal(name, tuple(session(rng, name, k, shared[order], **kwargs) for k in own))
        )
    return made


def padded(rng, rows=(30, 24), units=(12, 9), noise=1.0, patterns=None, silent=0.0):
    """Rates (row, 6, unit) of sessions side by side, NaN below the shorter ones."""
    blocks = []
    for n, u in zip(rows, units, strict=True):
        tuned = np.zeros((6, u)) if patterns is None else patterns @ rng.normal(size=(8, u))
        block = np.full((max(rows), 6, u), np.nan)
        block[:n] = tuned + noise * rng.normal(size=(n, 6, u)) + 10
        block[:n][rng.random((n, 6, u)) < silent] = 0
        blocks.append(block)
    return np.concatenate(blocks, axis=2)


def loop(source, target, bootstraps, seed=1234):
    """Section 'Definitions' of the specification, one bootstrap after the other.

    Returns:
        r_xy, r_xx, r_yy, score: (bootstrap,), NaN where a bootstrap is dropped.
    """

    def upper(patterns):
        return (1 - np.corrcoef(patterns))[np.triu_indices(6, k=1)]

    def correlate(a, b):
        return np.corrcoef(upper(a), upper(b))[0, 1]

    def mean(rows):
        with np.errstate(invalid="ignore"):
            return np.nansum(rows, axis=0) / (~np.isnan(rows)).sum(axis=0)

    def halves(rates, seed):
        if rates.ndim == 2:  # a model is the same on every trial
            return rates, rates
        order = list(range(len(rates)))
        np.random.RandomState(seed).shuffle(order)
        half = len(rates) // 2
        return mean(rates[order[:half]]), mean(rates[order[half:]])

    results = np.full((4, bootstraps), np.nan)
    full_source = source if source.ndim == 2 else mean(source)
    full_target = mean(target)
    for b in range(bootstraps):
        x1, x2 = halves(source, seed + b)
        y1, y2 = halves(target, seed + b)
        if not all(np.isfinite(h).all() for h in (x1, x2, y1, y2)):
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            r_xy, r_xx, r_yy = (
                correlate(full_source, full_target), correlate(x1, x2), correlate(y1, y2)
            )  # fmt: skip
            p = (2 * r_xx / (1 + r_xx)) * (2 * r_yy / (1 + r_yy))
        score = np.nan if not p > 0 or np.isclose(p, 0) else r_xy / np.sqrt(p)
        results[:, b] = r_xy, r_xx, r_yy, score
    return results


def courses(rng, features, number, trials=24, units=60, noise=2.0, sessions=2):
    """Animals whose units read out features (6, bin, feature) linearly, bin by bin."""
    made = []
    for i in range(number):
        recorded = []
        for k in range(sessions):
            stimulus = rng.permutation(np.repeat(np.arange(6), trials))
            tuned = 10 + features @ rng.normal(size=(features.shape[-1], units))
            course = tuned[stimulus]
            course = course + noise * rng.normal(size=course.shape)
            recorded.append(
                NeuralSession(f"mouse-{i}", f"{i}-{k}", course.mean(axis=1), stimulus, course)
            )
        made.append(Animal(f"mouse-{i}", tuple(recorded)))
    return made
