"""Daemons in the process of a test."""

from contextlib import contextmanager

from tactile_rt.daemon.checks import check_config
from tactile_rt.daemon.daemon import Daemon
from tactile_rt.daemon.loading import load_config


def load_checked(folder, text):
    """Write robot.toml into a folder, load it and check it."""
    file = folder / "robot.toml"
    file.write_text(text)
    loaded = load_config(file)
    check_config(loaded)
    return loaded


@contextmanager
def running_daemon(loaded):
    """Start a daemon, and see that it ends in time."""
    daemon = Daemon(loaded)
    daemon.start()
    try:
        yield daemon
    finally:
        assert daemon.stop() == []
