"""The example of the document does what the document says."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np


def test_the_example_of_the_document() -> None:
    text = (Path(__file__).parents[4] / "docs" / "theory-decoding.md").read_text(encoding="utf-8")
    example = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert len(example) == 1
    space: dict[str, Any] = {}
    exec(compile(example[0], "theory-decoding.md", "exec"), space)
    assert space["index"].count == 5
    assert np.allclose(space["answer"].x, [1.0, -2.0, 0.5])
    assert np.flatnonzero(space["answer"].in_error).tolist() == [0, 3]
    assert space["bounds"].kappa_c > 0
