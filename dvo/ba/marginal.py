"""Marginalisation: old states leave a problem, and a linear prior of those that they were tied to stays.

The factors that touch what leaves are linearised, ``r - J d``, and the unknowns that leave are eliminated: by QR of the
weighted rows ``[J_out J_kept r]``, whose lower rows are the prior (square-root form; Demmel et al., "Square root
marginalization for sliding-window bundle adjustment", ICCV 2021), or by a Schur complement of the normal equations,
which is the same in exact numbers and loses half of the digits. The prior is linear in the difference of a state from
where it was linearised, and its Jacobian stays (first-estimate Jacobians; Huang, Mourikis, Roumeliotis, 2010): other
factors that touch such a state keep the null space of the problem if they are linearised there too
(:class:`FirstEstimates`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from dvo.ba.blocks import State, StateBlock
from dvo.ba.layer.linearisation import landmark_count, landmark_part, reduced_part
from dvo.ba.problem import Factor, Linearisation, Problem
from dvo.core.errors import DvoError

Difference = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class LinearPrior(Factor):
    """``|residual - jacobian d|^2``, where ``d`` is the difference of some elements from their first estimates.

    Attributes:
        residual: ``(B, R)`` at the first estimates, whitened.
        jacobian: ``(B, R, C)``, of the tangents of the elements one after the other.
        first: ``(B, V)`` first estimates of the elements one after the other, flattened.
        elements: ``(S,)`` element of each slot.
        blocks: ``S`` names of state blocks.
        differences: ``S`` functions, see :attr:`dvo.ba.blocks.StateBlock.difference`.
        dims: ``S`` sizes of the tangents.
    """

    residual: Tensor
    jacobian: Tensor
    first: Tensor
    elements: Tensor
    blocks: tuple[str, ...]
    differences: tuple[Difference, ...]
    dims: tuple[int, ...]

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        differences = []
        for k, first in enumerate(self._firsts(values)):
            now = values[self.blocks[k]].index_select(1, self.elements[k : k + 1])
            differences.append(self.differences[k](first.expand_as(now), now).flatten(1))
        moved = torch.cat(differences, 1) if differences else self.residual.new_zeros(len(self.residual), 0)
        residual = (self.residual - (self.jacobian @ moved[..., None])[..., 0])[:, None]
        parts = self.jacobian[:, None].expand(len(residual), -1, -1, -1).split(self.dims, -1)
        indices = tuple(self.elements[k : k + 1] for k in range(len(self.blocks)))
        return Linearisation(residual, torch.ones_like(residual), self.blocks, indices, parts)

    def _firsts(self, values: Mapping[str, Tensor]) -> Iterator[Tensor]:
        """First estimates ``(B, 1, ...)`` by slot."""
        shapes = [values[name].shape[2:] for name in self.blocks]
        for first, shape in zip(self.first.split([shape.numel() for shape in shapes], 1), shapes, strict=True):
            yield first.reshape(len(first), 1, *shape)

    def first_estimates(self, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Values of the state blocks with the first estimates in the place of those elements that have them.

        Args:
            values: ``(B, N, ...)`` of the blocks.
        """
        out = dict(values)
        for k, first in enumerate(self._firsts(values)):
            name = self.blocks[k]
            out[name] = out[name].index_copy(1, self.elements[k : k + 1], first.expand_as(out[name][:, :1]))
        return out

    def renumbered(self, numbers: Mapping[str, Tensor]) -> LinearPrior:
        """The same prior after elements have been removed from blocks, or have moved in them.

        Args:
            numbers: by block ``(N,)`` new number of each element; blocks that are not named stay.

        Returns:
            The prior with other ``elements``.

        Raises:
            DvoError: an element of it has a negative number: marginalise it first.
        """
        moved = [
            numbers[name][element] if name in numbers else element
            for name, element in zip(self.blocks, self.elements, strict=True)
        ]
        elements = torch.stack(moved) if moved else self.elements
        if bool((elements < 0).any()):
            raise DvoError("an element of the prior is gone", field="numbers", remedy="marginalise it first")
        return replace(self, elements=elements)


@dataclass(frozen=True)
class FirstEstimates(Factor):
    """A factor with its residual at the present values and its Jacobians where a prior was linearised.

    Attributes:
        factor: any.
        prior: whose first estimates take the place of the present values of its elements.
    """

    factor: Factor
    prior: LinearPrior

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        now = self.factor.linearise(values)
        return replace(now, jacobians=self.factor.linearise(self.prior.first_estimates(values)).jacobians)

    def cost(self, values: Mapping[str, Tensor]) -> Tensor:
        return self.factor.cost(values)

    def tensors(self) -> tuple[Tensor, ...]:
        return *self.factor.tensors(), *self.prior.tensors()

    def indices(self) -> tuple[Tensor, ...]:
        return *self.factor.indices(), *self.prior.indices()

    def with_tensors(self, tensors: Sequence[Tensor]) -> Factor:
        count = len(self.factor.tensors())
        prior = self.prior.with_tensors(tensors[count:])
        assert isinstance(prior, LinearPrior)
        return FirstEstimates(self.factor.with_tensors(tensors[:count]), prior)

    def exact(self) -> Factor:
        prior = self.prior.exact()
        assert isinstance(prior, LinearPrior)
        return FirstEstimates(self.factor.exact(), prior)


def marginalise(
    problem: Problem, leaving: Mapping[str, Tensor], form: Literal["root", "schur"] = "root"
) -> LinearPrior:
    """Eliminate elements of a problem, and all elements of its eliminated block.

    Args:
        problem: factors that touch what leaves, and no others; a factor stays in use elsewhere or goes in here, never
            both. They are linearised at the state, with Jacobians at first estimates where a :class:`FirstEstimates`
            has them. Of patches they are of the generic kind (:class:`dvo.ba.layer.reprojection.PatchReprojection`).
        leaving: by block ``(n,)`` the elements that leave. Fixed elements are constants.
        form: ``root`` by QR of the rows, ``schur`` by the normal equations.

    Returns:
        Prior of those other elements that the factors touch, in double precision. Numbers of elements are those of the
        problem; see :meth:`LinearPrior.renumbered`.

    Raises:
        DvoError: an element whose block has no :attr:`dvo.ba.blocks.StateBlock.difference`, or of which another element
            moves by the same unknown.
    """
    if form not in ("root", "schur"):
        raise DvoError(f"is {form!r}", field="form", remedy="use root or schur")
    state = State({name: _exact(block) for name, block in problem.state.blocks.items()})
    device = next(iter(problem.state.values().values())).device
    with torch.no_grad():
        rows = [_rows(factor.exact().linearise(state.values()), state) for factor in problem.factors]
        jacobian, by_landmark, residual = (torch.cat(x, 1) for x in zip(*rows, strict=True))
        touched = (jacobian != 0).any(0).any(0)
        out, kept = [], []
        slots: list[tuple[str, int, Difference]] = []
        for name in state.offsets:
            block = state[name]
            gone = set(leaving[name].tolist()) if name in leaving else set[int]()
            every = state.rows(name, torch.arange(block.value.shape[1]))
            unknowns = every[every[:, 0] < state.size, 0]
            for element, columns in enumerate(every):
                if columns[0] == state.size:
                    continue
                if element in gone:
                    out.append(columns)
                elif bool(touched[columns].any()):
                    if block.difference is None or len(unknowns.unique()) < len(unknowns):
                        raise DvoError(f"{name!r} cannot be in a prior", field="problem", remedy="hold it")
                    kept.append(columns)
                    slots.append((name, element, block.difference))
        none = torch.zeros(0, dtype=torch.long)
        stays = jacobian[..., torch.cat([*kept, none])]
        leaves = torch.cat((by_landmark, jacobian[..., torch.cat([*out, none])]), -1)
        leaves = leaves[..., (leaves != 0).any(0).any(0)]
        reduce = _by_qr if form == "root" else _by_schur
        root, white = reduce(leaves, stays, residual)
        batch = len(root)
        firsts = [state[name].value[:, element].reshape(batch, -1) for name, element, _ in slots]
        return LinearPrior(
            residual=white.to(device),
            jacobian=root.to(device),
            first=torch.cat([*firsts, root.new_zeros(batch, 0)], 1).to(device),
            elements=torch.tensor([element for _, element, _ in slots], dtype=torch.long, device=device),
            blocks=tuple(name for name, _, _ in slots),
            differences=tuple(difference for _, _, difference in slots),
            dims=tuple(state[name].dim for name, _, _ in slots),
        )


def _exact(block: StateBlock) -> StateBlock:
    """The block on the CPU in double precision."""
    slot = None if block.slot is None else block.slot.cpu()
    return replace(block, value=block.value.detach().cpu().double(), slot=slot)


def _rows(linear: Linearisation, state: State) -> tuple[Tensor, Tensor, Tensor]:
    """Weighted rows ``(B, F * D, .)`` of a factor: by the reduced unknowns, by the landmarks, and the residual."""
    root = linear.weight.sqrt()
    jacobian, columns = reduced_part(linear, state)
    b, f, d = root.shape
    wide = jacobian.new_zeros(b, f, d, state.size + 1)
    place = columns[None, :, None].expand(*jacobian.shape)
    wide = wide.scatter_add(-1, place, jacobian * root[..., None])[..., : state.size]
    count = landmark_count(state)
    by_landmark = jacobian.new_zeros(b, f, d, count + 1)
    found = landmark_part(linear, state)
    if found is not None:
        value, index = found
        by_landmark.scatter_(-1, index[None, :, None, None].expand(b, f, d, 1), (value * root)[..., None])
    flat = (b, f * d)
    return wide.view(*flat, -1), by_landmark[..., :count].reshape(*flat, -1), (root * linear.residual).view(*flat)


def _by_qr(leaves: Tensor, stays: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Prior ``(B, R, C)`` and ``(B, R)``: what no step of what leaves can change, as a triangular factor."""
    gone, columns = leaves.shape[-1], stays.shape[-1]
    leaves = leaves / leaves.norm(dim=1, keepdim=True)  # of any unit
    triangle = torch.linalg.qr(torch.cat((leaves, stays, residual[..., None]), -1), mode="r")[1]
    # an unknown that nothing else holds leaves without taking a row along: the rank counts, not the columns
    u, singular, _ = torch.linalg.svd(triangle[..., :gone])
    rank = int((singular > 1e-12).sum(-1).max()) if gone else 0
    below = torch.linalg.qr(u[..., rank:].mT @ triangle[..., gone:], mode="r")[1][..., :columns, :]
    return below[..., :columns], below[..., columns]


def _by_schur(leaves: Tensor, stays: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """The same by the normal equations and a root of the Schur complement by eigenvalues."""
    mixed = stays.mT @ leaves
    inverse = torch.linalg.pinv(leaves.mT @ leaves, rtol=1e-12, hermitian=True)
    hessian = stays.mT @ stays - mixed @ inverse @ mixed.mT
    gradient = (stays.mT - mixed @ inverse @ leaves.mT) @ residual[..., None]
    values, vectors = torch.linalg.eigh((hessian + hessian.mT) / 2)
    good = values > 1e-12 * values[..., -1:]
    root = torch.where(good, values, 0.0).sqrt()[..., None] * vectors.mT
    inverse_root = torch.where(good, values, 1.0).rsqrt() * good
    return root, (inverse_root[..., None] * (vectors.mT @ gradient))[..., 0]
