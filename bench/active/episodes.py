"""What policies feel of objects, on all cores."""

import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.active.policies import Policy

Task = tuple[
    Policy, tuple[int, int], int, str
]  # instances; seed; object's name, empty: a drawn one

STEPS = 60  # 3 s
BLOCK = 50  # episodes that are kept together
BUDGETS = (4, 8, 16)  # touches
FORCE_N, MOMENT_NM = 2e-5, 1e-7  # loads are given to networks in these, their size tamed by asinh


@dataclass(frozen=True)
class Episodes:
    """What was felt.

    Attributes:
        felt: The (episode, step, feature) features of every step, float32; zeros after the end.
        touches: The (episode, step) touches up to the end of every step.
        labels: The (episode,) kinds.
        objects: The (episode,) names of the objects.
    """

    felt: NDArray[np.float32]
    touches: NDArray[np.int64]
    labels: NDArray[np.int64]
    objects: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.labels)

    def some(self, which: NDArray[Any]) -> "Episodes":
        """Those of a (episode,) mask or of these numbers."""
        return Episodes(
            self.felt[which], self.touches[which], self.labels[which], self.objects[which]
        )

    @property
    def instances(self) -> NDArray[np.int64]:
        """The (episode,) numbers of the objects among those of their kind."""
        return np.array([int(name.rpartition("-")[2]) for name in self.objects])

    def steps_at(self, budget: int) -> NDArray[np.int64]:
        """(episode,) the last step with no more touches than this, of at most `STEPS`."""
        steps: NDArray[np.int64] = np.maximum((self.touches <= budget).sum(axis=1) - 1, 0)
        return steps


def joined(parts: Sequence[Episodes]) -> Episodes:
    """Several as one."""
    return Episodes(
        np.concatenate([p.felt for p in parts]),
        np.concatenate([p.touches for p in parts]),
        np.concatenate([p.labels for p in parts]),
        np.concatenate([p.objects for p in parts]),
    )


@cache
def _environment(instances: tuple[int, int]) -> Any:
    import gymnasium

    from tactile_rt.sim_backend import environments

    environments.register()
    return gymnasium.make(
        environments.ENVIRONMENT,
        instances=instances,
        touches=max(BUDGETS) + 1,
        max_episode_steps=STEPS,
        disable_env_checker=True,
    )


def _features(seen: dict[str, NDArray[np.float32]]) -> NDArray[np.float64]:
    loads = np.arcsinh(seen["loads"] / np.repeat([FORCE_N, MOMENT_NM], 3))
    angle, head = seen["angle"], seen["head"]
    return np.concatenate(
        [
            loads.mean(axis=0).ravel(),
            np.ptp(loads, axis=0).ravel(),
            [angle.mean(), 5 * (angle[-1] - angle[0])],
            head[:3] * 50,
            head[3:] * 10,
        ]
    )


def _one(policy: Policy, instances: tuple[int, int], seed: int, name: str = "") -> Episodes:
    env = _environment(instances)
    seen, told = env.reset(seed=seed, options={"object": name} if name else None)
    policy.begin(np.random.default_rng(seed))
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    felt, touches, over = [], [], False
    while not over:
        action[:5] = policy.move(seen)
        seen, _, done, cut, told = env.step(action)
        felt.append(_features(seen))
        touches.append(told["touches"])
        over = done or cut
    whole = np.zeros((STEPS, len(felt[0])), dtype=np.float32)
    whole[: len(felt)] = felt
    counts = np.full(STEPS, max(BUDGETS) + 1 if done else touches[-1])
    counts[: len(touches)] = touches
    return Episodes(
        whole[None], counts[None], np.array([told["label"]]), np.array([told["object"]])
    )


def _work(task: Task) -> Episodes:
    return _one(*task)


@cache
def _pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn"))


def feel(tasks: Sequence[Task], kept: Path) -> Episodes:
    """One episode of each task, in order.

    Args:
        tasks: what is to be felt.
        kept: what was felt is kept in files that begin so, and not simulated again.
    """
    parts = []
    for at in range(0, len(tasks), BLOCK):
        path = kept.with_name(f"{kept.name}-{at}.npz")
        if path.exists():
            with np.load(path) as there:
                parts.append(Episodes(**there))
            continue
        block = joined(list(_pool().map(_work, tasks[at : at + BLOCK], chunksize=5)))
        whole = path.with_suffix(".part.npz")
        np.savez_compressed(whole, **asdict(block))
        whole.replace(path)
        parts.append(block)
    return joined(parts)
