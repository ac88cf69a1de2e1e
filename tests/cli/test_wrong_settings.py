"""A wrong source URL is answered by one text, through whatever door it comes.

The doors are `run --source URL`, a file that `config check` reads, and `--set` beside it. What is
wrong is written out by hand, and made from every option that a scheme or a codec has.
"""

import dataclasses
import json
from importlib.util import find_spec

import pytest

from tactile_rt.core.errors import TactileError
from tactile_rt.core.packages import install_extra
from tactile_rt.daemon.checks import check_config
from tactile_rt.daemon.loading import load_config
from tactile_rt.drivers.catalogue import CODECS
from tactile_rt.drivers.codec import codec_class
from tactile_rt.drivers.opening import CanOptions, SerialOptions
from tactile_rt.recording.replay import ReplayOptions, SweepOptions
from tactile_rt.sources.opening import open_source
from tactile_rt.sources.synthetic import SyntheticOptions
from tactile_rt.testing import small_spec
from tests.helpers.tiny_sweeps import write_tiny_set

SMALL = 'version = 1\n[[source]]\nname = "a"\nurl = {}\n'
SERIAL, CAN = "serial:///dev/none?codec=", "can:virtual:none?codec="

SCHEMES = [
    "", "mouse", "/dev/ttyUSB0", "?seed=1", "C:\\robot", "xyz:mouse", "serail:///dev/ttyUSB0",
    "cna:can0", "replya:run.mcap", "syntetic:5x6", "sum:mouse", "SERIAL", "http://robot/",
    "serial://[::1", "synthetic:5x6\n", "synthetic:5x6?seed=1\t", "synthetic:" + 5000 * "9",
]  # fmt: skip
TARGETS = [
    "serial:", "serial:?codec=native", "serial:/dev/none", "serial:/dev/none?baud=9600",
    "can:", "can:can0", "can:can0?codec=native", "can:sockectan:can0?codec=native",
    "can:virtual:none", "replay:", "replay:/none.mcap", "replay:/none.npz", "replay:/",
    "combined:", "combined:/none.toml", "combined:/none.toml?seed=1", "combined:/",
    "synthetic:5", "synthetic:0x6", "synthetic:5x7", "synthetic:99999x6", "synthetic:axb",
]  # fmt: skip
CODEC_NAMES = [
    SERIAL, SERIAL + "nativ", SERIAL + "xela", SERIAL + "Bota", SERIAL + "none",
    CAN, CAN + "nativ", CAN + "bota", CAN + "dbc", CAN + "can_dbc",
]  # fmt: skip
RANGES = [
    "synthetic:?rate_hz=2e6", "synthetic:?seconds=-1", "synthetic:?pace=slow",
    "synthetic:?seed=1&seed=2",
    SERIAL + "native&start_s=-1", SERIAL + "native&stale_s=-0.5", SERIAL + "native&clock=gps",
    SERIAL + "native&parity=X", SERIAL + "native&baud=-1", SERIAL + "native&baud=9600&baud=1",
    SERIAL + "native&calibration=/none.toml", SERIAL + "native&calibration=no such id",
    SERIAL + "native&array=/none.json", SERIAL + "native&format=int8", SERIAL + "native&range_n=0",
    SERIAL + "bota&sinc=1", SERIAL + "bota&baud=123", SERIAL + "optoforce&model=5d",
    SERIAL + "optoforce&rate_hz=7", SERIAL + "optoforce&filter_hz=7",
    SERIAL + "optoforce&counts=1,x", SERIAL + "anyskin&magnetometers=0", SERIAL + "mlx_hex&gain=8",
    SERIAL + "hx711_whisker&whiskers=10", SERIAL + "hx711_whisker&rate_hz=0",
    SERIAL + "ascii_line", SERIAL + "ascii_line&columns=A0", SERIAL + "ascii_line&columns=A0.fx:lb",
    SERIAL + "ascii_line&mapping=/none.toml", SERIAL + "ascii_line&columns=A0.fx&rate_hz=-1",
    SERIAL + "ft300&slave=248", SERIAL + "tsf85&signals=toes", SERIAL + "tsf85&fingers=3",
    SERIAL + "ati_485&matrix=/none.txt", SERIAL + "kwr75&newton=0",
    CAN + "native&base=0x7ff", CAN + "native&format=int8", CAN + "native&bitrate=-1",
    CAN + "native&data_bitrate=-1", CAN + "native&stale_s=-1", CAN + "native&baud=9600",
    CAN + "optoforce&device_id=0x800", CAN + "optoforce&host_id=x", CAN + "xela&board=256",
    CAN + "xela&first_id=0x800", CAN + "xela&rate_hz=0", CAN + "can-dbc",
    CAN + "can-dbc&mapping=/none.toml", CAN + "ati_can&calibration=16", CAN + "aft200&sensor=256",
    CAN + "icub_skin&triangles=a", CAN + "icub_skin&firmware=newest",
]  # fmt: skip
SIMULATED = [
    "sim:muose", "sim:/none.csv", "sim:?objects=mugg", "sim:?objects=mug,/none.stl",
    "sim:?sweeps=-1", "sim:?repeat=0", "sim:?seed=-1", "sim:?pace=slow", "sim:?profile=quick",
    "sim:?noise_force=-1", "sim:?drop_probability=1", "sim:?friction=2", "sim:?sweeps=1&sweeps=1",
    "whisking:cat", "whisking:?object=mugg", "whisking:?object=mug&position_mm=0,0,0",
    "whisking:?position_mm=1,2", "whisking:?size_mm=0", "whisking:?frequency_hz=-1",
    "whisking:?amplitude_deg=500", "whisking:?pace=slow", "whisking:?profile=quick",
]  # fmt: skip

# Texts that no value of a type can be.
WRONG = {"int": ("fast", "1.5", ""), "float": ("fast", "nan", "1e999"), "bool": ("maybe", "")}


def wrong_options(url, *kinds):
    """Every option misspelt, and with what it cannot be, after a URL that ends in ? or in &."""
    fields = {f.name: f for kind in kinds for f in dataclasses.fields(kind)}
    for name, field in fields.items():
        if name != "codec":
            yield f"{url}{name}_=1"
            yield f"{url}{name.upper()}=1"
        kind = getattr(field.type, "__name__", str(field.type)).partition(" ")[0]
        for text in WRONG.get(kind, ()):
            yield f"{url}{name}={text}"
    yield f"{url}=1"
    yield f"{url}zzz=1"
    yield f"{url}clock=host&zzz=1" if "codec=" in url else f"{url}zzz="


def generated():
    for wire, name in CODECS:
        try:
            codec = codec_class(wire, name)
        except ModuleNotFoundError:
            continue
        line, url = (SerialOptions, SERIAL) if wire == "serial" else (CanOptions, CAN)
        # The line's options are the same for all codecs: once will do.
        kinds = (line, codec.Options) if name == "native" else (codec.Options,)
        yield f"{wire} {name}", list(wrong_options(f"{url}{name}&", *kinds))
    yield "synthetic", list(wrong_options("synthetic:5x6?", SyntheticOptions))


TABLE = {
    "schemes": SCHEMES, "targets": TARGETS, "codecs": CODEC_NAMES, "ranges": RANGES,
    **dict(generated()),
}  # fmt: skip


class Doors:
    """What a URL is answered with at each door, without the place that each puts before it.

    Args:
        folder: for the configurations.
        call: calls the command, which takes long: most URLs go to what the commands call.
    """

    def __init__(self, folder, call):
        self.call = call
        self.right, self.wrong = folder / "right.toml", folder / "wrong.toml"
        self.right.write_text(SMALL.format(json.dumps("synthetic:")))

    def __call__(self, url, command=False):
        """Ask at all of them; the one text that they gave."""
        self.wrong.write_text(SMALL.format(json.dumps(url)))
        setting = f"source.a.url={url}"
        doors = [
            ("", ("run", "--source", url), lambda: open_source(url)),
            (f"{self.wrong}:4: source[0].url: ", ("config", "check", self.wrong),
             lambda: check_config(load_config(self.wrong))),
            (f"--set {setting}: source[0].url: ", ("config", "check", self.right, "--set", setting),
             lambda: check_config(load_config(self.right, [setting]))),
        ]  # fmt: skip
        found = []
        for place, arguments, function in doors:
            if command:
                code, _, said = self.call(*arguments)
                assert code == 2, (url, said)
                said = said.removesuffix("\n")
                place = f"tactile-rt: {place}"
            else:
                with pytest.raises(TactileError) as caught:
                    function()
                said = str(caught.value)
            assert said.startswith(place), (url, said)
            found.append(said.removeprefix(place))
        run, file, setting = found
        assert run == file == setting, url
        assert run and "\n" not in run
        # msgspec's own words, which name no option as it is written
        assert "Expected `" not in run and "`$" not in run and "$." not in run, run
        return run


@pytest.fixture
def alike(call, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    return Doors(tmp_path, call)


@pytest.mark.parametrize("group", TABLE)
def test_a_wrong_source_is_told_alike_at_every_door(alike, group):
    for i, url in enumerate(TABLE[group]):
        alike(url, command=i % 12 == 0)


@pytest.mark.skipif(find_spec("mujoco") is None, reason="mujoco is not installed")
def test_so_is_a_wrong_simulation(alike):
    from tactile_rt.sim_backend.source import SimOptions
    from tactile_rt.sim_backend.whisking_source import WhiskingOptions

    made = [*wrong_options("sim:?", SimOptions), *wrong_options("whisking:?", WhiskingOptions)]
    for i, url in enumerate([*SIMULATED, *made]):
        alike(url, command=i % 50 == 0)


def test_a_simulation_without_its_extra_is_told_alike(alike, monkeypatch):
    from tactile_rt.sources import opening

    def without_mujoco(name):
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")

    monkeypatch.setattr(opening, "import_module", without_mujoco)
    for url in ("sim:mouse", "whisking:mouse?object=mug"):
        assert alike(url, command=True).endswith(f"not installed: {install_extra('sim')}")


def test_so_is_what_is_wrong_with_a_file_that_it_names(alike, tmp_path):
    garbage, text = tmp_path / "garbage.bin", tmp_path / "text.mcap"
    garbage.write_bytes(b"\xff\xfe\x00")
    text.write_text("no recording")
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"\x89MCAP0\r\n" + bytes(40))
    sweeps = tmp_path / "set" / f"{write_tiny_set(tmp_path / 'set').names()[0]}.npz"
    member = '[[source]]\nname = "a"\nurl = "{}"\n'
    heads = {
        "rate": 'name = "head"\nrate_hz = "fast"\n',
        "key": 'name = "head"\nrate_hz = 10\n' + member.format("synthetic:") + "pose = 1\n",
        "url": 'name = "head"\nrate_hz = 10\n' + member.format("serial:///dev/x?codec=nativ"),
        "itself": 'name = "head"\nrate_hz = 10\n'
        + member.format(f"combined:{tmp_path}/itself.toml"),
    }
    for name, written in heads.items():
        (tmp_path / f"{name}.toml").write_text(written)
    array = tmp_path / "array.json"
    array.write_text(small_spec().to_json().replace("1000.0", '"fast"'))
    mapping, cell = tmp_path / "mapping.toml", tmp_path / "cell.toml"
    mapping.write_text('columns = ["A0.fx"]\nrate_hz = "fast"\n')
    cell.write_text("version = 1\ndevice = 7\n")
    said = [
        alike(url)
        for url in (
            *(f"combined:{tmp_path}/{name}.toml" for name in heads), f"combined:{garbage}",
            f"replay:{garbage}", f"replay:{text}", f"replay:{broken}", f"replay:{tmp_path}",
            *wrong_options(f"replay:{sweeps}?", SweepOptions),
            *(f"replay:{sweeps}?{o}" for o in ("speed=-1", "rest_s=-1", "from=wire")),
            f"{SERIAL}ascii_line&mapping={mapping}", f"{SERIAL}native&calibration={cell}",
            f"{SERIAL}native&array={garbage}", f"{SERIAL}ati_485&matrix={garbage}",
            f"{CAN}can-dbc&mapping={mapping}", f"{CAN}native&array={text}",
        )
    ]  # fmt: skip
    assert any(":2: rate_hz: expected a number, got 'fast'" in s for s in said)
    found = alike(f"{SERIAL}native&array={array}")
    assert found == f"{array}: rate_hz: expected a number, got 'fast' (in hertz)"


def test_so_is_a_recording_with_wrong_options(alike, call, tmp_path):
    path = tmp_path / "run.mcap"
    assert call("record", "synthetic:2x2?seconds=0.05&pace=fast", path)[0] == 0
    for url in (
        *wrong_options(f"replay:{path}?", ReplayOptions),
        *(f"replay:{path}?{o}" for o in ("speed=-1", "codec=native", "from=wire", "from=samples_",
                                         "from=wire&codec=none")),
    ):  # fmt: skip
        alike(url)
