"""What the environment for agents costs: `tactile_rt/ActiveWhisking-v0`, among objects."""

from time import process_time

import gymnasium
import numpy as np

from tactile_rt.models.evaluation.records import Record
from tactile_rt.sim_backend import environments

EPISODES, STEPS, STEP_S = 24, 40, 0.05
# amplitude, offset, velocity: whisk by 19 degrees and go past the object
WHISKING = (0.5, 0.0, 0.0, 0.5, 0.0)


def active(quick: bool) -> list[Record]:
    """Simulated seconds for a CPU second, resets and all, of the default array and of a mouse's."""
    records = []
    for name, whiskers in (("active", environments.WHISKERS), ("active.whole", ())):
        speeds = _speeds(whiskers, EPISODES // 4 if quick else EPISODES)
        records.append(
            Record(
                f"sim.{name}.real_time",
                float(np.median(speeds)),
                "x",
                ">= 5",
                f"simulated seconds for a CPU second, {len(whiskers) or 30} whiskers",
                f"median of {len(speeds)} episodes of {STEPS * STEP_S:g} s, whisking by 19 degrees "
                f"at 8 Hz past objects drawn at random, resets included; slowest "
                f"{min(speeds):.1f}, fastest {max(speeds):.1f}, all together "
                f"{len(speeds) / sum(1 / speed for speed in speeds):.1f}",
            )
        )
    return records


def _speeds(whiskers: tuple[str, ...], episodes: int) -> list[float]:
    """Of each episode; one before them finds what there is to import and to compile."""
    environments.register()
    env = gymnasium.make(
        environments.ENVIRONMENT,
        whiskers=whiskers,
        max_episode_steps=STEPS,
        disable_env_checker=True,
    )
    action = np.zeros(env.action_space.shape or (0,), dtype=np.float32)
    action[: len(WHISKING)] = WHISKING
    speeds = []
    for episode in range(episodes + 1):
        began = process_time()
        env.reset(seed=episode)
        over = False
        while not over:
            *_, done, cut, _ = env.step(action)
            over = done or cut
        speeds.append(STEPS * STEP_S / (process_time() - began))
    env.close()
    return speeds[1:]
