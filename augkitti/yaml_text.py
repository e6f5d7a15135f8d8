"""A YAML file that a user wrote in, its plain values out: no objects, no aliases, no more than 64 KiB."""

from pathlib import Path
from typing import Any

import yaml

from augkitti.errors import InputError

_MAX_BYTES = 64 * 1024  # a configuration has 5 kB; the parser takes a second for 100 kB


class _PlainLoader(yaml.SafeLoader):
    """PyYAML's safe loader without aliases: merges of aliases of aliases take memory without end."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases (`*name`) are not read here")
        return super().compose_node(parent, index)


def read_yaml(path: Path, remedy: str) -> Any:
    """The values of a file; None of an empty one.

    Args:
        path: of the file.
        remedy: what the user can do about a bad one.

    Raises:
        InputError: missing, not UTF-8, larger than 64 KiB, not YAML, or with aliases, tags or nesting without end.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise InputError(path, "larger than 64 KiB", remedy)
        return yaml.load(path.read_text(encoding="utf-8"), Loader=_PlainLoader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError, ValueError, RecursionError) as err:
        reason = " ".join(str(err).split())[:200] or type(err).__name__  # ValueError: dates and numbers out of range
        raise InputError(path, f"not readable as YAML ({reason})", remedy) from err
