"""Estimators of other packages: entry points of the group `gridsec.estimators`.

The name of an entry point is the estimator's name; it refers to a `feeders.registry.registry.Estimator` of
that name. Names are read without running external code; an estimator is loaded on first use.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

from feeders.format.columns import GROUP
from gridsec.errors import DesignInfeasible, GridsecError, NotObservable

if TYPE_CHECKING:
    from feeders.model.site import Site
    from feeders.registry.estimator import DesignOptions


class EstimatorUnusable(GridsecError):
    """An estimator of another package cannot be used."""

    code = "estimator-unusable"


def load(name: str, kind: type) -> Any:
    """Load the estimator of that name, of `feeders.format.columns.foreign_estimators`.

    Raises EstimatorUnusable if there is none or more than one, if its code fails, or if its type is not
        `kind` or its name wrong.
    """
    points = tuple(entry_points(group=GROUP, name=name))
    if len(points) != 1:
        raise EstimatorUnusable(f"estimator {name!r}: {len(points)} packages offer it; expected one")
    try:
        made = points[0].load()
    except Exception as failure:  # external code may raise anything
        raise EstimatorUnusable(
            f"estimator {name!r} ({_where(points[0])}) cannot be loaded: {failure}"
        ) from failure
    if not isinstance(made, kind) or getattr(made, "name", None) != name:
        raise EstimatorUnusable(
            f"estimator {name!r} ({_where(points[0])}) is no {kind.__name__} of that name"
        )
    return made


def design(name: str, make: Callable[[Site, DesignOptions], Any], site: Site, job: DesignOptions) -> Any:
    """Design by the function `make` of another package.

    Raises NotObservable, DesignInfeasible if the function raises it; EstimatorUnusable if the function raises
        anything else.
    """
    try:
        return make(site, job)
    except (NotObservable, DesignInfeasible):
        raise
    except Exception as failure:  # external code may raise anything
        why = " ".join(f"{type(failure).__name__}: {failure}".split())
        raise EstimatorUnusable(
            f"estimator {name!r} cannot be designed for {site.feeder.name}: {why}"
        ) from failure


def _where(point: EntryPoint) -> str:
    package = "" if point.dist is None else f" of {point.dist.name}"
    return f"{point.value}{package}"
