from __future__ import annotations

import json
import math

from caliv_graph.common.json_text import without_infinities


def test_json_has_no_infinity() -> None:
    document = {"sigma": math.inf, "rows": [(1.0, math.nan)], "text": "inf", "count": 3}

    plain = without_infinities(document)

    assert plain == {"sigma": None, "rows": [[1.0, None]], "text": "inf", "count": 3}
    json.dumps(plain, allow_nan=False)
