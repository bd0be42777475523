"""Manipulated meters from one set of readings, without time: hypotheses, likelihood, collusion."""

from gridsec.estimators.snapshot.identification import SnapshotExplanation, identify
from gridsec.estimators.snapshot.likelihood import Curved, ErrorPrior, FalsePowers

__all__ = ["Curved", "ErrorPrior", "FalsePowers", "SnapshotExplanation", "identify"]
