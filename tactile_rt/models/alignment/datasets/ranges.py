"""A file on a web server that is read where it is needed, by HTTP ranges, as h5py takes a file.

Bytes come in blocks, which are kept: what HDF5 says of its data is small, read again and again, and
strewn over gigabytes. Blocks that are missing beside each other come by one request.
"""

import io
from typing import TYPE_CHECKING
from urllib.request import getproxies

from tactile_rt.errors import ConfigError

if TYPE_CHECKING:
    import urllib3

__all__ = ["RangeFile", "connections"]

BLOCK = 1 << 16  # bytes
KEPT = 1 << 10  # blocks
PATIENCE_S = 60.0  # of a request that is answered with nothing
AGAIN = 4  # times that a request is repeated, after 0, 1, 2 and 4 s
BUSY = (429, 500, 502, 503, 504)


def connections() -> "urllib3.PoolManager":
    """Connections to servers, kept open from request to request, through the proxy that is set.

    Raises:
        ModuleNotFoundError: urllib3 is not installed.
    """
    import urllib3

    again = urllib3.Retry(AGAIN, backoff_factor=0.5, status_forcelist=BUSY, raise_on_status=False)
    proxy = getproxies().get("https")
    if proxy:
        return urllib3.ProxyManager(proxy, retries=again, timeout=PATIENCE_S)
    return urllib3.PoolManager(retries=again, timeout=PATIENCE_S)


class RangeFile(io.RawIOBase):
    """A file of known size, read by ranges.

    h5py swallows what its file raises and says something else; the first error stays in `error`.

    Args:
        pool: of `connections`.
        url: of the file.
        size: in bytes; a server that has another size has another file.

    Attributes:
        error: The first error of a request, in words; empty: none.
        transferred: The bytes that came so far.
    """

    def __init__(self, pool: "urllib3.PoolManager", url: str, size: int) -> None:
        self.error = ""
        self.transferred = 0
        self._pool, self._url, self._size = pool, url, size
        self._blocks: dict[int, bytes] = {}
        self._place = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._place = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._place}.get(whence, self._size)
        return self._place

    def tell(self) -> int:
        return self._place

    def readinto(self, buffer: "memoryview | bytearray") -> int:  # type: ignore[override]
        wanted = memoryview(buffer).cast("B")
        begin, end = self._place, min(self._place + len(wanted), self._size)
        if begin >= end:
            return 0
        first, last = begin // BLOCK, (end - 1) // BLOCK
        missing = [k for k in range(first, last + 1) if k not in self._blocks]
        if missing:
            self._fetch(missing[0], missing[-1])
        data = b"".join(self._blocks[k] for k in range(first, last + 1))
        wanted[: end - begin] = data[begin - first * BLOCK : end - first * BLOCK]
        self._place = end
        while len(self._blocks) > KEPT:
            del self._blocks[next(iter(self._blocks))]
        return end - begin

    def _fetch(self, first: int, last: int) -> None:
        """Get blocks, all between them included.

        Raises:
            ConfigError: the server did not give them.
        """
        import urllib3

        begin, end = first * BLOCK, min((last + 1) * BLOCK, self._size)
        try:
            answer = self._pool.request(
                "GET",
                self._url,
                headers={"Range": f"bytes={begin}-{end - 1}"},
                preload_content=False,
            )
            try:
                whole = answer.headers.get("Content-Range", "").rpartition("/")[2]
                if answer.status in (206, 416) and whole != str(self._size):
                    raise ConfigError(f"it has {whole or 'no'} bytes, and not {self._size}")
                if answer.status == 200:
                    raise ConfigError("the server sends whole files, no ranges")
                if answer.status != 206:
                    raise ConfigError(f"the server says {answer.status} {answer.reason or ''}")
                data = answer.read()
            except ConfigError:
                answer.close()  # what it still sends would be taken for the next answer
                raise
            answer.release_conn()
            if len(data) != end - begin:
                raise ConfigError(f"{len(data)} bytes came where {end - begin} were asked for")
        except (ConfigError, urllib3.exceptions.HTTPError) as error:
            reason = str(getattr(error, "reason", error))  # of many tries, the last one
            self.error = self.error or " ".join(reason.split())
            raise ConfigError(self.error) from None
        self.transferred += len(data)
        for k in range(first, last + 1):
            self._blocks[k] = data[k * BLOCK - begin : (k + 1) * BLOCK - begin]
