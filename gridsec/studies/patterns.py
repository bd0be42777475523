"""Where lies can hide: the unknown part of a feeder's voltages as a pair (A, C).

Powers that nobody knows move all squared voltages by ``W c``, c constant while it is looked at. The inverters
react. About a trajectory with slopes d of the droop curves,

    x' = A x + G diag(d) (H x - W_inverters c),   c' = 0,   y = C x - W_meters c

is a pair whose eigenvalue 0 holds what stays, a *persistent pattern*, and whose other eigenvalues hold what
the inverters forget by themselves. Lies are hidden while they look like such a pattern.

References
----------
lee2018, chapter 3; docs/theory-studies.md, section 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr
from scipy.sparse.csgraph import connected_components

from gridsec.arrays import Bools, Floats, Ints, unit_rows
from gridsec.errors import InputInvalid, Problem
from gridsec.index import Index, Sparsest, eigenspaces, fewest, kernel, linearise
from gridsec.index.blocks import MOST_NODES, Matrix
from gridsec.index.rows import fewest_rows
from gridsec.lure import Lure
from gridsec.network import Network, Power, between, busbar_places, one_busbar

__all__ = ["Patterns", "fewest_meters", "from_busbar", "patterns", "unknown_pair", "unknown_voltages"]


@dataclass(frozen=True, slots=True, eq=False)
class Patterns:
    """The directions in which lies can hide: eigenspaces of a pair. n states, p meters.

    Attributes
    ----------
    spaces : (n, g) each
        Orthonormal bases of the eigenspaces to search.
    seen : (p, g) each
        What the meters see of them, each meter's row of C scaled to length one, or zero.
    tol
        Products of unit vectors up to this are zero.
    """

    spaces: tuple[Matrix, ...]
    seen: tuple[Matrix, ...]
    tol: float

    @property
    def dimension(self) -> int:
        """Of all spaces together."""
        return sum(space.shape[1] for space in self.spaces)

    def blind(self, live: Bools) -> Floats:
        """Basis of what none of the live meters sees, real and imaginary parts side by side, (n, k)."""
        lost = [
            space @ kernel(seen[live], self.tol) for space, seen in zip(self.spaces, self.seen, strict=True)
        ]
        whole = np.hstack(lost) if lost else np.zeros((0, 0))
        return np.hstack([whole.real, whole.imag]) if np.iscomplexobj(whole) else np.asarray(whole)


def unknown_voltages(feeder: Network, unknown: Ints, *, busbar: bool, tol: float) -> Floats:
    """Orthonormal basis W of what unknown powers can do to the customers' squared voltages, (N, d).

    The range of ``[2 R_U, 2 X_U]``, and where the busbar's voltage is unknown too, of a column of ones; in
    three phases of a column for each, ones where its customers are. Powers that move no customer's voltage
    are no unknowns: they harm nobody.

    Parameters
    ----------
    feeder
        The feeder.
    unknown : (k,)
        Customers whose active and reactive powers nobody knows.
    busbar
        Whether the busbar's voltage is unknown as well.
    tol
        A power moves nothing if its column is up to this part of the longest. Singular values up to this
        part of the largest, of columns of unit length, are zero.
    """
    powers = np.hstack([between(feeder, power)[:, unknown] for power in Power])
    columns = unit_rows(powers.T, tol=tol).T
    if busbar:
        columns = np.hstack([columns, unit_rows(from_busbar(feeder).T, tol=tol).T])
    if not columns.any():
        return np.zeros((feeder.bus.size, 0))
    _, s, vh = np.linalg.svd(columns, full_matrices=False)
    some = s > tol * s[0]
    # The left singular vectors, but every row as exact as that of its customer: those of the decomposition
    # are as exact as the longest, and of a customer beside the busbar nothing would be left but rounding.
    return np.asarray(columns @ (vh[some].T / s[some]))


def from_busbar(feeder: Network) -> Floats:
    """What each voltage of the busbar does to the customers' squared voltages, (N, 1), or (N, 3) in phases.

    Parameters
    ----------
    feeder
        The feeder.
    """
    first = busbar_places(feeder)
    of_each = one_busbar(feeder, feeder.bus, np.arange(first.stop))
    return np.array(np.broadcast_to(of_each, (feeder.bus.size, first.stop)))


def unknown_pair(lure: Lure, slope: Floats, W: Floats) -> tuple[Floats, Floats]:
    """The pair (A, C) of the module's head, its states scaled to like size.

    Parameters
    ----------
    lure
        Closed loop, from `close_loop`.
    slope : (m,)
        Slope of each droop curve.
    W : (N, d)
        From `unknown_voltages`.
    """
    A, C = linearise(lure, slope)
    # Injections in units of the voltages that they make: no subspace changes, and ranks become decidable.
    # What inverters do to each other is in it, since meters may see none of them.
    unit = float(np.linalg.norm(np.vstack([lure.C, lure.H]), 2)) or 1.0
    d = W.shape[1]
    whole = np.block([[A, -unit * (lure.G * slope) @ lure.F @ W], [np.zeros((d, A.shape[0] + d))]])
    return whole, np.hstack([C / unit, -lure.D @ W])


def patterns(A: Floats, C: Floats, *, persistent: bool, tol: float) -> Patterns:
    """The eigenspaces in which an attack can stay invisible for ever.

    Parameters
    ----------
    A, C : (n, n), (p, n)
        A pair in continuous time.
    persistent
        Only of eigenvalues that do not decay: attacks that die away by themselves are left out, and
        observability becomes detectability.
    tol
        As in `gridsec.index.dynamic_index`: rows of C up to this part of the longest see nothing, too.
    """
    found = eigenspaces(A, tol=tol) if A.size else ()
    if persistent:
        found = tuple(each for each in found if each.unstable(discrete=False, tol=tol))
    rows = unit_rows(C, tol=tol)
    spaces: list[Matrix] = []
    for each in found:
        # A real eigenvalue has real eigenvectors, and real arithmetic is four times as fast.
        real = abs(each.value.imag) <= tol and float(np.abs(each.vectors.imag).max(initial=0.0)) <= tol
        spaces.append(each.vectors.real if real else each.vectors)
    return Patterns(tuple(spaces), tuple(np.asarray(rows @ space) for space in spaces), tol)


def fewest_meters(
    given: Patterns,
    *,
    honest: Bools | None = None,
    silent: Bools | None = None,
    must: int | None = None,
    below: float = 0.0,
    most: int = MOST_NODES,
) -> Index:
    """The fewest meters that must lie to imitate a pattern that any of the live meters sees.

    Patterns that nobody sees (`Patterns.blind`) need no lies and are left out.

    Parameters
    ----------
    given
        The patterns.
    honest : (p,), optional
        Meters that cannot lie: only patterns that none of them sees are left.
    silent : (p,), optional
        Meters that are not there.
    must
        A meter that is to be among the liars.
    below, most
        As in `gridsec.index.fewest`.

    Returns
    -------
    Index
        Infinite where there is no pattern to imitate.

    Raises
    ------
    DesignInfeasible
        After `most` nodes.
    ValueError
        If a meter must lie that is honest or silent.
    """
    p = given.seen[0].shape[0] if given.seen else 0
    none = np.zeros(p, dtype=np.bool_)
    silent = none if silent is None else silent[:p]
    bound = none if honest is None else honest[:p] & ~silent
    free = np.flatnonzero(~bound & ~silent)
    if must is not None and p and must not in free:
        raise InputInvalid([Problem("inconsistent", f"meter {must} must lie, but is honest or silent")])
    at = None if must is None else int(np.searchsorted(free, must))
    best = Index(np.inf, np.zeros(0, dtype=np.intp), np.zeros(0))
    for space, seen in zip(given.spaces, given.seen, strict=True):
        left = kernel(seen[bound], given.tol) if bound.any() else np.eye(space.shape[1])
        for part in _components(seen[free] @ left, given.tol):
            found = _fewest(seen[free] @ (left @ part), at, given.tol, below=below, most=most)
            if found.count < best.count:
                best = Index(found.count, free[found.blocks], space @ (left @ part @ found.direction))
    return best


def _fewest(seen: Matrix, must: int | None, tol: float, *, below: float, most: int) -> Sparsest:
    if seen.shape[1] == 1:
        # One direction: there is nothing to choose.
        who = np.flatnonzero(np.abs(seen[:, 0]) > tol)
        if must is None or must in who:
            return Sparsest(float(who.size), who, np.ones(1))
        return Sparsest(np.inf, who[:0], np.zeros(0))
    found = None if below > 0.0 else fewest_rows(seen, tol=tol, must=must)
    if found is not None:
        return found
    return fewest(list(seen[:, None, :]), np.eye(seen.shape[1]), tol=tol, must=must, below=below, most=most)


def _components(seen: Matrix, tol: float) -> list[Matrix]:
    """Split what is seen into subspaces that share no meter: a sparsest direction lies in one of them.

    In a basis that is the identity at as many meters as it has directions, these are the connected components
    of the bipartite graph of its entries: those of the matroid of the rows.

    Parameters
    ----------
    seen : (p, g)
        What each meter sees of a basis.
    tol
        What counts as zero.

    Returns
    -------
    (g, k) each
        Orthonormal bases; what nobody sees is left out.
    """
    # Counts do not depend on what nobody sees, so its complement will do.
    _, sizes, vh = np.linalg.svd(seen, full_matrices=False)
    basis = np.asarray(vh[: int(np.count_nonzero(sizes > tol))].conj().T)
    if basis.shape[1] <= 1:
        return [basis] if basis.size else []
    seen = seen @ basis
    _, _, pivots = qr(seen.conj().T, mode="economic", pivoting=True)
    change = np.linalg.inv(seen[pivots[: basis.shape[1]]])
    linked = (np.abs(seen @ change) > tol).astype(np.intp)
    count, label = connected_components(linked.T @ linked, directed=False)
    basis = basis @ change
    return [np.asarray(np.linalg.qr(basis[:, label == k])[0]) for k in range(count)]
