"""What the environment for agents costs: `tactile_rt/ActiveWhisking-v0`, among objects."""

from time import process_time

import gymnasium
import numpy as np

from tactile_rt.evidence.records import Record
from tactile_rt.sim_backend import environments

__all__ = ["active"]

OBJECTS = ("mug-50", "chair-50", "gear-50", "bowl-50")
STEP_S = 0.05
# amplitude, offset, velocity: whisk by 19 degrees and go past the object
WHISKING = (0.5, 0.0, 0.0, 0.5, 0.0)


def active(quick: bool) -> list[Record]:
    """Simulated seconds for a CPU second, resets and all, of the default array and of a mouse's."""
    records = []
    for name, whiskers in (("active", environments.WHISKERS), ("active.whole", ())):
        speeds, touches = [], []
        for thing in OBJECTS[: 2 if quick else None]:
            speed, made = _speed(thing, whiskers, 20 if quick else 40)
            speeds.append(speed)
            touches.append(made)
        count = len(whiskers) or 30
        records.append(
            Record(
                f"sim.{name}.real_time",
                float(np.mean(speeds)),
                "x",
                ">= 5",
                f"simulated seconds for a CPU second, {count} whiskers",
                f"whisking by 19 degrees at 8 Hz past {', '.join(OBJECTS[: len(speeds)])}, "
                f"{', '.join(map(str, touches))} touches; resets included; "
                f"{', '.join(f'{s:.1f}' for s in speeds)}",
            )
        )
    return records


def _speed(thing: str, whiskers: tuple[str, ...], steps: int) -> tuple[float, int]:
    environments.register()
    env = gymnasium.make(
        environments.ENVIRONMENT,
        whiskers=whiskers,
        instances=(0, 61),
        max_episode_steps=steps,
        disable_env_checker=True,
    )
    action = np.zeros(env.action_space.shape or (0,), dtype=np.float32)
    action[: len(WHISKING)] = WHISKING
    env.reset(seed=0, options={"object": thing})
    env.step(action)  # compiled, once
    began = process_time()
    env.reset(seed=0, options={"object": thing})
    over = False
    while not over:
        *_, done, cut, told = env.step(action)
        over = done or cut
    env.close()
    return steps * STEP_S / (process_time() - began), told["touches"]
