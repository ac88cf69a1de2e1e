"""The command line, called in this process."""

import sys

import pytest

from tactile_rt.cli import main


@pytest.fixture
def call(capsys, monkeypatch):
    """Call `tactile-rt` with these arguments: (exit code, stdout, stderr)."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["tactile-rt", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        return left.value.code or 0, *capsys.readouterr()

    return run
