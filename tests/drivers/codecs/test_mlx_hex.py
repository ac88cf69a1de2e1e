"""The MLX90393 whisker that prints hexadecimal digits."""

import numpy as np
import pytest

from tactile_rt.drivers.codecs.mlx_hex import MlxHex, MlxHexOptions
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked


def mlx_hex(**options: float) -> MlxHex:
    return MlxHex(MlxHexOptions(**options))


def signal(n: int = 40, most: float = 3e-3) -> np.ndarray:
    return np.random.default_rng(1).uniform(-most, most, size=(n, 1, 3))


class TestDefaults(CodecContract):
    case = CodecCase(mlx_hex, signal, 0.13e-6, checked=False)


class TestFinest(CodecContract):
    """Offset binary, as the chip counts with more than 16 bits."""

    case = CodecCase(
        lambda: mlx_hex(gain=0, resolution=2, hallconf=0), signal, 2.6e-6, checked=False
    )


# Lines as the firmware's source writes them, by hand: the three status bytes after exit, reset and
# start; 100, -100 and 32767 counts; then with capitals and a carriage return, no field, and a
# status byte of letters only.
GOLDEN = b"01\n05\n83\n820064ff9c7fff - 862\n8200640000FFFF - 8\r\nea000000000000 - 1000000\n"


def test_golden_lines() -> None:
    codec = mlx_hex()
    samples = codec.feed(GOLDEN, T0)
    assert samples.values[:, 0] == pytest.approx(
        np.array([[15e-6, -15e-6, 32767 * 0.242e-6], [15e-6, 0, -0.242e-6], [0, 0, 0]]), rel=1e-6
    )
    assert samples.status.tolist() == [0x82, 0x82, 0xEA] and samples.valid.all()
    assert codec.stats.corrupt == 0 and codec.stats.skipped == 6 and codec.stats.intact == 3


@pytest.mark.parametrize(
    ("options", "digits", "tesla"),
    [
        ({"gain": 0}, "0001ffff0002", [0.751, -0.751, 2.420]),
        ({"resolution": 1}, "000180000000", [0.300, -32768 * 0.300, 0]),
        ({"resolution": 2}, "800180007fff", [0.600, 0, -0.968]),
        ({"resolution": 3}, "400140003fff", [1.200, 0, -1.936]),
        ({"hallconf": 0}, "000100010001", [0.157, 0.157, 0.253]),
    ],
)
def test_counts_mean_what_the_chip_is_set_to(options, digits, tesla):
    samples = mlx_hex(**options).feed(f"82{digits} - 850\n".encode(), T0)
    assert samples.values[0, 0] == pytest.approx(1e-6 * np.array(tesla), rel=1e-6)


def test_an_error_bit_makes_a_sample_invalid() -> None:
    codec = mlx_hex()
    assert set(codec.status_bits) == {2, 3, 4}
    samples = codec.feed(b"92000100020003 - 850\n8a000100020003 - 850\n", T0)
    assert samples is not None and samples.valid.tolist() == [[False], [True]]


def test_an_emulated_chip_saturates_and_fails() -> None:
    codec = mlx_hex()
    chunk = chunk_of(codec, signal(3))
    chunk.values[0, 0] = [1.0, -1.0, 0.0]  # T
    chunk.values[1, 0, 2] = np.nan
    chunk.valid[2] = False
    packets = codec.encode(chunk)
    assert packets[0] == b"827fff80000000 - 850\n"
    samples = mlx_hex().feed(b"".join(packets), T0)
    assert samples is not None and samples.valid[:, 0].tolist() == [True, False, False]
    top = mlx_hex(resolution=3).encode(chunk)[0]
    assert top == b"827fff00004000 - 850\n"


@pytest.mark.parametrize(
    ("hurt", "lost"),
    [
        (lambda lines: [*lines[:3], lines[3].replace(b"\n", b"-"), *lines[4:]], 2),
        (lambda lines: [*lines[:3], lines[3][:7] + b"\n" + lines[3][8:], *lines[4:]], 1),
        (lambda lines: [*lines[:3], lines[3][:9], *lines[4:]], 2),
        (lambda lines: [*lines[:3], b"x" * 20 + b"\n", *lines[4:]], 1),
        (lambda lines: [*lines[:3], b"01\n", b"05\n", b"83\n", *lines[3:]], 0),
    ],
)
def test_damaged_lines_are_counted_as_the_samples_they_were(hurt: object, lost: int) -> None:
    codec = mlx_hex()
    lines = codec.encode(chunk_of(codec, signal(10)))
    samples = codec.feed(b"".join(hurt(lines)), T0)
    assert codec.stats.corrupt == lost == samples.damaged.sum()


def test_joining_in_the_middle_of_a_line_is_no_damage() -> None:
    codec = mlx_hex()
    wire = b"".join(codec.encode(chunk_of(codec, signal(5))))
    for start in range(1, 21):
        host = mlx_hex()
        samples = host.feed(wire[start:], T0)
        assert samples is not None and len(samples) == 4
        assert host.stats.corrupt == 0


def test_a_line_without_end_does_not_pile_up() -> None:
    stream = b"82000100020003 - 850\n" + b"8" * 1000 + b"\n82000100020003 - 850\n"
    whole, cut = mlx_hex(), mlx_hex()
    a, b = decode(whole, stream), decode(cut, stream, range(1, len(stream)))
    assert stacked(a, "damaged").tolist() == stacked(b, "damaged").tolist() == [0, 48]
    assert whole.stats == cut.stats
