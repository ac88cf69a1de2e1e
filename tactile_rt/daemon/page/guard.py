"""Who may see the page: the address asked for, where a request comes from, and the token."""

import hashlib
import hmac
import ipaddress
import socket
from collections.abc import Mapping
from urllib.parse import urlsplit

from tactile_rt.daemon.http import Refused

__all__ = ["HEADERS", "Guard"]

# Trusted Types: the browser itself refuses innerHTML and its like, whatever a label contains.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "manifest-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    "require-trusted-types-for 'script'; trusted-types 'none'"
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=()",
    "cache-control": "no-store",
}
COOKIE_S = 30 * 86400
MAX_TOKEN = 1024


class Guard:
    """Decides on requests by their headers alone.

    Args:
        host: The address that the page is bound to, as configured.
        token: The secret that a browser must know; empty: none.
    """

    def __init__(self, host: str, port: int, token: str) -> None:
        own = socket.gethostname().lower()
        self._names = {"localhost", host.strip("[]").lower(), own, f"{own}.local"}
        self._token = token.encode()
        # Cookies are shared by all ports of a host: two daemons must not overwrite each other's.
        self.cookie = f"tactile_rt_{port}"
        # It outlives the daemon, so that a page goes on after a restart, and tells no token.
        self._session = hmac.digest(self._token, b"tactile_rt page", hashlib.sha256).hex().encode()

    def check(self, headers: Mapping[str, str], method: str) -> None:
        """Let a request pass if it is of this page or of no page at all.

        A foreign site can neither point a name of its own at this address (DNS rebinding): only
        numbers and this host's names are answered; nor ask from its own pages: browsers tell.

        Raises:
            Refused: 403.
        """
        host = headers.get("host", "")
        if not self._is_own(host):
            raise Refused(403, "this page is not served under that name; use its IP address")
        origin = headers.get("origin")
        if origin is not None and urlsplit_netloc(origin) != host.lower():
            raise Refused(403, "asked for by another site")
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none") and (
            method != "GET" or headers.get("sec-fetch-mode") != "navigate"
        ):
            raise Refused(403, "asked for by another site")

    def knows(self, headers: Mapping[str, str]) -> bool:
        """Whether a request brings the token, in a header, or the cookie given for it."""
        if not self._token:
            return True
        kind, _, given = headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer" and self.is_token(given.strip()):
            return True
        for pair in headers.get("cookie", "").split(";"):
            name, _, value = pair.strip().partition("=")
            if name == self.cookie and hmac.compare_digest(value.encode("latin-1"), self._session):
                return True
        return False

    def is_token(self, given: str) -> bool:
        """Compares in a time that does not tell how much of it is right."""
        return len(given) <= MAX_TOKEN and hmac.compare_digest(
            given.encode("utf-8", "surrogatepass"), self._token
        )

    def set_cookie(self) -> str:
        """Header that lets a browser in; scripts and other sites never see it."""
        return (
            f"{self.cookie}={self._session.decode()}; HttpOnly; SameSite=Strict; Path=/; "
            f"Max-Age={COOKIE_S}"
        )

    def _is_own(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
            if name.lower().rstrip(".") in self._names:
                return True
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True


def urlsplit_netloc(origin: str) -> str:
    """HOST:PORT of an ``Origin`` header; empty if it is of no web site."""
    try:
        parts = urlsplit(origin)
    except ValueError:
        return ""
    return parts.netloc.lower() if parts.scheme in ("http", "https") else ""
