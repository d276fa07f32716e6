"""Products with a sparse matrix that does not change: sums over neighbours, patches, interpolation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class Bags:
    """The entries of a sparse matrix, row after row: row i begins at `offsets[i]`."""

    columns: Tensor  # (N,) int64
    offsets: Tensor  # (R,) int64
    values: Tensor | None  # (N,), None: all entries are 1

    @staticmethod
    def of(rows: Tensor, columns: Tensor, row_count: int, values: Tensor | None) -> Bags:
        order = rows.argsort(stable=True)
        count = torch.bincount(rows, minlength=row_count)
        return Bags(columns[order], count.cumsum(0) - count, None if values is None else values[order])

    def __matmul__(self, x: Tensor) -> Tensor:
        return F.embedding_bag(
            self.columns, x.contiguous(), self.offsets, mode="sum", per_sample_weights=self.values
        )


@dataclass(frozen=True)
class SparseMatrix:
    """A (R, C), constant; `A @ x` of a dense x (C, K) is (R, K), differentiable in x.

    The gradient is the product with the transposed matrix, which is stored too: always a gather by rows,
    never a scatter, so the same bits every time.
    """

    rows: Bags
    transposed: Bags

    @staticmethod
    def of(
        rows: Tensor, columns: Tensor, shape: tuple[int, int], values: Tensor | None = None
    ) -> SparseMatrix:
        """From the place of each entry, (N,) int64, in any order; entries at the same place add up."""
        return SparseMatrix(
            Bags.of(rows, columns, shape[0], values), Bags.of(columns, rows, shape[1], values)
        )

    def __matmul__(self, x: Tensor) -> Tensor:
        result: Tensor = _Product.apply(x, self)
        return result


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx: object, x: Tensor, matrix: SparseMatrix) -> Tensor:
        ctx.matrix = matrix  # type: ignore[attr-defined]
        return matrix.rows @ x

    @staticmethod
    def backward(ctx: object, *grads: Tensor) -> tuple[Tensor, None]:
        matrix: SparseMatrix = ctx.matrix  # type: ignore[attr-defined]
        return matrix.transposed @ grads[0], None
