"""Gains and constants of the partial high-gain observers: P(theta), decay, noise, settling times.

    z' = A z + e_n alpha(z) + beta(z) u,    zhat' = the same + K (y - zhat_1),    K = P^{-1} C^T
    0 = -theta P - A^T P - P A + C^T C

In `xi = diag(1, 1/theta, …, 1/theta^{n-1}) (zhat - z)` the error obeys
`xi' = theta (A - Pt^{-1} C^T C) xi + d + theta Pt^{-1} C^T v` with Pt = P(1), and `V = xi^T Pt xi` falls
like `V' <= -theta V / 2 + theta v^2` as soon as `margin` is positive. docs/theory-high-gain.md proves it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from math import comb, sqrt

import numpy as np

from gridsec.arrays import Floats


def riccati(n: int, theta: float) -> Floats:
    """P(theta) in closed form, (n, n): `(-1)^{i+j} C(i+j-2, i-1) / theta^{i+j-1}`.

    n: dimension of the observable part.
    theta: high-gain parameter, 1/s, positive.
    Source: kim2018, the equation after (5); lee2018 (5.2.7).
    """
    out = np.empty((n, n))
    for i, j in product(range(1, n + 1), repeat=2):
        out[i - 1, j - 1] = (-1.0) ** (i + j) * comb(i + j - 2, i - 1) / theta ** (i + j - 1)
    return out


def gain(n: int, theta: float) -> Floats:
    """K = P(theta)^{-1} C^T in closed form, (n,): `C(n, j) theta^j`.

    All eigenvalues of `A - K C` are -theta.

    Arguments as in `riccati`.
    """
    return np.array([comb(n, j) * theta**j for j in range(1, n + 1)], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Decay:
    """`|zhat(t) - z(t)| <= max(eta e^{-rate t} |zhat(0) - z(0)|, epsilon)`, largest entries."""

    eta: float  # overshoot
    epsilon: float  # floor by noise
    rate: float  # 1/s
    origin: str  # derivation: "kim2018", "lee2018" or "componentwise"

    def bound(self, initial: Floats, age: Floats) -> Floats:
        """Bound on the error (…) for its bound `initial` (…) at the start, after `age` (…), s."""
        return np.asarray(np.maximum(self.eta * initial * np.exp(-self.rate * age), self.epsilon))


def decay_kim(n: int, theta: float, noise: float) -> Decay:
    """Constants of kim2018: `eta = sqrt(2 n l2 / l1) theta^{n-1}`, `eps = 4 sqrt(2) Mv theta^{n-1} / l1`.

    noise: M_v, largest absolute value of the measurement noise.
    Source: kim2018, Lemma 1 and its proof in the appendix.
    """
    low, high = _spectrum(n)
    peak = theta ** (n - 1)
    rest = 4.0 * sqrt(2.0) * noise / low * peak
    return Decay(sqrt(2.0 * n * high / low) * peak, rest, theta / 8.0, "kim2018")


def decay_lee(n: int, theta: float, noise: float, *, printed: bool = False) -> Decay:
    """Bound in the form of lee2018 (5.2.8): rate theta / 4, a given floor in place of noise.

    The dissertation states that some eta(theta) exists, without a formula.

    noise: delta of Remark 5.4.1, the floor of the bound.
    printed: False: `eta = sqrt(n l2 / l1) theta^{n-1}`, by the steps of kim2018's appendix without noise.
        True: without the factor sqrt(n). This gives the printed 168; it has no derivation and is inferred
        here.
    Source: lee2018, Lemma 5.2.1 and Remark 5.4.1; docs/errata/kim2018.md.
    """
    low, high = _spectrum(n)
    factor = 1.0 if printed else float(n)
    return Decay(sqrt(factor * high / low) * theta ** (n - 1), noise, theta / 4.0, "lee2018")


def decay_componentwise(n: int, theta: float, noise: float) -> Decay:
    """Own constants: the same Lyapunov function, without a change of norm.

    `|e_j| <= theta^{j-1} sqrt(S_jj V)` with S = Pt^{-1}, `V(t) <= V(0) e^{-theta t / 2} + 2 Mv^2`, and
    V(0) at most the largest value of `xi^T Pt xi` over the corners of the box of initial errors.
    `sqrt(a + b) <= sqrt(2) max` brings it into the form of `Decay`. The rate is twice kim2018's.

    n, theta, noise: as in `decay_kim`; theta at least 1.
    Source: docs/theory-high-gain.md, Theorem 1.
    """
    base = riccati(n, 1.0)
    scale = theta ** np.arange(n, dtype=np.float64)
    corners = np.array(list(product((1.0, -1.0), repeat=n))) / scale
    start = float(np.max(np.einsum("ki,ij,kj->k", corners, base, corners)))
    reach = float(np.max(scale * np.sqrt(np.diagonal(np.linalg.inv(base)))))
    return Decay(reach * sqrt(2.0 * start), 2.0 * reach * noise, theta / 4.0, "componentwise")


def _spectrum(n: int) -> tuple[float, float]:
    values = np.linalg.eigvalsh(riccati(n, 1.0))
    return float(values[0]), float(values[-1])


@dataclass(frozen=True, slots=True, eq=False)
class Slopes:
    """Ranges of the partial derivatives of one sensor's alpha and beta u, over all arguments."""

    # (n, n) entry (j, k): range of the derivative of row j with respect to z_k. Rows before the last are
    # those of `beta_j u`, the last one that of `alpha + beta_n u`; zero above the diagonal
    low: Floats
    high: Floats  # (n, n) upper ends
    proven: bool  # True for rigorous ranges; False for samples


def margin(slopes: Slopes, theta: float) -> float:
    """Margin of the observer's Lyapunov inequality; Lemma 1 holds at this theta if positive.

    Largest mu with `Pt D + D^T Pt <= (theta/2 - mu) Pt` for every D with entries `D_jk = theta^{k-j} s_jk`
    and `s_jk` in its range. The inequality is affine in each s_jk, so that the corners decide.

    slopes: ranges of the derivatives.
    theta: high-gain parameter, 1/s.
    Source: docs/theory-high-gain.md, Theorem 1 (quantifies kim2018's "sufficiently large theta").
    """
    n = slopes.low.shape[0]
    base = riccati(n, 1.0)
    root = np.linalg.cholesky(base)
    power = theta ** (np.arange(n)[None, :] - np.arange(n)[:, None]).astype(np.float64)

    def growth(D: Floats) -> float:
        form = np.linalg.solve(root, np.linalg.solve(root, base @ D + D.T @ base).T)
        return float(np.linalg.eigvalsh(0.5 * (form + form.T))[-1])

    free = np.argwhere(slopes.low < slopes.high)
    if len(free) > _CORNERS:
        # Conservative: `2 |Pt^{1/2} D Pt^{-1/2}|` by centre and radius.
        centre, radius = 0.5 * (slopes.low + slopes.high) * power, 0.5 * (slopes.high - slopes.low) * power
        spread = np.abs(root.T) @ radius @ np.abs(np.linalg.inv(root.T))
        return 0.5 * theta - growth(centre) - 2.0 * float(np.linalg.norm(spread, 2))
    worst = -np.inf
    for pick in product((False, True), repeat=len(free)):
        chosen = slopes.low.copy()
        for (j, k), upper in zip(free, pick, strict=True):
            if upper:
                chosen[j, k] = slopes.high[j, k]
        worst = max(worst, growth(chosen * power))
    return 0.5 * theta - worst


# Number of uncertain entries above which a norm bound replaces the corners.
_CORNERS = 12


def smallest_theta(slopes: Slopes, *, most: float = 1e6, tolerance: float = 1e-6) -> float:
    """Smallest theta >= 1 that satisfies Theorem 1; every larger theta satisfies it too. Infinite if none.

    Below the diagonal `D_jk = theta^{k-j} s_jk` shrinks with theta. With zero in its range the set of all D
    shrinks as well, so that `margin` increases. A range without zero is widened to zero.

    The number is sufficient for Lemma 1, not necessary: (6) can hold at a smaller theta.

    slopes: ranges of the derivatives. An entry above the diagonal, which no uniformly observable system has,
        gives infinity.
    most: largest theta to consider, 1/s.
    Source: docs/theory-high-gain.md, section 2; kim2018, Lemma 1, states that some theta* exists.
    """
    if np.any(np.triu(slopes.low, 1)) or np.any(np.triu(slopes.high, 1)):
        return np.inf
    lower = np.tril(np.ones_like(slopes.low, dtype=np.bool_), -1)
    wide = Slopes(
        np.where(lower, np.minimum(slopes.low, 0.0), slopes.low),
        np.where(lower, np.maximum(slopes.high, 0.0), slopes.high),
        slopes.proven,
    )
    if margin(wide, 1.0) > 0.0:
        return 1.0
    if margin(wide, most) <= 0.0:
        return np.inf
    bad, good = 1.0, most
    while good - bad > tolerance * good:
        middle = sqrt(bad * good)
        bad, good = (bad, middle) if margin(wide, middle) > 0.0 else (middle, good)
    return good


def settling(decay: Decay, z_bound: float) -> tuple[float, float]:
    """Delta_1 and Delta_2, s: settling times of an observer after an attack, without and after a reset.

    decay: the observer's constants, epsilon > 0.
    z_bound: M_z, largest entry of the observable part.
    Source: kim2018 (18a), (18b) with equality.
    """
    start = 2.0 * z_bound * decay.eta
    first = (max(start, decay.epsilon) + 2.0 * z_bound) * decay.eta
    pair = [max(np.log(size / decay.epsilon) / decay.rate, 0.0) for size in (first, start)]
    return float(pair[0]), float(pair[1])
