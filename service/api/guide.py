"""Pages beside the web page: the operator guide, and Swagger UI of the OpenAPI description.

The guide is `docs/operator-guide.md` as HTML with named sections. Files of Swagger UI are in `web/swagger`.
"""

from __future__ import annotations

import re
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Final

from markdown_it import MarkdownIt
from starlette.requests import Request
from starlette.responses import HTMLResponse

from service.api.errors import SECURITY_POLICY

ADDRESS: Final = "/operator-guide"
"""Path of the guide, as in `web/dom.js`."""
DOCS: Final = "/api/v1/docs"
"""Path of Swagger UI, beside the OpenAPI description."""
DOCS_POLICY: Final = SECURITY_POLICY.replace("img-src 'self'", "img-src 'self' data:")
"""Content security policy of Swagger UI: the icons of its style sheet are `data:` addresses."""
_HERE = Path(__file__).parent
_FILES = (_HERE.with_name("web") / "operator-guide.md", _HERE.parents[1] / "docs" / "operator-guide.md")
"""The guide of an installed package, and of a source tree."""
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark"><title>Operator guide – gridsec</title>
<link rel="icon" href="icon.svg" type="image/svg+xml"><link rel="stylesheet" href="style.css"></head>
<body><article class="guide">{}</article></body></html>
"""

_DOCS = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>REST interface – gridsec</title>
<link rel="icon" href="../../icon.svg" type="image/svg+xml">
<link rel="stylesheet" href="../../swagger/swagger-ui.css"></head>
<body><div id="swagger-ui"></div>
<script src="../../swagger/swagger-ui-bundle.js"></script><script src="../../swagger/open.js"></script>
</body></html>
"""


def section(heading: str) -> str:
    """Return the name of a section as in GitHub's links: small letters, hyphens between words."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@cache
def page() -> str:
    """Return the guide as HTML, without pictures; links to other documents are texts."""
    file = next(file for file in _FILES if file.is_file())
    reader = MarkdownIt("commonmark").enable("table")
    tokens = reader.parse(file.read_text(encoding="utf-8"))
    for opening, inline in pairwise(tokens):
        if opening.type == "heading_open":
            opening.attrSet("id", section(inline.content))
    for token in tokens:
        token.children = [each for each in token.children or () if each.type != "image"]
        for link in token.children:
            if link.type == "link_open" and not str(link.attrGet("href")).startswith("#"):
                link.attrs = {}
    return _PAGE.format(reader.renderer.render(tokens, reader.options, {}))


def show(_: Request) -> HTMLResponse:
    """Answer a request of the guide."""
    return HTMLResponse(page(), headers={"Cache-Control": "no-cache"})


def show_docs(_: Request) -> HTMLResponse:
    """Answer a request of Swagger UI."""
    headers = {"Cache-Control": "no-cache", "Content-Security-Policy": DOCS_POLICY}
    return HTMLResponse(_DOCS, headers=headers)
