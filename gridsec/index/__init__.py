"""Redundant observability and detectability, and the security indices (lee2018, chapter 3)."""

from gridsec.index.blocks import Sparsest, fewest, kernel, row_space
from gridsec.index.feeder import FeederIndex, feeder_index, linearise, slopes
from gridsec.index.pairs import (
    Index,
    asymptotic_index,
    dynamic_index,
    observability,
    observable_rows,
    redundant_detectable,
    redundant_observable,
    static_index,
    undetectable_subspace,
    unobservable_subspace,
)
from gridsec.index.spectrum import Eigenspace, eigenspaces, stable_subspace, unstable_subspace
from gridsec.index.strong import Hidden, hidden, under_attack

__all__ = [
    "Eigenspace",
    "FeederIndex",
    "Hidden",
    "Index",
    "Sparsest",
    "asymptotic_index",
    "dynamic_index",
    "eigenspaces",
    "feeder_index",
    "fewest",
    "hidden",
    "kernel",
    "linearise",
    "observability",
    "observable_rows",
    "redundant_detectable",
    "redundant_observable",
    "row_space",
    "slopes",
    "stable_subspace",
    "static_index",
    "under_attack",
    "undetectable_subspace",
    "unobservable_subspace",
    "unstable_subspace",
]
