"""When a call is tried again: numbers by hand, at both ends of what is drawn at random."""

from __future__ import annotations

import pytest

from refine_client.retry import Retries, RetryPolicy
from refine_proto.errors import Busy, QueueFull

POLICY = RetryPolicy(retries=4, first_delay_s=0.5, longest_delay_s=2.0, longest_retry_after_s=60.0)


@pytest.fixture(params=[0.0, 1.0], ids=["least", "most"])
def draw(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> float:
    """What random.random() gives."""
    share: float = request.param
    monkeypatch.setattr("random.uniform", lambda low, high: low + share * (high - low))
    return share


def test_delays_double_up_to_the_longest_and_then_the_error_is_raised(draw: float) -> None:
    retries, error = Retries(POLICY), Busy("busy")
    spread = 0.5 + 0.5 * draw
    assert [retries.delay_s(error) for _ in range(4)] == [delay * spread for delay in (0.5, 1.0, 2.0, 2.0)]
    with pytest.raises(Busy) as raised:
        retries.delay_s(error)
    assert raised.value is error
    retries.reset()
    assert retries.delay_s(error) == 0.5 * spread


@pytest.mark.parametrize("wanted", [0.0, 7.0, 60.0])
def test_a_servers_wish_is_obeyed_and_callers_are_spread(draw: float, wanted: float) -> None:
    retries = Retries(POLICY)
    for _ in range(4):
        assert retries.delay_s(QueueFull("full", retry_after_s=wanted)) == wanted + 0.25 * draw


def test_a_wish_that_is_too_long_is_raised_at_once() -> None:
    error = QueueFull("full", retry_after_s=60.5)
    with pytest.raises(QueueFull) as raised:
        Retries(POLICY).delay_s(error)
    assert raised.value is error


def test_no_retries_are_none() -> None:
    with pytest.raises(Busy):
        Retries(RetryPolicy(retries=0)).delay_s(Busy("busy"))
