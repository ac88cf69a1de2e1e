"""A fixed model to compare speeds with: the same numbers to step, whatever becomes of the package.

The 30 mouse whiskers at 0.5 links per mm (8 at least) and 0.2 ms, a 40 mm icosphere of 162 corners
swept past at 34 mm/s; frozen as MuJoCo XML in November 2026. A cost divided by its cost says what
the code is worth, not the machine.
"""

import gzip
import time
from importlib import resources

import mujoco
import numpy as np
from mujoco import rollout

PROTOTYPE_CPU_S = 1.97  # per simulated second, when these settings were chosen, on that machine
START_MM, STEP_MM, STEPS_PER_MS = (23.30738888, -2.72380819, -2.0), (0.0, -0.0068, 0.0), 5
SWEEP_MS = 1564


def reference_cost(ms: int = SWEEP_MS) -> float:
    """CPU s per simulated s of the fixed model over the first ms of its sweep, one thread."""
    packed = resources.files(__package__).joinpath("data/reference_model.xml.gz").read_bytes()
    model = mujoco.MjModel.from_xml_string(gzip.decompress(packed).decode())
    data = mujoco.MjData(model)
    data.mocap_pos[0] = START_MM
    mujoco.mj_forward(model, data)
    frame = data.geom_xmat[-1].reshape(3, 3)  # the last geom is the object
    model.geom_surfacevel[-1, :3] = frame.T @ STEP_MM / model.opt.timestep
    model.flg_surfacevel = True
    spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.empty(mujoco.mj_stateSize(model, spec))
    mujoco.mj_getState(model, data, state, spec)
    path = START_MM + np.arange(1, ms * STEPS_PER_MS + 1)[:, None] * np.array(STEP_MM)
    control = int(mujoco.mjtState.mjSTATE_MOCAP_POS)
    began = time.process_time()
    rollout.rollout(model, data, state[None], path[None], control_spec=control)
    return (time.process_time() - began) / (ms * 1e-3)
