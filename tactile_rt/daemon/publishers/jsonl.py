"""Messages as lines of JSON, on standard output or in a file."""

import os
import sys

import msgspec

from tactile_rt.daemon.consumer import View
from tactile_rt.daemon.items import Item
from tactile_rt.daemon.messages import Message, encode, message_of, state_message
from tactile_rt.daemon.publishers.sending import Publisher, StateSeconds

TOGETHER = 64  # messages in one write


class JsonlOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of ``kind = "jsonl"``.

    Attributes:
        file: The file that lines are appended to; empty: standard output.
        state_s: The time between two ``state`` messages, s; 0 sends none.
    """

    file: str = ""
    samples: bool = False
    state_s: StateSeconds = 0.0


class JsonlPublisher(Publisher):
    """A publisher that appends a line per message. After a line that could not be written whole,
    the next message begins on a new line."""

    Options = JsonlOptions

    def __init__(self, name: str, options: JsonlOptions) -> None:
        super().__init__(name, options.samples, options.state_s)
        self._options, self._handle = options, -1

    def open(self, view: View) -> None:
        self._view = view
        if not self._options.file:
            sys.stdout.flush()
            self._handle = os.dup(sys.stdout.fileno())
            return
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        self._handle = os.open(self._options.file, flags, 0o644)
        size = os.fstat(self._handle).st_size
        if size and os.pread(self._handle, 1, size - 1) != b"\n":  # a disk was full
            os.write(self._handle, b"\n")

    def handle(self, items: list[Item]) -> None:
        name = self._options.file
        if name and not os.path.samestat(os.fstat(self._handle), os.stat(name)):
            raise OSError(f"{name} was moved while it was written: another is begun")
        # Much waits after a reader has stalled: do not hold all of it in memory at once.
        for start in range(0, len(items), TOGETHER):
            found = map(message_of, items[start : start + TOGETHER])
            self._write([message for message in found if message is not None])
        if self._state_due.now():
            self._write([state_message(self._view.snapshot())])

    def _write(self, messages: list[Message]) -> None:
        data = memoryview(b"".join(encode(m) + b"\n" for m in messages))
        self._bytes += len(data)
        while data:
            data = data[os.write(self._handle, data) :]
        self._messages += len(messages)

    def close(self) -> None:
        handle, self._handle = self._handle, -1
        if handle >= 0:
            os.close(handle)

    def details(self) -> dict[str, str | int | float]:
        return {
            "file": self._options.file or "standard output",
            "messages": self._messages,
            "bytes": self._bytes,
        }
