"""Tools that touch or hold the organ, and outlines that are drawn: what they add to each frame."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, ClassVar

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import Cut, Evidence
from tumortrack.live.values import CameraView, SinkContext

if TYPE_CHECKING:
    from collections.abc import Iterator

_MOST_NOTES = 20  # of a tool: beyond that only numbers in them are new


class Tool:
    """An open tool. The loop's thread asks it with each frame, so it must not wait for anything.
    ``trouble``: what is wrong with it now, in words; ``counts``: of its pieces, for the report."""

    trouble = ""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()

    @abstractmethod
    def evidence(self, view: CameraView) -> Sequence[Evidence]:
        """What became known with a view, in its camera's frame. Raises InputError: it cannot be
        used."""

    def touched(self) -> None:
        """The user says that it touches now; of one that holds, that it takes or lets go."""

    def located(self, view: CameraView, estimate: Estimate) -> None:
        """Where the organ was found in that view."""

    def close(self) -> None:
        """Release everything."""


class ToolConfig(Config, frozen=True, kw_only=True, tag_field="kind"):
    """Base of configurations of tools; as ``live.values.SourceConfig``."""

    target: ClassVar[str] = ""

    @abstractmethod
    def open(self, context: SinkContext, name: str) -> Tool:
        """``name``: of the tool, which its evidence bears. Raises InputError if it can never
        work."""


class Tools:
    """All tools of a run, by name. None can keep a frame from its result: what is wrong is said
    once, in ``notes``. Raises InputError: one can never work."""

    def __init__(
        self, configs: Mapping[str, ToolConfig], context: SinkContext, notes: list[str]
    ) -> None:
        self._context, self._notes, self._given = context, notes, list[Evidence]()
        self._tools, self._told = dict[str, Tool](), dict[str, list[str]]()
        with ExitStack() as opened:
            for name, config in configs.items():
                try:
                    self._check("")
                    self._tools[name] = config.open(context, name)
                except InputError as error:
                    raise InputError(f"tool {name}: {error}") from error
                opened.callback(self._tools[name].close)
            self.close = opened.pop_all().close

    def evidence(self, view: CameraView) -> tuple[Evidence, ...]:
        """What became known with a view, in its camera's frame."""
        self._given = []
        self._give("of the source", view.seen.evidence)
        touched = self._context.controls.touched
        while touched:
            if (tool := self._tools.get(name := touched.popleft())) is not None:
                with self._guarded(name):
                    tool.touched()
        for name, tool in self._tools.items():
            with self._guarded(name):
                self._give(name, tool.evidence(view))
                self._say(name, tool.trouble)
        return tuple(self._given)

    def located(self, view: CameraView, estimate: Estimate) -> None:
        """The estimate of that view."""
        given = [piece for piece in self._given if not isinstance(piece, Cut)]  # those it tells of
        told = estimate.report.evidence[-len(given) :] if given else ()
        for piece, said in zip(given, told, strict=False):
            if said.rejected and piece.tool in self._tools:
                self._tools[piece.tool].counts["rejected"] += 1
        for name, tool in self._tools.items():
            with self._guarded(name):
                tool.located(view, estimate)

    def summary(self) -> dict[str, Any]:
        """Of each tool its counts and what was wrong (JSON types)."""
        told = self._told
        return {n: {**+t.counts, "trouble": told.get(n, [])} for n, t in self._tools.items()}

    def _check(self, part: str) -> None:
        if self._context.anatomy_ct is None:
            raise InputError("it needs a model that knows a motion: give the case itself.")
        if part and part not in (parts := self._context.touchable):
            raise InputError(f"there is no part {part!r}; this organ has {', '.join(parts)}.")

    def _give(self, name: str, pieces: Sequence[Evidence]) -> None:
        for piece in pieces:
            with self._guarded(name):
                self._check(getattr(piece, "part", ""))
                self._given.append(piece)

    @contextmanager
    def _guarded(self, name: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # a tool of another package raises anything
            known = isinstance(error, InputError)
            self._say(name, str(error) if known else f"{type(error).__name__}: {error}")

    def _say(self, name: str, trouble: str) -> None:
        told = self._told.setdefault(name, [])
        if trouble and trouble not in told and len(told) < _MOST_NOTES:
            told.append(trouble)
            self._notes.append(f"tool {name}: {trouble.rstrip('.')}")
