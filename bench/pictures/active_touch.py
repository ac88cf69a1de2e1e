"""Draw docs/pictures/active-touch.png: a head whisks past a gear, from above and from the side.

What the environment draws of itself at the step of an episode in which most whiskers touch.
Run: python -m bench.pictures.active_touch [--out FILE]
"""

import argparse
from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image

from bench.active.policies import Scripted
from tactile_rt.sim_backend.environments import ENVIRONMENT

OBJECT, SEED = "gear-48", 0


def draw(out: Path) -> None:
    """Whisk for an episode and write its fullest picture."""
    environment = gymnasium.make(ENVIRONMENT, render_mode="rgb_array")
    seen, _ = environment.reset(seed=SEED, options={"object": OBJECT})
    policy = Scripted()
    policy.begin(np.random.default_rng(SEED))
    most, best, ended = -1, None, False
    while not ended:
        nothing = np.zeros(environment.action_space.shape[0] - 5)  # nothing is decided
        seen, _, done, cut, told = environment.step(np.concatenate([policy.move(seen), nothing]))
        ended = done or cut
        if told["touching"].sum() > most:
            most, best = told["touching"].sum(), environment.render()
    assert best is not None
    Image.fromarray(best).save(out, optimize=True)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures/active-touch.png"))
    draw(parser.parse_args().out)


if __name__ == "__main__":
    main()
