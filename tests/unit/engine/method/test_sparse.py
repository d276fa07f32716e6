"""Products with a constant sparse matrix against the dense product."""

import pytest
import torch
from torch import Tensor

from refine_engine.method.sparse import SparseMatrix

ROWS = torch.tensor([3, 0, 3, 1, 3, 0])
COLUMNS = torch.tensor([0, 2, 4, 2, 0, 0])  # (3, 0) twice; row 2 and columns 1 and 3 are empty
VALUES = torch.tensor([0.5, -1.0, 2.0, 3.0, 0.25, 4.0], dtype=torch.float64)


def dense(values: Tensor) -> Tensor:
    return torch.zeros(4, 5, dtype=torch.float64).index_put_((ROWS, COLUMNS), values, accumulate=True)


@pytest.mark.parametrize("values", [None, VALUES])
def test_product_and_gradient(values: Tensor | None) -> None:
    matrix = SparseMatrix.of(ROWS, COLUMNS, (4, 5), values)
    x = torch.randn(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)
    expected = dense(torch.ones_like(VALUES) if values is None else values) @ x
    torch.testing.assert_close(matrix @ x, expected)
    assert torch.autograd.gradcheck(lambda factor: matrix @ factor, x)


def test_a_factor_that_is_not_contiguous() -> None:
    matrix = SparseMatrix.of(ROWS, COLUMNS, (4, 5), VALUES)
    x = torch.randn(3, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64).T
    torch.testing.assert_close(matrix @ x, dense(VALUES) @ x)


def test_no_entries() -> None:
    nothing = torch.zeros(0, dtype=torch.int64)
    assert (SparseMatrix.of(nothing, nothing, (2, 3)) @ torch.ones(3, 4)).tolist() == [[0.0] * 4] * 2
