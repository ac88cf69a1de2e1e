"""Every source keeps the contract; a new one is a line in `CASES`."""

from contextlib import contextmanager
from importlib.util import find_spec

import numpy as np
import pytest
from contract import Case, SourceContract

from tactile_rt.sources import open_source
from tactile_rt.testing import ArraySource, FakeCan, FakeSerial, cut, small_spec

SPEC = small_spec()
CHUNKS = cut(np.random.default_rng(0).normal(size=(500, *SPEC.shape)), SPEC.rate_hz)
SIM = "sim:mouse?objects=mug-1&sweeps=1&seed=1"

TOUCHES = np.random.default_rng(1).normal(size=(500, 4, 6)) * 1e-3


@contextmanager
def device(make, **options):
    """What a driver delivers of an emulated device; a moment late, as its clock is learnt."""
    with make(TOUCHES, pace="realtime", **options) as fake, open_source(fake.url) as source:
        yield source


def driver(make, **options):
    return Case(lambda: device(make, **options), 500, rate_tolerance=0.02, endless=True)


CASES = {
    "serial, a pty": driver(FakeSerial),
    "serial, int16": driver(FakeSerial, options={"format": "int16"}),
    "can, slcan over a pty": driver(FakeCan),
    "can, virtual bus": driver(FakeCan, bus="virtual:contract"),
    "array": Case(lambda: ArraySource(SPEC, CHUNKS), 500),
    "array live": Case(lambda: ArraySource(SPEC, CHUNKS, live=True), 500),
    "synthetic fast": Case(lambda: open_source("synthetic:4x6?seconds=0.5&pace=fast"), 500),
    "synthetic realtime": Case(lambda: open_source("synthetic:4x6?seconds=0.5"), 500),
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
