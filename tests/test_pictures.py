"""Pictures of the page in the documents: all are there, small, and of the stated sizes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from docs import pictures

PAGE = Path(__file__).parents[1] / "docs" / "page"
MOST_BYTES = 4e6


def test_every_view_has_its_pictures() -> None:
    names = {
        f"{v}-{size}-{s}.png"
        for v in (*pictures.VIEWS, "login")
        for size in pictures.SIZES
        for s in pictures.SCHEMES
    }
    files = sorted(PAGE.glob("*.png"))
    assert {file.name for file in files} == names
    assert sum(file.stat().st_size for file in files) < MOST_BYTES
    for file in files:
        with Image.open(file) as image:
            assert image.size == pictures.SIZES[file.stem.rsplit("-", 2)[1]]
            assert image.mode == "P"


def test_a_reduced_picture_keeps_its_frequent_colours() -> None:
    draw = np.random.default_rng(1)
    pixels = draw.integers(0, 256, (60, 60, 3)).astype(np.uint8)
    pixels[:30], pixels[30:40] = (243, 245, 247), (161, 24, 47)
    made = pictures.reduced(Image.fromarray(pixels))
    assert len(made.getcolors() or []) <= pictures.COLOURS
    assert (np.asarray(made.convert("RGB"))[:40] == pixels[:40]).all()


def test_the_fleet_has_four_attacks_and_an_outage() -> None:
    stations = pictures.fleet(60)
    assert len({station.name for station in stations}) == 60
    assert sum(bool(station.attack) for station in stations) == 4
    assert [station.silent for station in stations if station.silent] == [1.0, 0.05]
