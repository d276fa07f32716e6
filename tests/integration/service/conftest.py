"""One service for all tests that need no settings of their own."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest
from redis import Redis
from service_process import Hand, Service, run_service

from refine_client import RefineClient


@pytest.fixture(scope="session")
def shared_service(redis_url: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with run_service(redis_url, tmp_path_factory.mktemp("service"), {"grpc_reflection": "true"}) as service:
        yield service


@pytest.fixture
def service(shared_service: Service, redis: Redis) -> Service:
    """The service on an empty database."""
    return shared_service


@pytest.fixture
def hand(service: Service, redis: Redis) -> Hand:
    return Hand(redis, service.data_folder)


@pytest.fixture
def rest(service: Service) -> Iterator[httpx.Client]:
    with service.rest() as client:
        yield client


@pytest.fixture(params=["rest", "grpc"])
def client(service: Service, request: pytest.FixtureRequest) -> Iterator[RefineClient]:
    with service.client(request.param) as client:
        yield client
