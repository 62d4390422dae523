"""Keys that stand twice in one object of a JSON text: readers differ in which of the two values they take."""

import json
from typing import Any

__all__ = ["repeated_key"]


class _TwiceError(Exception):
    """Carries the key out of the parser."""

    def __init__(self, key: str) -> None:
        super().__init__(key)
        self.key = key


def repeated_key(content: bytes) -> str | None:
    """Find the first key that stands twice in one object; None if there is none.

    Parameters
    ----------
    content : bytes
        Sound JSON.
    """
    try:
        json.loads(content, object_pairs_hook=_once_each, parse_float=str, parse_int=str)
    except _TwiceError as error:
        return error.key
    return None


def _once_each(pairs: list[tuple[str, Any]]) -> None:
    keys = [key for key, _ in pairs]
    if len(set(keys)) < len(keys):
        raise _TwiceError(next(key for place, key in enumerate(keys) if key in keys[:place]))
