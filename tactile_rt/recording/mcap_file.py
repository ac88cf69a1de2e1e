"""The channels of a recording in an MCAP file."""

from collections.abc import Mapping
from typing import Any, BinaryIO

from tactile_rt.recording.description import METADATA, SESSION, Description, seal
from tactile_rt.recording.layout import CHANNELS

__all__ = ["McapFile"]

SEQUENCES = 1 << 32


class McapFile:
    """The channels of a recording in an MCAP file; knows nothing of threads.

    Args:
        file: to write; not closed with this.
        about: what it is of.
    """

    def __init__(self, file: BinaryIO, about: Description) -> None:
        import mcap.writer

        self.about, self._file = about, file
        # Checksums over the whole file, too: a record that is lost altogether must be noticed.
        self._writer: Any = mcap.writer.Writer(file, enable_data_crcs=True)
        self._writer.start(profile="", library="tactile_rt")
        # In this order: a file that says what it is of has the notes, too, wherever it is cut.
        if about.session:
            self._writer.add_metadata(SESSION, seal(about.session))
        self._writer.add_metadata(METADATA, about.to_metadata())
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        for topic, wire in CHANNELS:
            if wire not in ("", about.wire):
                continue
            schema = CHANNELS[topic, wire]
            kind = self._writer.register_schema(schema.name, schema.encoding, schema.text.encode())
            self._channels[topic] = self._writer.register_channel(
                topic, schema.message_encoding, kind
            )
            self._counts[topic] = 0

    def add(self, topic: str, data: bytes, t_ns: int) -> None:
        """Add a message of this host time, ns; messages are numbered so that none gets lost."""
        utc = max(0, t_ns + self.about.utc_offset_ns)
        count = self._counts[topic]
        self._writer.add_message(self._channels[topic], utc, data, utc, count % SEQUENCES)
        self._counts[topic] = count + 1

    def note(self, name: str, fields: Mapping[str, str]) -> None:
        """Add metadata."""
        self._writer.add_metadata(name, seal(fields))

    def flush(self) -> int:
        """Let the system have all that was added; the size of the file."""
        self._writer.flush()
        return self._file.tell()

    def finish(self) -> int:
        """Write the index; the size of the file."""
        self._writer.finish()
        self._file.flush()
        return self._file.tell()
