"""Pytest fixtures for tests with emulated devices. In your conftest.py:

    from tactile_rt.testing.fixtures import fake_can, fake_serial

    def test_it_feels(fake_serial):
        device = fake_serial(signal, "bota")
        with open_source(device.url) as source:
            ...

No other module of tactile_rt imports this one, so that pytest is needed for tests only.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from tactile_rt.testing import FakeCan, FakeSerial

__all__ = ["fake_can", "fake_serial"]


@pytest.fixture
def fake_serial() -> Iterator[Callable[..., FakeSerial]]:
    """Provide a factory of plugged-in serial devices, unplugged when the test ends."""
    with ExitStack() as devices:
        yield lambda *words, **options: devices.enter_context(FakeSerial(*words, **options))


@pytest.fixture
def fake_can() -> Iterator[Callable[..., FakeCan]]:
    """Provide a factory of plugged-in CAN devices, unplugged when the test ends."""
    with ExitStack() as devices:
        yield lambda *words, **options: devices.enter_context(FakeCan(*words, **options))
