"""Times of JSON objects: each time in Unix seconds has a twin `<name>_utc` as in RFC 3339.

A class with `UtcTwins` as its first base gets a computed field for each field with the name of a time. The
names are those of the columns of tables. `dump_python(..., round_trip=True)` leaves the twins out.
"""

from __future__ import annotations

import re
from datetime import datetime, timedelta
from functools import partial
from inspect import get_annotations
from typing import Annotated, Any, Final

from pydantic import Field, computed_field

_TIME: Final = re.compile(r"t(_[a-z]+)?|(.+_)?(since|until)|expires|expected|learned_at|kept|died|delivered")
"""Names of fields with a time, Unix s."""
_EPOCH: Final = datetime(1970, 1, 1)  # without the offset that isoformat would add
_Utc = Annotated[str, Field(json_schema_extra={"format": "date-time"})]


def rfc3339(t: float | None) -> str | None:
    """Return a Unix time, s, as in RFC 3339 to the millisecond; None beyond the years 1 to 9999."""
    if t is None:
        return None
    try:
        return (_EPOCH + timedelta(milliseconds=round(1e3 * t))).isoformat(timespec="milliseconds") + "Z"
    except (OverflowError, ValueError):
        return None


def is_time(name: str) -> bool:
    """True for the name of a field with a time."""
    return _TIME.fullmatch(name) is not None


class UtcTwins:
    """Base of a dataclass or model: adds the twin of each field that is a time."""

    __slots__ = ()

    def __init_subclass__(cls, **options: Any) -> None:
        """Add the computed fields before pydantic or `dataclass` reads the class."""
        super().__init_subclass__(**options)
        names = (name for base in cls.__mro__ for name in get_annotations(base))
        for name in filter(is_time, names):
            text = f"`{name}` as in RFC 3339; null where it is null."
            make = computed_field(return_type=_Utc | None, description=text)
            setattr(cls, f"{name}_utc", make(property(partial(_twin, name))))


def _twin(name: str, one: object) -> str | None:
    return rfc3339(getattr(one, name))
