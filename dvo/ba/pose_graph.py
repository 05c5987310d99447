"""Pose graphs: absolute poses from relative ones, in SE(3) or Sim(3).

The residual of an edge is ``e = chart(M_ij T_i T_j^-1)`` for a measurement ``M_ij`` of ``T_j T_i^-1``, weighted by an
information matrix; with the chart "log" that of :class:`dvo.ba.factors.RelativePose`. With camera-to-world poses
``X = T^-1`` and ``Z_ij = M_ij^-1`` it is ``chart(Z_ij^-1 X_i^-1 X_j)``, the error of g2o (Kuemmerle et al., "g2o: a
general framework for graph optimization", 2011). In Sim(3) each pose has a scale of its own, so that a loop can correct
drift of scale (Strasdat, Montiel and Davison, "Scale drift-aware large scale monocular SLAM", 2010).

Poses of a trajectory that drifted far lie in the basin of a poor local minimum. The problem is therefore started from
the poses given, from those of a spanning tree or from a linear relaxation, whichever cost least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import torch
from torch import Tensor

from dvo.ba.blocks import free_slots
from dvo.ba.checks import REAL, WHOLE, check_kind, check_tensor, check_within
from dvo.ba.kernels import Kernel
from dvo.ba.limits import HEAVIEST
from dvo.ba.planar_edges import PLANE, cotangent_terms, flattened, in_plane, planar_edges
from dvo.ba.pose_graph_start import relaxation, spanning_tree
from dvo.ba.sparse.equations import SparseSystem
from dvo.ba.sparse.levenberg import LMOptions, levenberg_marquardt
from dvo.ba.sparse.multifrontal import scipy_is_installed
from dvo.ba.sparse.schur_pattern import make_schur_pattern
from dvo.core.context import full_precision, use_threads
from dvo.core.errors import DvoError
from dvo.geometry import se3, sim3, so3

Chart = Literal["log", "split", "quaternion"]
"""Coordinates of an error ``(R, t)`` or ``(s, R, t)``: "log" is the logarithm of the group; "split" is ``[t, log R]``,
that of 2-D graphs; "quaternion" is ``[t, q_xyz]`` with ``q_w >= 0``, that of 3-D graphs in g2o files. In Sim(3)
``log s`` comes last."""
Start = Literal["given", "tree", "relaxation"]


@dataclass(frozen=True)
class PoseGraphOptions:
    """Settings of :func:`optimise_pose_graph`.

    Attributes:
        fixed: how many leading poses stay, or which: bool ``(N,)``.
        chart: coordinates of the residual.
        kernel: robust kernel on ``e^T Omega e``.
        solver: of Levenberg-Marquardt and its linear systems. The damping is close to none at first, as the best start
            is near the minimum as a rule, and directions of little curvature matter. "auto" is "fronts" on the CPU
            where SciPy is installed, else "tiles".
        start: "best" is that of least chi2 of the poses given, a spanning tree and a linear relaxation; "given" keeps
            to the poses given.
    """

    fixed: int | Tensor | Sequence[bool] = 1
    chart: Chart = "log"
    kernel: Kernel = field(default_factory=Kernel)
    solver: LMOptions = field(default_factory=lambda: LMOptions(max_iterations=100, damping=1e-12, decrease=0.1))
    start: Literal["best", "given"] = "best"

    def __post_init__(self) -> None:
        check_kind(self.kernel, "kernel", Kernel)
        check_kind(self.solver, "solver", LMOptions)


LOOP_OPTIONS = PoseGraphOptions(solver=LMOptions(max_iterations=100, damping=1e-6, solver="tiles"), start="given")
"""Of a trajectory whose loops were found as it went on: its poses are near, and the result is the same with and without
the optional SciPy."""


@dataclass(frozen=True)
class PoseGraphResult:
    """Outcome of :func:`optimise_pose_graph`.

    Attributes:
        poses_cw: ``(N, 7)`` or ``(N, 8)``.
        initial_chi2, chi2: sum of ``e^T Omega e`` (of its kernel), without a factor 1/2, before and after.
            Before is of the poses given, whatever the start.
        iterations: steps tried.
        converged: whether a criterion was met before the limit of iterations.
        start: what was started from.
        start_chi2: of the start.
    """

    poses_cw: Tensor
    initial_chi2: float
    chi2: float
    iterations: int
    converged: bool
    start: Start
    start_chi2: float


def optimise_pose_graph(
    poses_cw: Tensor,
    ii: Tensor,
    jj: Tensor,
    measurements: Tensor,
    information: Tensor | None = None,
    options: PoseGraphOptions = PoseGraphOptions(),  # noqa: B008 (frozen)
) -> PoseGraphResult:
    """Minimise ``sum e^T Omega e`` over the edges of a pose graph.

    Args:
        poses_cw: ``(N, 7)`` world to camera for SE(3), or ``(N, 8)`` similarities for Sim(3).
        ii, jj: ``(E,)`` frames of each edge.
        measurements: ``(E, 7)`` or ``(E, 8)``, of ``T_j T_i^-1``.
        information: ``(E, D, D)`` symmetric, ``(E, D)`` diagonal, or None for the identity; ``D`` is 6 or 7, in the
            order of the chart.
        options: see :class:`PoseGraphOptions`.

    Returns:
        Poses of the lowest chi2 found, and how it went.

    Raises:
        DvoError: types, shapes or indices that do not fit, numbers that are not finite or larger than 1e8 (information:
            1e16), scales that are not positive, or information that is not positive semi-definite.

    Example:
        >>> result = optimise_pose_graph(poses_cw, ii, jj, measurements)
        >>> result.poses_cw, result.chi2
    """
    use_threads()
    check_kind(options, "options", PoseGraphOptions)
    dim = _check(poses_cw, ii, jj, measurements, options)
    ii, jj = ii.long(), jj.long()
    with torch.no_grad(), full_precision(poses_cw.device):
        measurements = measurements.to(poses_cw)
        full = _full_information(information, dim, len(ii))
        plane = in_plane(poses_cw, measurements, full)
        axes = list(PLANE) if plane else list(range(dim))
        root = None
        if full is not None:
            diagonal = information is not None and information.dim() == 2
            root = _square_root(full[:, axes][:, :, axes] if plane else full, poses_cw, diagonal)
        slot, free = free_slots(options.fixed, len(poses_cw), poses_cw.device)
        group = se3 if dim == 6 else sim3
        none = torch.zeros(0, dtype=torch.long, device=ii.device)
        pattern = make_schur_pattern(free, none, none, none, slot[ii], slot[jj])
        solver = options.solver
        if solver.solver == "auto":
            fronts = poses_cw.device.type == "cpu" and scipy_is_installed()
            solver = replace(solver, solver="fronts" if fronts else "tiles")

        def whitened(poses: Tensor) -> Tensor:
            if plane:
                e, _, _ = planar_edges(poses, ii, jj, measurements, options.chart, False)
            else:
                e = residuals(poses, ii, jj, measurements, options.chart)
            return e if root is None else (root @ e[..., None])[..., 0]

        def cost(poses: Tensor) -> float:
            s = whitened(poses).square().sum(-1)
            return 0.5 * float(options.kernel.cost(s).sum(dtype=torch.float64))

        def linearise(poses: Tensor) -> SparseSystem:
            if plane:
                e, j_i, j_j = planar_edges(poses, ii, jj, measurements, options.chart, True)
                assert j_i is not None and j_j is not None
            else:
                e, j_i, j_j = residuals_and_jacobians(poses, ii, jj, measurements, options.chart)
            if root is not None:
                e, j_i, j_j = (root @ e[..., None])[..., 0], root @ j_i, root @ j_j
            weight = options.kernel.slope(e.square().sum(-1, keepdim=True)).expand_as(e)
            zeros, unknowns = poses.new_zeros, len(axes)
            system = SparseSystem(
                pattern, zeros(pattern.h_pp.count, unknowns, unknowns), zeros(0, unknowns), zeros(0),
                zeros(free, unknowns), zeros(0), False,
            )  # fmt: skip
            system.add(e, weight, [(slot[ii], -j_i), (slot[jj], -j_j)])
            return system

        def move(poses: Tensor, step: tuple[Tensor, Tensor]) -> Tensor:
            change = step[0]
            if plane:
                change = change.new_zeros(free, dim).index_copy_(1, torch.tensor(axes, device=change.device), change)
            moved = group.retract(poses, torch.nn.functional.pad(change, (0, 0, 0, 1))[slot])
            return torch.where((slot == free)[:, None], poses, moved)

        begin, initial = poses_cw, None
        start: Start = "given"
        if options.start == "best" and free and solver.max_iterations > 0:
            initial = cost(poses_cw)
            least = initial
            tree = spanning_tree(poses_cw, ii, jj, measurements, full, slot == free)
            same = bool((tree.roots == (slot == free)).all())
            loose = relaxation(tree, ii, jj, measurements, full, solver.solver, pattern.h_pp if same else None)
            candidates: tuple[tuple[Start, Tensor], ...] = (("tree", tree.poses), ("relaxation", loose))
            for name, poses in candidates:
                poses = flattened(poses) if plane else poses
                found = cost(poses)
                if found < least:  # False for NaN
                    begin, start, least = poses, name, found
        outcome = levenberg_marquardt(begin, linearise, cost, move, solver)
    before = outcome.initial_cost if initial is None else initial
    return PoseGraphResult(
        outcome.state, 2 * before, 2 * outcome.cost, outcome.iterations, outcome.converged, start,
        2 * outcome.initial_cost,
    )  # fmt: skip


def residuals(poses_cw: Tensor, ii: Tensor, jj: Tensor, measurements: Tensor, chart: Chart = "log") -> Tensor:
    """Errors ``(E, D)`` of edges; arguments as of :func:`optimise_pose_graph`."""
    error, _ = _errors(poses_cw, ii, jj, measurements)
    return _coordinates(error, chart)


def residuals_and_jacobians(
    poses_cw: Tensor, ii: Tensor, jj: Tensor, measurements: Tensor, chart: Chart = "log"
) -> tuple[Tensor, Tensor, Tensor]:
    """Errors of edges and their derivatives by left perturbations ``T <- Exp(xi) T`` of both poses.

    ``M Exp(a) T_i (Exp(b) T_j)^-1 = E Exp(Ad(T_j T_i^-1) a - b)`` to first order, hence ``J_j = -C`` and
    ``J_i = C Ad(T_j T_i^-1)``, where ``C`` is the derivative of the chart by a right perturbation of ``E``.

    Args:
        poses_cw, ii, jj, measurements: as of :func:`optimise_pose_graph`.
        chart: coordinates of the residual.

    Returns:
        ``e (E, D)``, ``J_i (E, D, D)`` and ``J_j (E, D, D)``.
    """
    error, motion = _errors(poses_cw, ii, jj, measurements)
    e = _coordinates(error, chart)
    by_right = _chart_jacobian(error, e, chart)
    adjoint = se3.adjoint(motion) if e.shape[-1] == 6 else sim3.adjoint(motion)
    return e, by_right @ adjoint, -by_right


def _inverse_right_jacobian(xi: Tensor) -> Tensor:
    """Of SE(3): ``x / (1 - e^-x)`` at ``x = ad(xi)``, in closed form.

    The even part is ``1 + a x^2 + b x^4``, as ``x (x^2 + theta^2)^2 = 0``; at ``x^2 = -theta^2`` it takes the value
    ``1 - f theta^2`` of :func:`dvo.ba.planar_edges.cotangent_terms`, and its derivative.
    """
    x = _small_adjoint(xi)
    square = xi[..., 3:6].square().sum(-1)[..., None, None]
    f, slope = cotangent_terms(square)
    xx = x @ x
    eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    return eye + 0.5 * x + (f - 0.5 * slope * square) * xx - 0.5 * slope * (xx @ xx)


def right_jacobian(xi: Tensor) -> Tensor:
    """Right Jacobian of the exponential of SE(3) or Sim(3): ``Exp(xi + d) = Exp(xi) Exp(J_r d)`` to first order.

    ``J_r = phi(-ad(xi))`` with ``phi(x) = (e^x - 1) / x``: a Taylor series at ``x / 8``, then three doublings
    ``phi(2 x) = (e^x + 1) phi(x) / 2``. The quadrature of :func:`dvo.geometry.sim3.left_jacobian` gives the same from
    256 rotations for each element, too much for graphs of many thousand edges.

    Args:
        xi: ``(..., 6)`` or ``(..., 7)``, angle at most pi.

    Returns:
        ``(..., 6, 6)`` or ``(..., 7, 7)``.
    """
    x = -_small_adjoint(xi) / 8
    eye = torch.eye(xi.shape[-1], dtype=xi.dtype, device=xi.device)
    phi = eye + x / 13
    for order in range(12, 1, -1):
        phi = eye + x @ phi / order
    power = eye + x @ phi
    for _ in range(3):
        phi, power = 0.5 * (power @ phi + phi), power @ power
    return phi


def _small_adjoint(xi: Tensor) -> Tensor:
    """``ad(xi)``, the derivative of the adjoint of ``Exp(xi)`` at the identity."""
    tau, phi = so3.hat(xi[..., :3]), so3.hat(xi[..., 3:6])
    dim = xi.shape[-1]
    out = xi.new_zeros(*xi.shape[:-1], dim, dim)
    out[..., :3, :3] = out[..., 3:6, 3:6] = phi
    out[..., :3, 3:6] = tau
    if dim == 7:
        out[..., :3, :3].diagonal(dim1=-2, dim2=-1).add_(xi[..., 6:])
        out[..., :3, 6] = -xi[..., :3]
    return out


def _errors(poses_cw: Tensor, ii: Tensor, jj: Tensor, measurements: Tensor) -> tuple[Tensor, Tensor]:
    """``M T_i T_j^-1`` and ``T_j T_i^-1``."""
    a, b = poses_cw.index_select(0, ii), poses_cw.index_select(0, jj)
    group = se3 if poses_cw.shape[-1] == 7 else sim3
    motion = group.compose(b, group.inverse(a))
    return group.normalise(group.compose(measurements, group.inverse(motion))), motion


def _coordinates(error: Tensor, chart: Chart) -> Tensor:
    if chart == "log":
        return se3.log(error) if error.shape[-1] == 7 else sim3.log(error)
    t, q, scale = error[..., :3], error[..., 3:7], error[..., 7:].log()
    if chart == "split":
        return torch.cat((t, so3.log(q), scale), -1)
    return torch.cat((t, torch.where(q[..., 3:] < 0, -q[..., :3], q[..., :3]), scale), -1)


def _chart_jacobian(error: Tensor, e: Tensor, chart: Chart) -> Tensor:
    """Derivative ``(E, D, D)`` of the coordinates ``e`` of an error by a right perturbation of it."""
    if chart == "log":
        return _inverse_right_jacobian(e) if e.shape[-1] == 6 else torch.linalg.inv(right_jacobian(e))
    q = error[..., 3:7]
    q = torch.where(q[..., 3:] < 0, -q, q)
    dim = error.shape[-1] - 1
    out = error.new_zeros(*error.shape[:-1], dim, dim)
    out[..., :3, :3] = so3.matrix(q) * (error[..., 7:, None] if dim == 7 else 1.0)
    out[..., 6:, 6:] = 1
    eye = torch.eye(3, dtype=error.dtype, device=error.device)
    if chart == "split":
        phi, factor = so3.log_terms(q)
        cross = so3.hat(phi)
        out[..., 3:6, 3:6] = eye + 0.5 * cross + factor[..., None] * (cross @ cross)
    else:
        out[..., 3:6, 3:6] = 0.5 * (q[..., 3:, None] * eye + so3.hat(q[..., :3]))
    return out


def _full_information(information: Tensor | None, dim: int, edges: int) -> Tensor | None:
    """``(E, D, D)`` float64."""
    if information is None:
        return None
    check_tensor(information, "information", REAL, None)
    if information.shape not in ((edges, dim, dim), (edges, dim)):
        raise DvoError(
            f"has shape {tuple(information.shape)}", field="information", remedy=f"give ({edges}, {dim}, {dim})"
        )
    full = information.double() if information.dim() == 3 else torch.diag_embed(information.double())
    check_within(full, "information", -HEAVIEST, HEAVIEST)
    return full


def _square_root(full: Tensor, like: Tensor, diagonal: bool) -> Tensor:
    """``(E, D, D)`` with ``root^T root = information``."""
    lower, info = torch.linalg.cholesky_ex(full)
    if not diagonal and not bool(info.any()):
        return lower.mT.to(like)
    values, vectors = torch.linalg.eigh(full)
    if bool((values < -1e-9 * values.abs().amax(-1, keepdim=True)).any()):
        raise DvoError("has a negative eigenvalue", field="information", remedy="give positive semi-definite matrices")
    return (values.clamp(min=0).sqrt()[..., None] * vectors.mT).to(like)


def _check(poses_cw: Tensor, ii: Tensor, jj: Tensor, measurements: Tensor, options: PoseGraphOptions) -> int:
    """Dimension of the tangent."""
    device = getattr(poses_cw, "device", None)
    for name, tensor in (("poses_cw", poses_cw), ("measurements", measurements)):
        check_tensor(tensor, name, REAL, device)
    for name, tensor in (("ii", ii), ("jj", jj)):
        check_tensor(tensor, name, WHOLE, device)
        if tensor.dim() != 1:
            raise DvoError(f"has shape {tuple(tensor.shape)}", field=name, remedy="give (E,)")
    if poses_cw.dim() != 2 or poses_cw.shape[-1] not in (7, 8):
        raise DvoError(f"has shape {tuple(poses_cw.shape)}", field="poses_cw", remedy="give (N, 7) or (N, 8)")
    if options.chart not in get_args(Chart):
        raise DvoError(f"unknown chart {options.chart!r}", field="chart", remedy="use log, split or quaternion")
    if options.start not in ("best", "given"):
        raise DvoError(f"unknown start {options.start!r}", field="start", remedy="use best or given")
    if poses_cw.dtype not in (torch.float32, torch.float64):
        raise DvoError(f"has dtype {poses_cw.dtype}", field="poses_cw", remedy="use float32 or float64")
    wanted = (len(ii), poses_cw.shape[1])
    if measurements.shape != wanted or len(jj) != len(ii):
        raise DvoError(f"has shape {tuple(measurements.shape)}", field="measurements", remedy=f"give {wanted}")
    for name, index in (("ii", ii), ("jj", jj)):
        if len(index) and (int(index.min()) < 0 or int(index.max()) >= len(poses_cw)):
            raise DvoError(f"has an index outside 0..{len(poses_cw) - 1}", field=name, remedy="give existing frames")
    for name, tensor in (("poses_cw", poses_cw), ("measurements", measurements)):
        check_within(tensor, name)
        check_within(torch.linalg.vector_norm(tensor[:, 3:7], dim=-1), f"{name}, length of quaternions", 0.95, 1.05)
        check_within(tensor[:, 7:], f"{name}, scales", 1e-8)
    return poses_cw.shape[1] - 1
