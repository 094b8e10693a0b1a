"""What is refused: by the kind of error, and the data that it names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def refused(kind: type[Exception], *data: object) -> Iterator[None]:
    """An error of this kind that names each of ``data``: a file, a row, a key, a number."""
    with pytest.raises(kind) as raised:
        yield
    for one in data:
        assert str(one) in str(raised.value)
