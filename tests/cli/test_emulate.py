"""`tactile-rt emulate`: another process meets the device; mistakes are one line."""

import os
import select
import signal
import time

import numpy as np
import pytest

from tactile_rt.drivers.codec import Command
from tactile_rt.drivers.codecs.native import NativeOptions, NativeSerial
from tests.helpers.processes import start_program
from tests.helpers.waiting import PATIENCE_S


def started(*arguments):
    """(process, the URL that it prints)."""
    process = start_program("emulate", *arguments, env={**os.environ, "PYTHONUNBUFFERED": "1"})
    line = process.stdout.readline()
    assert line.startswith("connect to "), process.communicate()
    return process, line.removeprefix("connect to ").strip()


def test_another_process_meets_the_device(tmp_path):
    faults = tmp_path / "faults.toml"
    faults.write_text('[[fault]]\nkind = "drop"\nat_s = 1.0\namount = 7\n')
    link = tmp_path / "whisker0"
    process, url = started(
        "native", "--source", "synthetic:3x6?pace=fast", "--link", link, "--fast",
        "--seconds", 2, "--faults", faults, "--set", "format=int16",
    )  # fmt: skip
    assert url == f"serial://{link}?codec=native&format=int16"
    fd = os.open(link, os.O_RDWR | os.O_NOCTTY)
    codec, counts = NativeSerial(NativeOptions()), []
    os.write(fd, b"".join(step.send for step in codec.commands(Command.START)))
    end = time.monotonic() + PATIENCE_S
    while len(counts) < 1993 and time.monotonic() < end:
        if select.select([fd], [], [], 1)[0]:
            samples = codec.feed(os.read(fd, 65_536), 0)
            counts += [] if samples is None else samples.count.tolist()
    os.close(fd)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0 and out == ""
    assert counts == [*range(1000), *range(1007, 2000)]
    assert err == "2000 samples: 1993 sent, 7 dropped\n"
    assert not link.is_symlink()
    assert codec.spec.name == "synthetic" and np.isfinite(codec.spec.rate_hz)


def test_ctrl_c_leaves(tmp_path):
    link = tmp_path / "adapter"
    process, url = started("native", "--wire", "slcan", "--link", link)
    assert url == f"can:slcan:{link}?codec=native"
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out, err) == (0, "", "0 samples\n")
    assert not link.is_symlink()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nativ"], "no serial codec 'nativ'; did you mean native?"),
        (["bota", "--wire", "can", "--bus", "virtual:x"], "codec bota speaks over serial:"),
        (["native", "--wire", "usb"], "--wire must be serial, slcan or can, not 'usb'"),
        (["native", "--wire", "can"], "--bus INTERFACE:CHANNEL goes with --wire can"),
        (["native", "--bus", "virtual:x", "--link", "y"], "--link names a port; a --bus has none"),
        (["native", "--set", "format"], "--set format: an option must be KEY=VALUE"),
        (["native", "--set", "form=int16"], "no option 'form'; did you mean format?"),
        (["native", "--link", "/none/x"], "/none/x: No such file or directory"),
    ],
)
def test_a_mistake_is_one_line(refused, arguments, message):
    assert message in refused("emulate", *arguments)
