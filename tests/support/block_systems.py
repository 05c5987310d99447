"""Positive definite systems of blocks, for tests of sparse solvers."""

import torch
from hypothesis import strategies as st

PAIRS = st.lists(st.tuples(st.integers(0, 30), st.integers(0, 30)), max_size=60)


def system(size, pairs, dim, seed):
    """Blocks of the lower triangle of a positive definite matrix, and the matrix."""
    generator = torch.Generator().manual_seed(seed)
    places = sorted({(i, i) for i in range(size)} | {(max(p) % size, min(p) % size) for p in pairs})
    places = sorted({(max(p), min(p)) for p in places})
    rows, columns = torch.tensor(places).T
    blocks = torch.randn(len(places), dim, dim, dtype=torch.float64, generator=generator)
    equal = rows == columns
    blocks[equal] = blocks[equal] + blocks[equal].mT
    dense = torch.zeros(size, dim, size, dim, dtype=torch.float64)
    for i, j, block in zip(rows.tolist(), columns.tolist(), blocks, strict=True):
        dense[i, :, j] = block
        dense[j, :, i] = block.T
    shift = (1 + dense.view(size * dim, -1).abs().sum(1).max()) * torch.eye(dim, dtype=torch.float64)
    blocks[equal] += shift
    for i in range(size):
        dense[i, :, i] += shift
    return rows, columns, blocks, dense.view(size * dim, -1), torch.randn(size, dim, generator=generator).double()
