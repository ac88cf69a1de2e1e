"""Every source keeps the contract; a new one is a line in `CASES`."""

import functools
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from tactile_rt.recording import StreamWriter
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import write_object
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import ArraySource, FakeCan, FakeSerial, cut_chunks, small_spec
from tests.helpers.source_contract import Case, SourceContract
from tests.helpers.waiting import PATIENCE_S

SPEC = small_spec()
CHUNKS = cut_chunks(np.random.default_rng(0).normal(size=(500, *SPEC.shape)), SPEC.rate_hz)
SIM = "sim:mouse?objects=mug-1&sweeps=1&seed=1"

LEARNT = {"rate_tolerance": 0.02, "settling_s": 0.1}  # the clock of a device
TOUCHES = np.random.default_rng(1).normal(size=(500, 4, 6)) * 1e-3


@contextmanager
def device(make, **options):
    """What a driver delivers of an emulated device; a moment late, as its clock is learnt."""
    with make(TOUCHES, pace="realtime", **options) as fake:
        with open_source(f"{fake.url}&start_s={PATIENCE_S:g}") as source:
            yield source


@functools.cache
def recording():
    """A recording of a device, and its sweeps' set, in memory."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with device(FakeSerial) as source, StreamWriter(path, source) as recorder:
            while source.stats.delivered < 500:
                chunk = source.read(1.0)
                if chunk is not None:
                    recorder.push(chunk)
        return path.read_bytes()


@contextmanager
def replay(options):
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        path.write_bytes(recording())
        with open_source(f"replay:{path}?{options}") as source:
            yield source


@contextmanager
def sweeps():
    with TemporaryDirectory() as folder:
        manifest = SweepManifest(SPEC, 9_000_000, 5, ("mug",), {"train": ("mug-1",)})
        manifest.write(Path(folder))
        values = np.random.default_rng(2).normal(size=(3, 40, *SPEC.shape))
        write_object(Path(folder), "mug-1", values, {})
        with open_source(f"replay:{folder}/mug-1.npz?speed=20&rest_s=0.09") as source:
            yield source


def driver(make, **options):
    return Case(lambda: device(make, **options), 500, **LEARNT, endless=True)


CASES = {
    "serial, a pty": driver(FakeSerial),
    "serial, int16": driver(FakeSerial, options={"format": "int16"}),
    "can, slcan over a pty": driver(FakeCan),
    "can, virtual bus": driver(FakeCan, bus="virtual:contract"),
    "array": Case(lambda: ArraySource(SPEC, CHUNKS), 500),
    "array live": Case(lambda: ArraySource(SPEC, CHUNKS, live=True), 500),
    "synthetic fast": Case(lambda: open_source("synthetic:4x6?seconds=0.5&pace=fast"), 500),
    "synthetic realtime": Case(lambda: open_source("synthetic:4x6?seconds=0.5"), 500),
    "replay samples": Case(lambda: replay("speed=1"), 500, **LEARNT),
    "replay samples fast": Case(lambda: replay("speed=0"), 500, **LEARNT),
    "replay wire": Case(lambda: replay("from=wire&speed=2"), 500, **LEARNT),
    "replay wire fast": Case(lambda: replay("from=wire&speed=0"), 500, **LEARNT),
    "replay sweeps": Case(sweeps, 150),
    "sim fast": Case(lambda: open_source(f"{SIM}&pace=fast")),
    "sim whisking fast": Case(lambda: open_source("whisking:mouse?seconds=0.5&pace=fast"), 500),
    "sim whisking realtime": Case(
        lambda: open_source("whisking:mouse?seconds=0.5"), 500, stands_still=True
    ),
    "sim realtime": Case(lambda: open_source(f"{SIM}&pace=realtime"), stands_still=True),
}
NEEDS = {"sim": "mujoco", "replay": "mcap"}


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    module = NEEDS.get(request.param.split()[0])
    if module and find_spec(module) is None:
        pytest.skip(f"{module} is not installed")
    return CASES[request.param]


class TestSources(SourceContract):
    pass
