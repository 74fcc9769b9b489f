"""Marks of the tests of envs/."""

import pytest


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: minutes on two cores; left out of the default run")
