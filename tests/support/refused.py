"""What is refused: by the kind of error, and the data that it names. Never by its sentence."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tumortrack.core.wording import for_caller


@contextmanager
def refused(kind: type[Exception], *data: object) -> Iterator[pytest.ExceptionInfo[BaseException]]:
    """An error of this kind that names each of ``data``: a file, a row, a key; a number whole; an
    option of the command line (``--unit m``) as its caller reads it (``unit="m"``)."""
    with pytest.raises(kind) as raised:
        yield raised
    said = str(raised.value)
    for one in data:
        whole = (
            rf"(?<![\d.]){one}(?!\.?\d)"
            if isinstance(one, int)
            else re.escape(for_caller(str(one)))
        )
        assert re.search(whole, said), f"{one!r} is not in {said!r}"
