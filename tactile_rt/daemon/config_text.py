"""A configuration as TOML, with all defaults, for `config show`, recordings and the page."""

import json
from typing import Any

import msgspec

from tactile_rt.daemon.config import Config

__all__ = ["config_text"]

SECRETS = ("token", "password", "secret", "key")
HIDDEN = "***"


def config_text(config: Config) -> str:
    """TOML that says the same, but for secrets, which are hidden."""
    lines = [f"version = {config.version}"]
    for table, several in (
        ("source", True), ("model", True), ("publisher", True), ("recorder", False),
        ("page", False), ("metrics", False), ("log", False), ("limits", False),
    ):  # fmt: skip
        found = getattr(config, table)
        for one in found if several else [found] if found is not None else []:
            lines += ["", f"[[{table}]]" if several else f"[{table}]"]
            for key, value in msgspec.structs.asdict(one).items():
                lines.append(f"{key} = {_toml(_hide(key, value))}")
    return "\n".join(lines) + "\n"


def _hide(key: str, value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _hide(k, v) for k, v in value.items()}
    secret = any(key.lower() == s or key.lower().endswith(f"_{s}") for s in SECRETS)
    return HIDDEN if secret and isinstance(value, str) and value else value


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # TOML's basic strings are JSON's, but for the one control character that JSON leaves bare.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, float):
        text = repr(value)
        return text if any(c in text for c in ".en") else f"{text}.0"
    if isinstance(value, dict):
        pairs = [f"{_toml(k)} = {_toml(v)}" for k, v in value.items()]
        inner = ", ".join(pairs)
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return str(value) if isinstance(value, int) else value.isoformat()
