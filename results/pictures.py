"""Pictures of the documentation, in a third of the bytes."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

COLORS = 256


def store(source: Path, place: Path) -> None:
    """Writes a PNG with a palette of its own; `source` and `place` may be the same file."""
    with Image.open(source) as picture:
        small = picture.convert("RGB").quantize(COLORS, dither=Image.Dither.NONE)
    small.save(place, optimize=True)
