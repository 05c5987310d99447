"""Normal equations with a block-diagonal landmark part, solved by Schur complement and damped Cholesky.

    [ H_pp   H_pl ] [ dp ]   [ g_p ]
    [ H_pl^T H_ll ] [ dl ] = [ g_l ]

``P`` pose unknowns are few, ``K`` landmarks are many and do not couple among themselves: ``H_ll`` has one ``m x m``
block per landmark (``m = 1`` for an inverse depth, 3 for a point). See Triggs et al., "Bundle adjustment - a modern
synthesis", 6.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.ba.limits import RETRIES


def factorise(s: Tensor) -> tuple[Tensor, Tensor]:
    """Cholesky factors, with damping where the plain factorisation fails.

    Damping of 1e-6 to 0.1 of the largest diagonal entry is tried in turn; where that fails too, or ``s`` is not finite,
    the factor is the identity.

    Args:
        s: ``(B, P, P)`` symmetric.

    Returns:
        Lower factors ``(B, P, P)``, and ``(B,)`` bool, true where the factor is one of ``s`` (damped if need be).
    """
    factor, info = torch.linalg.cholesky_ex(s)
    if sums_up(factor) and not info.any():
        return factor, info == 0
    ok = (info == 0) & torch.isfinite(factor).all(-1).all(-1)
    if bool(ok.all()):  # the only place of a step where an accelerator is waited for
        return factor, ok
    eye = torch.eye(s.shape[-1], dtype=s.dtype, device=s.device)
    finite = torch.isfinite(s).all(-1).all(-1)
    s = torch.where(finite[:, None, None], s, eye)
    boost = s.diagonal(dim1=-2, dim2=-1).abs().amax(-1).clamp(min=torch.finfo(s.dtype).tiny) * 1e-6
    for _ in range(RETRIES):
        again, info = torch.linalg.cholesky_ex(s + boost[:, None, None] * eye)
        solved = finite & ~ok & (info == 0)
        factor = torch.where(solved[:, None, None], again, factor)
        ok = ok | solved
        boost = boost * 10
    return torch.where(ok[:, None, None], factor, eye), ok


def sums_up(*tensors: Tensor) -> bool:
    """True if tensors are on the CPU, where a look costs no wait, and are known to be finite by their sums."""
    return all(x.device.type == "cpu" and math.isfinite(x.sum().item()) for x in tensors)


def solve_with(factor: Tensor, ok: Tensor, y: Tensor) -> Tensor:
    """Solve ``L L^T x = y``.

    Args:
        factor, ok: of :func:`factorise`.
        y: ``(B, P)``.

    Returns:
        ``x (B, P)``, zero where the factor is not ``ok`` or the result is not finite.
    """
    x = torch.cholesky_solve(y[..., None], factor)[..., 0]
    if sums_up(x) and ok.all():
        return x
    return torch.where((ok & torch.isfinite(x).all(-1))[:, None], x, 0.0)


def damped(s: Tensor, absolute: float | Tensor, relative: float | Tensor) -> Tensor:
    """Damped matrix ``s + absolute I + relative diag(s)`` for ``s (B, P, P)``."""
    return s + torch.diag_embed(s.diagonal(dim1=-2, dim2=-1) * relative + absolute)


def invert_blocks(h_ll: Tensor) -> Tensor:
    """Inverse of landmark blocks ``(B, K, m, m)``; zero for a landmark that nothing observes."""
    if h_ll.shape[-1] == 1:
        seen = h_ll > 0
        return torch.where(seen, 1 / torch.where(seen, h_ll, 1.0), 0.0)
    inverse, info = torch.linalg.inv_ex(h_ll)
    good = (info == 0)[..., None, None] & torch.isfinite(inverse).all(-1, keepdim=True).all(-2, keepdim=True)
    return torch.where(good, inverse, 0.0)


@dataclass(frozen=True)
class SchurFactor:
    """The system at the top of this file with its landmarks eliminated, for any right-hand side.

    Attributes:
        h_pl: ``(B, P, K, m)``.
        q: ``(B, K, m, m)`` inverse of ``h_ll``.
        factor: ``(B, P, P)`` Cholesky factor of the damped reduced system.
        ok: ``(B,)`` true where the factorisation succeeded; elsewhere poses do not move.
    """

    h_pl: Tensor
    q: Tensor
    factor: Tensor
    ok: Tensor

    def solve(self, g_p: Tensor, g_l: Tensor) -> tuple[Tensor, Tensor]:
        """``dp (B, P)`` and ``dl (B, K, m)`` for ``g_p (B, P)`` and ``g_l (B, K, m)``."""
        b, p, k, m = self.h_pl.shape
        flat = self.h_pl.reshape(b, p, k * m)
        weighted = _times_blocks(g_l[:, None], self.q).reshape(b, k * m, 1)
        dp = solve_with(self.factor, self.ok, g_p - (flat @ weighted)[..., 0])
        rest = g_l - (flat.mT @ dp[..., None]).view(b, k, m)
        return dp, _times_blocks(rest[:, None], self.q)[:, 0]


def eliminate(
    h_pp: Tensor, h_pl: Tensor, h_ll: Tensor, absolute: float | Tensor = 0.0, relative: float | Tensor = 0.0
) -> SchurFactor:
    """Eliminate the landmarks and factor what is left.

    Args:
        h_pp: ``(B, P, P)``.
        h_pl: ``(B, P, K, m)``.
        h_ll: ``(B, K, m, m)``, with any damping included; a block that is not positive counts as unobserved.
        absolute, relative: damping of the reduced system ``S``: ``S + absolute I + relative diag(S)``.
    """
    q = invert_blocks(h_ll)
    weighted = _times_blocks(h_pl, q).flatten(-2)
    factor, ok = factorise(damped(h_pp - weighted @ h_pl.flatten(-2).mT, absolute, relative))
    return SchurFactor(h_pl, q, factor, ok)


def _times_blocks(x: Tensor, q: Tensor) -> Tensor:
    """Rows ``x (B, R, K, m)`` times symmetric blocks ``q (B, K, m, m)``."""
    if q.shape[-1] == 1:
        return x * q[:, None, :, 0]
    return (x.transpose(1, 2) @ q).transpose(1, 2)
