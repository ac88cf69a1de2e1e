"""Every source keeps the contract; a new one is a line in `CASES`."""

from importlib.util import find_spec

import numpy as np
import pytest
from contract import Case, SourceContract

from tactile_rt.sources import open_source
from tactile_rt.testing import ArraySource, cut, small_spec

SPEC = small_spec()
CHUNKS = cut(np.random.default_rng(0).normal(size=(500, *SPEC.shape)), SPEC.rate_hz)
SIM = "sim:mouse?objects=mug-1&sweeps=1&seed=1"

CASES = {
    "array": Case(lambda: ArraySource(SPEC, CHUNKS), 500),
    "array live": Case(lambda: ArraySource(SPEC, CHUNKS, live=True), 500),
    "sim fast": Case(lambda: open_source(f"{SIM}&pace=fast")),
    "sim realtime": Case(lambda: open_source(f"{SIM}&pace=realtime")),
}
NEEDS = {"sim": "mujoco"}


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    module = NEEDS.get(request.param.split()[0])
    if module and find_spec(module) is None:
        pytest.skip(f"{module} is not installed")
    return CASES[request.param]


class TestSources(SourceContract):
    pass
