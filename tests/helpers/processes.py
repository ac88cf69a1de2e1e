"""The command line in a process of its own."""

import subprocess
import sys

PROGRAM = "import sys; sys.argv[0] = 'tactile-rt'; from tactile_rt.cli import main; main()"


def start_program(*arguments, program=PROGRAM):
    """Run the command line with these arguments; its streams are text."""
    return subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
