"""Pictures of the page in the documents: every view at both sizes and in both schemes, each shown."""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path

from PIL import Image

from docs.pictures import SCHEMES, SIZES, VIEWS

DOCS = Path(__file__).parents[1] / "docs"
PAGE = DOCS / "page"
NAMES = {"-".join(each): each[1] for each in product((*VIEWS, "login"), SIZES, SCHEMES)}
MOST_BYTES = 4_000_000
"""Largest size of all pictures, bytes."""


def test_every_view_has_its_pictures_and_there_are_no_others() -> None:
    assert {path.stem for path in PAGE.iterdir()} == {*NAMES}
    assert {path.suffix for path in PAGE.iterdir()} == {".png"}
    assert sum(path.stat().st_size for path in PAGE.iterdir()) < MOST_BYTES
    for name, size in NAMES.items():
        with Image.open(PAGE / f"{name}.png") as picture:
            assert picture.size == SIZES[size], name
            assert len(picture.getcolors(1 << 20) or ()) > 16, f"{name} is empty"


def test_every_picture_is_shown_in_a_document() -> None:
    shown: set[str] = set()
    for path in DOCS.glob("*.md"):
        shown |= {*re.findall(r"\]\(page/([a-z-]+)\.png\)", path.read_text(encoding="utf-8"))}
    assert shown == {*NAMES}
