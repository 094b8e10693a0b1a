"""The pieces that can be planned, and for each the ways to cut it: what the arms choose from."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import manifold3d
import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.mesh_query import contains
from tumortrack.core.organ import organ_name
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import ORGAN, Mesh
from tumortrack_resection.facets import (
    TOOLS,
    UP,
    FacetSearch,
    Piece,
    Tools,
    Vector,
    inside,
    keep_mm,
    sphere,
)
from tumortrack_resection.outline import published_cuts
from tumortrack_resection.strokes import (
    Facet,
    Sections,
    Stroke,
    cup_direction,
    grasp_point,
    trimmed,
)
from tumortrack_resection.values import (
    NO_ROOM,
    UNGUARDED,
    Cut,
    Located,
    ResectionConfig,
    ResectionPlan,
    label_of,
    name_of,
)

_LOOSE_MM3 = 500.0  # what may come off beside the piece
_CLEAR_MM = 5.0  # of the electrode stay outside the organ: its grip must not touch it
_IN_THE_WAY_MM = 40.0  # of depth that a direction out of the arms' way is worth
_LESS_ROOM = (0.5, 0.2)  # shares of the margin that other tumors keep where there is no room
_TOGETHER = 2.0  # tumors come away together if that takes less than so many times the tissue
# z of where an electrode comes from: below, stand and table are in its arm's way. The more drafts
# the arms did not manage, the less is tried.
_LOWEST = (-0.5, -0.5, -0.2, -0.2, -0.2, 0.0)
_MOST_WAYS = 8  # to cut a facet
_MOST_PIECES, _MOST_SEARCHES = 8, 6  # that are looked at, each without what was to blame before
_EVERY, _SHELL_MM = 8, 1.5  # points of healthy tissue, and of the tumor's surface, for its shell
_DIRECTIONS, _MOST = 192, 12_000  # of the hull, points it is made of: off by 0.5 mm
_FEWEST = 30  # points that define a tumor's shape


class _Unfit(NamedTuple):
    """Why a piece can't be planned; ``normals``: to blame; ``tool``: a longer electrode would
    do."""

    message: str
    normals: tuple[int, ...] = ()
    tool: bool = False


@dataclass(frozen=True, eq=False)
class Draft:
    """A piece, and for each sweep the ways to cut it, the best first. ``taken``: labels of the
    tumors that come away. ``share``: of the tumor outside the organ's hull. ``piece``: None: the
    paper's method has none. ``keep_mm``: what the electrode keeps away from beside these.
    ``solid``: what comes away, closed. ``healthy``, ``kerf``: shares of the parenchyma that come
    away with it, and that the electrode's width takes. ``through``: sweeps that are no more
    needed."""

    located: Located
    config: ResectionConfig
    label: int
    taken: tuple[int, ...]
    share: float
    piece: Piece | None
    sweeps: tuple[tuple[Cut, ...], ...]
    grasp_mm: Vector
    lift: Vector
    keep_mm: Mapping[str, float]
    solid: Mesh
    healthy: float
    kerf: float
    notes: tuple[str, ...] = ()
    through: Collection[int] = ()

    @property
    def lost(self) -> float:
        return self.healthy + self.kerf

    @property
    def level(self) -> bool:
        """A way needs several directions of a level instrument, which the arms choose."""
        return self.piece is None

    @property
    def keep(self) -> dict[str, tuple[Mesh, float]]:
        """Surfaces, with the distances that the electrode keeps from them whatever it does."""
        kept = {} if self.level else {name_of(n): self.config.margin_mm for n in self.taken}
        surfaces = self.located.surfaces
        return {name: (surfaces[name], mm) for name, mm in {**kept, **self.keep_mm}.items()}

    def plan(self, cuts: tuple[Cut, ...] = ()) -> ResectionPlan:
        """With these ways; by default each sweep's best, as far as geometry goes."""
        cuts = cuts or tuple(choices[0] for choices in self.sweeps)
        located, config = self.located, self.config
        tumors_ml = {n: located.meshes[name_of(n)].volume_ml for n in located.tumors}
        parenchyma_ml = located.parenchyma_ml
        healthy_ml = parenchyma_ml * self.healthy
        volumes_ml = {
            "organ": located.organ.volume_ml, "parenchyma": parenchyma_ml,
            "tumor": tumors_ml[self.label], "healthy": healthy_ml,
            "piece": healthy_ml + sum(tumors_ml[n] for n in self.taken),
        }  # fmt: skip
        if not self.level:
            volumes_ml["kerf"] = parenchyma_ml * self.kerf
        facets = np.zeros((0, 4)) if self.piece is None else self.piece.planes
        return ResectionPlan(
            method=config.method, tumor=name_of(self.label), label=self.label,
            grasp_mm=self.grasp_mm, cuts=cuts, piece=self.solid, facets=facets,
            taken=tuple(map(name_of, self.taken)), keep_mm=dict(self.keep_mm), lift=self.lift,
            margin_mm=config.margin_mm, volumes_ml=volumes_ml, exophytic=self.share,
            stamp_ns=located.stamp_ns, notes=self.notes,
        )  # fmt: skip


class Drafts:
    """The pieces that can be planned for one tumor, the best first; others once one or the other
    facet is left out. ``like``: an earlier plan, whose facets are kept, and with them what comes
    away and what they keep away from. ``done``: the cup holds its piece, and so many facets are
    cut: these lie in the gap between the piece and the rest, as others do that the organ no
    longer reaches."""

    def __init__(
        self, located: Located, config: ResectionConfig, tools: Tools,
        like: ResectionPlan | None = None, done: int | None = None,
    ) -> None:  # fmt: skip
        self._label, self._share = chosen_tumor(located, config)
        self._done, self._held = done or 0, None if done is None else like
        _check_kept(located, config, name_of(self._label))
        self._located, self._config, self._tools, self._like = located, config, tools, like
        self._solid = solid_of(located.organ, "the organ's surface")
        self._sections = Sections(self._solid)
        self._searches: dict[tuple[tuple[int, ...], float], FacetSearch] = {}
        self._left_out: list[int] = []
        self._failures = 0
        self._last: Piece | None = None
        self._best: Draft | None = None
        self._over = False

    def best(self) -> Draft:
        """Raises InputError: no such tumor; NoPlan: there is none any more."""
        if self._over:
            raise NoPlan("the facets of the earlier plan can be cut from no direction.")
        if self._best is None:
            self._best = self._published() if self._config.method == "published" else self._found()
        return self._best

    def _found(self) -> Draft:
        reasons: list[_Unfit] = []
        taken = () if self._like is None else tuple(map(label_of, self._like.taken))
        alone = taken or (self._label,)
        near = [
            n for n in self._located.tumors
            if n not in alone and name_of(n) not in self._config.keep_away
        ]  # fmt: skip
        found = self._first([(alone, 1.0)], reasons)
        if found is None and near and self._like is None:
            found = self._first([(alone, room) for room in _LESS_ROOM], reasons)
            together = [*((self._label, n) for n in near), (self._label, *near)]
            both = self._first([(targets, 1.0) for targets in together], reasons)
            if both and (found is None or both[1].lost <= _TOGETHER * found[1].lost):
                found = both
        if found is None:
            raise NoPlan(self._why_not(reasons))
        self._last = found[0]
        return found[1]

    @property
    def _lowest(self) -> float:
        return _LOWEST[min(self._failures, len(_LOWEST) - 1)]

    def leave_out(self, sweeps: Sequence[int]) -> None:
        """The facets of these sweeps of the last draft can't be cut; nor can those like them."""
        assert self._last is not None
        self._best, before = None, self._lowest
        if self._like is not None:  # these facets are wanted: only from where they are cut changes
            higher = [n for n, lowest in enumerate(_LOWEST) if lowest > before]
            self._over, self._failures = not higher, min(higher, default=0)
            return
        self._failures += 1
        if self._lowest != before:  # from there another facet may be possible
            self._left_out = []
            return
        self._left_out += [self._last.chosen[sweep - 1] for sweep in sweeps]

    def _first(
        self, ways: Sequence[tuple[tuple[int, ...], float]], reasons: list[_Unfit]
    ) -> tuple[Piece, Draft] | None:
        """The best piece round these tumors, where others keep this share of the margin; of the
        first way for which there is one."""
        for targets, room in ways:
            search = self._searches.get((targets, room))
            if search is None:
                keep = keep_mm(self._located, targets, self._config, room)
                normals = None
                if self._like is not None:
                    keep, normals = self._like.keep_mm, self._like.facets[:, :3]
                search = FacetSearch(
                    self._located, targets, keep, self._config, self._tools, normals
                )
                self._searches[targets, room] = search
            left_out = list(self._left_out)
            for _ in range(_MOST_SEARCHES):
                bad: set[int] = set()
                for piece in search.pieces(left_out, self._lowest)[:_MOST_PIECES]:
                    draft = self._draft(search, piece, targets, room)
                    if isinstance(draft, Draft):
                        return draft.piece or piece, draft
                    reasons.append(draft)
                    bad |= set(draft.normals)
                if not bad or self._like is not None:
                    break
                left_out += bad
        return None

    def _draft(
        self, search: FacetSearch, piece: Piece, targets: tuple[int, ...], room: float
    ) -> Draft | _Unfit:
        located, config, tools = self._located, self._config, self._tools
        facets = [Facet(self._sections, piece.planes, n) for n in range(1, len(piece.planes) + 1)]
        full = [facet for facet in facets if facet.number > self._done and not facet.empty]
        if not full and not self._done:
            return _Unfit("the organ does not reach the tumor's margin; there is nothing to cut.")
        if swallowed := sorted({*piece.with_it} - {*targets}):
            return _Unfit(f"{name_of(swallowed[0])} would come away, too.")
        if piece.healthy > config.most_healthy:
            return _Unfit(
                f"{piece.healthy:.0%} of the organ's healthy tissue would come away; allowed are "
                f"{config.most_healthy:.0%}. Ask for a smaller margin, or allow more."
            )
        if len(full) < len(facets) and self._held is None:
            if self._like is not None:
                return _Unfit("the organ no longer reaches all facets of the earlier plan.")
            kept = [facet.number - 1 for facet in full]
            piece = replace(piece, planes=piece.planes[kept],
                            chosen=tuple(piece.chosen[n] for n in kept))  # fmt: skip
            return self._draft(search, piece, targets, room)
        lift = self._held.lift if self._held else cup_direction(piece.planes)
        if lift is None:
            return _Unfit("the cup can't be held so that it lifts the piece out.")
        through = {facet.number for facet in facets} - {facet.number for facet in full}
        sweeps = self._sweeps(facets, piece, lift, through)
        if isinstance(sweeps, _Unfit):
            return sweeps
        grasp_mm = self._grasp(piece, lift)
        if grasp_mm is None:
            return _Unfit("there is no place on the piece on which the cup can come down.")
        rest = self._solid - trimmed(self._solid, piece.planes, -tools.radius_mm)
        loose_mm3 = sum(sorted(part.volume() for part in rest.decompose())[:-1])
        if loose_mm3 > _LOOSE_MM3:
            return _Unfit(f"{loose_mm3 / 1000:.0f} ml beside the piece would come off, too.")
        solid = mesh_of(trimmed(self._solid, piece.planes, tools.radius_mm))
        healthy = located.points_of(ORGAN)
        inner = float(inside(piece.planes, healthy, tools.radius_mm).mean())
        outer = float(inside(piece.planes, healthy, -tools.radius_mm).mean())
        return Draft(
            located=located, config=config, label=self._label, taken=targets, share=self._share,
            piece=piece, sweeps=sweeps, grasp_mm=grasp_mm,
            lift=lift, keep_mm=search.keep_mm,
            solid=solid, healthy=inner, kerf=outer - inner,
            notes=(*self._notes(targets, room, search), *_unguarded(located, config)),
            through=through,
        )  # fmt: skip

    def _grasp(self, piece: Piece, lift: Vector) -> Vector | None:
        if self._held is not None:
            return self._held.grasp_mm
        return grasp_point(self._located, self._label, piece, self._tools, lift)

    def _sweeps(
        self, facets: Sequence[Facet], piece: Piece, lift: Vector, through: Collection[int]
    ) -> tuple[tuple[Cut, ...], ...] | _Unfit:
        """For each facet the ways to cut it, the best first; of those that are ``through``, how
        it was done."""
        sweeps: list[tuple[Cut, ...]] = []
        room_mm = self._tools.electrode_mm - _CLEAR_MM
        for facet, normal in zip(facets, piece.chosen, strict=True):
            if facet.number in through:
                assert self._held is not None
                sweeps.append(tuple(c for c in self._held.cuts if c.sweep == facet.number))
                continue
            strokes = [
                facet.stroke(back, self._config)
                for back in facet.directions(self._lowest)[:_MOST_WAYS]
            ]
            strokes.sort(key=lambda stroke: _effort(stroke, lift))
            fit = tuple(stroke.cut for stroke in strokes if stroke.depth_mm <= room_mm)
            if not strokes:
                return _Unfit("the instrument would have to come from below.", (normal,))
            if not fit:
                return _Unfit(
                    f"the cut would be {min(stroke.depth_mm for stroke in strokes):.0f} mm deep; "
                    f"the bare electrode of {self._tools.electrode_mm:g} mm allows {room_mm:g} mm "
                    "(electrode_mm in the cell).",
                    (normal,),
                    tool=True,
                )
            sweeps.append(fit)
        return tuple(sweeps)

    def _notes(self, targets: tuple[int, ...], room: float, search: FacetSearch) -> tuple[str, ...]:
        located, name, margin_mm = self._located, name_of(self._label), self._config.margin_mm
        notes = [f"{name_of(n)} comes away with {name}." for n in targets[1:]]
        if room < 1:
            least = ", ".join(
                f"{mm:g} mm from {other}" for other, mm in search.keep_mm.items()
                if other not in self._config.keep_away
            )  # fmt: skip
            notes.append(f"{NO_ROOM} {margin_mm:g} mm from other tumors; kept are {least}.")
        healthy = located.points_of(ORGAN)[::_EVERY]
        surface = cKDTree(located.meshes[name].spread_mm(_SHELL_MM))
        shell = float((surface.query(healthy)[0] < margin_mm).mean())
        notes.append(
            f"a shell of {margin_mm:g} mm alone, which no straight electrode can cut, would be "
            f"{shell * located.parenchyma_ml:.1f} ml of healthy tissue."
        )
        return tuple(notes)

    def _why_not(self, reasons: list[_Unfit]) -> str:
        for reason in reasons:
            if reason.tool:
                return reason.message
        located, name, tools = self._located, name_of(self._label), self._tools
        tumor = cKDTree(located.meshes[name].spread_mm(1.0))
        surfaces, tight = located.surfaces, []
        for other, mm in keep_mm(located, (self._label,), self._config, 1.0).items():
            points = surfaces[other].spread_mm(1.0)
            gaps = tumor.query(points)[0]
            needed_mm = self._config.margin_mm + 2 * tools.radius_mm + mm
            if gaps.min() < needed_mm:
                tight.append((float(gaps.min()), other, points[gaps.argmin()]))
        if tight:
            gap_mm, other, (x, y, z) = min(tight, key=lambda near: near[:2])
            return (
                f"{other} lies {gap_mm:.1f} mm from {name}, at x {x:.0f}, y {y:.0f}, z {z:.0f} mm "
                f"(table): an electrode {2 * tools.radius_mm:g} mm thick has no way between them "
                f"that keeps {self._config.margin_mm:g} mm from {name}. Ask for a smaller margin, "
                f"for less distance (--keep-away {other}=0.5), or plan the other one."
            )
        if reasons:
            return reasons[0].message
        return (
            f"no piece with up to {self._config.most_facets} plane facets round {name} can be cut "
            "and lifted out. Place the organ otherwise, or ask for a smaller margin."
        )

    def _published(self) -> Draft:
        """The paper's: the piece, two sweeps, and where to hold (its section II-D)."""
        located, label = self._located, self._label
        cuts, ring, low_mm, grasp_mm = published_cuts(located, label, self._config)
        area = manifold3d.CrossSection([ring], manifold3d.FillRule.NonZero)
        high_mm = float(located.organ.box_mm[1, 2]) + 1.0
        prism = area.extrude(high_mm - low_mm).translate((0.0, 0.0, low_mm))
        piece = mesh_of(self._solid ^ prism)
        healthy = contains(piece, located.points_of(ORGAN)).mean()
        if healthy > self._config.most_healthy:
            raise NoPlan(
                f"{healthy:.0%} of the organ's healthy tissue would come away; allowed are "
                f"{self._config.most_healthy:.0%}. Ask for a smaller margin, or allow more."
            )
        return Draft(
            located=located, config=self._config, label=label, taken=(label,), share=self._share,
            piece=None, sweeps=tuple((cut,) for cut in cuts),
            grasp_mm=grasp_mm, lift=UP, keep_mm=self._config.keep_away, solid=piece,
            healthy=float(healthy), kerf=0.0,
            notes=_unguarded(located, self._config),
        )  # fmt: skip


def _effort(stroke: Stroke, lift: Vector) -> float:
    """Depth, mm; an instrument beside the grasper, or from below, is in the arms' way."""
    assert stroke.cut.axis is not None
    back = -stroke.cut.axis
    return stroke.depth_mm + _IN_THE_WAY_MM * float(max(back @ lift, 0) + max(-back[2], 0))


def _check_kept(located: Located, config: ResectionConfig, tumor: str) -> None:
    """InputError: something to keep away from was not located, or is the tumor itself."""
    if tumor in config.keep_away:
        raise InputError(
            f"--keep-away {tumor}: that is the tumor to be cut out; its distance is --margin."
        )
    known = [*located.structures, *map(name_of, located.tumors)]
    if lacking := sorted(config.keep_away.keys() - set(known)):
        raise InputError(
            f"--keep-away {lacking[0]}: there is no such structure or tumor in this estimate. It "
            f"has: {', '.join(known) or 'none'}."
        )


def _unguarded(located: Located, config: ResectionConfig) -> tuple[str, ...]:
    """A note on structures without a distance to keep."""
    others = [name for name in located.structures if name not in config.keep_away]
    return (f"{UNGUARDED} {', '.join(others)}.",) if others else ()


def plan_resection(
    located: Located, config: ResectionConfig, tools: Tools = TOOLS
) -> ResectionPlan:
    """A plan by itself, as far as geometry goes; the arms may want another
    (``arms.procedure.plan_motions``). Raises InputError: no such tumor; NoPlan: nothing to cut, or
    not as asked."""
    return Drafts(located, config, tools).best().plan()


def chosen_tumor(located: Located, config: ResectionConfig) -> tuple[int, float]:
    """Label of the tumor to cut out, and its share outside the organ's hull."""
    if len(located.points_of(ORGAN)) < _FEWEST:
        raise NoPlan("no organ was located, so nothing can be planned. Locate it first.")
    if not located.tumors:
        raise NoPlan("no tumor was located, so there is nothing to cut out.")
    names = {name_of(label): label for label in located.tumors}
    if config.tumor and config.tumor not in names:
        raise InputError(f"there is no {config.tumor!r}; located were {', '.join(names)}.")
    candidates = [names[config.tumor]] if config.tumor else list(names.values())
    shares = exophytic_shares(located, candidates)
    label = max(shares, key=lambda tumor: shares[tumor])
    name, n = name_of(label), len(located.points_of(label))
    if n < _FEWEST:
        raise NoPlan(f"{name} has only {n} points; {_FEWEST} are needed. Locate with more points.")
    if shares[label] < config.least_exophytic:
        inside = f"{name} lies" if len(candidates) == 1 else "all tumors lie"
        raise NoPlan(
            f"{inside} wholly inside the organ ({shares[label]:.0%} outside its hull, "
            f"{config.least_exophytic:.0%} are needed; least_exophytic in --config allows less)."
        )
    needed = (organ_name(located.meshes), *names)
    if lacking := [part for part in needed if part not in located.meshes]:
        raise NoPlan(
            f"{lacking[0] or 'the organ'} has no surface to keep a margin from. Locate it again."
        )
    return label, shares[label]


def exophytic_shares(located: Located, labels: list[int]) -> dict[int, float]:
    """How much of each tumor lies outside the convex hull of the organ without tumors, which
    needs only the farthest point in each of many directions."""
    organ = located.points_of(ORGAN)
    organ = organ[:: 1 + len(organ) // _MOST]
    farthest = (sphere(_DIRECTIONS).astype(np.float32) @ organ.T.astype(np.float32)).argmax(axis=1)
    try:
        hull = ConvexHull(organ[np.unique(farthest)].astype(np.float64))
    except QhullError as error:
        raise NoPlan("the organ's points lie in a plane; locate it again.") from error
    normals, offsets = np.split(hull.equations.astype(np.float32), [3], axis=1)
    shares = {}
    for label in labels:
        points = located.points_of(label).astype(np.float32)
        outside = (normals @ points.T + offsets).max(axis=0) > 0
        shares[label] = float(outside.mean()) if len(points) else 0.0
    return shares
