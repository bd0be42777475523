"""Commands run in this process, from `main` to the exit code."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from html import unescape

import pytest

from service.cli.main import main

Run = Callable[..., tuple[int, str, str]]


def command(*names: str) -> Run:
    """What runs `gridsec NAMES`: exit code, output, and what is said on the error stream."""

    def run(
        monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str
    ) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["gridsec", *names, *arguments])
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            main()
        told = capsys.readouterr()
        return int(end.value.code or 0), told.out, told.err

    return run


def text_of(html: str) -> str:
    """A page, or a part of it, as it is read: without marks."""
    return unescape(re.sub("<[^>]*>", "", html))


def plain(text: str) -> str:
    """A message without its frame and its line breaks."""
    return " ".join(text.replace("│", " ").split())
