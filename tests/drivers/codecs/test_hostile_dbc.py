"""DBC files that are made to exhaust who reads them are refused at once, in one line."""

import pytest

from tests.helpers.dbc_mappings import map_signal
from tests.helpers.hostile_files import DBCS
from tests.helpers.measured import measured

pytest.importorskip("cantools")


@pytest.mark.parametrize("name", DBCS)
def test_a_hostile_dbc_file_is_refused(name, tmp_path):
    (tmp_path / "hostile.dbc").write_bytes(DBCS[name]())
    mapping = tmp_path / "mapping.toml"
    mapping.write_text(map_signal("hostile.dbc", "fz", "M.S"))
    url = f"can:virtual:x?codec=can-dbc&mapping={mapping}"
    measured("hz", url).assert_refused("hostile.dbc")
