"""The papers' examples, computed once for all tests that look at them."""

from __future__ import annotations

from functools import cache
from importlib import import_module

from gridsec.papers.claims import Reproduction
from service.cli.reproduce import PAPERS

REPRODUCE = {paper: import_module(f"gridsec.papers.{paper}").reproduce for paper in PAPERS}


@cache
def made(paper: str) -> Reproduction:
    """What a paper's own `reproduce` hands back, even where a test has put something in its place."""
    found = REPRODUCE[paper]()
    assert isinstance(found, Reproduction)
    return found
