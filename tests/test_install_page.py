"""docs/start/which-install.md names every extra that can be asked for."""

import re
import tomllib

from tests.helpers.source_tree import ROOT

PAGE = (ROOT / "docs" / "start" / "which-install.md").read_text("utf-8")


def test_every_extra_has_its_row() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    rows = re.findall(r"^\| .+? \| (`.+?`) \| [\d,]+ \|", PAGE, re.M)
    named = [extra for row in rows for extra in re.findall(r"`(\w+)`", row)]
    assert sorted(named) == sorted(project["optional-dependencies"])


def test_every_python_is_named() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    tested = [c.rpartition(" ")[2] for c in project["classifiers"] if ":: 3." in c]
    assert tested and all(version in PAGE for version in tested)
