"""What is installed only where it is asked for."""

from __future__ import annotations

__all__ = ["extra"]


def extra(name: str) -> str:
    """Return what is missing, and how to get it, as the end of a sentence.

    Parameters
    ----------
    name
        The extra, as in pyproject.toml.
    """
    return f"the extra {name!r}, in a checkout: pip install -e '.[{name}]'"
