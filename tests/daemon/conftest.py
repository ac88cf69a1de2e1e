"""What tests of the daemon share."""

import pytest

from tactile_rt.daemon import messages


@pytest.fixture
def still_clock(monkeypatch):
    """A message tells how old its decision is: 3 ms after the epoch, whenever it is written."""
    monkeypatch.setattr(messages, "_now_ns", lambda: 3_000_000)
