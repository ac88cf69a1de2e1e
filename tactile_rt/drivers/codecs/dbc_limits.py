"""Check of a DBC file against the limits of CAN, before cantools reads it.

The file may be untrusted. cantools lays out every bit of every message and every value of a
multiplexer's range in memory: a message of 100,000 bytes takes it minutes. So sizes are checked in
the text, without parsing it: a size in a comment counts, too.
"""

import re
from typing import Final

from tactile_rt.core.errors import ConfigError

MOST_BYTES: Final = 1 << 20  # of the file: 20,000 signals, read in a second
MOST_FRAME: Final = 64  # bytes of a CAN FD frame
MOST_MESSAGES: Final = 10_000
MOST_SIGNALS: Final = 20_000
MOST_MULTIPLEXED: Final = 1 << 16  # values of all multiplexers' ranges together
DEEPEST: Final = 16  # multiplexers within each other

_MESSAGE = re.compile(r"\bBO_\s+\d+\s+(\w+)\s*:\s*(\d+)")
_SIGNAL = re.compile(r"\bSG_\s+(\w+)(?:\s+\w+)?\s*:\s*(\d+)\s*\|\s*(\d+)")
_RANGES = re.compile(r"\bSG_MUL_VAL_\b([^;]*)")
_RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")


def check_dbc(file: str, text: str) -> None:
    """Raise a ConfigError if sizes in a DBC file exceed those of CAN or sensors."""
    messages = signals = 0
    for found in _MESSAGE.finditer(text):
        messages += 1
        if _parse_number(found[2]) > MOST_FRAME:
            raise ConfigError(
                f"{file}: message {found[1][:50]} of {found[2][:20]} bytes; "
                f"a CAN frame has {MOST_FRAME} at most"
            )
    for found in _SIGNAL.finditer(text):
        signals += 1
        start, length = _parse_number(found[2]), _parse_number(found[3])
        if not (start < 8 * MOST_FRAME and 0 < length <= 8 * MOST_FRAME):
            raise ConfigError(
                f"{file}: signal {found[1][:50]} of {found[3][:20]} bits at bit {found[2][:20]}; "
                f"a CAN frame has {8 * MOST_FRAME} bits at most"
            )
    for number, most, of in (
        (messages, MOST_MESSAGES, "messages"),
        (signals, MOST_SIGNALS, "signals"),
    ):
        if number > most:
            raise ConfigError(
                f"{file}: {number} {of}, more than {most}; keep the messages of the sensor"
            )
    values = 0
    for ranges in _RANGES.finditer(text):
        for low, high in _RANGE.findall(ranges[1]):
            values += max(0, _parse_number(high) - _parse_number(low))
    if values > MOST_MULTIPLEXED:
        raise ConfigError(
            f"{file}: multiplexers of more than {MOST_MULTIPLEXED} values; keep those in use"
        )


def _parse_number(digits: str) -> int:
    return int(digits[:20])
