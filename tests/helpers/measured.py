"""What a command costs: its processor time and its memory, children included."""

import json
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

# A process inherits the peak of who started it: a small one starts the command.
LAUNCHER = """
import json, resource, subprocess, sys
done = subprocess.run(sys.argv[1:], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
cpu_s, peak_mb = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
print(json.dumps([done.returncode, done.stdout, done.stderr, cpu_s, peak_mb]))
"""


@dataclass(frozen=True)
class Measured:
    """How a command ended, and what it took."""

    code: int
    out: str
    err: str
    cpu_s: float
    peak_mb: float
    arguments: tuple[str | Path, ...]

    def assert_refused(self, *names: str, cpu_s: float = 2.0, peak_mb: float = 300.0) -> None:
        """One line that has these names, soon, and in little memory."""
        assert self.code in (1, 2), self
        assert self.err.startswith("tactile-rt: ") and len(self.err) < 1000, self.err
        assert self.err.count("\n") == 1, self.err
        for name in names:
            assert name in self.err, self.err
        spent = self.cpu_s
        if spent >= cpu_s:  # machines differ, and what shares a core slows all on it
            spent = min(measured(*self.arguments).cpu_s for _ in range(3)) - _start_cpu_s()
        assert spent < cpu_s, self
        assert self.peak_mb < peak_mb, self


@cache
def _start_cpu_s() -> float:
    """The processor time of a command that is refused at once, on this machine, s."""
    return min(measured("hz", "nothing:").cpu_s for _ in range(3))


def measured(*arguments: str | Path, limit_s: float = 120.0) -> Measured:
    """Run `tactile-rt` with these arguments."""
    command = [sys.executable, "-c", "from tactile_rt.cli import main; main()"]
    launcher = subprocess.run(
        [sys.executable, "-S", "-c", LAUNCHER, *command, *map(str, arguments)],
        capture_output=True, text=True, timeout=limit_s, check=True,
    )  # fmt: skip
    return Measured(*json.loads(launcher.stdout), arguments)
