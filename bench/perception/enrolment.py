"""Which of ten objects is it, or none of them? Objects enrolled in a model file by three touches.

Objects are drawn from those for testing: ten are enrolled by three sweeps each, and judged by one
or two others; ten more are strangers, judged likewise. All sweeps have any yaw and height.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.enrolment import IdentityRule, margins, project
from tactile_rt.classifier.model_file import file_outputs, load_model
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.evaluation.measures import Floats, Interval, auroc, cut_windows, run_over

ENROLLED, TOUCHES, DRAWS = 10, 3, 200


def measure_enrolment(path: Path, test: SweepSet) -> dict[str, Interval]:
    """Enrol objects and judge touches, draw by draw; nothing of a model that cannot.

    Returns:
        The share of objects of which the likeliest is the right one, that are named rightly, and
        that are refused; strangers that are refused; and AUROC of the enrolled against strangers;
        each by one touch and by two. Intervals hold 95 of 100 draws.
    """
    session, card = load_model(path)
    rule = card.identity
    if rule is None:
        return {}

    def embed(samples: Floats, offset: Floats, sigma: Floats) -> Floats:
        return file_outputs(session, card, samples, offset, sigma)["embedding"][:, -1]

    embeddings, felt = run_over(cut_windows(test), embed)
    embeddings, objects = embeddings[felt], test.sweeps.objects[felt]
    return {
        f"{figure}, {judged} judged": value
        for judged in (1, 2)
        for figure, value in _enrol(rule, embeddings, objects, judged).items()
    }


def _enrol(
    rule: IdentityRule, embeddings: Floats, objects: NDArray[np.str_], judged: int
) -> dict[str, Interval]:
    """Enrol and judge by so many touches, draw by draw."""
    names, count = np.unique(objects, return_counts=True)
    names = names[count >= TOUCHES + judged]
    if len(names) < 2 * ENROLLED:
        return {}
    rng, draws = np.random.default_rng(0), []
    for _ in range(DRAWS):
        drawn = [
            embeddings[rng.permutation(np.flatnonzero(objects == name))[: TOUCHES + judged]]
            for name in rng.choice(names, 2 * ENROLLED, replace=False)
        ]
        each = np.stack(drawn)  # (object, touch, unit)
        enrolled = project(rule, each[:ENROLLED, :TOUCHES].mean(axis=1))
        touches = project(rule, each[:, TOUCHES:].mean(axis=1))
        above = margins(rule, enrolled, np.full(ENROLLED, TOUCHES), touches, judged)
        best, of = above.max(axis=1), above.argmax(axis=1)
        right = of[:ENROLLED] == np.arange(ENROLLED)
        known, strange = best[:ENROLLED], best[ENROLLED:]
        draws.append((right.mean(), (right & (known >= 0)).mean(), (strange < 0).mean(),
                      (known < 0).mean(), auroc(known, strange)))  # fmt: skip
    figures = ("likeliest", "named", "strangers refused", "enrolled refused", "AUROC")
    values = dict(zip(figures, np.transpose(draws), strict=True))
    return {
        name: Interval(float(one.mean()), *np.quantile(one, (0.025, 0.975)).tolist())
        for name, one in values.items()
    }
