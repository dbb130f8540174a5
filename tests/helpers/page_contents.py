"""What a report page holds."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import numpy as np


def data_of(page: Path) -> dict[str, Any]:
    """The numbers that its script draws."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.S)
    assert found is not None
    return json.loads(found.group(1))


def floats(text: str) -> np.ndarray:
    """Numbers as the page packs them."""
    return np.frombuffer(base64.b64decode(text), "<f4").astype(float)
