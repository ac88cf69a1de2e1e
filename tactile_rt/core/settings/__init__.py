"""Conversion of a user's settings to typed structs, with uniform error messages.

TOML files, ``--set key=value``, the ``?option=value`` of a URL and the rows of a CSV file all
become a tree of `SettingNode`, in which every value has its place in the text; `convert` turns it
into a struct or a dataclass. An error is one line::

    robot.toml:5: page.port: expected a whole number <= 65535, got 70000
    serial:/dev/ttyUSB0 has no option 'boud'; did you mean baud?
    --set page.prot=1: page has no key 'prot'; did you mean port?
    loads.csv:3: fx: expected a number, got '1,2'

tree      the tree, and parsing of TOML
structs   conversion of a tree to a struct, with error messages
written   settings that are text only: ``--set``, URLs, CSV
"""

from tactile_rt.core.settings.structs import convert, hint, nearest, no_such, refusal
from tactile_rt.core.settings.tree import (
    SettingNode,
    find_lines,
    format_path,
    make_node,
    parse_toml,
    read_text,
    read_toml,
)
from tactile_rt.core.settings.written import (
    CsvTable,
    check_columns,
    read_csv,
    set_key,
    set_keys,
    split_url,
    take_options,
    take_sets,
)

__all__ = [
    "CsvTable",
    "SettingNode",
    "check_columns",
    "convert",
    "find_lines",
    "format_path",
    "hint",
    "make_node",
    "nearest",
    "no_such",
    "parse_toml",
    "read_csv",
    "read_text",
    "read_toml",
    "refusal",
    "set_key",
    "set_keys",
    "split_url",
    "take_options",
    "take_sets",
]
