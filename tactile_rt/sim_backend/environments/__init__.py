"""Active touch as Gymnasium environments (extra ``gym``): agents move a whisker array.

    import gymnasium

    env = gymnasium.make("tactile_rt.sim_backend.environments:tactile_rt/ActiveWhisking-v0")

Gymnasium imports the module before the colon, which registers the environment.
"""

from contextlib import suppress
from typing import Final

__all__ = ["ENVIRONMENT", "WHISKERS", "register"]

ENVIRONMENT: Final = "tactile_rt/ActiveWhisking-v0"
STEPS: Final = 40  # of 50 ms
# The middle of a mouse's pad: three rows of three.
WHISKERS: Final = tuple(f"{row}{column}" for row in "BCD" for column in (1, 2, 3))


def register() -> None:
    """Register `ENVIRONMENT` with Gymnasium, unless it is registered already."""
    from gymnasium.envs import registration

    if ENVIRONMENT in registration.registry:
        return
    with registration.namespace("tactile_rt"):
        registration.register(
            id="ActiveWhisking-v0",
            entry_point="tactile_rt.sim_backend.environments.active_whisking:ActiveWhisking",
            max_episode_steps=STEPS,
            kwargs={"whiskers": WHISKERS},
        )


with suppress(ModuleNotFoundError):  # without the extra there is no Gymnasium
    register()
