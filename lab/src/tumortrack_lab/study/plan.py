"""What the study measures: every number that decides a figure, and the jobs that follow."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal, TypeVar, get_args

from tumortrack.core.config import Config
from tumortrack_lab.study.bound import BOUNDS
from tumortrack_lab.study.cases import StudyCase
from tumortrack_lab.study.measure import CLEAN_VIEW, Job, by_method
from tumortrack_lab.study.methods import Method, Network
from tumortrack_lab.study.models import CLINIC, UNREFINED
from tumortrack_lab.study.resection import Cutting, Truth

VARIANTS = ("D0", "D1", "D2", "D3", "Rot90", "Rot180", "Rot270", "G1", "P1")
VIEWS = ("clean", "noise", "shaft", "clutter")
FAULTS = (
    "clean", "noise", "distortion", "offset", "occlusion", "outliers", "registration", "all"
)  # fmt: skip
SEVERITIES = (
    "noise=0.5", "noise=1", "noise=2", "noise=4",
    "visible=80", "visible=60", "visible=40",
    "outliers=1", "outliers=3", "outliers=10", "outliers=20",
    "points=500", "points=1000", "points=2000",
    "offset=1", "offset=2", "offset=4",
    "distance=80", "distance=120", "distance=160", "distance=200", "distance=250", "distance=300",
    "tilt=15", "tilt=30", "tilt=45",
)  # fmt: skip
_HIDDEN = "visible=60"  # the severity of the goals: 40 % of the visible surface is hidden
_ABLATION = (
    CLINIC, f"{CLINIC}{UNREFINED}", "clinic_clean", "clinic_drags", "clinic_pointnet",
    "quick_elastic", "M_lim",
)  # fmt: skip
Section = Literal[
    "accuracy", "goals", "ablation", "deformation", "peers", "faults", "views", "severity",
    "resection",
]  # fmt: skip
SECTIONS: tuple[Section, ...] = get_args(Section)
T = TypeVar("T")


class StudyPlan(Config, frozen=True):
    """What is measured. Severities are measured beside the clean scene, which is the end of most
    curves. None: the same as the phantom's."""

    name: str
    # In accuracy, peers and views: M_lim, M_full, clinic
    models: tuple[str, ...] = ("M_lim", "M_full", CLINIC)
    steps: int = 12_000  # Of training M_lim and M_full
    clinic_steps: int = 6_000  # Of training clinic (the preset's)
    # Of training in the deformation study (as many as --steps)
    configuration_steps: int | None = None
    seeds: tuple[int, ...] = (0, 1, 2)  # Of training
    case_seeds: tuple[int, ...] | None = None  # Of training for --case (the same as the phantom's)
    # Of training in the deformation study (the same as the phantom's)
    configuration_seeds: tuple[int, ...] | None = None
    variants: tuple[str, ...] = VARIANTS  # Of every table that names no others
    view: str = "noise"  # Of every table but those of faults and views
    grid: int = 400  # Voxels along the longest side, in the table of accuracy
    case_grid: int | None = None  # The same for --case (as for the phantom)
    coarse_grid: int = 160  # The same in every other table
    configurations: tuple[int, ...] = (1, 2, 3, 4, 5, 6)  # Rows of the paper's deformation table
    configuration_variants: tuple[str, ...] = ("D0", "D1", "D2", "D3")  # In the deformation study
    configuration_view: str = "noise"  # In the deformation study
    peers: tuple[str, ...] = ("rigid_bound", "rigid", "cpd", "elastic")  # Methods beside the models
    case_peers: tuple[str, ...] | None = None  # Peers for --case (as for the phantom)
    faults: tuple[str, ...] = FAULTS  # Error sources
    fault_seeds: tuple[int, ...] = (0, 1, 2)  # Of the random part of each fault
    fault_models: tuple[str, ...] = ("M_lim", CLINIC)  # Models in the table of faults
    fault_peers: tuple[str, ...] = ("elastic",)  # Peers in the table of faults
    fault_variants: tuple[str, ...] = ("D1", "D2", "D3", "G1", "P1")  # In the table of faults
    views: tuple[str, ...] = VIEWS  # In the table of views
    # Faults and their levels, such as visible=60 (those of the plan)
    severities: tuple[str, ...] = SEVERITIES
    severity_seeds: tuple[int, ...] = (0, 1, 2)  # Of the random part of each severity
    severity_variants: tuple[str, ...] = ("D2", "G1")  # In the severities
    severity_models: tuple[str, ...] = ("M_lim", CLINIC)  # Models beside the severities' peers
    severity_peers: tuple[str, ...] = ("rigid",)  # Peers in the severities
    goal_models: tuple[str, ...] = ("M_lim", CLINIC)  # Models in the table of goals
    goal_peers: tuple[str, ...] = ("elastic",)  # Peers in the table of goals
    # Models whose estimates are planned on and cut, beside the truth
    resection_models: tuple[str, ...] = ("M_lim", CLINIC)
    ablation_models: tuple[str, ...] = _ABLATION  # Rows of the ablation
    # Cases of the ablation, of those that are given
    ablation_cases: tuple[str, ...] = ("phantom", "case_00000")
    # Training scenes of each model in the ablation, whatever its batches
    ablation_scenes: int = 32_000
    ablation_seeds: tuple[int, ...] = (0, 1, 2)  # Of training in the ablation
    ablation_views: tuple[str, ...] = ("noise", "shaft")  # Views in the ablation
    ablation_variants: tuple[str, ...] = ("D1", "D2", "D3", "G1", "P1")  # In the ablation


FULL = StudyPlan(name="full")
QUICK = StudyPlan(
    name="quick",
    steps=800,
    clinic_steps=200,
    seeds=(0,),
    variants=("D0", "D2", "G1"),
    grid=96,
    coarse_grid=96,
    configurations=(1, 3),
    configuration_variants=("D1", "D3"),
    peers=("rigid_bound", "rigid", "elastic"),
    faults=("clean", "noise", "offset", "all"),
    fault_seeds=(0,),
    fault_variants=("D2", "G1"),
    views=("clean", "noise", "clutter"),
    severities=("noise=2", "visible=60", "points=500", "tilt=30"),
    severity_seeds=(0,),
    ablation_models=(CLINIC, f"{CLINIC}{UNREFINED}", "quick_elastic"),
    ablation_scenes=3_200,
    ablation_seeds=(0,),
    ablation_variants=("D2", "G1"),
)


@dataclass(frozen=True)
class Methods:
    """Where methods come from: trained models, those of the ablation, peers (and bounds) made
    ready for a patient."""

    model: Callable[[StudyCase, str, int], Network]
    peer: Callable[[str, StudyCase], Method]
    ablated: Callable[[StudyCase, str, int], Network]


Made = Callable[[Methods], Iterable[Method]]  # making methods trains


@dataclass(frozen=True)
class _Block:
    """Every method on every scene under every fault (with the seed of its random part)."""

    methods: Made
    variants: tuple[str, ...]
    views: tuple[str, ...]
    grid: int
    faults: tuple[tuple[str, int], ...] = (("none", 0),)

    def jobs(self, case: StudyCase, methods: Methods) -> Iterator[Job]:
        made = list(self.methods(methods))
        for method, view, fault, variant in product(made, self.views, self.faults, self.variants):
            yield Job(case, method, variant, view, self.grid, *fault)


def jobs_of(
    plan: StudyPlan, section: Section, cases: tuple[StudyCase, ...], methods: Methods
) -> list[Job]:
    """The jobs of one section, grouped by method. Models that are not trained yet are trained.

    ``cases``: for ``deformation`` the second phantom; for faults, views and severities, which have
    the first seed alone, the paper's phantom; for all others every case.
    """
    return by_method(
        job
        for case in cases
        for block in _Blocks(plan, case).of(section)
        for job in block.jobs(case, methods)
    )


def scenes_of(
    plan: StudyPlan, section: Section, case: StudyCase
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Variants and views that a section needs; the clean view always, for it says what is
    visible."""
    blocks = _Blocks(plan, case).of(section)
    variants = dict.fromkeys(variant for block in blocks for variant in block.variants)
    views = dict.fromkeys(view for block in blocks for view in block.views)
    return tuple(variants), tuple(dict.fromkeys((CLEAN_VIEW, *views)))


class _Blocks:
    """The blocks of each section, by its name."""

    def __init__(self, plan: StudyPlan, case: StudyCase) -> None:
        self._plan, self._case = plan, case
        self._seeds = self._for_case(plan.seeds, plan.case_seeds)

    def of(self, section: Section) -> list[_Block]:
        blocks: list[_Block] = getattr(self, section)()
        return blocks

    def accuracy(self) -> list[_Block]:
        grid = self._for_case(self._plan.grid, self._plan.case_grid)
        return [self._usual(self._made(self._plan.models), grid)]

    def goals(self) -> list[_Block]:
        """Hidden surface is for methods that have to find the organ: bounds see no cloud."""
        models, peers = self._plan.goal_models, self._plan.goal_peers
        hidden = self._disturbed(self._made(models, peers), (_HIDDEN,))
        return [self._usual(self._made(models, (*peers, *BOUNDS))), hidden]

    def ablation(self) -> list[_Block]:
        plan, case = self._plan, self._case
        if case.name not in plan.ablation_cases:
            return []
        models = list(product(plan.ablation_models, plan.ablation_seeds))
        made: Made = lambda methods: [methods.ablated(case, *model) for model in models]  # noqa: E731
        return [_Block(made, plan.ablation_variants, plan.ablation_views, plan.coarse_grid)]

    def deformation(self) -> list[_Block]:
        plan = self._plan
        names = [f"configuration_{number}" for number in plan.configurations]
        seeds = plan.seeds if plan.configuration_seeds is None else plan.configuration_seeds
        views = (plan.configuration_view,)
        made = self._made(names, seeds=seeds)
        return [_Block(made, plan.configuration_variants, views, plan.coarse_grid)]

    def peers(self) -> list[_Block]:
        peers = self._for_case(self._plan.peers, self._plan.case_peers)
        return [self._usual(self._made(self._plan.models, peers))]

    def faults(self) -> list[_Block]:
        plan = self._plan
        draws = [(f, s) for f in plan.faults for s in (plan.fault_seeds if f != "clean" else (0,))]
        made = self._one_seed(plan.fault_models, plan.fault_peers)
        return [_Block(made, plan.fault_variants, (CLEAN_VIEW,), plan.coarse_grid, tuple(draws))]

    def views(self) -> list[_Block]:
        plan = self._plan
        return [_Block(self._one_seed(plan.models), plan.variants, plan.views, plan.coarse_grid)]

    def severity(self) -> list[_Block]:
        made = self._one_seed(self._plan.severity_models, self._plan.severity_peers)
        return [self._disturbed(made, self._plan.severities)]

    def resection(self) -> list[_Block]:
        located_by = self._one_seed(self._plan.resection_models)
        return [self._usual(lambda methods: map(Cutting, [*located_by(methods), Truth()]))]

    def _for_case(self, ours: T, theirs: T | None) -> T:
        return ours if self._case.is_paper or theirs is None else theirs

    def _usual(self, methods: Made, grid: int | None = None) -> _Block:
        plan = self._plan
        return _Block(methods, plan.variants, (plan.view,), grid or plan.coarse_grid)

    def _disturbed(self, methods: Made, severities: Sequence[str]) -> _Block:
        plan = self._plan
        draws = (("clean", 0), *product(severities, plan.severity_seeds))
        return _Block(methods, plan.severity_variants, (CLEAN_VIEW,), plan.coarse_grid, draws)

    def _one_seed(self, models: Sequence[str], peers: Sequence[str] = ()) -> Made:
        known = [name for name in peers if name in self._plan.peers]
        return self._made(models, known, self._seeds[:1])

    def _made(
        self,
        models: Sequence[str],
        peers: Sequence[str] = (),
        seeds: Sequence[int] | None = None,
    ) -> Made:
        case, every = self._case, list(product(models, self._seeds if seeds is None else seeds))
        return lambda methods: [
            *(methods.model(case, *model) for model in every),
            *(methods.peer(name, case) for name in peers),
        ]
