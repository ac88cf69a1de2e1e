"""CAN sensors described by a DBC file."""

import re
from pathlib import Path

import cantools
import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codec import CanFrame, Command
from tactile_rt.drivers.codecs.can_dbc import CanDbc, CanDbcOptions
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked
from tests.helpers.dbc_mappings import map_signal
from tests.helpers.hostile_files import DBCS
from tests.helpers.measured import measured

DOCS = Path(__file__).parents[3] / "docs" / "codecs"

# A 4 x 4 patch of three-axis taxels, a message per taxel, no counter: see test_xela.py.
PATCH_DBC = "".join(
    f"""
BO_ {1808 + i} Taxel{i}: 8 Board
 SG_ X : 15|16@0+ (1,0) [0|65535] "" Host
 SG_ Y : 31|16@0+ (1,0) [0|65535] "" Host
 SG_ Z : 47|16@0+ (1,0) [0|65535] "" Host
"""
    for i in range(16)
)
PATCH_TOML = 'dbc = "patch.dbc"\nname = "patch"\nrate_hz = 100.0\n' + "".join(
    [f'[[channel]]\nname = "{c}"\nunit = "1"\n' for c in "xyz"]
    + [
        f'[[element]]\nname = "T{i}"\ngrid = [{i // 4}, {i % 4}]\nsignals = '
        f'{{ x = "Taxel{i}.X", y = "Taxel{i}.Y", z = "Taxel{i}.Z" }}\n'
        for i in range(16)
    ]
)

# The counter is in each frame, and a multiplexer within a multiplexer.
NESTED_DBC = """
BO_ 2147484400 Skin: 8 Board
 SG_ N : 4|4@1+ (1,0) [0|15] "" Host
 SG_ Side M : 0|2@1+ (1,0) [0|3] "" Host
 SG_ Row m1M : 2|2@1+ (1,0) [0|3] "" Host
 SG_ A m0 : 8|16@1- (0.5,1) [0|0] "" Host
 SG_ B m1 : 40|16@1+ (1,0) [0|0] "" Host
 SG_ C m0 : 8|16@1+ (1,0) [0|0] "" Host
 SG_ D m1 : 8|16@1+ (1,0) [0|0] "" Host
SG_MUL_VAL_ 2147484400 Row Side 1-1;
SG_MUL_VAL_ 2147484400 A Side 0-0;
SG_MUL_VAL_ 2147484400 B Side 1-1;
SG_MUL_VAL_ 2147484400 C Row 0-0;
SG_MUL_VAL_ 2147484400 D Row 1-1;
"""
NESTED_TOML = """
dbc = "nested.dbc"
name = "nested"
rate_hz = 50.0
counter = { signal = "Skin.N" }
channel = [{ name = "p", unit = "Pa", scale = -2.0, offset = 7.0 }]
element = [
  { name = "A", grid = [0, 0], signals = { p = "Skin.A" } },
  { name = "B", grid = [0, 1], signals = { p = "Skin.B" } },
  { name = "C", grid = [0, 2], signals = { p = "Skin.C" } },
  { name = "D", grid = [0, 3], signals = { p = "Skin.D" } },
]
"""


def pad() -> CanDbc:
    return CanDbc(CanDbcOptions(str(DOCS / "can_dbc.toml")))


def pad_signal(n: int = 30) -> np.ndarray:
    draw = np.random.default_rng(1)
    fx, fz = draw.uniform(-1, 1, (n, 4)), draw.uniform(0, 16, (n, 4))
    return np.stack([fx, fz, draw.uniform(0, 500, (n, 4))], axis=2)


class TestPad(CodecContract):
    case = CodecCase(pad, pad_signal, (0.25e-3, 0.125e-3, 5e-3), checked=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("dbc")
    for name, dbc, toml in (("patch", PATCH_DBC, PATCH_TOML), ("nested", NESTED_DBC, NESTED_TOML)):
        (made / f"{name}.dbc").write_text('VERSION ""\nBU_: Board Host\n' + dbc)
        (made / f"{name}.toml").write_text(toml)
    return made


class TestNested(CodecContract):
    @pytest.fixture(autouse=True)
    def _case(self, folder: Path) -> None:
        self.case = CodecCase(
            lambda: CanDbc(CanDbcOptions(str(folder / "nested.toml"))),
            # A in steps of 0.5 from 1, the others in whole counts, each -2 x + 7
            lambda: np.random.default_rng(1).integers(0, 15000, (30, 4, 1)) * -2.0 + 7.0,
            tolerance=0.5,
            checked=False,
        )


# By hand from docs/codecs/can_dbc.dbc. Shear0, 12 bits from bit 8 (low nibble of byte 2 on top):
# 0x801 is -2047, in 0.5 mN; Normal0, 16 bits big-endian from the top of byte 3: 0x1234 = 4660, in
# 0.25 mN from -100; Warmth0 in bytes 6-7: 0xff9c = -100, in 0.01 degC from 20. Warmth3 is a float.
GOLDEN = [
    CanFrame(0x210, bytes.fromhex("07 10 27 00 02")),  # counter 7, time 0x002710 = 10,000, fault 2
    CanFrame(0x211, bytes.fromhex("00 01 08 12 34 00 9c ff")),
    CanFrame(0x211, bytes.fromhex("01 00 00 01 90 00 00 00")),
    CanFrame(0x211, bytes.fromhex("02 ff 07 ff ff 00 e8 03")),
    CanFrame(0x212, bytes.fromhex("02 00 00 00 0000c841")),  # 25.0
]


def test_a_golden_sample() -> None:
    samples = pad().feed(GOLDEN, T0)
    assert samples is not None and samples.valid.all()
    expected = [
        [-1.0235, 1.065, 292.15],  # -2047 / 2 mN, (4660 / 4 - 100) mN, 19 degC
        [0.0, 0.0, 293.15],  # 0x0190 = 400
        [1.0235, 16.28375, 303.15],
        [0.001, -0.1, 298.15],
    ]
    np.testing.assert_allclose(samples.values[0], expected, rtol=1e-6, atol=1e-9)
    assert samples.count is not None and samples.count.tolist() == [7]
    assert samples.ticks is not None and samples.ticks.tolist() == [10_000]
    assert samples.status is not None and samples.status.tolist() == [2]
    codec = pad()
    assert (codec.count_bits, codec.tick_bits, codec.tick_ns) == (8, 24, 100_000.0)
    low = codec.feed([GOLDEN[0]._replace(data=b"\x07\x10\x27\x00\x01"), *GOLDEN[1:]], T0)
    assert low is not None and not low.valid.any()  # the supply is too low


def test_what_cantools_decodes_we_decode(folder: Path) -> None:
    """Random bytes, each signal by cantools: another implementation."""
    draw = np.random.default_rng(2)
    for path in (DOCS / "can_dbc.dbc", folder / "patch.dbc"):
        database = cantools.database.load_file(path)
        codec = CanDbc(CanDbcOptions(str(path.with_suffix(".toml"))))
        for part in codec._map.parts:
            for _ in range(50):
                data = draw.bytes(part.length)
                if part.when:
                    data = bytes((min(part.when[0][1]),)) + data[1:]
                message = database.get_message_by_name(part.message.name)
                expected = message.decode(data, scaling=False, decode_choices=False)
                assert part.length <= 8 and part.matches(data)
                for signal, inside in codec._map.cells:
                    if codec._map.parts.index(part) in inside:
                        read = signal.read(data)
                        assert np.array_equal(read, expected[signal.name], equal_nan=True)


def test_the_patch_is_read_as_its_own_codec_reads_it(folder: Path) -> None:
    from tactile_rt.drivers.codecs.xela import Xela, XelaOptions

    device = Xela(XelaOptions())
    values = np.random.default_rng(1).integers(0, 65536, size=(5, 16, 3))
    wire = [f for p in device.encode(chunk_of(device, values)) for f in p]
    del wire[20]
    frames = [f._replace(data=f.data + b"\0") for f in wire]
    mine = decode(CanDbc(CanDbcOptions(str(folder / "patch.toml"))), frames)
    theirs = decode(device, wire)
    for what in ("values", "valid"):
        assert np.array_equal(stacked(mine, what), stacked(theirs, what))


def test_nested_multiplexers(folder: Path) -> None:
    codec = CanDbc(CanDbcOptions(str(folder / "nested.toml")))
    # byte 0: counter in the high nibble, row in bits 2-3, side in bits 0-1
    frames = [
        CanFrame(0x2F0, bytes((0x30, 10, 0, 0, 0, 0, 0, 0)), True),
        CanFrame(0x2F0, bytes((0x31, 20, 0, 0, 0, 30, 0, 0)), True),
        CanFrame(0x2F0, bytes((0x35, 40, 0, 0, 0, 30, 0, 0)), True),
    ]
    samples = codec.feed(frames, T0)
    assert samples is not None and samples.valid.all()
    # -2 x + 7 with x = 10 / 2 + 1, 30, 20, 40
    assert samples.values[0, :, 0].tolist() == [-5.0, -53.0, -33.0, -73.0]
    assert codec.feed([frames[0]._replace(extended=False)], T0) is None
    assert codec.stats.skipped == 1


def test_a_counter_in_each_frame_keeps_samples_apart(folder: Path) -> None:
    codec = CanDbc(CanDbcOptions(str(folder / "nested.toml")))
    values = np.arange(12).reshape(3, 4, 1) * -2.0 + 7.0
    first, second, third = codec.encode(chunk_of(codec, values))
    # the end of one sample and the beginning of the next are lost: together they look whole
    samples = decode(codec, [*first[:1], *second[1:], *third])
    assert stacked(samples, "count").tolist() == [0, 1, 2]
    valid = stacked(samples, "valid")
    assert valid.tolist() == [[True, False, False, False], [False, True, True, True], [True] * 4]
    assert codec.stats.incomplete == 2


def test_lost_frames() -> None:
    device, values = pad(), pad_signal(3)
    packets = device.encode(chunk_of(device, values))
    for lost in range(5):
        host = pad()
        samples = decode(
            host, [*packets[0], *packets[1][:lost], *packets[1][lost + 1 :], *packets[2]]
        )
        count, valid = stacked(samples, "count"), stacked(samples, "valid")
        assert count is not None and valid is not None and host.stats.incomplete == 1
        if lost == 0:
            assert count.tolist() == [0, 2]  # who has lost its number is not delivered
        else:
            assert count.tolist() == [0, 1, 2]
            assert valid[1].tolist() == [i != lost - 1 for i in range(4)]
        off = np.abs(stacked(samples, "values") - values[count])[valid]
        assert (off < [0.26e-3, 0.13e-3, 5.1e-3]).all()


def test_commands() -> None:
    device = pad()
    (start,), (stop,) = device.commands(Command.START), device.commands(Command.STOP)
    assert list(start.send) == [CanFrame(0x200, b"\x01\x64")] and start.expect == 0x201
    assert not device.streaming and not device.polls and not device.commands(Command.POLL)
    assert device.respond(start.send)[0].id == 0x201 and device.streaming
    assert not device.respond(stop.send) and not device.streaming


def test_polling(folder: Path) -> None:
    path = folder / "polled.toml"
    path.write_text(PATCH_TOML + '[[command]]\nwhen = "poll"\nid = 0x201\ndata = "0700"\n')
    device = CanDbc(CanDbcOptions(str(path)))
    (poll,) = device.commands(Command.POLL)
    assert device.polls and device.streaming
    device.respond(poll.send)
    assert device.polled == 1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"Taxel3.X"', '"Taxl3.X"', r"channel x: no message 'Taxl3' in .*; did you mean Taxel3\?"),
        ('"Taxel3.X"', '"Taxel3.q"', r"no signal 'q' in message Taxel3 of .*; there are X, Y, Z"),
        ('"Taxel3.X"', '"X"', r"'X' must be written Message.Signal \(did you mean Taxel0.X\?\)"),
        ('x = "Taxel3.X", ', "", r"element T3: no signal for channel x; add one"),
        ('x = "Taxel3.X"', 'xx = "Taxel3.X"', r"element T3: no channel 'xx'; did you mean x\?"),
        ("patch.dbc", "patsch.dbc", r"dbc: .*patsch.dbc: No such file"),
        ("patch.dbc", "bad.dbc", r"bad.dbc: is not a DBC file that cantools reads: .*line 3"),
        ("rate_hz", "rate_hs", r":3: the file has no key 'rate_hs'; did you mean rate_hz\?"),
        ("100.0", "-1.0", r"array 'patch': rate_hz must be positive"),
        ("grid = [0, 1]", "grid = [0, 0]", r"array 'patch': grid repeat"),
        ("rate_hz", 'order = ["Taxel1"]\nrate_hz', r"order: Taxel0 is missing; name every"),
        ("rate_hz", 'counter = { signal = "Taxel0.K" }\nrate_hz', r"counter: no signal 'K'"),
        ("rate_hz", 'command = [{ when = "stop", id = 1, data = "0" }]\nrate_hz', r"data '0' m"),
        ("rate_hz", 'command = [{ when = "go", id = 1 }]\nrate_hz', r"when: 'go' is not one"),
        ("rate_hz", 'command = [{ when = "stop", id = 0x800 }]\nrate_hz', r"0x800 has over"),
        ('unit = "1"\n', 'unit = "1"\nscale = 0.0\n', r"channel x: scale must not be 0"),
    ],
)  # fmt: skip
def test_mistakes_are_named(folder: Path, old: str, new: str, message: str) -> None:
    (folder / "bad.dbc").write_text('VERSION ""\nBU_: Board\nSG_ X\n')
    path = folder / "wrong.toml"
    assert old in PATCH_TOML
    path.write_text(PATCH_TOML.replace(old, new, 1))
    with pytest.raises(ConfigError, match=message) as caught:
        CanDbc(CanDbcOptions(str(path)))
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)


def test_no_mapping_or_no_such() -> None:
    with pytest.raises(ConfigError, match=r"can-dbc needs mapping=FILE.toml"):
        CanDbcOptions()
    with pytest.raises(ConfigError, match=r"nowhere.toml: no such file"):
        CanDbc(CanDbcOptions("nowhere.toml"))


@pytest.mark.parametrize("factor, offset", [("1e308", "0"), ("0.001", "1e300"), ("1e27", "0")])
def test_a_factor_that_no_sensor_has_is_named(folder: Path, factor: str, offset: str) -> None:
    dbc = (folder / "patch.dbc").read_text()
    wrong = re.sub(r"(SG_ X : \S+) \([^)]*\)", rf"\1 ({factor},{offset})", dbc, count=1)
    assert wrong != dbc
    (folder / "patch.dbc").write_text(wrong)
    (folder / "patch.toml").write_text(PATCH_TOML)
    with pytest.raises(ConfigError, match=r"signal X give readings up to .* more than") as caught:
        CanDbc(CanDbcOptions(str(folder / "patch.toml")))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", DBCS)
def test_a_hostile_dbc_file_is_refused(name, tmp_path):
    (tmp_path / "hostile.dbc").write_bytes(DBCS[name]())
    mapping = tmp_path / "mapping.toml"
    mapping.write_text(map_signal("hostile.dbc", "fz", "M.S"))
    url = f"can:virtual:x?codec=can-dbc&mapping={mapping}"
    measured("hz", url).assert_refused("hostile.dbc")
