"""The command line in a process of its own."""

import subprocess
import sys

PROGRAM = "import sys; sys.argv[0] = 'tactile-rt'; from tactile_rt.cli import main; main()"


def start_program(*arguments, program=PROGRAM, **options):
    """Run the command line with these arguments; its streams are text."""
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.Popen(command, text=True, **options)


def run_program(*arguments, program=PROGRAM, **options):
    """Run the command line with these arguments to its end; its streams are text."""
    options = {"input": "", "capture_output": True, "timeout": 120, **options}
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, text=True, **options)
