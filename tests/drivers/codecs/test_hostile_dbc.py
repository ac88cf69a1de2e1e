"""DBC files that are made to exhaust who reads them are refused at once, in one line."""

import pytest

from tests.helpers.hostile_files import DBCS
from tests.helpers.measured import measured

pytest.importorskip("cantools")

MAPPING = """
dbc = "hostile.dbc"
name = "pad"
rate_hz = 100.0
[[channel]]
name = "fz"
unit = "N"
[[element]]
name = "T0"
grid = [0, 0]
signals = { fz = "M.S" }
"""


@pytest.mark.parametrize("name", DBCS)
def test_a_hostile_dbc_file_is_refused(name, tmp_path):
    (tmp_path / "hostile.dbc").write_bytes(DBCS[name]())
    mapping = tmp_path / "mapping.toml"
    mapping.write_text(MAPPING)
    url = f"can:virtual:x?codec=can-dbc&mapping={mapping}"
    measured("hz", url).assert_refused("hostile.dbc")
