"""What two tables cannot both have, an address to listen at or a file to write, and what no table
can: an address that is none, a file where a folder should be."""

import ipaddress
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from tactile_rt.daemon.config_file import Loaded
from tactile_rt.daemon.consumers import Wanted

__all__ = ["check_folder", "check_host", "check_listeners", "check_outputs"]

HOST = re.compile(r"(?=.{1,253}\Z)([A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?\.?)+\Z")
ANY = ("", "*", "0.0.0.0", "::")

KeyPath = list[str | int]


def check_host(loaded: Loaded, path: KeyPath, host: str) -> None:
    """Refuse what is neither an IP address nor can be the name of a host."""
    try:
        ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        # Digits alone are an address that went wrong, not a name.
        if not HOST.match(host) or re.fullmatch(r"[\d.]+", host):
            why = "no address: 127.0.0.1, ::1 or a host's name; a port has a key of its own"
            loaded.refuse(path, f"{host!r:.60} is {why}")


def check_listeners(loaded: Loaded, wanted: Sequence[Wanted]) -> None:
    """Refuse a second one at a port."""
    taken: list[tuple[str, int, str]] = []
    for one in wanted:
        for key, host, port in _addresses(one):
            path = _path(loaded, one, key)
            if key == "port":
                check_host(loaded, [*path[:-1], "host"], host)
            host = "127.0.0.1" if host == "localhost" else host.strip("[]")
            for other, number, name in taken:
                if port == number and (host == other or host in ANY or other in ANY):
                    loaded.refuse(path, f"{host}:{port} is where {name} listens")
            taken.append((host, port, one.name))


def check_outputs(loaded: Loaded, wanted: Sequence[Wanted]) -> None:
    """Refuse a file that cannot be one, or that another writes already."""
    taken: dict[str, str] = {}
    for one in wanted:
        if one.kind not in ("log", "jsonl"):
            continue
        path, file = _path(loaded, one, "file"), one.options.file
        if not file and one.kind == "log":
            continue
        if "\0" in file:
            loaded.refuse(path, "no file's name has a zero byte")
        if file and not os.path.isdir(Path(file).parent):
            loaded.refuse(path, f"no folder {Path(file).parent}")
        if file and os.path.isdir(file):
            loaded.refuse(path, f"{file} is a folder")
        place = os.path.realpath(file) if file else "standard output"
        if place in taken:
            loaded.refuse(path, f"{place} is where {taken[place]} writes")
        taken[place] = one.name


def check_folder(loaded: Loaded, folder: str) -> None:
    """Refuse a recorder's folder that cannot be made."""
    place = Path(folder)
    if "\0" in folder or (os.path.exists(folder) and not os.path.isdir(folder)):
        loaded.refuse(["recorder", "folder"], f"{folder!r} is not a folder")
    above = next((p for p in place.parents if os.path.lexists(p)), None)
    if above is not None and not os.path.isdir(above):
        loaded.refuse(["recorder", "folder"], f"{folder!r}: {above} is not a folder")


def _addresses(wanted: Wanted) -> Iterator[tuple[str, str, int]]:
    """(key, host, port) at which a consumer will listen; ports that are chosen then are left out.

    Of kinds that other packages add it is not known what their options mean.
    """
    options = wanted.options
    if wanted.kind in ("page", "metrics", "foxglove"):
        if options.port:
            yield "port", options.host, options.port
    elif wanted.kind == "zmq":
        if options.bind.startswith("tcp:") and not options.bind.endswith(":*"):
            yield "bind", *_split(options.bind.partition("://")[2])
    elif wanted.kind == "zenoh":
        for endpoint in options.listen:
            protocol, _, address = endpoint.partition("/")
            host, port = _split(re.split("[?#]", address)[0])
            if protocol in ("tcp", "tls", "ws") and port:
                yield "listen", host, port


def _split(address: str) -> tuple[str, int]:
    """(host, port); 0: none."""
    host, _, port = address.rpartition(":")
    return host, int(port) if port.isdecimal() else 0


def _path(loaded: Loaded, wanted: Wanted, key: str) -> KeyPath:
    """Where a key of a consumer's table is, or would be."""
    table, _, name = wanted.name.partition(".")
    if table != "publisher":
        return [table, key]
    return ["publisher", [p.name for p in loaded.config.publisher].index(name), "options", key]
