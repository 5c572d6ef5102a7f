"""The tests of a file run in one process, which makes the file's fixtures and caches once."""

import os

import pytest


@pytest.mark.skipif("PYTEST_XDIST_WORKER" not in os.environ, reason="only if tests run in several processes")
def test_the_file_is_the_group(request: pytest.FixtureRequest) -> None:
    """Fails where pytest-xdist and pytest do not fit together: groups are then ignored without a word."""
    assert request.node.nodeid.endswith(f"@{request.node.path}")
