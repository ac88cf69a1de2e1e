"""What a mistake is answered with: one line that says what is wrong."""

from collections.abc import Callable
from typing import Any

import pytest

from tactile_rt.core.errors import ConfigError


def refusal(work: Callable[..., Any], *arguments: Any, **options: Any) -> str:
    """Call what must raise a `ConfigError` of one line, and return that line."""
    with pytest.raises(ConfigError) as caught:
        work(*arguments, **options)
    said = str(caught.value)
    assert "\n" not in said
    return said
