"""On the site the reference of a module has all docstrings and signatures, where the page's own text has a table.

its heading, <!-- api: salver.contact_margins --> ... <!-- end -->    becomes    ::: salver.contact_margins
"""

from __future__ import annotations

import re
from typing import Any


def on_page_markdown(markdown: str, **_: Any) -> str:
    return re.sub(r"## `salver[\w.]*`\n\n<!-- api: ([\w.]+) -->\n.*?<!-- end -->", r"::: \1", markdown, flags=re.S)
