from __future__ import annotations

import copy
import pickle
from collections.abc import Iterable, Iterator
from inspect import signature
from typing import Any, get_type_hints

import pytest

from greenhouse_gym.errors import GreenhouseError, MissingDependencyError, UnknownNameError


def kinds(base: type[GreenhouseError] = GreenhouseError) -> Iterator[type[GreenhouseError]]:
    yield base
    for kind in base.__subclasses__():
        yield from kinds(kind)


def example(kind: type[GreenhouseError]) -> GreenhouseError:
    """An error of a kind, its constructor's parameters filled by their types."""
    if "__init__" not in vars(kind):
        return kind("what is wrong")
    values: dict[Any, Any] = {str: "text", object: "thing", Iterable[str]: ("a", "b"), OSError: OSError(28, "No space")}
    hints = get_type_hints(kind.__init__)
    return kind(*(values[hints[name]] for name in list(signature(kind.__init__).parameters)[1:]))


@pytest.mark.parametrize("kind", list(kinds()), ids=lambda kind: kind.__name__)
def test_every_error_survives_a_pickle_and_a_copy(kind: type[GreenhouseError]) -> None:
    error = example(kind)
    for again in (pickle.loads(pickle.dumps(error)), copy.copy(error), copy.deepcopy(error)):
        assert type(again) is kind
        assert str(again) == str(error)
        assert again.args == error.args
        assert vars(again) == vars(error)


def test_restored_errors_keep_what_their_bases_know() -> None:
    again = pickle.loads(pickle.dumps(MissingDependencyError("cv2", "reconstruct")))
    assert isinstance(again, ImportError)
    assert again.msg == "cv2 is not installed: pip install 'greenhouse-gym[reconstruct]'"
    assert pickle.loads(pickle.dumps(UnknownNameError("arm", "ur", ["ur5e"]))).choices == ("ur5e",)
