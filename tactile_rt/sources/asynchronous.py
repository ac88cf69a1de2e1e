"""Reading of a source in an event loop.

async for chunk in chunks(source):
    ...
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress

from tactile_rt.core.stream import Chunk, EndOfStream, Source

LOOK_S = 0.1  # longest wait for data before a source is read again


async def chunks(source: Source) -> AsyncIterator[Chunk]:
    """Yield the chunks of a source as they come, until it ends. The caller closes the source.

    If the source has a file descriptor, the event loop waits for it, without a thread. A source
    without a descriptor, or with a lost line, is read in a thread, 0.1 s at a time.

    Raises:
        SourceError: the device broke.
    """
    loop, came = asyncio.get_running_loop(), asyncio.Event()
    while True:
        fd = source.fileno()
        try:
            if fd < 0:
                chunk = await asyncio.to_thread(source.read, LOOK_S)
            else:
                chunk = source.read(0.0)
        except EndOfStream:
            return
        if chunk is not None:
            yield chunk
        elif fd >= 0:
            came.clear()
            loop.add_reader(fd, came.set)
            try:
                with suppress(TimeoutError):
                    await asyncio.wait_for(came.wait(), LOOK_S)
            finally:
                loop.remove_reader(fd)
