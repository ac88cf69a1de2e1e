"""Catalogue of the codecs by wire and name: the module of each, and its devices.

No codec is imported here, so that `tactile-rt codecs` answers at once.
"""

from pathlib import Path
from typing import NamedTuple


class Entry(NamedTuple):
    """Entry of the catalogue: where a codec's class is, and which devices it is for.

    Attributes:
        attribute: Class in the module; for a frame described in TOML, its file in `FRAMES`.
    """

    module: str
    attribute: str
    device: str


def _entry(where: str, device: str) -> Entry:
    module, _, attribute = where.partition(":")
    return Entry(f"tactile_rt.drivers.codecs.{module}", attribute, device)


# (wire, name)
CODECS = {
    ("serial", "native"): _entry("native:NativeSerial", "Your own firmware, by our format"),
    ("can", "native"): _entry("native_can:NativeCan", "Your own firmware, by our format"),
    ("serial", "bota"): _entry("bota:Bota", "Bota SensONE and Rokubi, generation 2: six axes"),
    ("serial", "optoforce"): _entry("optoforce:OptoForceSerial", "OptoForce OMD and HEX, USB"),
    ("can", "optoforce"): _entry("optoforce:OptoForceCan", "OptoForce OMD and HEX"),
    ("serial", "anyskin"): _entry("anyskin:AnySkin", "AnySkin, ReSkin, eFlesh: magnetic skins"),
    ("serial", "mlx_hex"): _entry("mlx_hex:MlxHex", "One magnet whisker on an MLX90393"),
    ("serial", "hx711_whisker"): _entry(
        "hx711_whisker:Hx711Whisker", "Up to nine strain-gauge whiskers on HX711"
    ),
    ("serial", "ascii_line"): _entry("ascii_line:AsciiLine", "Any board that prints numbers"),
    ("serial", "binary_frame"): _entry(
        "binary_frame:BinaryFrame", "Any sensor whose frame you describe, mapping=FILE.toml"
    ),
    ("serial", "ft300"): _entry("ft300:Ft300", "Robotiq FT 150 and FT 300: six axes"),
    ("serial", "tsf85"): _entry("tsf85:Tsf85", "Robotiq TSF-85: two fingertips of 28 taxels"),
    ("serial", "ati_485"): _entry("ati_485:Ati485", "ATI with digital output, RS-485: six axes"),
    ("can", "xela"): _entry("xela:Xela", "XELA uSkin uSPa44: 16 taxels of three axes"),
    ("can", "can-dbc"): _entry(
        "can_dbc:CanDbc", "Any CAN sensor with a DBC file, mapping=FILE.toml"
    ),
    ("can", "ati_can"): _entry("ati_can:AtiCan", "ATI on the NETCANOEM board: six axes"),
    ("can", "aft200"): _entry("aft200:Aft200", "Aidin AFT200: six axes"),
    ("can", "icub_skin"): _entry("icub_skin:IcubSkin", "iCub skin: boards of 16 triangles"),
}
FRAMES = Path(__file__).with_name("codecs") / "frames"
# Devices that need only a description of their frame; its first comment names the device.
for _file in sorted(FRAMES.glob("*.toml")):
    if ("serial", _file.stem) not in CODECS:
        with _file.open(encoding="utf-8") as _text:
            _first = _text.readline().strip("# .\n")
        CODECS["serial", _file.stem] = _entry(f"binary_frame:{_file.name}", _first)
