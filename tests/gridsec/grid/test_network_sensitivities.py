"""What powers do to voltages, kept as a table or made when asked for, against columns one by one."""

from __future__ import annotations

import numpy as np
import pytest

from gridsec.grid import network as module
from gridsec.grid.network import Network, Power, Sensitivities
from tests.gridsec.grid.test_network import phased
from tests.gridsec.meshes import random_mesh
from tests.gridsec.radial import random_feeder
from tests.gridsec.unbalanced import random_phased_mesh

FEEDERS = {
    "radial": lambda: random_feeder(1, customers=9),
    "meshed": lambda: random_mesh(2),
    "three phases": lambda: phased(3),
    "meshed in three phases": lambda: random_phased_mesh(4),
}


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("name", FEEDERS)
def test_numbers_are_active_powers_first(name: str, kept: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    feeder: Network = FEEDERS[name]()
    count, places = feeder.bus.size, len(feeder.buses)
    if not kept:
        monkeypatch.setattr(module, "_KEPT", 0)
        monkeypatch.setattr(module, "_BLOCK", 2)
    sensitivities, rng = Sensitivities(feeder), np.random.default_rng(5)
    assert (sensitivities.table is not None) is kept
    both = [feeder.columns(power, np.arange(count)) for power in Power]
    expected = np.hstack(both)
    assert not np.allclose(*both)
    which = rng.permutation(2 * count)[: count + 1]
    np.testing.assert_allclose(sensitivities.numbered(which), expected[:, which], atol=1e-12)
    for power, own in zip(Power, both, strict=True):
        np.testing.assert_allclose(
            sensitivities.columns(power, which % count), own[:, which % count], atol=1e-12
        )
    at = rng.choice(places, 2)
    np.testing.assert_allclose(np.hstack(list(sensitivities.rows(at))), expected[at], atol=1e-12)
