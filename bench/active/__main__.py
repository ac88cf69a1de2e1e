"""Learn a policy, hold it and a script against passive sweeps, and write the table.

python -m bench.active [FOLDER] [--page FILE]

FOLDER (data/active) keeps what was felt, the policy that was learnt, and the figures; a run that
was stopped goes on from there. It takes some ten minutes on two cores that have nothing else to do.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.active.episodes import BUDGETS, Episodes, feel, joined
from bench.active.learning import learn
from bench.active.policies import Passive, Policy, Scripted
from bench.active.recogniser import log_likelihoods, trained
from tactile_rt.sim_backend.environments.active_whisking import KINDS

FOLDER, PAGE = Path("data/active"), Path("docs/explain/active-touch.md")
TAUGHT, UNSEEN = (0, 44), (48, 61)  # instances, the first and the one after the last
TRAINING, SWEEPS, NETWORKS, RESAMPLED = 500, 2, 3, 2000
MARKS = "<!-- table: written by python -m bench.active -->", "<!-- end table -->"
NAMES = {
    "passive": "passive sweeps",
    "scripted": "whisking by a script",
    "learnt": "whisking as learnt",
}

Floats = NDArray[np.float64]


def main() -> int:
    """Measure, show, and write the table into the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    parser.add_argument("--page", type=Path, default=PAGE)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    policies: dict[str, Policy] = {"passive": Passive(), "scripted": Scripted()}
    known = {
        name: _felt(policy, 10_000 * i, given.folder / name)
        for i, (name, policy) in enumerate(policies.items())
    }
    _say("passive sweeps and script are felt")
    learnt, course = learn(joined(list(known.values())), TAUGHT, len(KINDS), 0, _say, given.folder)
    kept = {"weights": learnt.weights.tolist(), "course": course}
    (given.folder / "learnt.json").write_text(json.dumps(kept))
    policies["learnt"] = learnt
    known["learnt"] = _felt(learnt, 20_000, given.folder / "learnt")
    right = {}
    for name, policy in policies.items():
        right[name] = _measured(policy, known[name], given.folder / f"{name}-unseen")
        _say(f"{name}: {np.round(right[name][0].mean(axis=1), 3)}")
    table = _table(right)
    (given.folder / "table.md").write_text(table)
    _say(table)
    if given.page.exists():
        before, _, rest = given.page.read_text().partition(MARKS[0])
        _, _, after = rest.partition(MARKS[1])
        given.page.write_text(f"{before}{MARKS[0]}\n{table}{MARKS[1]}{after}")
    return 0


def _say(what: str) -> None:
    print(what, flush=True)  # noqa: T201


def _felt(policy: Policy, seed: int, kept: Path) -> Episodes:
    """What a policy feels of objects of which recognisers may learn."""
    return feel([(policy, TAUGHT, seed + i, "") for i in range(TRAINING)], kept)


def _measured(policy: Policy, known: Episodes, kept: Path) -> tuple[Floats, Floats, Floats]:
    """(budget, object) share of unseen objects named rightly; (budget,) touches, and seconds."""
    names = [f"{kind}-{i}" for kind in KINDS for i in range(*UNSEEN)]
    new = feel([(policy, UNSEEN, 5_000_000 + s, n) for n in names for s in range(SWEEPS)], kept)
    said = sum(np.exp(log_likelihoods(trained(known, len(KINDS), s), new)) for s in range(NETWORKS))
    right = (np.argmax(said, axis=2) == new.labels).reshape(len(BUDGETS), -1, SWEEPS).mean(axis=2)
    return right, *_taken(new)


def _taken(felt: Episodes) -> tuple[Floats, Floats]:
    """(budget,) mean touches made, and mean seconds since the start."""
    at = np.arange(len(felt))
    steps = np.array([felt.steps_at(budget) for budget in BUDGETS])
    touches = np.array([felt.touches[at, row].mean() for row in steps])
    return touches, (steps.mean(axis=1) + 1) * 0.05


def _table(right: dict[str, tuple[Floats, Floats, Floats]]) -> str:
    rng = np.random.default_rng(0)
    objects = next(iter(right.values()))[0].shape[1]
    drawn = rng.integers(objects, size=(RESAMPLED, objects))
    lines = [
        "| at most so many touches | " + " | ".join(f"{b}" for b in BUDGETS) + " |",
        "|---|" + "---|" * len(BUDGETS),
    ]

    def said(of: Floats) -> str:
        low, high = np.percentile(of[drawn].mean(axis=1), [2.5, 97.5])
        return f"{100 * of.mean():.0f} % ({100 * low:.0f} to {100 * high:.0f})"

    for name, (share, touches, seconds) in right.items():
        lines.append(f"| {NAMES[name]} | " + " | ".join(said(s) for s in share) + " |")
        lines.append(
            "| touches made, after | "
            + " | ".join(f"{t:.1f}, {s:.1f} s" for t, s in zip(touches, seconds, strict=True))
            + " |"
        )
    for name in ("scripted", "learnt"):
        more = right[name][0] - right["passive"][0]
        lines.append(f"| {NAMES[name]}, more than passive | " + " | ".join(map(said, more)) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
