"""Options that no device can have are refused in one line, whatever the codec."""

import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.opening import make_codec

WRONG = [
    ("serial anyskin", "magnetometers", "0", "magnetometers must be 1 to 64, not 0"),
    ("serial hx711_whisker", "whiskers", "10", "whiskers must be 1 to 9, not 10"),
    ("serial hx711_whisker", "rate_hz", "inf", "rate_hz: inf is not a finite number"),
    ("serial mlx_hex", "gain", "8", "gain must be 0 to 7, not 8"),
    ("serial mlx_hex", "resolution", "4", "resolution must be 0 to 3, not 4"),
    ("serial mlx_hex", "hallconf", "1", "hallconf must be 12 or 0, not 1"),
    ("serial mlx_hex", "rate_hz", "0", "rate_hz must be positive, not 0"),
    ("serial bota", "sinc", "20", "sinc must be 51 to 512"),
    ("serial bota", "baud", "1000000", "baud must be one of 9600"),
    ("serial tsf85", "signals", "all", "signals"),
    ("serial tsf85", "fingers", "3", "fingers"),
    ("serial tsf85", "period_ms", "0", "1 to 255"),
    ("serial ati_485", "slave", "0", "must be"),
    ("serial ft300", "slave", "0", "slave must be a Modbus address, 1 to 247, not 0"),
    ("can optoforce", "model", "5d", "model must be one of 3d, 4x3d, 6d"),
    ("can optoforce", "rate_hz", "200", "rate_hz must be one of 1000, 333, 100, 30, 10, not 200"),
    ("can optoforce", "filter_hz", "1", "filter_hz must be one of 0, 500, 150, 50, 15, 5, 1.5, no"),
    ("can optoforce", "counts", "1,2", "counts must be 3 numbers"),
    ("can optoforce", "counts", "1,2,0", "counts must be positive"),
    ("can optoforce", "host_id", "0x800", "host_id must be from 0 to 0x7ff, not 0x800"),
    ("can ati_can", "base", "128", "base must be from 0 to 0x7f, not 0x80"),
    ("can ati_can", "calibration", "16", "calibration must be from 0 to 15, or -1, not 16"),
    ("can icub_skin", "board", "16", "board must be from 0 to 15, not 16"),
    ("can icub_skin", "triangles", "0-16", "triangles must be from 0 to 15, not '0-16'"),
    ("can icub_skin", "triangles", "a", "triangles must be numbers and ranges like 0-6,9, not 'a'"),
    ("can icub_skin", "firmware", "newer", "firmware must be new or old, not 'newer'"),
    ("can icub_skin", "period_ms", "0", "period_ms must be from 1 to 255, not 0"),
    ("can aft200", "rate_hz", "2000", "rate_hz must be from 15.3 to 1000, not 2000"),
    ("can aft200", "sensor", "256", "sensor must be from 0 to 255"),
    ("can aft200", "force_id", "2047", "force_id must be from 0 to 0x7fe, not 0x7ff"),
    ("can xela", "board", "256", "board must be from 0 to 255, not 256"),
    ("can xela", "first_id", "2033", "first_id must be from 0 to 0x7f0, not 0x7f1"),
]


@pytest.mark.parametrize(("codec", "option", "value", "says"), WRONG)
def test_an_option_that_cannot_be_is_named(codec, option, value, says):
    with pytest.raises(ConfigError) as caught:
        make_codec(*codec.split(), {option: value})
    assert says in str(caught.value) and "\n" not in str(caught.value)
