"""Documents as JSON takes them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


def without_infinities(document: Any) -> Any:
    """A document with None for numbers that JSON does not have."""
    if isinstance(document, Mapping):
        return {key: without_infinities(value) for key, value in document.items()}
    if isinstance(document, list | tuple):
        return [without_infinities(value) for value in document]
    if isinstance(document, float) and not math.isfinite(document):
        return None
    return document
