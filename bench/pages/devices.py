"""The page of supported devices, docs/reference/devices.md.

    python -m bench.pages.devices

Codecs declare most of it, or say it in their docstrings; `devices.toml` has the rest.
"""

import re
import tomllib
from dataclasses import fields
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from typing import Any

from tactile_rt.drivers.catalogue import CODECS, FRAMES
from tactile_rt.drivers.codec import codec_class

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "devices.md"


def write_page() -> str:
    """Return the text of the page."""
    told = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
    rows, sections = [], []
    for group in told["group"]:
        sections.append(f"## {group.pop('title')}\n")
        for name, facts in group.items():
            kinds = [codec_class(wire, n) for wire, n in CODECS if n == name]
            # of one that needs a description there is only its class
            codecs = kinds if "options" in facts else [kind(kind.Options()) for kind in kinds]
            devices = (CODECS[kind.wire, name].device for kind in kinds)
            title = re.split(r": |, mapping", min(devices, key=len))[0]
            sections.append(f"### {title}\n\n{describe_device(name, codecs, facts)}\n")
            anchor = re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
            for codec in codecs:
                found = re.findall("counter|clock|checksum", seen_by(codec, facts))
                seen = "as described" if "seen" in facts else ", ".join(found) or "-"
                cells = (f"[{title}](#{anchor})", f"`{name}`", speed(codec), *shape(codec), seen)
                rows.append(f"| {' | '.join(cells)} |")
    head = told["head"].format(codecs=len(CODECS), protocols=len({name for _, name in CODECS}))
    return "\n".join([head.strip(), *rows, "", *sections])


def describe_device(name: str, codecs: list[Any], facts: dict[str, str]) -> str:
    """Return the five entries of one protocol, over every wire that it has."""
    first = codecs[0]
    wires = " or ".join(map(speed, codecs)) + ", each sample asked for" * first.polls
    hz, measured = shape(first)
    paced = [f"{hz} Hz" if hz != "-" else "", facts.get("rate", "")]
    unseen = dict.fromkeys(codec.cannot_detect for codec in codecs if codec.cannot_detect)
    options = ", ".join(f"`{one.name}`" for one in fields(first.Options))
    seen = seen_by(first, facts) or "nothing: no frame carries a counter, clock or checksum"
    entries = {
        "Wire and rate": f"{wires}; {', '.join(filter(None, paced))}.",
        "Measures": f"{measured}. {facts['measured']}",
        "Connect": f"options in the URL: {options}.\n\n{commands(name, codecs, facts)}",
        "Losses": f"seen by {seen}. Not seen: {'; '.join(unseen)}.",
        "Protocol from": f"{source(name, codecs, facts)} Tested with {facts['tested']}. "
        "Not tried on a device.",
    }
    return "\n\n".join(f"**{label}**: {text}" for label, text in entries.items())


def commands(name: str, codecs: list[Any], facts: dict[str, str]) -> str:
    """Return what reads the device, and what emulates its twin and reads that."""
    option, twin = facts.get("options", ""), facts.get("twin", "")
    query = f"codec={name}" + f"&{option}" * bool(option)
    of_can = [codec.wire == "can" for codec in codecs]
    port = f"serial:///dev/{'ttyACM0' if getattr(codecs[0], 'usb', False) else 'ttyUSB0'}"
    lines = ["can:socketcan:can0" if can else port for can in of_can]
    lines.append(f"{'can:slcan:' if of_can[0] else 'serial://'}/tmp/{name}")
    urls = [f"tactile-rt hz '{line}?{query}' --seconds 5" for line in lines]
    emulate = f"tactile-rt emulate {name} {twin}" + f"--set '{option}' " * bool(option)
    said = "# its twin, touched again and again; read it in another terminal"
    urls.insert(-1, f"\n{said}\n{emulate}--link /tmp/{name}")
    return "\n".join(["```sh", *urls, "```"])


def speed(codec: Any) -> str:
    """Return the wire and its speed."""
    if codec.wire == "can":
        return f"CAN {codec.bitrate / 1e6:g} Mbit/s" + " or CAN FD" * bool(codec.data_bitrate)
    return "USB serial" if codec.usb else f"serial {codec.baud} 8{codec.parity}1"


def shape(codec: Any) -> tuple[str, str]:
    """Return the rate in Hz, and the number of elements with their channels and units."""
    spec = getattr(codec, "spec", None)
    if spec is None:
        return "-", "As described"
    units: dict[str, list[str]] = {}
    for channel, unit in zip(spec.channels, spec.units, strict=True):
        units.setdefault("counts" if unit == "1" else unit, []).append(channel)
    told = ", ".join(f"{' '.join(names)} ({unit})" for unit, names in units.items())
    return f"{spec.rate_hz:g}", f"{len(spec.elements)} x {told}"


def seen_by(codec: Any, facts: dict[str, str]) -> str:
    """Return what a frame carries that shows losses."""
    own = codec.frame.mapping.checksum if hasattr(codec, "frame") else None
    checksum = facts.get("checksum", own.name if own else "CAN's" * (codec.wire == "can"))
    found = [f"a counter of {codec.count_bits} bits"] if codec.count_bits else []
    found += [f"a clock in steps of {codec.tick_ns / 1e3:g} us"] if codec.tick_ns else []
    found += [f"a checksum ({checksum})"] if checksum else []
    return facts.get("seen", ", ".join(found))


def source(name: str, codecs: list[Any], facts: dict[str, str]) -> str:
    """Return where the protocol is from: a paragraph of a docstring, or of a frame's head."""
    module, frame = import_module(CODECS[codecs[0].wire, name].module), FRAMES / f"{name}.toml"
    docs = [cleandoc(thing.__doc__ or "") + "\n\n" for thing in (module, type(codecs[0]))]
    docs += [re.sub("^# ?", "", frame.read_text(), flags=re.M)] if frame.exists() else []
    found = re.search(r"^Sources?: (.+?)\n\n", "".join(docs), re.M | re.S)
    said = " ".join((found[1] if found else facts["source"]).split())
    linked = re.sub(r"github\.com/([\w-]+/[\w.-]*\w)", r"[\1](https://github.com/\1)", said)
    return linked[0].upper() + linked[1:]


if __name__ == "__main__":
    PAGE.write_text(write_page(), "utf-8")
