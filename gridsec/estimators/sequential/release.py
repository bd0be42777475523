"""What the trusted meters say where the powers that the others tell are not believed either.

Who lies about the voltage may lie about its powers: the active power of customer k, whose meter is not
trusted, by as much as the search allows for, evenly spread, and the reactive one by half of that. Whether it
does is as likely as not, before the trusted meters are asked. With a its column of 2R, times the standard
deviation of a false power, what they say is a Bayes factor,

    log B_k = (a_T^T Q m)^2 / (2 (1 + a_T^T Q a_T)) - log(1 + a_T^T Q a_T) / 2,

and the variance of what is false of k's power is that of a false one times ``B_k / (1 + B_k)``: where nobody
feels this load its power is doubted for good, where many do and find nothing odd it is believed after all.
With U the columns of 2R and 2X of all these customers, each times its standard deviation, the prior
covariance of `gridsec.estimators.sequential.conditional` is ``S + U U^T``, hence

    C = U - S_:T Q U_T,   G = I + U_T^T Q U_T,
    w' = w + C G^-1 U_T^T Q m,   M' = M + C G^-1 C^T.

At the buses of trusted meters, whose readings have variances D, ``S_TT Q = I - D Q`` leaves
``C = D Q U_T``.

References
----------
Sherman, Morrison and Woodbury's identity; Mitchell and Beauchamp 1988 (spike and slab); here each customer is
asked as if no other lied about powers, and the mixture is taken for the normal distribution of the same
variance. docs/theory-sequential.md, section 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack
from scipy.special import expit

from gridsec.arrays import Floats, Ints, all_of, indices, submatrix
from gridsec.estimators.sequential.bounds import FALSE_Q
from gridsec.estimators.sequential.conditional import Fit, Judged
from gridsec.estimators.sequential.effects import Effects
from gridsec.grid.network import Power


@dataclass(frozen=True, slots=True, eq=False)
class Released:
    """A fit in which liars' powers are not believed. n buses, p meters, l liars.

    Attributes
    ----------
    fit
        The fit, in which they are.
    customers, sizes : (l,)
        Whose powers, and by how much they may be false, pu.
    share : (l,)
        Part of the standard deviation of a false power that was reckoned with.
    seen : (t, 2 l)
        What false powers do to the trusted meters, as standard deviations; the active ones first.
    gram : (2 l, 2 l)
        U_T^T Q U_T of whole standard deviations.
    C : (n, 2 l)
        What such false powers do to every voltage beside what the meters say of it.
    factor : (2 l, 2 l)
        Cholesky factor of G, of the parts that were reckoned with, lower triangle.
    variance : (n,)
        Diagonal of M'.
    """

    fit: Fit
    customers: Ints
    sizes: Floats
    share: Floats
    seen: Floats
    gram: Floats
    C: Floats
    factor: Floats
    variance: Floats

    def said(self, judged: Judged) -> Floats:
        """w', (n,).

        Parameters
        ----------
        judged
            What the fit says.
        """
        both = np.tile(self.share, 2)
        along = both * (judged.weights[self.fit.trusted] @ self.seen)
        amount, _ = lapack.dpotrs(self.factor, along, lower=True)
        return np.asarray(judged.w + self.C @ (both * amount))

    def about(self, fit: Fit, customers: Ints, sizes: Floats) -> bool:
        """Whether `release` would begin with the same, whatever the meters say.

        Parameters
        ----------
        fit, customers, sizes
            As there.
        """
        same = fit is self.fit and np.array_equal(customers, self.customers)
        return same and np.array_equal(sizes, self.sizes)

    def holds(self, judged: Judged) -> bool:
        """Whether the parts that were reckoned with are as good as those that the meters now ask for.

        Parameters
        ----------
        judged
            What the fit says.
        """
        share = _share(self.seen, self.gram, judged.weights[self.fit.trusted])
        return all_of((share <= _MORE * self.share) & (share >= _LESS * self.share))

    def anew(self, judged: Judged) -> Released:
        """The same with the parts that the meters ask for.

        Parameters
        ----------
        judged
            What the fit says.
        """
        share = _share(self.seen, self.gram, judged.weights[self.fit.trusted])
        factor, variance = _parts(self.fit, self.gram, self.C, share)
        return replace(self, share=share, factor=factor, variance=variance)


# Parts of a false power's standard deviation that are as good as one another; and the least.
_MORE, _LESS, _LEAST = 1.25, 0.5, 0.125


def release(effects: Effects, fit: Fit, customers: Ints, sizes: Floats, judged: Judged) -> Released:
    """Doubt some customers' powers; O(n p l).

    Parameters
    ----------
    effects
        Of the feeder.
    fit
        The trusted meters.
    customers, sizes : (l,)
        Whose powers, and by how much the active ones may be false, pu.
    judged
        What the fit says.
    """
    prior, (at, inverse), std = fit.prior, fit.trusting(), sizes / np.sqrt(3.0)
    U = np.empty((prior.variance.size, 2 * sizes.size))
    U[:, : sizes.size] = effects.columns(Power.ACTIVE, customers) * std
    U[:, sizes.size :] = effects.columns(Power.REACTIVE, customers) * (FALSE_Q * std)
    seen = U[prior.meters[at]]
    known = inverse @ seen
    gram = seen.T @ known
    _conditioned(fit, U, known)
    share = _share(seen, gram, judged.weights[at])
    return Released(fit, customers, sizes, share, seen, gram, U, *_parts(fit, gram, U, share))


def _parts(fit: Fit, gram: Floats, C: Floats, share: Floats) -> tuple[Floats, Floats]:
    """The Cholesky factor of G and the diagonal of M' where powers are false by parts of their sizes."""
    both = np.tile(share, 2)
    G = gram * np.multiply.outer(both, both)
    G[np.diag_indices(both.size)] += 1.0
    # Symmetric: the transpose is the same in the order of LAPACK.
    factor, failed = lapack.dpotrf(G.T, lower=True, clean=False, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    variance = fit.variance.copy()
    for first in range(0, len(C), _ROWS):
        rows = slice(first, first + _ROWS)
        half, _ = lapack.dtrtrs(factor, (C[rows] * both).T, lower=True, overwrite_b=True)
        variance[rows] += np.einsum("ij,ij->j", half, half)
    return factor, variance


def _conditioned(fit: Fit, U: Floats, known: Floats) -> None:
    """Put C in the place of U, some rows at a time: they are large where many lie."""
    prior, at = fit.prior, indices(fit.trusted)
    buses, left = prior.meters[at], np.ones(len(U), dtype=np.bool_)
    left[buses] = False
    others, loose = indices(left), fit.loose[buses].T @ known
    for first in range(0, others.size, _ROWS):
        rows = others[first : first + _ROWS]
        U[rows] -= submatrix(prior.of_meters, rows, at) @ known + fit.loose[rows] @ loose
    U[buses] = fit.noise[at, None] * known


# Rows that are worked on together.
_ROWS = 256


def _share(seen: Floats, gram: Floats, weights: Floats) -> Floats:
    """Root of the probability that each power is false, (l,)."""
    count = len(gram) // 2
    form, along = gram.diagonal()[:count], weights @ seen[:, :count]
    odds = 0.5 * (along**2 / (1.0 + form) - np.log1p(form))
    return np.asarray(np.maximum(np.sqrt(expit(odds)), _LEAST))
