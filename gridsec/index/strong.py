"""Strong observability and detectability: subspaces hidden by an unknown input.

For `x(k+1) = A x + B a`, `y = C x + D a` with an unknown a. With B = 0 and D the identity on the
manipulated sensors this is a system under attack, which ties chapter 3 of lee2018 to the geometric theory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gridsec.arrays import Floats, unit_rows
from gridsec.index.blocks import kernel, span


@dataclass(frozen=True, slots=True, eq=False)
class Hidden:
    """Motions of a system with an unknown input that cannot be distinguished from rest.

    Attributes
    ----------
    weakly_unobservable : (n, d)
        Basis of the initial states with an input that keeps the output zero for ever.
    controllable : (n, c)
        Basis of those among them that are reached from rest with zero output: the input stays hidden there
        without any effect on the initial state.
    zeros : (d - c,)
        Invariant zeros: the eigenvalues of the remaining motion, which no input can change.
    """

    weakly_unobservable: Floats
    controllable: Floats
    zeros: NDArray[np.complex128]

    @property
    def strongly_observable(self) -> bool:
        """True if zero output implies zero state, for any input."""
        return bool(self.weakly_unobservable.shape[1] == 0)

    def strongly_detectable(self, *, discrete: bool, tol: float) -> bool:
        """True if zero output implies a state that decays, for any input.

        Parameters
        ----------
        discrete
            Sampled time: zeros must have modulus below 1; otherwise a negative real part.
        tol
            Distance from that border within which a zero counts as unstable.

        References
        ----------
        lee2018, Proposition 3.1.10 (iii), corrected: docs/errata/lee2018-chapter-3.md.
        """
        size = np.abs(self.zeros) - 1.0 if discrete else self.zeros.real
        return bool(self.controllable.shape[1] == 0 and np.all(size < -tol))


def hidden(A: Floats, B: Floats, C: Floats, D: Floats, *, tol: float) -> Hidden:
    """Weakly unobservable subspace, its controllable part, and the invariant zeros.

        V_0 = R^n,  V_(k+1) = {x : exists a with A x + B a in V_k, C x + D a = 0}
        T_0 = 0,    T_(k+1) = {A x + B a : x in T_k, C x + D a = 0},   controllable part = V ∩ T

    Parameters
    ----------
    A, B, C, D : (n, n), (n, m), (p, n), (p, m)
        The system, preferably in units with entries of order one.
    tol
        Singular values up to this, times the largest of the system's, count as zero.

    References
    ----------
    H. Trentelman, A. Stoorvogel, M. Hautus, "Control theory for linear systems", Springer, 2001,
    chapter 7; lee2018, section 3.1.2.
    """
    whole = np.block([[A, B], [C, D]])
    size = float(np.linalg.norm(whole, 2)) or 1.0
    A, B, C, D = A / size, B / size, C / size, D / size
    V = _output_nulling(A, B, C, D, tol)
    T = _reachable(A, B, C, D, tol)
    # V ∩ T: combinations V a = T b.
    meet = kernel(np.hstack([V, -T]), tol)
    R = span(V @ meet[: V.shape[1]], tol)
    # A V - V X + B U = 0 and C V + D U = 0; X is the motion inside V, in a basis that begins with R.
    rest = V @ kernel(R.T @ V, tol) if R.shape[1] else V
    basis = np.hstack([R, rest])
    p, d = C.shape[0], basis.shape[1]
    left = np.block([[basis, -B], [np.zeros((p, d)), -D]])
    X = np.linalg.lstsq(left, np.vstack([A @ basis, C @ basis]), rcond=tol)[0][:d]
    inner = X[R.shape[1] :, R.shape[1] :] * size
    zeros = np.linalg.eigvals(inner) if inner.size else np.zeros(0)
    return Hidden(V, R, zeros.astype(np.complex128))


def under_attack(A: Floats, C: Floats, manipulated: Sequence[int], *, tol: float) -> Hidden:
    """`hidden` for the pair (A, C) with arbitrary reports of the sensors in `manipulated`.

    The system `x+ = A x`, `y = C x + I_manipulated a` of the paper's (3.1.6).

    Parameters
    ----------
    A, C : (n, n), (p, n)
        The pair.
    manipulated
        Sensors under the attacker's control.
    tol
        As in `hidden`. A sensor with a row up to this fraction of the longest measures nothing.

    References
    ----------
    lee2018 (3.1.6), Propositions 3.1.3 and 3.1.10.
    """
    # All blocks scaled to the size of A, so that one tolerance suffices: units change no subspace.
    size = float(np.linalg.norm(A, 2)) or 1.0
    unit = unit_rows(C, tol=tol) * size
    D = size * np.eye(C.shape[0])[:, list(manipulated)]
    return hidden(A, np.zeros((A.shape[0], D.shape[1])), unit, D, tol=tol)


def _output_nulling(A: Floats, B: Floats, C: Floats, D: Floats, tol: float) -> Floats:
    n = A.shape[0]
    V = np.eye(n)
    while V.shape[1] > 0:
        outside = np.eye(n) - V @ V.T
        free = np.vstack([outside @ B, D])
        u = span(free, tol)
        image = np.vstack([outside @ A, C])
        image = image - u @ (u.T @ image)
        smaller = np.asarray(V @ kernel(image @ V, tol))
        if smaller.shape[1] == V.shape[1]:
            break
        V = smaller
    return V


def _reachable(A: Floats, B: Floats, C: Floats, D: Floats, tol: float) -> Floats:
    n = A.shape[0]
    T = np.zeros((n, 0))
    for _ in range(n):
        inputs = kernel(np.hstack([C @ T, D]), tol)
        larger = np.asarray(span(np.hstack([A @ T, B]) @ inputs, tol))
        if larger.shape[1] == T.shape[1]:
            break
        T = larger
    return T
